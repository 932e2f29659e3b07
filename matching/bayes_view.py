"""Field of view: how likely a robot is to detect an object at a place in its own levelled frame."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from .pose import Array

EDGE_RAD = 0.02
RANGE_SOFTNESS = 0.2
LEAST_PROBABILITY = 0.01
SECTOR_MARGIN_RAD = 0.05
SECTOR_REACH = 1.05
SECTOR_COST = 0.2
"""Nats against a pose for an object that stays alone although the other robot evidently looks there (fitted)."""

SECTOR_SHARE = 0.6
"""Share of the objects that stay alone which lie there anyway; it takes the mean off (fitted)."""


class View(NamedTuple):
    """What a robot can see, in its levelled frame.

    Attributes:
        known: 1 where the field of view is known, else 0 (then the rest is not used).
        planes: (k, 3) inward unit normals of the planes through the sensor that bound the view.
        half_range: m, where half of the objects are lost.
        detection: probability of detecting an object close by in plain view.
        occluder: m, half width of what hides.
        occluded: factor on the probability behind another detection.
    """

    known: float
    planes: Array
    half_range: float
    detection: float
    occluder: float
    occluded: float


@njit(cache=True)
def detection_probability(x: float, y: float, z: float, view: View, detections: Array) -> float:
    """Probability of detecting an object at (x, y, z) m; own `detections` (n + 1, 3), the robot itself last, hide."""
    square = x * x + y * y + z * z + 1e-18
    r = np.sqrt(square)
    margin = 1.0
    for k in range(len(view.planes)):
        margin = min(margin, (view.planes[k, 0] * x + view.planes[k, 1] * y + view.planes[k, 2] * z) / r)
    far = (r / view.half_range - 1.0) / RANGE_SOFTNESS
    if margin < -8.0 * EDGE_RAD or far > 8.0:
        return LEAST_PROBABILITY
    p = view.detection / ((1.0 + np.exp(-margin / EDGE_RAD)) * (1.0 + np.exp(far)))
    gap = 1e300
    for k in range(len(detections) - 1):
        u, v, w = detections[k, 0], detections[k, 1], detections[k, 2]
        dot = u * x + v * y + w * z
        own = u * u + v * v + w * w
        if dot > 0 and own < 0.85 * square:
            gap = min(gap, own - dot * dot / square)
    if gap < view.occluder * view.occluder:
        p *= view.occluded
    return max(p, LEAST_PROBABILITY)


@njit(cache=True)
def seen_sector(p: Array) -> tuple[float, float, float]:
    """Where a robot evidently looks: middle and half width (rad) and reach (m) of its detections.

    Positions (n + 1, 3) m, levelled, the robot itself last.
    """
    n = len(p) - 1
    x = y = reach = 0.0
    for i in range(n):
        r = np.sqrt(p[i, 0] ** 2 + p[i, 1] ** 2) + 1e-12
        x += p[i, 0] / r
        y += p[i, 1] / r
        reach = max(reach, r)
    middle = np.arctan2(y, x)
    half = 0.0
    for i in range(n):
        half = max(half, abs((np.arctan2(p[i, 1], p[i, 0]) - middle + np.pi) % (2 * np.pi) - np.pi))
    return middle, half + SECTOR_MARGIN_RAD, SECTOR_REACH * reach


@njit(cache=True)
def alone_in_sector(x: float, y: float, alone: float, sector: tuple[float, float, float]) -> float:
    """Nats for an object at (x, y) m in the other robot's frame that has no match with probability `alone`."""
    middle, half, reach = sector
    inside = x * x + y * y < reach * reach and abs((np.arctan2(y, x) - middle + np.pi) % (2 * np.pi) - np.pi) < half
    return SECTOR_COST * alone * (SECTOR_SHARE - 1.0 if inside else SECTOR_SHARE)


@njit(cache=True)
def sector_evidence(p_a: Array, p_b: Array, R: Array, t: Array, marginals: Array) -> Array:
    """What objects that stay alone say of every mode (k,), in nats, where fields of view are not known.

    Positions (n + 1, 3), (m + 1, 3) m, levelled, the robots themselves last; poses (k, 3, 3), (k, 3) of target to
    source; match probabilities (k, n, m).
    """
    n, m = len(p_a) - 1, len(p_b) - 1
    sector_a, sector_b = seen_sector(p_a), seen_sector(p_b)
    out = np.zeros(len(R))
    for k in range(len(R)):
        c, s = R[k, 0, 0], R[k, 1, 0]
        for i in range(n):
            x, y = p_a[i, 0] - t[k, 0], p_a[i, 1] - t[k, 1]
            out[k] += alone_in_sector(c * x + s * y, c * y - s * x, 1.0 - marginals[k, i].sum(), sector_b)
        for j in range(m):
            x, y = c * p_b[j, 0] - s * p_b[j, 1] + t[k, 0], s * p_b[j, 0] + c * p_b[j, 1] + t[k, 1]
            out[k] += alone_in_sector(x, y, 1.0 - marginals[k, :, j].sum(), sector_a)
    return out
