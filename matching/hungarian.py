"""Gated nearest neighbour by optimal assignment, for robots that know their relative pose (Kuhn 1955, Munkres 1957)."""

from __future__ import annotations

import numpy as np
from scipy.optimize import linear_sum_assignment

from .checks import check_interval
from .graph import Matching, ObjectGraph, PriorRequiredError, check_comparable
from .pose import RelativePose, transform


def hungarian(
    source: ObjectGraph,
    target: ObjectGraph,
    *,
    prior: RelativePose | None = None,
    rng: np.random.Generator | None = None,
    gate_m: float = 7.0,
) -> Matching:
    """Assign target objects, mapped to the source by the prior, to the nearest source objects within a gate.

    Args:
        source, target: the two robots' graphs.
        prior: relative pose; needed. Only its mean is used.
        rng: not used.
        gate_m: largest distance of a match, m.

    Returns:
        Matches of least total distance among those with the most pairs inside the gate; score 1 - distance / gate_m.

    Raises:
        PriorRequiredError: no prior given.
        ValueError: gate_m is not positive and finite, or different attribute classes.
    """
    check_comparable(source, target, prior)
    if prior is None:
        raise PriorRequiredError("hungarian needs a relative pose: give a prior, or run with --pose known")
    check_interval("gate_m", gate_m, "(0, inf)")
    if len(source) == 0 or len(target) == 0:
        return Matching.empty()
    mapped = transform(prior.T_source_target, target.positions)
    distance = np.linalg.norm(source.positions[:, None] - mapped[None], axis=2)
    # A pair outside the gate costs more than any set of pairs inside it can save.
    outside = gate_m * (min(distance.shape) + 1)
    rows, cols = linear_sum_assignment(np.where(distance <= gate_m, distance, outside))
    inside = distance[rows, cols] <= gate_m
    rows, cols = rows[inside], cols[inside]
    return Matching(np.stack([rows, cols], axis=1), 1.0 - distance[rows, cols] / gate_m)
