"""How far evidence is to be trusted: what a match says, and what chance would explain as well.

A wrong pose often explains two views better than the true one, and errors that the model takes for independent are not.
So a mode's evidence is damped, the more the less a single match says; `covis train calibration` fits the weights.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from .bayes_overlap import N_FEATURES
from .bayes_prepare import Problem
from .graph import ObjectGraph
from .pose import Array


class Evidence(NamedTuple):
    """What is weighed of one pair of views: `overlap_features` of its modes (k, 8), and its `pair_features` (5,)."""

    modes: Array
    pair: Array


class Calibration(NamedTuple):
    """Calibrated log evidence of a mode: exp(damping . pair features) (terms . mode features) + offset . pair features.

    Attributes:
        terms: weights of `overlap_features`.
        damping, offset: weights of `pair_features`.
        min_score: half the F1 to be expected of such pairs, which as a threshold maximises F1 pooled over many.
    """

    terms: Array
    damping: Array
    offset: Array
    min_score: float


FEW = 5
"""Objects of the smaller view up to which known fields of view without images count as they are."""

_WHOLE, _NONE = np.eye(N_FEATURES)[0], np.zeros(5)
_CONCENTRATED = np.array([1.0, 0.0, 0.0, 0.0, 0.0])
"""A nat: poses of views that share objects are more concentrated than the uniform prior says (fitted)."""

CALIBRATIONS = {
    # Gravity known, and no field of view.
    "unseen": Calibration(
        np.array([0.554, 0.07, -0.276, 0.069, 0.239, 1.443, 2.679, -3.363]),
        np.array([0.0, 0.562, 0.375, 0.166, -0.351]),
        np.array([6.967, 2.808, 4.423, -0.177, -2.004]),
        0.43,
    ),
    # Cameras that report full covariances: one network's errors in one image go together.
    "eyes": Calibration(
        np.array([0.336, 0.353, -0.041, -0.017, -0.168, -0.338, 1.663, -1.092]),
        np.array([0.0, -0.009, -0.927, 0.404, -0.145]),
        np.array([-0.038, -0.2, 0.359, 1.622, -1.57]),
        0.26,
    ),
    # Known fields of view without images, and more than FEW objects: some of them hide.
    "fields": Calibration(
        np.array([0.312, -0.022, 0.027, -0.072, 0.292, 5.916, 2.376, -1.962]),
        np.array([0.0, 0.51, -0.22, 0.15, 0.0]),
        np.array([4.88, 1.74, -1.04, 1.05, 0.0]),
        0.42,
    ),
    # Known fields of view without such cameras, and at most FEW objects.
    "few": Calibration(_WHOLE, _NONE, _CONCENTRATED, 0.21),
    # Cameras without covariances, or gravity unknown.
    "whole": Calibration(_WHOLE, _NONE, _CONCENTRATED, 0.42),
    # With a prior pose.
    "posed": Calibration(_WHOLE, _NONE, _NONE, 0.42),
}
"""By `kind_of` graphs. The first three are the work of `covis train calibration`; the others count evidence whole."""


@njit(cache=True)
def pair_features(x: Problem) -> Array:
    """What decides how well a wrong pose may explain two views, (5,), each but the first about a usual value.

    In order: 1; nats that a match says by its place: log of a view's room over the area that both errors together
    leave open; nats that it says by its class; how differently high the robots stand, in median ranges; log of the
    smaller number of objects.
    """
    n, m = len(x.p_a) - 1, len(x.p_b) - 1
    area = height = 0.0
    for i in range(n):
        area += np.sqrt(max(x.S_a[i, 0, 0] * x.S_a[i, 1, 1] - x.S_a[i, 0, 1] ** 2, 1e-18)) / n
        height += x.p_a[i, 2] / n
    for j in range(m):
        area += np.sqrt(max(x.S_b[j, 0, 0] * x.S_b[j, 1, 1] - x.S_b[j, 0, 1] ** 2, 1e-18)) / m
        height -= x.p_b[j, 2] / m
    total = nats = 0.0
    for i in range(n):
        for j in range(m):
            ratio = np.exp(x.likely[i, j])
            total += ratio
            nats += ratio * x.likely[i, j]
    place = np.log(0.5 * (x.room_a + x.room_b) / (2.0 * np.pi * area))
    # Beyond what the weights were fitted on, features count as at the border of it.
    place = min(max(place - 5.0, -1.5), 1.5)
    high = min(abs(height) / x.median_range - 0.2, 1.0)
    few = min(max(np.log(min(n, m)) - 2.2, -1.1), 0.9)
    return np.array([1.0, place, min(nats / total - 0.5, 1.0), high, few])


def kind_of(source: ObjectGraph, target: ObjectGraph, gravity: bool, seen: bool, posed: bool) -> str:
    """The entry of CALIBRATIONS for such graphs: is gravity known, are both fields of view, is a prior pose given."""
    if posed:
        return "posed"
    if gravity and not seen:
        return "unseen"
    graphs = (source, target)
    if gravity and all(g.intrinsics is not None and g.covariances is not None for g in graphs):
        return "eyes"
    if seen and min(len(source), len(target)) <= FEW:
        return "few"
    return "fields" if gravity and all(g.intrinsics is None for g in graphs) else "whole"


def calibrated(evidence: Evidence, calibration: Calibration) -> Array:
    """Calibrated log evidence (k,) of the modes."""
    pair = evidence.pair
    damping = np.exp(pair @ calibration.damping)
    return damping * (evidence.modes @ calibration.terms) + pair @ calibration.offset
