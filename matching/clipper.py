"""CLIPPER (Lusk, Fathian and How 2021): the densest clique of mutually consistent candidate matches.

Two candidates are consistent if the distances they relate differ by less than `epsilon_m`, more so the smaller the
difference. The densest clique is relaxed to max u^T M_d u over unit u >= 0, where M_d penalises inconsistent pairs by
d; d grows (a homotopy) until the constraints hold, and u is rounded to its largest entries.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from .candidates import MAX_CANDIDATES, check_size, distance_variance_m2
from .checks import check_count, check_interval
from .graph import Matching, ObjectGraph, check_comparable
from .pose import Array, RelativePose
from .similarity import attribute_similarity, distances


def clipper(
    source: ObjectGraph,
    target: ObjectGraph,
    *,
    prior: RelativePose | None = None,
    rng: np.random.Generator | None = None,
    sigma_m: float | None = None,
    epsilon_m: float | None = None,
    sigma_factor: float = 1.0,
    epsilon_sigmas: float = 6.0,
    min_similarity: float = 0.5,
    min_distance_m: float = 0.0,
    min_matches: int = 1,
) -> Matching:
    """Match by the densest clique of the consistency graph over all candidates.

    The published defaults for metric point clouds are sigma 0.01 m, epsilon 0.06 m. They belong to a sensor, so here
    sigma follows the reported variances, and epsilon keeps the published ratio of 6 sigma.

    Args:
        source, target: the two robots' graphs, n n' <= `MAX_CANDIDATES`.
        prior, rng: not used.
        sigma_m: width of the consistency score exp(-difference^2 / (2 sigma^2)), m. None: `sigma_factor` times the
            root of the median variance of a candidate.
        epsilon_m: largest difference of consistent distances, m. None: `epsilon_sigmas` times sigma.
        sigma_factor, epsilon_sigmas: see above.
        min_similarity: candidates of lower attribute similarity, Eq. (1), are left out.
        min_distance_m: pairs of objects closer than this in either view are never consistent (the authors' mindist).
        min_matches: smaller cliques are returned as no match at all.

    Returns:
        The clique, made one-to-one by construction; a match's score is its mean consistency with the others.

    Raises:
        ValueError: a parameter out of range, too many candidates, different attribute classes.
    """
    check_comparable(source, target, prior)
    check_size("clipper", source, target, MAX_CANDIDATES)
    check_interval("min_similarity", min_similarity, "[0, 1]")
    check_interval("sigma_factor", sigma_factor, "(0, inf)")
    check_interval("epsilon_sigmas", epsilon_sigmas, "(0, inf)")
    check_interval("min_distance_m", min_distance_m, "[0, inf)")
    check_count("min_matches", min_matches)
    if len(source) == 0 or len(target) == 0:
        return Matching.empty()
    s, t = distances(source.positions), distances(target.positions)
    if sigma_m is None:
        sigma_m = sigma_factor * float(np.sqrt(distance_variance_m2(source, target, s, t)))
    check_interval("sigma_m", sigma_m, "(0, inf)")
    epsilon_m = epsilon_sigmas * sigma_m if epsilon_m is None else epsilon_m
    check_interval("epsilon_m", epsilon_m, "(0, inf)")
    A = attribute_similarity(source.attributes, target.attributes)
    candidates = np.argwhere(min_similarity <= A)
    if len(candidates) == 0:
        return Matching.empty()
    M = consistency(s, t, candidates, sigma_m, epsilon_m, min_distance_m)
    chosen = densest_clique(M)
    if len(chosen) < min_matches:
        return Matching.empty()
    among = M[np.ix_(chosen, chosen)]
    others = max(len(chosen) - 1, 1)
    scores = among.sum(axis=1) - 1 if len(chosen) > 1 else np.zeros(1)
    return Matching(candidates[chosen], np.clip(scores / others, 0.0, 1.0))


@njit(cache=True)
def consistency(
    s: Array, t: Array, candidates: NDArray[np.int64], sigma_m: float, epsilon_m: float, min_distance_m: float
) -> Array:
    """M (k, k) of k candidates: 1 on the diagonal, 0 where inconsistent or sharing an object."""
    k = len(candidates)
    M = np.zeros((k, k))
    for a in range(k):
        M[a, a] = 1.0
        i, ii = candidates[a, 0], candidates[a, 1]
        for b in range(a):
            j, jj = candidates[b, 0], candidates[b, 1]
            if i == j or ii == jj or s[i, j] < min_distance_m or t[ii, jj] < min_distance_m:
                continue
            difference = abs(s[i, j] - t[ii, jj])
            if difference < epsilon_m:
                M[a, b] = M[b, a] = np.exp(-0.5 * difference * difference / (sigma_m * sigma_m))
    return M


@njit(cache=True)
def densest_clique(
    M: Array,
    tolerance_u: float = 1e-8,
    tolerance_f: float = 1e-9,
    epsilon: float = 1e-9,
    inner_iterations: int = 200,
    outer_iterations: int = 1000,
    backtracking: float = 0.25,
    backtracking_steps: int = 99,
) -> NDArray[np.int64]:
    """Indices of the densest clique of M (k, k), by projected gradient ascent with the published parameters.

    The ascent starts from one power step on the vector of ones. The penalty d starts at, and grows by, the mean of what
    would bring each violated entry of the gradient to zero, as in the authors' code since its release of 2022.
    """
    C = (M > 0).astype(np.float64)
    u = M.sum(axis=1)
    u /= np.sqrt((u * u).sum())
    Mu, violated = M @ u, u.sum() - C @ u
    d = max(_penalty_step(u, Mu, violated, epsilon), 0.0)
    F = 0.0
    for _ in range(outer_iterations):
        gradient = Mu - d * violated
        F = (u * gradient).sum()
        for _ in range(inner_iterations):
            step = 1.0
            change = 0.0
            new, new_gradient, new_F = u, gradient, F
            for _ in range(backtracking_steps):
                new = np.maximum(u + step * gradient, 0.0)
                norm = np.sqrt((new * new).sum())
                if norm <= 0.0:
                    break
                new = new / norm
                Mu, violated = M @ new, new.sum() - C @ new
                new_gradient = Mu - d * violated
                new_F = (new * new_gradient).sum()
                change = new_F - F
                if change >= -epsilon:
                    break
                step *= backtracking
            moved = np.sqrt(((new - u) ** 2).sum())
            u, gradient, F = new, new_gradient, new_F
            if moved < tolerance_u or abs(change) < tolerance_f:
                break
        Mu, violated = M @ u, u.sum() - C @ u
        growth = _penalty_step(u, Mu, violated, epsilon)
        if growth < 0.0:
            break
        d += growth
    return _consistent_largest(M, u, int(np.round(F)))


@njit(cache=True)
def _penalty_step(u: Array, Mu: Array, violated: Array, epsilon: float) -> float:
    """Mean of Mu / violated where constraints are violated; -1 where none is."""
    total, found = 0.0, 0
    for a in range(len(u)):
        if violated[a] > epsilon and u[a] > epsilon:
            total += Mu[a] / violated[a]
            found += 1
    return total / found if found else -1.0


@njit(cache=True)
def _consistent_largest(M: Array, u: Array, size: int) -> NDArray[np.int64]:
    """The `size` largest positive entries of u, passing over any inconsistent with one already taken."""
    order = np.argsort(-u, kind="mergesort")
    chosen = np.empty(max(size, 0), dtype=np.int64)
    found = 0
    for a in order:
        if found >= size or u[a] <= 0:
            break
        consistent = True
        for x in range(found):
            consistent = consistent and M[a, chosen[x]] > 0
        if consistent:
            chosen[found] = a
            found += 1
    return chosen[:found]
