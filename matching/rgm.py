"""Regularised graph matching: the paper's method (Eq. 15), solved by its Algorithm 1 (section 3.4).

A Markov chain walks over sets y of active source objects. Each set is scored by the objective of the best matching
pi(y) that matches all of them; adding an object prefers certain ones, Eq. (18); moves are accepted by Eq. (19) while a
temperature falls. The best set seen is returned.

Where the text does not determine a method that works, this file chooses, and says so by an option:

* Eq. (3) is summed over matched corners; `nine_terms=True` sums over all nine as printed.
* Distances and angles are blind to reflections; `reject_mirrored=True` gives T = 0 to triangles that turn opposite
  ways seen from above (needs `up` in both graphs).
* Terms of Eq. (15) grow like m, m^2 and m^3; `scaling="mean"` gives all of them the size of the count penalty, and
  ||X||^2 is m^2 (`count_penalty`): see `covis.matching.objective.coefficients`. `scaling="sum"` is as printed.
* (V + U) adds m^2 to squared probabilities: each is divided by its own unit, by default six medians in the pair,
  so that lambda_1 weighs a relative uncertainty: 0.1 costs a typical candidate .01, one of five times the variances
  .28. Units of 1 are as printed.
* gamma and sigma stand for seven different widths; each is a parameter here, with its unit.
* exp() of Eq. (16) overflows: the chain works with log P.
* Eq. (18) is normalised over the objects that can be added.
* Algorithm 1 compares the acceptance ratio with an undefined epsilon and accepts rises of P only: `acceptance="paper"`
  does that with a uniform draw for epsilon; the temperature then only counts. `"metropolis"` accepts by
  exp(change / temperature), as Suh 2015 does.
* pi(y) is NP-hard: it is approximated by a reweighted random walk computed once, read off greedily for the active
  objects, and local search (reassign, exchange) on the sums of Eq. (12). It is a function of y alone, so the chain has
  a stationary distribution.
"""

from __future__ import annotations

from functools import partial

import numpy as np
from numpy.typing import NDArray

from .checks import check_count
from .graph import Matching, ObjectGraph, check_comparable, generator
from .objective import Terms, coefficients
from .objective_state import empty_state, load_match
from .pose import Array, RelativePose
from .rgm_chain import Annealing, solve
from .rgm_problem import Similarity, build

MAX_OBJECTS = 64
"""Largest n or n' accepted: finding the nearest triangles takes O(n^6) operations, the pair affinity O(n^4) memory."""


