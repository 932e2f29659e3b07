"""Random walks over candidate matches: sparse affinities, steps, and the jumps of Cho, Lee and Lee 2010."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from .pose import Array

NEGLIGIBLE = 1e-12
"""Affinities below this share of the largest are taken for zero: most distances do not agree at all."""

Columns = NDArray[np.uint16]
"""Candidates have 16-bit numbers here: what a step of the walk costs is the memory that it reads."""


class Affinity(NamedTuple):
    """A symmetric affinity (k, k) by rows: `start` (k + 1,) into the columns and values of what is not negligible."""

    start: NDArray[np.int64]
    column: Columns
    value: Array


def distance_affinity(s: Array, t: Array, width_m2: float, a: Array, diagonal: bool) -> Affinity:
    """`candidates.affinity_matrix` of candidates i n' + i' without ever holding it: entries D_ab a_a a_b.

    Args:
        s, t: (n, n) and (n', n') m, distances within both graphs.
        width_m2: gamma of Eq. (2).
        a: (n n',) similarity of each candidate, in [0, 1].
        diagonal: whether `a` itself is the diagonal; else it is 0.

    Raises:
        ValueError: more than 65,536 candidates.
    """
    if len(a) > 1 << 16:
        raise ValueError(f"an affinity has at most {1 << 16} candidates, got {len(a)}")
    start, column, value = _agreeing(s, t, np.sqrt(-np.log(NEGLIGIBLE) * width_m2), a > NEGLIGIBLE)
    value *= -1.0 / width_m2
    np.exp(value, out=value)
    _weigh(start, column, value, a, diagonal)
    return Affinity(start, column, value)


@njit(cache=True)
def _agreeing(s: Array, t: Array, reach: float, usable: NDArray[np.bool_]) -> tuple[NDArray[np.int64], Columns, Array]:
    """By rows, the usable candidates whose distances differ by at most `reach`, and the squared differences.

    First in each row stands the candidate itself, with 0. With the distances from i and those from i' in ascending
    order, those that agree with one another form windows that only move forward.
    """
    n, m = len(s), len(t)
    by_s, by_t = _order_of_rows(s), _order_of_rows(t)
    start = np.zeros(n * m + 1, dtype=np.int64)
    column, value = np.empty(0, dtype=np.uint16), np.empty(0)
    for write in (False, True):  # count, then write
        if write:
            column, value = np.empty(start[-1], dtype=np.uint16), np.empty(start[-1])
        for i in range(n):
            for ii in range(m):
                row = i * m + ii
                at = start[row]
                if write:
                    column[at], value[at] = row, 0.0
                at += 1
                low = high = 0
                for j in by_s[i]:
                    if j == i or not usable[row]:
                        continue
                    while low < m and t[ii, by_t[ii, low]] < s[i, j] - reach:
                        low += 1
                    while high < m and t[ii, by_t[ii, high]] <= s[i, j] + reach:
                        high += 1
                    for x in range(low, high):
                        jj = by_t[ii, x]
                        if jj == ii or not usable[j * m + jj]:
                            continue
                        if write:
                            column[at], value[at] = j * m + jj, (s[i, j] - t[ii, jj]) ** 2
                        at += 1
                if not write:
                    start[row + 1] = at
    return start, column, value


@njit(cache=True)
def _order_of_rows(distance: Array) -> NDArray[np.int64]:
    out = np.empty(distance.shape, dtype=np.int64)
    for i in range(len(distance)):
        out[i] = np.argsort(distance[i])
    return out


@njit(cache=True)
def _weigh(start: NDArray[np.int64], column: Columns, value: Array, a: Array, diagonal: bool) -> None:
    """Scale rows and columns by a (k,), in place; the first entry of each row is the diagonal."""
    for row in range(len(a)):
        for at in range(np.uint64(start[row]), np.uint64(start[row + 1])):
            value[at] *= a[row] * a[np.uint64(column[at])]
        value[start[row]] = a[row] if diagonal else 0.0


@njit(cache=True)
def sparse(K: Array) -> Affinity:
    """The affinity K (k, k), k <= 65,536, without its negligible entries."""
    k = len(K)
    least = NEGLIGIBLE * K.max()
    start = np.zeros(k + 1, dtype=np.int64)
    for a in range(k):
        count = 0
        for b in range(k):
            count += K[a, b] > least
        start[a + 1] = start[a] + count
    # Every entry is written and the next overwrites it if negligible: branches would be guessed wrongly too often.
    column, value = np.empty(start[k] + 1, dtype=np.uint16), np.empty(start[k] + 1)
    for a in range(k):
        at = start[a]
        for b in range(k):
            column[at], value[at] = b, K[a, b]
            at += K[a, b] > least
    return Affinity(start, column[:-1], value[:-1])


@njit(cache=True, fastmath=True)
def reweighted_random_walk(
    affinity: Affinity,
    n: int,
    m: int,
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
    size = n * m
    x = np.full(size, 1.0 / size)
    before = x.copy()
    mixed = x.copy()
    start, column, value = affinity
    for _ in range(iterations):
        walk = multiply(start, column, value, mixed)
        total = walk.sum()
        if total <= 0.0:
            return np.zeros((n, m))
        walk /= total
        jump = reweighted(walk, n, m, inflation, sinkhorn_iterations, sinkhorn_tolerance)
        mixed = walk_weight * walk + (1.0 - walk_weight) * jump
        # An oscillation between two states counts as an end, too.
        change = min(((walk - x) ** 2).sum(), ((walk - before) ** 2).sum())
        before[:] = x
        x[:] = walk
        if change < tolerance * tolerance:
            break
    return x.reshape(n, m)


@njit(cache=True, fastmath=True)
def reweighted(
    walk: Array, n: int, m: int, inflation: float, sinkhorn_iterations: int, sinkhorn_tolerance: float
) -> Array:
    """Where a step jumps, (n m,) of sum 1: the visits inflated, then made bistochastic."""
    jump = np.exp(inflation * (walk / walk.max() - 1.0)).reshape(n, m)
    sinkhorn(jump, sinkhorn_iterations, sinkhorn_tolerance, np.exp(-inflation))
    return jump.reshape(n * m) / jump.sum()


@njit(cache=True, fastmath=True)
def multiply(start: NDArray[np.int64], column: Columns, value: Array, x: Array) -> Array:
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
