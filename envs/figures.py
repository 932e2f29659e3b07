"""A step's scores as the plain numbers that infos hold, and their sums over an episode."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .scoring import StepScore

N_SUMS = 7


def sums(result: StepScore) -> NDArray[np.float64]:
    """Per robot (N, 7): the team's correct, retrieved, covisible, visible; own single and fused error (m), number."""
    counts = result.counts
    team = (counts.correct, counts.retrieved, counts.common, result.n_visible)
    out = np.zeros((len(result.tied), N_SUMS))
    out[:, :4] = team
    if counts.correct:
        localized = ~np.isnan(result.error_single)
        out[:, 4] = np.where(localized, result.error_single, 0.0).sum(axis=1)
        out[:, 5] = np.where(localized, result.error_fused, 0.0).sum(axis=1)
        out[:, 6] = localized.sum(axis=1)
    return out


def figures(sums: NDArray[np.float64], prefix: str) -> dict[str, float]:
    """One robot's sums (7,) as infos' figures; ratios and means of nothing are 0."""
    correct, retrieved, common, visible, single, fused, localized = sums.tolist()
    return {
        f"{prefix}n_correct": correct,
        f"{prefix}n_retrieved": retrieved,
        f"{prefix}n_covisible": common,
        f"{prefix}n_visible": visible,
        f"{prefix}precision": correct / retrieved if retrieved else 0.0,
        f"{prefix}recall": correct / common if common else 0.0,
        f"{prefix}scene_recall": correct / visible if visible else 0.0,
        f"{prefix}n_localized": localized,
        f"{prefix}displacement_single_m": single / localized if localized else 0.0,
        f"{prefix}displacement_fused_m": fused / localized if localized else 0.0,
    }