def rgm(
    source: ObjectGraph,
    target: ObjectGraph,
    *,
    prior: RelativePose | None = None,
    rng: np.random.Generator | None = None,
    uncertainty_weight: float = 0.1,
    noncovisibility_weight: float = 0.4,
    acceptance: str = "paper",
    proposals: int | None = None,
    start_temperature: float = 3.0,
    end_temperature: float = 0.1,
    add_probability: float = 0.5,
    proposal_width: float = 2.0,
    scaling: str = "mean",
    count_penalty: str = "squared",
    distance_width_m2: float | None = None,
    distance_width_factor: float = 2.0,
    angle_width: float = 0.25,
    attribute_uncertainty_width: float | None = None,
    distance_uncertainty_width_m2: float | None = None,
    angle_uncertainty_width_m2: float | None = None,
    uncertainty_width_factor: float = 60.0,
    attribute_unit: float | None = None,
    position_unit_m2: float | None = None,
    neighbours: int | None = None,
    nine_terms: bool = False,
    reject_mirrored: bool = False,
    workers: int = 1,
) -> Matching:
    """Match two graphs by Eq. (15) and Algorithm 1.

    Args:
        source, target: the two robots' graphs, at most `MAX_OBJECTS` objects each.
        prior: not used; the method needs no poses.
        rng: random stream of the chain.
        uncertainty_weight: lambda_1. 0 is the ablation `rgm-no-uncertainty`.
        noncovisibility_weight: lambda_2. 0 is the ablation `rgm-no-covisibility`.
        acceptance, proposals, start_temperature, end_temperature, add_probability, proposal_width: see `Annealing`.
        scaling, count_penalty: see `covis.matching.objective.coefficients`.
        distance_width_m2, distance_width_factor, angle_width: see `Similarity`.
        neighbours, nine_terms, reject_mirrored: see `Similarity`.
        attribute_uncertainty_width, distance_uncertainty_width_m2, angle_uncertainty_width_m2: see `Similarity`.
        uncertainty_width_factor: see `Similarity`.
        attribute_unit, position_unit_m2: see `Similarity`. Give 1 for both to follow the text.
        workers: processes among which the proposals are divided (section 4.2).

    Returns:
        Matches, each with its mean weighted similarity as score: of its attributes, pairs and triples, in [0, 1].
        Objects of infinite variance are never matched.

    Raises:
        ValueError: a parameter out of range, more than `MAX_OBJECTS` objects, or different attribute classes.
    """
    check_comparable(source, target, prior)
    similarity = Similarity(
        distance_width_m2,
        distance_width_factor,
        angle_width,
        attribute_uncertainty_width,
        distance_uncertainty_width_m2,
        angle_uncertainty_width_m2,
        uncertainty_width_factor,
        attribute_unit,
        position_unit_m2,
        neighbours,
        nine_terms,
        reject_mirrored,
    )
    annealing = Annealing(proposals, start_temperature, end_temperature, acceptance, add_probability, proposal_width)
    check_count("workers", workers)
    for name, graph in (("source", source), ("target", target)):
        if len(graph) > MAX_OBJECTS:
            raise ValueError(f"rgm accepts at most {MAX_OBJECTS} objects a side, {name} has {len(graph)}")
    known_source, known_target = _known(source), _known(target)
    largest = min(len(known_source), len(known_target))
    table = coefficients(largest, uncertainty_weight, noncovisibility_weight, scaling, count_penalty)
    if largest == 0:
        return Matching.empty()
    problem = build(
        source.take(known_source),
        target.take(known_target),
        similarity,
        table,
        coefficients(largest, 0.0, 0.0, scaling, count_penalty),
        proposal_width,
    )
    match, log_p = solve(problem, annealing, generator(rng), workers)
    rows = np.flatnonzero(match >= 0)
    pairs = np.stack([known_source[rows], known_target[match[rows]]], axis=1)
    return Matching(pairs, scores(problem.terms, match)[rows], diagnostics={"log_p": log_p})


rgm_no_uncertainty = partial(rgm, uncertainty_weight=0.0)
"""The paper's ablation without the uncertainty regulariser (Table 1, lambda_1 = 0)."""

rgm_no_covisibility = partial(rgm, noncovisibility_weight=0.0)
"""The paper's ablation without the non-covisibility regulariser (Table 1, lambda_2 = 0)."""


def scores(terms: Terms, match: NDArray[np.int64]) -> Array:
    """(n,) mean weighted similarity of each match: its attributes, and its pairs and triples with the others."""
    n, m = terms.attribute.shape
    state = empty_state(n, m)
    load_match(terms, state, match)
    count = int(state.size[0])
    out = np.zeros(n)
    for i in np.flatnonzero(match >= 0):
        parts = [terms.attribute[i, match[i]]]
        if count > 1:
            parts.append(state.pair_gain[i, match[i]] / (2 * (count - 1)))
        if count > 2:
            parts.append(state.triple_gain[i, match[i]] / (3 * (count - 1) * (count - 2)))
        out[i] = np.mean(parts)
    return np.clip(out, 0.0, 1.0)


def _known(graph: ObjectGraph) -> NDArray[np.int64]:
    """Which objects have finite variances."""
    return np.flatnonzero(np.isfinite(graph.position_variance) & np.isfinite(graph.attribute_variance))
