"""How the paper's method depends on lambda_1 and lambda_2 (section 4.1 chose 0.1 and 0.4 by such an analysis)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from .tuning import compare_settings, grid

UNCERTAINTY_WEIGHTS = (0.0, 0.05, 0.1, 0.2, 0.4)
"""lambda_1."""
NONCOVISIBILITY_WEIGHTS = (0.0, 0.2, 0.3, 0.4, 0.5, 0.6, 0.8)
"""lambda_2."""


def sensitivity(
    targets: Sequence[str | Path],
    *,
    uncertainty_weights: Sequence[float] = UNCERTAINTY_WEIGHTS,
    noncovisibility_weights: Sequence[float] = NONCOVISIBILITY_WEIGHTS,
    **options: Any,
) -> list[dict[str, Any]]:
    """Pooled precision, recall and F1 of `rgm` for every pair of lambdas, on dataset folders.

    Args:
        targets: dataset folders.
        uncertainty_weights, noncovisibility_weights: values of lambda_1 and lambda_2.
        options: `frames`, `seed` and `progress` of `compare_settings`, and further options of `rgm`.

    Returns:
        A row per target and setting: target, uncertainty_weight, noncovisibility_weight, pairs, precision, recall, f1.

    Raises:
        ValueError: `frames` below 1, or an option that `rgm` refuses.
        DatasetError: a folder that cannot be read.
    """
    settings = grid(uncertainty_weight=uncertainty_weights, noncovisibility_weight=noncovisibility_weights)
    return compare_settings(targets, "rgm", settings, **options)
