"""Matchers' settings compared on dataset folders: how every rival was tuned, with the grid that each was given."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from ..matching import METHODS
from ..matching.metrics import count, pooled
from .datasets import View, load_dataset
from .progress import Progress, silent
from .run_dataset import pairs

Setting = dict[str, Any]
"""Options of a matcher."""

MEASURED = ("precision", "recall", "f1")


def grid(**values: Sequence[Any]) -> list[Setting]:
    """Every combination of the options' values."""
    return [dict(zip(values, combination, strict=True)) for combination in product(*values.values())]


TRIPLES = grid(angle_width=(None, 0.1, 0.3, 1.0), neighbours_factor=(0.3, 1.0, 3.0))

GRIDS: dict[str, list[Setting]] = {
    "rgm": grid(distance_width_factor=(2.0, 4.0, 8.0), angle_width=(0.25, 0.5), reject_mirrored=(False, True)),
    "rrwm": grid(distance_width_factor=(0.5, 1.0, 2.0, 4.0), attribute_weight=(0.0, 1.0, 3.0)),
    "icp": [
        {"gate_sigmas": gate, "translations": translations, "gate_shrink": shrink}
        for gate in (1.0, 2.0, 3.0, 5.0)
        for translations, shrink in (("centroids", 0.0), ("objects", 0.0), ("objects", 0.7))
    ],
    "bcagm": TRIPLES,
    "rrwhm": TRIPLES,
    "reid": grid(min_similarity=[round(0.09 * k, 2) for k in range(12)]),
    "mos": grid(
        distance_width_factor=(1.0, 2.0, 4.0),
        attribute_exponent=(1.0, 3.0),
        order_weights=((1.0, 1.0, 1.0), (1.0, 1.0, 0.3)),
    ),
    "clipper": grid(sigma_factor=(0.5, 1.0, 2.0), epsilon_sigmas=(3.0, 6.0), min_similarity=(0.5, 0.8)),
}
"""Twelve settings of each rival, and of the paper's method, over what its paper leaves to the user."""


def compare_settings(
    targets: Sequence[str | Path],
    method: str,
    settings: Sequence[Setting],
    *,
    frames: int | None = None,
    seed: int = 0,
    progress: Progress = silent,
    **options: Any,
) -> list[dict[str, Any]]:
    """Pooled precision, recall and F1 of a method for every setting, on dataset folders, poses unknown.

    Args:
        targets: dataset folders.
        method: a name of METHODS.
        settings: options to compare, each with the same names.
        frames: at most so many frames of each target, evenly spread; None = all.
        seed: of the detections' shuffling and of the matchers' streams.
        progress: called with settings done and settings in all.
        options: further options of the method, the same in every setting.

    Returns:
        A row per target and setting: target, the setting's options, pairs, precision, recall, f1.

    Raises:
        ValueError: `frames` below 1, or an option that the method refuses.
        DatasetError: a folder that cannot be read.
    """
    if frames is not None and frames < 1:
        raise ValueError(f"frames must be at least 1, got {frames}")
    rows: list[dict[str, Any]] = []
    for target in targets:
        found = view_pairs(target, frames, seed)
        for setting in settings:
            progress(len(rows), len(targets) * len(settings))
            score = _score(found, method, seed, {**options, **setting})
            rows.append({"target": Path(target).name, **setting, **score})
    progress(len(rows), len(rows))
    return rows


def mean_over_targets(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """A row per setting: precision, recall and F1 averaged over the targets, each counting alike; `pairs` summed."""
    targets = sorted({row["target"] for row in rows})
    name = targets[0] if len(targets) == 1 else f"mean of {len(targets)} datasets"
    groups: dict[str, list[Mapping[str, Any]]] = {}
    for row in rows:
        groups.setdefault(str(setting_of(row)), []).append(row)
    return [
        {"target": name, **setting_of(own[0]), "pairs": sum(r["pairs"] for r in own)}
        | {measure: float(np.mean([r[measure] for r in own])) for measure in MEASURED}
        for own in groups.values()
    ]


def setting_of(row: Mapping[str, Any]) -> Setting:
    """The options among a row's entries."""
    return {name: value for name, value in row.items() if name not in ("target", "pairs", *MEASURED)}


def view_pairs(target: str | Path, frames: int | None, seed: int) -> list[tuple[View, View]]:
    """Every pair of views with enough detections, of at most `frames` frames, evenly spread."""
    return [(a, b) for frame in load_dataset(target, seed).spread(frames) for _, a, b in pairs(frame)]


def _score(pairs: list[tuple[View, View]], method: str, seed: int, options: Setting) -> dict[str, Any]:
    streams = np.random.default_rng(seed).spawn(len(pairs))
    total = pooled(
        [
            count(METHODS[method](a.graph, b.graph, rng=rng, **options), a.identity, b.identity)
            for (a, b), rng in zip(pairs, streams, strict=True)
        ]
    )
    return {"pairs": len(pairs), "precision": total.precision, "recall": total.recall, "f1": total.f1}
