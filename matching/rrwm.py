"""Reweighted random walks for graph matching (Cho, Lee and Lee 2010): pairwise, by distances."""

from __future__ import annotations

import numpy as np
from numba import njit

from .pose import Array


@njit(cache=True, fastmath=True)
def reweighted_random_walk(
    affinity: Array,
    n: int,
    m: int,
    walk_weight: float = 0.2,
    inflation: float = 30.0,
    iterations: int = 300,
    sinkhorn_iterations: int = 10,
    tolerance: float = 1e-9,
) -> Array:
    """Quasi-stationary visits (n, m) of the walk over candidate matches; affinity (n m, n m), candidate i * m + i'.

    Each step follows the affinities with weight `walk_weight` and jumps, with the rest, to candidates reweighted by
    inflating and normalising over conflicting candidates. Sums to 1; zero where the affinity is zero altogether.
    """
    size = n * m
    x = np.full(size, 1.0 / size)
    degree = affinity.sum(axis=1).max()
    if degree <= 0:
        return np.zeros((n, m))
    for _ in range(iterations):
        walk = affinity @ x
        walk /= max(walk.sum(), 1e-300)
        jump = np.exp(inflation * (walk / walk.max() - 1.0)).reshape(n, m)
        sinkhorn(jump, sinkhorn_iterations)
        jump_flat = jump.reshape(size)
        new = walk_weight * walk + (1.0 - walk_weight) * jump_flat / jump_flat.sum()
        new /= new.sum()
        change = ((new - x) ** 2).sum()
        x = new
        if change < tolerance * tolerance:
            break
    return x.reshape(n, m)


@njit(cache=True, fastmath=True)
def sinkhorn(X: Array, iterations: int) -> None:
    """Normalise the rows and columns of X (n, m) in turn, in place."""
    n, m = X.shape
    column = np.empty(m)
    for _ in range(iterations):
        column[:] = 1e-300
        for i in range(n):
            total = 1e-300
            for j in range(m):
                total += X[i, j]
            scale = 1.0 / total
            for j in range(m):
                X[i, j] *= scale
                column[j] += X[i, j]
        for j in range(m):
            column[j] = 1.0 / column[j]
        for i in range(n):
            for j in range(m):
                X[i, j] *= column[j]
