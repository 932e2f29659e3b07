"""Random walks over candidate matches: affinities by windows, steps, and the jumps of Cho, Lee and Lee 2010."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from .pose import Array

NEGLIGIBLE = 1e-12
"""Affinities below this share of the largest are taken for zero: most distances do not agree at all."""

BLOCK = 16
"""Windows begin and end at multiples of this: as many single-precision numbers fill the widest vector register."""

Single = NDArray[np.float32]


class Affinity(NamedTuple):
    """Affinities D_ab a_a a_b of every two candidates a = (i, i'), b = (j, j'), by windows, in single precision.

    With the pairs of target objects in ascending order of distance, those that agree with the distance of i and j are
    neighbours: a window, to be multiplied as a whole, without looking up where its entries belong.

    Attributes:
        weight: (n, n') a.
        diagonal: (n, n') affinity of a candidate with itself.
        first, second: (t,) the pairs i' < j' of target objects by distance, pairs of no affinity to fill the block.
        low, high: (n, n) blocks where the window of i and j begins and ends.
        start: (n, n) where its entries begin in `value`; i, j and j, i have the same.
        value: D.
    """

    weight: Array
    diagonal: Array
    first: NDArray[np.int64]
    second: NDArray[np.int64]
    low: NDArray[np.int64]
    high: NDArray[np.int64]
    start: NDArray[np.int64]
    value: Single


def distance_affinity(s: Array, t: Array, width_m2: float, weight: Array, diagonal: Array) -> Affinity:
    """The affinities of all candidates, D of Eq. (2) times the weights of both.

    Args:
        s, t: (n, n) and (n', n') m, distances within both graphs.
        width_m2: gamma of Eq. (2).
        weight: (n, n') of each candidate, in [0, 1].
        diagonal: (n, n') affinity of each candidate with itself.
    """
    pairs = np.array(np.triu_indices(len(t), 1))
    distance = t[tuple(pairs)]
    order = np.argsort(distance, kind="stable")
    k, size = len(order), BLOCK * -(-len(order) // BLOCK)
    ascending, (first, second) = np.full(size, np.inf), np.zeros((2, size), dtype=np.int64)
    ascending[:k], first[:k], second[:k] = distance[order], *pairs[:, order]
    reach = np.sqrt(-np.log(NEGLIGIBLE) * width_m2)
    low = np.searchsorted(ascending, s - reach) // BLOCK
    high = -(-np.searchsorted(ascending, s + reach, side="right") // BLOCK)
    start, value = _exponents(s, ascending, width_m2, low, high)
    np.exp(value, out=value)
    return Affinity(weight, diagonal, first, second, low, high, start, value)


@njit(cache=True)
def _exponents(
    s: Array, ascending: Array, width_m2: float, low: NDArray[np.int64], high: NDArray[np.int64]
) -> tuple[NDArray[np.int64], Single]:
    """Where the window of each two source objects starts, and log D of all."""
    n = len(s)
    start = np.zeros((n, n), dtype=np.int64)
    total = 0
    for i in range(n):
        for j in range(i):
            start[i, j] = start[j, i] = total
            total += BLOCK * (high[i, j] - low[i, j])
    value = np.empty(total, dtype=np.float32)
    for i in range(n):
        for j in range(i):
            window = ascending[BLOCK * low[i, j] : BLOCK * high[i, j]]
            for k in range(len(window)):
                value[start[i, j] + k] = -((s[i, j] - window[k]) ** 2) / width_m2
    return start, value


@njit(cache=True, fastmath=True)
def reweighted_random_walk(
    affinity: Affinity,
    walk_weight: float = 0.2,
    inflation: float = 30.0,
    iterations: int = 300,
    sinkhorn_iterations: int = 1000,
    tolerance: float = 3e-13,
    sinkhorn_tolerance: float = 1e-3,
) -> Array:
    """Quasi-stationary visits (n, m), summing to 1, of the walk over candidates.

    A step walks from the mixture of the last visits (weight `walk_weight`) and of those visits inflated and made
    bistochastic (the jump). Zero where there is no affinity at all.
    """
    n, m = affinity.weight.shape
    x = np.full((n, m), 1.0 / (n * m))
    before = x.copy()
    mixed = x.copy()
    partners = np.empty((n, 2, len(affinity.first)), dtype=np.float32)
    for _ in range(iterations):
        walk = multiply(affinity, mixed, partners)
        total = walk.sum()
        if total <= 0.0:
            return np.zeros((n, m))
        walk /= total
        jump = reweighted(walk, inflation, sinkhorn_iterations, sinkhorn_tolerance)
        mixed = walk_weight * walk + (1.0 - walk_weight) * jump
        # An oscillation between two states counts as an end, too.
        change = min(((walk - x) ** 2).sum(), ((walk - before) ** 2).sum())
        before[:] = x
        x[:] = walk
        if change < tolerance * tolerance:
            break
    return x


@njit(cache=True, fastmath=True)
def reweighted(walk: Array, inflation: float, sinkhorn_iterations: int, sinkhorn_tolerance: float) -> Array:
    """Where a step jumps, (n, m) of sum 1: the visits (n, m) inflated, then made bistochastic."""
    jump = np.exp(inflation * (walk / walk.max() - 1.0))
    sinkhorn(jump, sinkhorn_iterations, sinkhorn_tolerance, np.exp(-inflation))
    return jump / jump.sum()


@njit(cache=True, fastmath=True)
def multiply(affinity: Affinity, x: Array, partners: Single) -> Array:
    """The affinity times x (n, n'), both by candidates; `partners` (n, 2, t) is overwritten.

    Along the pairs i', j' of target objects, i collects from every j what is at j, j' (for i, i') and at j, i' (for
    i, j'). Indices are unsigned, since those that might count from the end keep the compiler from vector instructions.
    """
    weight, diagonal, first, second, low, high, start, value = affinity
    n, pairs = np.uint64(len(x)), np.uint64(len(first))
    heavy = (weight * x).astype(np.float32)
    for j in range(n):
        for k in range(pairs):
            partners[j, np.uint64(0), k] = heavy[j, np.uint64(second[k])]
            partners[j, np.uint64(1), k] = heavy[j, np.uint64(first[k])]
    out = np.empty(x.shape)
    collected = np.empty((2, len(first)), dtype=np.float32)
    for i in range(n):
        collected[:] = 0.0
        for j in range(n):
            if i == j:
                continue
            from_value = np.uint64(start[i, j]) - np.uint64(BLOCK) * np.uint64(low[i, j])
            for k in range(np.uint64(BLOCK) * np.uint64(low[i, j]), np.uint64(BLOCK) * np.uint64(high[i, j])):
                collected[np.uint64(0), k] += value[from_value + k] * partners[j, np.uint64(0), k]
                collected[np.uint64(1), k] += value[from_value + k] * partners[j, np.uint64(1), k]
        total = np.zeros(x.shape[1], dtype=np.float32)
        for k in range(pairs):
            total[np.uint64(first[k])] += collected[np.uint64(0), k]
            total[np.uint64(second[k])] += collected[np.uint64(1), k]
        out[i] = weight[i] * total + diagonal[i] * x[i]
    return out


@njit(cache=True, fastmath=True)
def sinkhorn(X: Array, iterations: int, tolerance: float = 0.0, slack: float = 0.0) -> None:
    """Normalise the rows and columns of X (n, m) in turn, in place.

    Where n and m differ, |n - m| slack rows (or columns) of equal entries `slack` join in, so that rows and columns can
    sum to 1 at once; as equals they stay equal, so one stands for all.
    """
    n, m = X.shape
    row, column, total = np.ones(n), np.ones(m), np.empty(m)
    slack_column = 1.0
    for _ in range(iterations):
        change = 0.0
        total[:] = 1e-300
        if m > n:
            total += (m - n) / column.sum()
        for i in range(n):
            before = max(n - m, 0) * slack * slack_column + 1e-300
            for j in range(m):
                before += X[i, j] * column[j]
            change = max(change, abs(before * row[i] - 1.0))
            row[i] = 1.0 / before
            for j in range(m):
                total[j] += X[i, j] * row[i]
        for j in range(m):
            column[j] = 1.0 / total[j]
        if n > m:
            slack_column = 1.0 / max(slack * row.sum(), 1e-300)
        if change < tolerance:
            break
    for i in range(n):
        for j in range(m):
            X[i, j] *= row[i] * column[j]
