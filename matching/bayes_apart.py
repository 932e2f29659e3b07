"""Objects do not overlap: two detections that would lie within one object of each other are hardly of two objects."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from .pose import Array

LEAST_APART = 0.1
"""Share of such places at which two objects are found nevertheless: small ones, detections that are none."""

ROBOT_STD = 0.25
"""Deviation of the distance that two robots keep, as a share of it."""


@njit(cache=True)
def log_apart(
    p_a: Array,
    S_a: Array,
    B_a: Array,
    p_b: Array,
    S_b: Array,
    B_b: Array,
    R: Array,
    t: Array,
    bias: Array,
    apart: float,
    out: Array,
) -> float:
    """Log of how much rarer than by chance two different objects lie where i and j do, into out (n, m); its sum.

    Two objects' middles are at least `apart` (m) from each other. Positions, covariances, biases and pose as in
    `residual_edges`; the last object of either side is the robot itself, whose place the other's objects do not shun:
    a detection of it is known by another part of the robot, and a robot may fly.
    """
    n, m, nb = len(p_a), len(p_b), len(bias)
    total = 0.0
    x, y = np.empty(3), np.empty(3)
    out[:] = 0.0
    for j in range(m):
        for a in range(3):
            y[a] = t[a]
            for b in range(3):
                v = p_b[j, b]
                for k in range(nb):
                    v += bias[k] * B_b[j, k, b]
                y[a] += R[a, b] * v
        for i in range(n):
            robots = (i == n - 1) + (j == m - 1)
            if robots == 1:
                continue
            square = 0.0
            for a in range(3):
                x[a] = p_a[i, a] - y[a]
                for k in range(nb):
                    x[a] += bias[k] * B_a[i, k, a]
                square += x[a] * x[a]
            if square > 9.0 * apart * apart:
                continue
            trace, along = 0.0, (ROBOT_STD * apart) ** 2
            if robots == 0:
                along = 0.0
                for a in range(3):
                    for b in range(3):
                        s = S_a[i, a, b]
                        for c in range(3):
                            for d in range(3):
                                s += R[a, c] * S_b[j, c, d] * R[b, d]
                        along += x[a] * s * x[b] / (square + 1e-18)
                        if a == b:
                            trace += s
            # The true distance is about sqrt(square + trace).
            z = (math.sqrt(square + trace) - apart) / math.sqrt(2.0 * along + 1e-18)
            out[i, j] = math.log(LEAST_APART + (1.0 - LEAST_APART) * 0.5 * math.erfc(-z))
            total += out[i, j]
    return total
