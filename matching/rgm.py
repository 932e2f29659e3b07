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

from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from functools import lru_cache, partial

import numpy as np
from numba import njit
from numpy.typing import NDArray

from .graph import Matching, ObjectGraph, check_comparable, generator
from .objective import (
    State,
    Terms,
    add,
    best_exchange,
    best_reassignment,
    coefficients,
    empty_state,
    load_match,
    remove,
    value,
)
from .pose import Array, RelativePose
from .rrwm import reweighted_random_walk
from .similarity import attribute_similarity, distances, pair_affinity, triangle_radius, triangle_sides, vertex_cosines
from .uncertainty import certainty, kronecker_plus, typical

MAX_OBJECTS = 64
"""Largest n or n' accepted: finding the nearest triangles takes O(n^6) operations, the pair affinity O(n^4) memory."""

UNIT_MEDIANS = 6.0
"""Unit of V and of U in the uncertainty regulariser, in medians over the candidates."""

ACCEPTANCES = ("paper", "metropolis")


@dataclass(frozen=True)
class Similarity:
    """Widths and options of the similarities and their weights; None = from the pair's median variances.

    Attributes:
        distance_width_m2: gamma of Eq. (2), m^2. None: `distance_width_factor` times the median of U.
        distance_width_factor: see above.
        angle_width: gamma of Eq. (3), dimensionless (a sum of differences of cosines).
        attribute_uncertainty_width: sigma of Eq. (8), probability^2. None: `uncertainty_width_factor` medians of V.
        distance_uncertainty_width_m2: sigma of Eq. (10), m^2. None: `uncertainty_width_factor` medians of U.
        angle_uncertainty_width_m2: sigma of Eq. (11), m^2. None: `uncertainty_width_factor` medians of U.
        uncertainty_width_factor: see above.
        neighbours: k of section 3.4, nearest target triangles of each source triangle. None: n n'.
        nine_terms: Eq. (3) as printed.
        reject_mirrored: T = 0 for triangles that turn opposite ways seen from above.
    """

    distance_width_m2: float | None = None
    distance_width_factor: float = 2.0
    angle_width: float = 0.25
    attribute_uncertainty_width: float | None = None
    distance_uncertainty_width_m2: float | None = None
    angle_uncertainty_width_m2: float | None = None
    uncertainty_width_factor: float = 60.0
    neighbours: int | None = None
    nine_terms: bool = False
    reject_mirrored: bool = False


@dataclass(frozen=True)
class Annealing:
    """How the chain of Algorithm 1 runs.

    Attributes:
        proposals: number of proposals. None: 200, the paper's number at n = 15, and in proportion above that.
        start_temperature, end_temperature: T and T_f; the rate xi follows from them and `proposals`.
        acceptance: "paper" or "metropolis".
        add_probability: alpha of Eq. (18).
        proposal_width: gamma of Eq. (18), in units of the (relative) uncertainty v + u.
    """

    proposals: int | None = None
    start_temperature: float = 3.0
    end_temperature: float = 0.1
    acceptance: str = "paper"
    add_probability: float = 0.5
    proposal_width: float = 2.0

    def __post_init__(self) -> None:
        if self.acceptance not in ACCEPTANCES:
            raise ValueError(f"acceptance must be one of {ACCEPTANCES}, got {self.acceptance!r}")
        if self.proposals is not None and self.proposals < 0:
            raise ValueError(f"proposals must not be negative, got {self.proposals}")
        if not 0 < self.end_temperature <= self.start_temperature:
            raise ValueError(
                f"need 0 < end_temperature <= start_temperature, got {self.end_temperature}, {self.start_temperature}"
            )
        if not 0 < self.add_probability < 1:
            raise ValueError(f"add_probability must lie in (0, 1), got {self.add_probability}")
        if not self.proposal_width > 0:
            raise ValueError(f"proposal_width must be positive, got {self.proposal_width}")

    def temperatures(self, n: int) -> Array:
        """T at each proposal."""
        count = round(200 * max(1.0, n / 15)) if self.proposals is None else self.proposals
        return np.geomspace(self.start_temperature, self.end_temperature, count)


