"""Field of view: how likely a robot is to detect an object at a place in its own levelled frame."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from .pose import Array

EDGE_RAD = 0.02
RANGE_SOFTNESS = 0.2
LEAST_PROBABILITY = 0.01


class View(NamedTuple):
    """What a robot can see, in its levelled frame.

    Attributes:
        known: 1 where the field of view is known, else 0 (then the rest is not used).
        planes: (k, 3) inward unit normals of the planes through the sensor that bound the view.
        half_range: m, where half of the objects are lost.
        detection: probability of detecting an object close by in plain view.
        occluder: m, half width of what hides.
        occluded: factor on the probability behind another detection.
        half_length: m, half an object's length: beyond the border of the view a part of it is seen; 0 = unknown.
    """

    known: float
    planes: Array
    half_range: float
    detection: float
    occluder: float
    occluded: float
    half_length: float


@njit(cache=True)
def detection_probability(x: float, y: float, z: float, view: View, detections: Array) -> float:
    """Probability of detecting an object at (x, y, z) m; own `detections` (n + 1, 3), the robot itself last, hide."""
    square = x * x + y * y + z * z + 1e-18
    r = np.sqrt(square)
    margin = 1.0
    for k in range(len(view.planes)):
        margin = min(margin, (view.planes[k, 0] * x + view.planes[k, 1] * y + view.planes[k, 2] * z) / r)
    far = (r / view.half_range - 1.0) / RANGE_SOFTNESS
    edge = EDGE_RAD + 0.5 * view.half_length / r
    if margin < -8.0 * edge or far > 8.0:
        return LEAST_PROBABILITY
    p = view.detection / ((1.0 + np.exp(-margin / edge)) * (1.0 + np.exp(far)))
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
