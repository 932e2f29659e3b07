"""Reweighted random walks for graph matching (Cho, Lee and Lee 2010): pairwise, by distances."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from .candidates import MAX_CANDIDATES, affinity_matrix, check_size, distance_variance_m2, mean_agreement
from .graph import Matching, ObjectGraph, check_comparable
from .pose import Array, RelativePose
from .similarity import distances


def rrwm(
    source: ObjectGraph,
    target: ObjectGraph,
    *,
    prior: RelativePose | None = None,
    rng: np.random.Generator | None = None,
    walk_weight: float = 0.2,
    inflation: float = 30.0,
    iterations: int = 300,
    sinkhorn_iterations: int = 1000,
    tolerance: float = 3e-13,
    sinkhorn_tolerance: float = 1e-3,
    distance_width_m2: float | None = None,
    distance_width_factor: float = 2.0,
    attribute_weight: float = 1.0,
) -> Matching:
    """Walk randomly over candidate matches, jumping to those that satisfy the one-to-one constraints, and assign.

    The published parameters are the defaults of the first six options.

    Args:
        source, target: the two robots' graphs, n n' <= `MAX_CANDIDATES`.
        prior, rng: not used.
        walk_weight: share of the walk in each step; the rest jumps (the authors' c).
        inflation: beta, exponent of the reweighting at the most visited candidate.
        iterations: most steps of the walk.
        sinkhorn_iterations: most normalisations of rows and columns per step.
        tolerance: the walk ends when its change (Euclidean norm) falls below; 0 = all iterations.
        sinkhorn_tolerance: normalisation ends when the entries' change falls below; 0 = all iterations.
        distance_width_m2: gamma of Eq. (2). None: `distance_width_factor` times the median variance of a candidate.
        distance_width_factor: see above.
        attribute_weight: exponent of the attribute similarities in the affinity; 0 = distances alone, as in the paper.

    Returns:
        min(n, n') matches (the method has no null match), each scored by its mean affinity with the others.

    Raises:
        ValueError: a parameter out of range, too many objects, different attribute classes.
    """
    check_comparable(source, target, prior)
    check_size("rrwm", source, target, MAX_CANDIDATES)
    check_walk(walk_weight, inflation, iterations, sinkhorn_iterations)
    if len(source) == 0 or len(target) == 0:
        return Matching.empty()
    s, t = distances(source.positions), distances(target.positions)
    width = distance_width(source, target, s, t, distance_width_m2, distance_width_factor)
    K = affinity_matrix(source, target, s, t, width, attribute_weight)
    visits = reweighted_random_walk(
        K,
        len(source),
        len(target),
        walk_weight,
        inflation,
        iterations,
        sinkhorn_iterations,
        tolerance,
        sinkhorn_tolerance,
    )
    return mean_agreement(K, visits)


def distance_width(
    source: ObjectGraph, target: ObjectGraph, s: Array, t: Array, width_m2: float | None, factor: float
) -> float:
    """gamma of Eq. (2), m^2: as given, or `factor` times the median variance of a candidate."""
    width = factor * distance_variance_m2(source, target, s, t) if width_m2 is None else width_m2
    if not (np.isfinite(width) and width > 0):
        raise ValueError(f"the distance width must be positive, got {width} m^2")
    return float(width)


def check_walk(walk_weight: float, inflation: float, iterations: int, sinkhorn_iterations: int) -> None:
    """Raises ValueError naming the value unless the walk's parameters make sense."""
    if not 0 <= walk_weight <= 1:
        raise ValueError(f"walk_weight must lie in [0, 1], got {walk_weight}")
    if not inflation > 0:
        raise ValueError(f"inflation must be positive, got {inflation}")
    if iterations < 1 or sinkhorn_iterations < 1:
        raise ValueError(f"iterations must be at least 1, got {iterations} and {sinkhorn_iterations}")


@njit(cache=True, fastmath=True)
def reweighted_random_walk(
    affinity: Array,
    n: int,
    m: int,
    walk_weight: float = 0.2,
    inflation: float = 30.0,
    iterations: int = 300,
    sinkhorn_iterations: int = 1000,
    tolerance: float = 3e-13,
    sinkhorn_tolerance: float = 1e-3,
) -> Array:
    """Quasi-stationary visits (n, m), summing to 1, of the walk over candidates; affinity (n m, n m).

    A step walks from the mixture of the last visits (weight `walk_weight`) and of those visits inflated and made
    bistochastic (the jump). Zero where there is no affinity at all.
    """
    size = n * m
    x = np.full(size, 1.0 / size)
    before = x.copy()
    mixed = x.copy()
    start, column, value = sparse(affinity)
    for _ in range(iterations):
        walk = multiply(start, column, value, mixed)
        total = walk.sum()
        if total <= 0.0:
            return np.zeros((n, m))
        walk /= total
        jump = np.exp(inflation * (walk / walk.max() - 1.0)).reshape(n, m)
        sinkhorn(jump, sinkhorn_iterations, sinkhorn_tolerance, np.exp(-inflation))
        jump_flat = jump.reshape(size)
        mixed = walk_weight * walk + (1.0 - walk_weight) * (jump_flat / jump_flat.sum())
        # An oscillation between two states counts as an end, too.
        change = min(((walk - x) ** 2).sum(), ((walk - before) ** 2).sum())
        before[:] = x
        x[:] = walk
        if change < tolerance * tolerance:
            break
    return x.reshape(n, m)


NEGLIGIBLE = 1e-12
"""Affinities below this share of the largest are taken for zero: most distances do not agree at all."""


@njit(cache=True)
def sparse(K: Array) -> tuple[NDArray[np.int64], NDArray[np.int32], Array]:
    """K (k, k) by rows: `start` (k + 1,) into columns and values of the entries that are not negligible."""
    k = len(K)
    least = NEGLIGIBLE * K.max()
    start = np.zeros(k + 1, dtype=np.int64)
    for a in range(k):
        count = 0
        for b in range(k):
            count += K[a, b] > least
        start[a + 1] = start[a] + count
    # Every entry is written and the next overwrites it if negligible: branches would be guessed wrongly too often.
    column, value = np.empty(start[k] + 1, dtype=np.int32), np.empty(start[k] + 1)
    for a in range(k):
        at = start[a]
        for b in range(k):
            column[at], value[at] = b, K[a, b]
            at += K[a, b] > least
    return start, column[:-1], value[:-1]


@njit(cache=True, fastmath=True)
def multiply(start: NDArray[np.int64], column: NDArray[np.int32], value: Array, x: Array) -> Array:
    """The sparse matrix times x (k,)."""
    out = np.empty(len(x))
    for a in range(len(x)):
        total = 0.0
        # Unsigned, since an index that might count from the end keeps the compiler from using vector instructions.
        for at in range(np.uint64(start[a]), np.uint64(start[a + 1])):
            total += value[at] * x[np.uint64(column[at])]
        out[a] = total
    return out


@njit(cache=True, fastmath=True)
def sinkhorn(X: Array, iterations: int, tolerance: float = 0.0, slack: float = 0.0) -> None:
    """Normalise the rows and columns of X (n, m) in turn, in place.

    Where n and m differ, |n - m| slack rows (or columns) of equal entries `slack` join in, so that rows and columns can
    sum to 1 at once; as equals they stay equal, so one stands for all.
    """
    n, m = X.shape
    extra = np.full(max(n, m), slack)
    column = np.empty(m)
    for _ in range(iterations):
        change = 0.0
        column[:] = 1e-300
        for i in range(n):
            total = 1e-300
            for j in range(m):
                total += X[i, j]
            if n > m:
                total += (n - m) * extra[i]
                extra[i] /= total
            for j in range(m):
                X[i, j] /= total
                column[j] += X[i, j]
            change = max(change, abs(total - 1.0))
        if m > n:
            total = max(extra[:m].sum(), 1e-300)
            for j in range(m):
                extra[j] /= total
                column[j] += (m - n) * extra[j]
                extra[j] /= column[j]
        elif n > m:
            total = max(extra[:n].sum(), 1e-300)
            extra[:n] /= total
        for j in range(m):
            column[j] = 1.0 / column[j]
        for i in range(n):
            for j in range(m):
                X[i, j] *= column[j]
        if change < tolerance:
            break