@dataclass(frozen=True)
class Problem:
    """Eq. (15) for one pair of graphs.

    Attributes:
        terms: similarities and weights.
        table: `coefficients` with both regularisers; `table_pi` without, for Eq. (17).
        support: (n, n') score of every candidate match by the reweighted random walk.
        proposal_weight: (n,) exp(-(v + u) / gamma) of Eq. (18).
    """

    terms: Terms
    table: Array
    table_pi: Array
    support: Array
    proposal_weight: Array


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
        attribute_unit: unit of v in the uncertainty regulariser, probability^2. None: `UNIT_MEDIANS` medians of V.
        position_unit_m2: unit of u there, m^2. None: `UNIT_MEDIANS` medians of U. Give 1 for both to follow the text.
        workers: processes among which the proposals are divided (section 4.2).

    Returns:
        Matches, each with its mean weighted similarity as score: of its attributes, pairs and triples, in [0, 1].
        Objects of infinite variance are never matched.

    Raises:
        ValueError: a parameter out of range, more than `MAX_OBJECTS` objects, or different attribute classes.
    """
    check_comparable(source, target)
    similarity = Similarity(
        distance_width_m2,
        distance_width_factor,
        angle_width,
        attribute_uncertainty_width,
        distance_uncertainty_width_m2,
        angle_uncertainty_width_m2,
        uncertainty_width_factor,
        neighbours,
        nine_terms,
        reject_mirrored,
    )
    annealing = Annealing(proposals, start_temperature, end_temperature, acceptance, add_probability, proposal_width)
    if workers < 1:
        raise ValueError(f"workers must be at least 1, got {workers}")
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
        attribute_unit,
        position_unit_m2,
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


def build(
    source: ObjectGraph,
    target: ObjectGraph,
    similarity: Similarity,
    table: Array,
    table_pi: Array,
    attribute_unit: float | None = None,
    position_unit_m2: float | None = None,
    proposal_width: float = 2.0,
) -> Problem:
    """The problem of two graphs whose variances are finite. Eq. (1)-(3), (7)-(11)."""
    V = kronecker_plus(source.attribute_variance, target.attribute_variance)  # Eq. (7)
    U = kronecker_plus(source.position_variance, target.position_variance)  # Eq. (9)
    source_distance, target_distance = distances(source.positions), distances(target.positions)
    # Graphs that claim no error at all still need a width: a thousandth of their extent.
    floor = 1e-6 * max(float((source_distance**2).mean()), float((target_distance**2).mean()), 1e-6)
    scale_U = max(typical(U), floor)
    scale_V = max(typical(V), 1e-6)
    width = similarity.distance_width_m2
    width = similarity.distance_width_factor * scale_U if width is None else width
    for name, number in (("distance_width_m2", width), ("angle_width", similarity.angle_width)):
        if not number > 0:
            raise ValueError(f"{name} must be positive, got {number}")
    w_a = certainty(
        V, _or(similarity.attribute_uncertainty_width, similarity.uncertainty_width_factor * scale_V)
    )  # Eq. (8)
    w_d = certainty(
        U, _or(similarity.distance_uncertainty_width_m2, similarity.uncertainty_width_factor * scale_U)
    )  # Eq. (10)
    w_t = certainty(
        U, _or(similarity.angle_uncertainty_width_m2, similarity.uncertainty_width_factor * scale_U)
    )  # Eq. (11)
    c, d = vertex_cosines(source.positions), vertex_cosines(target.positions)
    neighbours = len(source) * len(target) if similarity.neighbours is None else similarity.neighbours
    if neighbours < 1:
        raise ValueError(f"neighbours must be at least 1, got {neighbours}")
    attribute_unit, position_unit_m2 = (
        _or(attribute_unit, UNIT_MEDIANS * scale_V),
        _or(position_unit_m2, UNIT_MEDIANS * scale_U),
    )
    pair = pair_affinity(source_distance, target_distance, width)
    pair *= w_d[:, :, None, None]
    pair *= w_d[None, None]
    mirrored = similarity.reject_mirrored
    terms = Terms(
        attribute=attribute_similarity(source.attributes, target.attributes) * w_a,
        pair=pair,
        source_cosine=c,
        target_cosine=d,
        source_apex=np.ascontiguousarray(c.transpose(1, 2, 0)),
        target_apex=np.ascontiguousarray(d.transpose(1, 2, 0)),
        source_side=triangle_sides(source.positions, source.up if mirrored else None),
        target_side=triangle_sides(target.positions, target.up if mirrored else None),
        radius=triangle_radius(c, d, neighbours, similarity.nine_terms),
        angle_width=float(similarity.angle_width),
        angle_weight=w_t,
        nine_terms=similarity.nine_terms,
        penalty=(V / attribute_unit + U / position_unit_m2) ** 2,
    )
    uncertainty = source.attribute_variance / attribute_unit + source.position_variance / position_unit_m2
    return Problem(
        terms,
        table,
        table_pi,
        support(terms),
        np.exp(-(uncertainty - uncertainty.min()) / proposal_width),
    )


def support(terms: Terms) -> Array:
    """(n, n') how well candidate matches agree with each other in attributes and distances: a random walk's visits."""
    n, m = terms.attribute.shape
    affinity = terms.pair.reshape(n * m, n * m).copy()
    affinity.flat[:: n * m + 1] = terms.attribute.ravel()
    return reweighted_random_walk(affinity, n, m, iterations=30, sinkhorn_iterations=10)


def solve(
    problem: Problem, annealing: Annealing, rng: np.random.Generator, workers: int = 1
) -> tuple[NDArray[np.int64], float]:
    """The best matching (n,) found, -1 = none, and its log P; the proposals are shared among `workers` processes."""
    if workers == 1:
        return _solve_one(problem, annealing, rng)
    return parallel_chains(problem, annealing, rng, workers)


def parallel_chains(
    problem: Problem, annealing: Annealing, rng: np.random.Generator, workers: int
) -> tuple[NDArray[np.int64], float]:
    """Independent chains in processes, no communication until their results are combined (after Neiswanger 2013).

    The posterior here is over one discrete set rather than over data that can be divided, so the combination is the
    best state of all chains. Each chain gets an equal share of the proposals and starts from its own random set.
    """
    total = len(annealing.temperatures(len(problem.support)))
    share = -(-total // workers)
    job = Annealing(
        share,
        annealing.start_temperature,
        annealing.end_temperature,
        annealing.acceptance,
        annealing.add_probability,
        annealing.proposal_width,
    )
    try:
        results = list(_pool(workers).map(_solve_one, [problem] * workers, [job] * workers, rng.spawn(workers)))
    except BrokenProcessPool:
        # Not to be met again by the next call.
        _pool.cache_clear()
        raise
    return max(results, key=lambda result: result[1])


@lru_cache(maxsize=1)
def _pool(workers: int) -> ProcessPoolExecutor:
    """The processes of `parallel_chains`, kept from call to call: starting them costs more than a match."""
    return ProcessPoolExecutor(workers)


def _solve_one(problem: Problem, annealing: Annealing, rng: np.random.Generator) -> tuple[NDArray[np.int64], float]:
    temperatures = annealing.temperatures(len(problem.support))
    match, log_p, _ = run_chain(
        problem.terms,
        problem.table,
        problem.table_pi,
        candidate_order(problem),
        problem.proposal_weight,
        initial_active(problem.support),
        temperatures,
        annealing.acceptance == "metropolis",
        annealing.add_probability,
        rng.random((len(temperatures), 3)),
    )
    return match, float(log_p)


def candidate_order(problem: Problem) -> NDArray[np.int64]:
    """Candidates i * n' + i' in the order in which `assign` considers them.

    By falling support, but first the matching that local search finds with as many objects active as can be matched:
    the assignment of a subset is then mostly a part of it, and little is left to search.
    """
    m = problem.support.shape[1]
    order = np.argsort(-problem.support.ravel(), kind="stable")
    state = empty_state(*problem.support.shape)
    assign(problem.terms, problem.table_pi, state, initial_active(problem.support), order)
    rows = np.flatnonzero(state.match >= 0)
    first = rows * m + state.match[rows]
    first = first[np.argsort(-problem.support.ravel()[first], kind="stable")]
    return np.concatenate([first, order[~np.isin(order, first)]])


def initial_active(support: Array) -> NDArray[np.bool_]:
    """The chain starts with as many objects active as can be matched, the best supported ones."""
    n, m = support.shape
    active = np.zeros(n, dtype=np.bool_)
    active[np.argsort(-support.max(axis=1), kind="stable")[: min(n, m)]] = True
    return active


@njit(cache=True)
def run_chain(
    terms: Terms,
    table: Array,
    table_pi: Array,
    order: NDArray[np.int64],
    proposal_weight: Array,
    active: NDArray[np.bool_],
    temperatures: Array,
    metropolis: bool,
    add_probability: float,
    draws: Array,
) -> tuple[NDArray[np.int64], float, NDArray[np.int64]]:
    """Algorithm 1. Returns the best matching (n,), its log P, and the visited sets as bit masks (proposals,).

    `order` lists the candidate matches i * n' + i' by falling support; `draws` (proposals, 3) are uniform in [0, 1).
    """
    n, m = terms.attribute.shape
    state = empty_state(n, m)
    active = active.copy()
    assign(terms, table_pi, state, active, order)
    log_p = value(state.sums, state.size[0], table)
    best, best_log_p = state.match.copy(), log_p
    # pi(y) is a function of y: sets seen before are looked up.
    seen_key = np.zeros(4096, dtype=np.uint64)
    seen_value = np.full(4096, np.nan)
    visited = np.zeros(len(temperatures), dtype=np.int64)
    for step in range(len(temperatures)):
        i, log_ratio = propose(active, proposal_weight, add_probability, draws[step])
        if i >= 0:
            active[i] = not active[i]
            log_p_new = -np.inf
            if active.sum() <= m:
                key = set_key(active)
                slot = np.int64((key * np.uint64(0x9E3779B97F4A7C15)) >> np.uint64(52))
                if not np.isnan(seen_value[slot]) and seen_key[slot] == key:
                    log_p_new = seen_value[slot]
                else:
                    assign(terms, table_pi, state, active, order)
                    log_p_new = value(state.sums, state.size[0], table)
                    seen_key[slot], seen_value[slot] = key, log_p_new
                    if log_p_new > best_log_p:
                        best_log_p = log_p_new
                        best[:] = state.match
            change = log_p_new - log_p
            if metropolis:
                accepted = np.log(draws[step, 2]) < change / temperatures[step] + log_ratio
            else:  # lines 5-12 of Algorithm 1
                accepted = change > 0 and np.log(draws[step, 2]) < change + log_ratio
            if accepted:
                log_p = log_p_new
            else:
                active[i] = not active[i]
        visited[step] = set_key(active)
    return best, best_log_p, visited


@njit(cache=True)
def set_key(active: NDArray[np.bool_]) -> np.uint64:
    """The set as a bit mask; n <= 64."""
    key = np.uint64(0)
    for i in range(len(active)):
        if active[i]:
            key |= np.uint64(1) << np.uint64(i)
    return key


@njit(cache=True)
def propose(active: NDArray[np.bool_], weight: Array, add_probability: float, draw: Array) -> tuple[int, float]:
    """Object to switch and log q(back) - log q(there), Eq. (18) normalised; object -1 = no such move."""
    n = len(active)
    count = active.sum()
    inactive_weight = 0.0
    for i in range(n):
        if not active[i]:
            inactive_weight += weight[i]
    log_odds = np.log(add_probability) - np.log(1.0 - add_probability)
    if draw[0] < add_probability:
        if count == n:
            return -1, 0.0
        left = draw[1] * inactive_weight
        chosen = -1
        for i in range(n):
            if not active[i]:
                chosen = i
                left -= weight[i]
                if left < 0:
                    break
        return chosen, np.log(inactive_weight / weight[chosen]) - np.log(count + 1.0) - log_odds
    if count == 0:
        return -1, 0.0
    left_count = int(draw[1] * count)
    chosen = -1
    for i in range(n):
        if active[i]:
            chosen = i
            left_count -= 1
            if left_count < 0:
                break
    return chosen, np.log(weight[chosen] / (inactive_weight + weight[chosen])) + np.log(count * 1.0) + log_odds


@njit(cache=True)
def assign(terms: Terms, table_pi: Array, state: State, active: NDArray[np.bool_], order: NDArray[np.int64]) -> None:
    """pi(y), Eq. (17): change `state` to a matching of all active objects, at most n' of them.

    Greedy by support, then the best reassignment or exchange until none raises the sums of Eq. (12).
    """
    n, m = terms.attribute.shape
    match = np.full(n, -1)
    taken = np.zeros(m, dtype=np.bool_)
    left = active.sum()
    for candidate in order:
        i, ii = candidate // m, candidate % m
        if active[i] and match[i] < 0 and not taken[ii]:
            match[i] = ii
            taken[ii] = True
            left -= 1
            if left == 0:
                break
    load_match(terms, state, match)
    current = value(state.sums, state.size[0], table_pi)
    for _ in range(10 * n):
        moved, i, ii = best_reassignment(terms, state, table_pi, current + 1e-9)
        _, a, b = best_exchange(terms, state, table_pi, moved)
        if a >= 0:
            exchange(terms, state, a, b)
        elif i >= 0:
            remove(terms, state, i)
            add(terms, state, i, ii)
        else:
            break
        current = value(state.sums, state.size[0], table_pi)


@njit(cache=True)
def exchange(terms: Terms, state: State, i: int, j: int) -> None:
    """Let the matched source objects i and j exchange their targets."""
    ii, jj = state.match[i], state.match[j]
    remove(terms, state, i)
    remove(terms, state, j)
    add(terms, state, i, jj)
    add(terms, state, j, ii)


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
    return np.flatnonzero(np.isfinite(graph.position_variance) & np.isfinite(graph.attribute_variance))


def _or(given: float | None, default: float) -> float:
    return default if given is None else given
