"""Sizes and options that matchers refuse."""

import inspect

import numpy as np
import pytest

from covis.matching import METHODS, ObjectGraph, RelativePose, bcagm, clipper, icp, mos, rgm, rrwhm, rrwm


@pytest.mark.parametrize(("matcher", "n"), [(rrwm, 71), (clipper, 71), (rrwhm, 33), (mos, 33), (bcagm, 33), (icp, 33)])
def test_too_many_objects_are_refused_with_the_numbers(matcher, n):
    graph = ObjectGraph.from_positions(np.random.default_rng(0).normal(size=(n, 3)))
    with pytest.raises(ValueError, match=f"accepts at most .* candidate matches .* got {n} x {n}"):
        matcher(graph, graph)


def numeric_options():
    """Method and name of every option that takes a number."""
    for method, matcher in METHODS.items():
        for name, option in inspect.signature(matcher).parameters.items():
            if name not in ("source", "target", "prior", "rng") and not isinstance(option.default, bool | str):
                yield method, name


@pytest.mark.parametrize(("method", "option"), [*numeric_options()])
def test_an_option_that_is_no_sensible_number_is_named_with_its_value(method, option):
    graph = ObjectGraph.from_positions(np.random.default_rng(0).normal(size=(4, 3)))
    prior = RelativePose(np.eye(4), np.eye(6)) if method == "hungarian" else None
    for bad, written in ((np.nan, "nan"), (-1, "-1"), ("many", "'many'")):
        with pytest.raises(ValueError, match=f"^{option} must .*, got {written}$"):
            METHODS[method](graph, graph, prior=prior, **{option: bad})


@pytest.mark.parametrize(
    ("matcher", "options", "message"),
    [
        (rrwm, {"walk_weight": 1.5}, r"walk_weight must lie in \[0, 1\], got 1.5"),
        (rrwm, {"iterations": 0}, "iterations must be a whole number of at least 1, got 0"),
        (rrwm, {"iterations": 2.5}, "iterations must be a whole number of at least 1, got 2.5"),
        (rrwm, {"distance_width_m2": 0.0}, r"distance_width_m2 must lie in \(0, inf\), got 0"),
        (rrwm, {"distance_width_m2": np.inf}, r"distance_width_m2 must lie in \(0, inf\), got inf"),
        (rrwhm, {"neighbours_factor": 0.0}, r"neighbours_factor must lie in \(0, inf\), got 0"),
        (mos, {"order_weights": (0, 0, 0)}, r"order_weights must be three .* not all zero, got \(0, 0, 0\)"),
        (mos, {"order_weights": (1, 1)}, r"order_weights must be three .* got \(1, 1\)"),
        (clipper, {"min_similarity": 2.0}, r"min_similarity must lie in \[0, 1\], got 2"),
        (clipper, {"min_matches": 0}, "min_matches must be a whole number of at least 1, got 0"),
        (icp, {"restarts": 0}, "restarts must be a whole number of at least 1, got 0"),
        (icp, {"translations": "none"}, "translations must be 'centroids' or 'objects', got 'none'"),
        (icp, {"gate_shrink": 1.0}, r"gate_shrink must lie in \[0, 1\), got 1"),
        (rgm, {"end_temperature": 4.0}, r"end_temperature must lie in \(0, 3.0\], got 4"),
    ],
)
def test_limits_of_options_are_named(matcher, options, message):
    graph = ObjectGraph.from_positions(np.random.default_rng(0).normal(size=(4, 3)))
    with pytest.raises(ValueError, match=message):
        matcher(graph, graph, **options)
