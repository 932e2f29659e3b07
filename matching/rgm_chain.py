"""Algorithm 1 of the paper: a Markov chain over sets of active source objects (section 3.4, Eq. 16-19)."""

from __future__ import annotations

from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numba import njit
from numpy.typing import NDArray

from .checks import check_count, check_interval
from .objective import Terms, value
from .objective_state import State, add, best_exchange, best_reassignment, empty_state, load_match, remove
from .pose import Array
from .rgm_problem import Problem

ACCEPTANCES = ("paper", "metropolis")


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
        if self.proposals is not None:
            check_count("proposals", self.proposals, 0)
        check_interval("start_temperature", self.start_temperature, "(0, inf)")
        check_interval("end_temperature", self.end_temperature, f"(0, {self.start_temperature}]")
        check_interval("add_probability", self.add_probability, "(0, 1)")
        check_interval("proposal_width", self.proposal_width, "(0, inf]")

    def temperatures(self, n: int) -> Array:
        """T at each proposal."""
        count = round(200 * max(1.0, n / 15)) if self.proposals is None else self.proposals
        return np.geomspace(self.start_temperature, self.end_temperature, count)


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
    best state of all chains. Each chain gets an equal share of the proposals and a random stream of its own.
    """
    total = len(annealing.temperatures(len(problem.support)))
    job = replace(annealing, proposals=-(-total // workers))
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
