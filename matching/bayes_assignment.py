"""Marginals of a one-to-one assignment in which any object may stay alone (sum-product, after Williams & Lau 2014).

An assignment M has weight prod_{(i, j) in M} w_ij; an object that stays alone weighs 1. Edges are sparse: parallel
arrays of row, column and log weight, sorted by row.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from .pose import Array

MAX_LOG_WEIGHT = 60.0


@njit(cache=True)
def assignment_marginals(
    rows: Array, cols: Array, log_weights: Array, n_edges: int, n: int, m: int, iterations: int, out: Array
) -> float:
    """Probability of every edge, into `out`; returns the Bethe estimate of log sum_M prod w.

    Exact where the edges form no cycle. Messages: mu (row to column) and nu (column to row), both of them ratios of
    "matched" to "alone".
    """
    mu = np.empty(n_edges)
    nu = np.ones(n_edges)
    weight = np.empty(n_edges)
    for e in range(n_edges):
        weight[e] = np.exp(min(log_weights[e], MAX_LOG_WEIGHT))
    row_sum = np.empty(n)
    col_sum = np.empty(m)
    for _ in range(iterations):
        row_sum[:] = 1.0
        for e in range(n_edges):
            row_sum[rows[e]] += weight[e] * nu[e]
        col_sum[:] = 1.0
        for e in range(n_edges):
            # The difference loses its digits where one edge dominates its row: then it is 1 + the others, summed anew.
            rest = row_sum[rows[e]] - weight[e] * nu[e]
            if rest < 1e-6 * row_sum[rows[e]]:
                rest = 1.0
                for f in range(n_edges):
                    if rows[f] == rows[e] and f != e:
                        rest += weight[f] * nu[f]
            mu[e] = weight[e] / rest
            col_sum[cols[e]] += mu[e]
        change = 0.0
        for e in range(n_edges):
            rest = col_sum[cols[e]] - mu[e]
            if rest < 1e-6 * col_sum[cols[e]]:
                rest = 1.0
                for f in range(n_edges):
                    if cols[f] == cols[e] and f != e:
                        rest += mu[f]
            new = 1.0 / rest
            change = max(change, abs(new - nu[e]))
            nu[e] = new
        if change < 1e-6:
            break
    row_sum[:] = 1.0
    col_sum[:] = 1.0
    log_z = 0.0
    for e in range(n_edges):
        row_sum[rows[e]] += weight[e] * nu[e]
        col_sum[cols[e]] += mu[e]
        log_z -= np.log1p(mu[e] * nu[e])
    for i in range(n):
        log_z += np.log(row_sum[i])
    for j in range(m):
        log_z += np.log(col_sum[j])
    for e in range(n_edges):
        out[e] = weight[e] * nu[e] / row_sum[rows[e]]
    return log_z
