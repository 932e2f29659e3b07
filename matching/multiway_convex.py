"""Convex relaxation of multi-robot matching: one semidefinite matrix for all detections of all robots.

Detections that are one object have X = 1, all others 0. Such an X of consistent groups is positive semidefinite, the
blocks X_ii of one robot are identities, and no row or column of a block X_ij sums to more than 1 (a detection has at
most one partner in each robot). Relaxed to real numbers,

    max <L, X>   subject to   X >= 0 semidefinite,   X_ii = I,   X_ij >= 0,   X_ij 1 <= 1,   X_ij^T 1 <= 1,

with L the log odds of "one object" of every two detections: the programme of Huang and Guibas 2013 (consistent shape
maps via semidefinite programming) for partial maps, which Chen, Guibas and Huang 2014 (MatchLift) analyse and Hu,
Huang, Thibert and Guibas 2018 (distributable consistent multi-object matching) split over overlapping subsets of the
robots. This is the undivided programme, and L weighs every given match by its evidence. There is no universe size to be
guessed, unlike in MatchLift, and no rank, unlike in MatchALS (Zhou, Zhu and Daniilidis 2015). Like those two it is
solved by ADMM, here with one copy of X per set of constraints.

The optimum bounds the sum of log odds of every consistent grouping from above: a grouping that reaches it is optimal.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from .pose import Array

Indices = NDArray[np.int64]

MAX_CONNECTED = 300
"""Most detections that likely matches may chain together: an iteration costs their number cubed."""
ROUND_AT = 0.4
"""Groups are merged where X is larger on average: below a half, so that of two equal partners the first is taken."""


def relaxed(L: Array, robot: Indices, *, iterations: int = 3000, tolerance: float = 1e-5) -> Array:
    """The relaxation's solution X (n, n), symmetric, entries in [0, 1] up to the tolerance.

    Args:
        L: (n, n) symmetric log odds of "the same object"; entries within a robot do not count.
        robot: (n,) robot of each detection, ascending.
        iterations: most steps of ADMM per connected part.
        tolerance: on the root mean square of what the copies of X differ by, and of their change in a step.

    Raises:
        ValueError: more than `MAX_CONNECTED` detections chained together by positive log odds.
    """
    n = len(L)
    X = np.eye(n)
    likely = (L > 0) & (robot[:, None] != robot[None])
    # Between parts that no likely match joins X = 0 is optimal: cutting X to its diagonal blocks keeps it feasible and
    # only drops terms that are not positive. So each part is a programme of its own, exactly.
    parts, part = connected_components(csr_array(likely), directed=False)
    for p in range(parts):
        member = np.flatnonzero(part == p)
        if len(member) > MAX_CONNECTED:
            raise ValueError(
                f"the convex relaxation accepts at most {MAX_CONNECTED} detections chained together by likely matches, "
                f"got {len(member)}; use method='joint'"
            )
        if len(member) > 1:
            X[np.ix_(member, member)] = _admm(L[np.ix_(member, member)], robot[member], iterations, tolerance)
    return X


def _admm(L: Array, robot: Indices, iterations: int, tolerance: float) -> Array:
    """Consensus ADMM (Boyd et al. 2011, section 7.1): copies of X in the semidefinite cone, with rows, with columns.

    The copy with columns is always the transpose of the one with rows, since all else is symmetric.
    """
    n = len(L)
    same_robot = robot[:, None] == robot[None]
    gain = np.where(same_robot, 0.0, L)
    gain /= max(np.abs(gain).max(), 1e-300)
    penalty = 0.5
    Z, U_cone, U_rows = np.eye(n), np.zeros((n, n)), np.zeros((n, n))
    for _ in range(iterations):
        cone = _semidefinite(Z - U_cone)
        rows = _rows_within_one(Z - U_rows, robot, same_robot)
        before = Z
        both = rows + U_rows
        Z = (cone + U_cone + both + both.T + gain / penalty) / 3
        U_cone += cone - Z
        U_rows += rows - Z
        apart = np.sqrt((((cone - Z) ** 2).mean() + 2 * ((rows - Z) ** 2).mean()) / 3)
        moved = penalty * np.sqrt(((Z - before) ** 2).mean())
        if max(apart, moved) < tolerance:
            break
        # Residual balancing (Boyd et al., section 3.4.1).
        factor = 2.0 if apart > 10 * moved else 0.5 if moved > 10 * apart else 1.0
        penalty *= factor
        U_cone /= factor
        U_rows /= factor
    return Z


def _semidefinite(V: Array) -> Array:
    """Nearest positive semidefinite matrix."""
    values, vectors = np.linalg.eigh(V)
    return (vectors * np.maximum(values, 0.0)) @ vectors.T


def _rows_within_one(V: Array, robot: Indices, same_robot: NDArray[np.bool_]) -> Array:
    """Nearest matrix with X_ii = I, X_ij >= 0 and X_ij 1 <= 1."""
    X = np.where(same_robot, np.eye(len(V)), np.maximum(V, 0.0))
    for r in np.unique(robot):
        cols = np.flatnonzero(robot == r)
        over = np.flatnonzero((X[:, cols].sum(axis=1) > 1) & (robot != r))
        if len(over):
            X[np.ix_(over, cols)] = _simplex(V[np.ix_(over, cols)])
    return X


def _simplex(V: Array) -> Array:
    """Nearest rows (k, n) of non-negative numbers that sum to 1."""
    falling = -np.sort(-V, axis=1)
    excess = np.cumsum(falling, axis=1) - 1
    count = np.arange(1, V.shape[1] + 1)
    support = (falling * count > excess).sum(axis=1)
    shift = excess[np.arange(len(V)), support - 1] / support
    return np.maximum(V - shift[:, None], 0.0)
