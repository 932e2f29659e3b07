"""Headings on streets and in buildings: robots that follow one grid differ by a multiple of a right angle.

Whether a place has such a grid shows in how the objects of a single view lie: in lanes and rows, along the robot's own
heading or across it, or in all directions alike.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from .graph import ObjectGraph
from .pose import Array

RIGHT_ANGLE_STD_RAD = math.radians(2.0)
"""How far headings, and rows of objects, differ from the axes of a grid."""

IN_LINE = 0.05
"""Share of the pairs of objects that lie along an axis of the grid because of it."""

VAGUE_RAD = math.radians(15.0)
"""Standard deviation of the direction between two objects above which it is not looked at."""

LEAST_LEVEL = 0.1
"""Horizontal part of a unit vector below which it gives no heading."""


def heading_log_prior(R: Array, right_angles: float) -> Array:
    """Log prior (k,) of levelled rotations R (k, 3, 3) about z against a uniform one.

    `right_angles` is the probability that headings differ by a multiple of a right angle.
    """
    yaw = np.arctan2(R[:, 1, 0], R[:, 0, 0])
    off = ((yaw + math.pi / 4) % (math.pi / 2) - math.pi / 4) / RIGHT_ANGLE_STD_RAD
    peak = math.pi / 2 / (RIGHT_ANGLE_STD_RAD * math.sqrt(2 * math.pi))
    return np.log(1 - right_angles + right_angles * peak * np.exp(-0.5 * off**2))


@njit(cache=True)
def grid_log_evidence(p: Array, S: Array, forward: Array) -> float:
    """Log evidence of a view for objects that lie along the robot's heading or across it more often than by chance.

    Levelled positions (n + 1, 3) m and covariances (n + 1, 3, 3) m^2, the robot itself last; `forward` (2,) unit
    vector. The directions of all pairs of objects count as independent.
    """
    total = 0.0
    for i in range(len(p) - 1):
        for j in range(i + 1, len(p) - 1):
            dx, dy = p[j, 0] - p[i, 0], p[j, 1] - p[i, 1]
            square = dx * dx + dy * dy + 1e-12
            across = dy * dy * (S[i, 0, 0] + S[j, 0, 0]) + dx * dx * (S[i, 1, 1] + S[j, 1, 1])
            across -= 2.0 * dx * dy * (S[i, 0, 1] + S[j, 0, 1])
            variance = across / square**2 + RIGHT_ANGLE_STD_RAD**2
            if variance > VAGUE_RAD**2:
                continue
            angle = np.arctan2(forward[0] * dy - forward[1] * dx, forward[0] * dx + forward[1] * dy)
            off = (angle + np.pi / 4) % (np.pi / 2) - np.pi / 4
            peak = np.pi / 2 / np.sqrt(2 * np.pi * variance)
            total += np.log(1.0 - IN_LINE + IN_LINE * peak * np.exp(-0.5 * off * off / variance))
    return total


def level_heading(graph: ObjectGraph, L: Array) -> Array | None:
    """Unit vector (2,) in which a robot looks, in its frame levelled by L (3, 3); None = unknown, or up or down."""
    axis = np.array([0.0, 0.0, 1.0]) if graph.intrinsics is not None else graph.forward
    if axis is None:
        return None
    level: Array = (L @ axis)[:2]
    size = math.hypot(level[0], level[1])
    return level / size if size > LEAST_LEVEL else None


def right_angles_given(right_angles: float, log_evidence: float) -> float:
    """Probability of right angles after `log_evidence` for a grid, `right_angles` before it."""
    return right_angles / (right_angles + (1 - right_angles) * math.exp(min(-log_evidence, 500.0)))
