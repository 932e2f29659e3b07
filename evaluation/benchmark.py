"""Targets x methods -> rows."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from .engine import Unit, dataset_units, run, target_name
from .methods import Method
from .records import summarise
from .settings import Settings


def plan(targets: Sequence[str], settings: Settings) -> list[Unit]:
    """Work units of the targets: dataset folders.

    Raises:
        ValueError: a target that is neither.
    """
    units: list[Unit] = []
    for target in targets:
        if not Path(target).is_dir():
            raise ValueError(f"target {target!r} is not a dataset folder")
        units += dataset_units(target, settings)
    return units


def benchmark(
    targets: Sequence[str],
    methods: Sequence[Method],
    settings: Settings,
    *,
    workers: int = 1,
    out: Path | None = None,
    resume: bool = False,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> list[dict[str, Any]]:
    """One row per target and method, as docs/reference/commands.md describes."""
    for method in methods:
        method.load()
    units = plan(targets, settings)
    records = run(units, methods, settings, workers=workers, out=out, resume=resume, progress=progress)
    names = list(dict.fromkeys(target_name(unit, settings) for unit in units))
    rows = []
    for name in names:
        for method in methods:
            chosen = [r for r in records if r.target == name and r.method == method.label]
            head = {
                "target": name,
                "method": method.name,
                "options": dict(method.options),
                "pose": settings.pose,
                "preset": settings.preset,
                "sequence": settings.sequence,
                "min_common": settings.min_common,
                "seed": settings.seed,
            }
            rows.append(head | summarise(chosen))
    return rows
