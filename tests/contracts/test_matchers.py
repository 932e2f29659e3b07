"""Every built-in matcher keeps the contract, on one shared list of problems."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from covis.matching import METHODS, Hypothesis, Matching, ObjectGraph, PriorRequiredError, RelativePose
from covis.matching.testing import check_matcher, check_well_formed, degenerate_problems, scene

NEEDS_PRIOR = {"hungarian"}
STOCHASTIC = {"rgm", "rgm-no-uncertainty", "rgm-no-covisibility"}
ACCEPT_ANY_SIZE = {"bayes", "hungarian", "reid"}
USES_PLACE_OF_ROBOT = {"bayes"}
"""Methods for which moving the objects without the robot is another problem: depth errors point along the rays."""

# Least F1 on the easy scenes. The hypergraph methods see angles only and match every object of the smaller view.
LEAST_F1 = {"rrwhm": 0.3, "bcagm": 0.3, "reid": 0.4}
EVERY = sorted(METHODS)


@pytest.mark.parametrize("name", EVERY)
def test_contract(name):
    check_matcher(
        METHODS[name],
        invariant=name not in STOCHASTIC,
        needs_prior=name in NEEDS_PRIOR,
        min_f1=LEAST_F1.get(name, 0.6),
    )


@pytest.mark.parametrize("name", EVERY)
def test_rigid_motion_of_one_view_changes_nothing(name):
    problem = scene(np.random.default_rng(5))
    T = np.eye(4)
    # The headings that `icp` starts from are 15 degrees apart: turned by a multiple of that, they are the same ones.
    T[:3, :3] = Rotation.from_euler("z", np.radians(7 * 15) if name == "icp" else 2.0).as_matrix()
    if name not in USES_PLACE_OF_ROBOT:
        T[:3, 3] = [4.0, 7.0, -1.0]
    target = problem.target
    moved = ObjectGraph.from_positions(
        target.positions @ T[:3, :3].T + T[:3, 3],
        attributes=target.attributes,
        position_variance=target.position_variance,
        attribute_variance=target.attribute_variance,
        up=target.up,
    )
    prior = problem.prior if name in NEEDS_PRIOR else None
    moved_prior = prior and RelativePose(prior.T_source_target @ np.linalg.inv(T), prior.covariance)
    before = METHODS[name](problem.source, problem.target, prior=prior, rng=np.random.default_rng(1))
    after = METHODS[name](problem.source, moved, prior=moved_prior, rng=np.random.default_rng(1))
    assert len(before) > 0
    assert as_set(before) == as_set(after)


EVERY_TRIANGLE = {"neighbours_factor": 1e6}


@pytest.mark.parametrize(
    ("name", "options", "least"),
    [
        *((name, {}, 1.0) for name in sorted(set(EVERY) - STOCHASTIC - {"bcagm", "rrwhm", "mos", "icp"})),
        # Neighbours are kept of every source triangle, not of every target triangle: symmetric only if all are kept.
        *((name, EVERY_TRIANGLE, 1.0) for name in ("bcagm", "rrwhm", "mos")),
        *((name, {}, 0.6) for name in ("bcagm", "rrwhm", "mos")),
        # Targets are drawn to their closest sources, not the other way round.
        ("icp", {}, 0.8),
        ("icp", {"translations": "centroids"}, 1.0),
    ],
)
def test_exchanging_the_robots_exchanges_the_matches(name, options, least):
    """`rgm`, which is random, hardly changes: see its own tests."""
    for seed in range(6, 10):
        overlap = {"source_only": 0, "target_only": 0} if "translations" in options else {}
        problem = scene(np.random.default_rng(seed), **overlap)
        prior = problem.prior if name in NEEDS_PRIOR else None
        back = None if prior is None else prior.inverse()
        there = METHODS[name](problem.source, problem.target, prior=prior, **options)
        again = METHODS[name](problem.target, problem.source, prior=back, **options)
        one, other = as_set(there), {(b, a) for a, b in as_set(again)}
        assert one
        assert len(one & other) >= least * max(len(one), len(other))


def as_set(matching):
    return {(int(a), int(b)) for a, b in matching.pairs}


def test_the_list_of_problems_covers_what_it_promises():
    names = [p.name for p in degenerate_problems()]
    assert len(names) == len(set(names)) >= 20
    for word in (
        "empty",
        "one",
        "two",
        "collinear",
        "coincident",
        "identical",
        "mirror",
        "nothing",
        "zero",
        "infinite",
    ):
        assert any(word in name for name in names), word


def in_order(source, target, *, prior=None, rng=None):
    """A well-behaved matcher that knows nothing."""
    k = min(len(source), len(target))
    return Matching(np.stack([np.arange(k), np.arange(k)], axis=1), np.ones(k))


def test_check_matcher_accepts_what_keeps_the_contract():
    check_matcher(in_order, min_f1=None, invariant=False)


def without_prior(source, target, rng=None):
    return in_order(source, target)


def gives_none(source, target, **_):
    return None


def gives_list(source, target, **_):
    return in_order(source, target).pairs.tolist()


def beyond(source, target, **_):
    return Matching(np.array([[0, 99]]), np.ones(1)) if min(len(source), len(target)) else Matching.empty()


def out_of_bounds_scores(source, target, **_):
    k = min(len(source), len(target))
    return Matching(in_order(source, target).pairs, np.full(k, 1.5))


def fails_on_few(source, target, **_):
    if min(len(source), len(target)) == 1:
        raise IndexError("index 1 is out of bounds")
    return in_order(source, target)


def centres_its_input(source, target, **_):
    target.attributes[:] = 1.0
    return in_order(source, target)


def overwrites_the_prior(source, target, *, prior=None, rng=None):
    if prior is not None:
        prior.covariance[:] = 0.0
    return in_order(source, target)


def seeds_everything(source, target, **_):
    np.random.seed(0)  # noqa: NPY002
    return in_order(source, target)


def fickle(source, target, **_):
    k = min(len(source), len(target))
    return Matching(np.stack([np.arange(k), np.random.default_rng().permutation(k)], axis=1), np.ones(k))


def fickle_without_a_stream(source, target, *, prior=None, rng=None):
    return fickle(source, target) if rng is None else in_order(source, target)


def needs_poses(source, target, *, prior=None, rng=None):
    if prior is None:
        raise PriorRequiredError("needs a prior")
    return in_order(source, target)


def improbable_hypothesis(source, target, **_):
    found = in_order(source, target)
    pose = RelativePose(np.eye(4), np.eye(6))
    return replace(found, hypotheses=(Hypothesis(pose, 1.7, found.pairs, found.scores),))


@pytest.mark.parametrize(
    ("matcher", "complaint"),
    [
        (without_prior, r"takes \(source, target, \*, prior=None, rng=None, .* unexpected keyword argument 'prior'"),
        ("bayes", "a matcher is callable, got 'bayes'"),
        (gives_none, "returns a Matching, got NoneType"),
        (gives_list, "returns a Matching, got list"),
        (beyond, r"one and one: a match of no object, \[\[0, 99\]\]"),
        (out_of_bounds_scores, r"the matcher raised ValueError: scores must lie in \[0, 1\]"),
        (fails_on_few, "one and one: the matcher raised IndexError: index 1 is out of bounds"),
        (centres_its_input, "the matcher changed its input, target.attributes"),
        (overwrites_the_prior, "the matcher changed its input, prior.covariance"),
        (seeds_everything, "uses NumPy's global random stream"),
        (fickle, "the same rng gives different matches"),
        (fickle_without_a_stream, "no rng gives different matches"),
        (needs_poses, "checked with needs_prior=True"),
        (improbable_hypothesis, "a hypothesis has probability 1.7"),
        (in_order, "another order of objects gives other matches"),
        (lambda s, t, **_: Matching.empty(), "F1 on easy scenes is 0.00, expected at least 0.5"),
    ],
)
def test_check_matcher_finds_what_is_wrong(matcher, complaint):
    with pytest.raises(AssertionError, match=complaint):
        check_matcher(matcher)


def test_check_matcher_asks_for_a_refusal_without_prior():
    check_matcher(needs_poses, needs_prior=True, min_f1=None, invariant=False)
    with pytest.raises(AssertionError, match="must raise PriorRequiredError without one"):
        check_matcher(in_order, needs_prior=True, min_f1=None, invariant=False)


@pytest.mark.parametrize("name", EVERY)
def test_two_hundred_objects_are_matched_or_refused_with_the_numbers(name):
    """Without their sizes' check these would take gigabytes, or hours."""
    problem = scene(np.random.default_rng(0), common=140, source_only=60, target_only=60)
    prior = problem.prior if name in NEEDS_PRIOR else None
    if name in ACCEPT_ANY_SIZE:
        check_well_formed(METHODS[name](problem.source, problem.target, prior=prior), problem.source, problem.target)
    else:
        with pytest.raises(ValueError, match=r"accepts at most \d+ .*200"):
            METHODS[name](problem.source, problem.target, prior=prior)


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (lambda g: ((np.eye(3), g), {}), "source must be an ObjectGraph, got ndarray; ObjectGraph.from_positions"),
        (lambda g: ((g, None), {}), "target must be an ObjectGraph, got NoneType"),
        (lambda g: ((g, g), {"prior": np.eye(4)}), "prior must be a RelativePose or None, got ndarray"),
    ],
)
@pytest.mark.parametrize("name", EVERY)
def test_what_is_no_graph_or_pose_is_refused_by_name(name, arguments, complaint):
    positional, named = arguments(ObjectGraph.from_positions(np.eye(3)))
    with pytest.raises(TypeError, match=complaint):
        METHODS[name](*positional, **named)


def test_well_formed_accepts_the_empty_matching():
    graph = ObjectGraph.from_positions(np.zeros((0, 3)))
    check_well_formed(Matching.empty(), graph, graph)
