"""How the paper's method depends on lambda_1 and lambda_2 (section 4.1 chose 0.1 and 0.4 by such an analysis)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from ..matching import METHODS
from ..matching.metrics import count, pooled
from .datasets import View, load_dataset

UNCERTAINTY_WEIGHTS = (0.0, 0.05, 0.1, 0.2, 0.4)
"""lambda_1."""
NONCOVISIBILITY_WEIGHTS = (0.0, 0.2, 0.3, 0.4, 0.5, 0.6, 0.8)
"""lambda_2."""


def sensitivity(
    targets: Sequence[str | Path],
    *,
    uncertainty_weights: Sequence[float] = UNCERTAINTY_WEIGHTS,
    noncovisibility_weights: Sequence[float] = NONCOVISIBILITY_WEIGHTS,
    every: int = 1,
    seed: int = 0,
    progress: Callable[[int, int], None] = lambda done, total: None,
    **options: Any,
) -> list[dict[str, Any]]:
    """Pooled precision, recall and F1 of `rgm` for every pair of lambdas, on dataset folders.

    Args:
        targets: dataset folders.
        uncertainty_weights, noncovisibility_weights: values of lambda_1 and lambda_2.
        every: take every so many-th frame.
        seed: of the detections' shuffling and of the chains.
        progress: called with settings done and settings in all.
        options: further options of `rgm`.

    Returns:
        A row per target and setting: target, uncertainty_weight, noncovisibility_weight, pairs, precision, recall, f1.

    Raises:
        ValueError: `every` below 1, or an option that `rgm` refuses.
        DatasetError: a folder that cannot be read.
    """
    if every < 1:
        raise ValueError(f"every must be at least 1, got {every}")
    settings = [(a, b) for a in uncertainty_weights for b in noncovisibility_weights]
    rows: list[dict[str, Any]] = []
    for k, target in enumerate(targets):
        pairs = view_pairs(target, every, seed)
        for s, (lambda_1, lambda_2) in enumerate(settings):
            progress(k * len(settings) + s, len(targets) * len(settings))
            weights = {"uncertainty_weight": lambda_1, "noncovisibility_weight": lambda_2}
            rows.append({"target": Path(target).name, **weights, **_score(pairs, seed, {**options, **weights})})
    progress(len(targets) * len(settings), len(targets) * len(settings))
    return rows


def view_pairs(target: str | Path, every: int, seed: int) -> list[tuple[View, View]]:
    """Every pair of robots of every so many-th frame with at least 3 detections each."""
    frames = [frame for i, frame in enumerate(load_dataset(target, seed)) if i % every == 0]
    return [(a, b) for frame in frames for a, b in combinations(frame.views, 2) if min(len(a.graph), len(b.graph)) >= 3]


def _score(pairs: list[tuple[View, View]], seed: int, options: dict[str, Any]) -> dict[str, Any]:
    streams = np.random.default_rng(seed).spawn(len(pairs))
    total = pooled(
        [
            count(METHODS["rgm"](a.graph, b.graph, rng=rng, **options), a.identity, b.identity)
            for (a, b), rng in zip(pairs, streams, strict=True)
        ]
    )
    return {"pairs": len(pairs), "precision": total.precision, "recall": total.recall, "f1": total.f1}
