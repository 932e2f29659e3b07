"""Targets x methods -> rows."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from .engine import Unit, dataset_units, run, scene_units, target_name
from .extras import require
from .methods import Method
from .records import summarise
from .settings import SCENE_NAMES, Settings, scene_preset


def plan(targets: Sequence[str], settings: Settings) -> list[Unit]:
    """Work units of the targets: names of scenes, `package.module:World`, dataset folders.

    Raises:
        ValueError: a target that is neither.
        MissingExtraError: a scene without the packages it needs.
    """
    units: list[Unit] = []
    for target in targets:
        if target in SCENE_NAMES or (":" in target and not Path(target).exists()):
            require("envs")
            units += scene_units(target, settings)
        elif Path(target).is_dir():
            units += dataset_units(target, settings)
        else:
            raise ValueError(f"target {target!r} is neither a dataset folder nor a scene ({', '.join(SCENE_NAMES)})")
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
                "preset": scene_preset(name, settings),
                "sequence": settings.sequence,
                "min_common": settings.min_common,
                "seed": settings.seed,
            }
            rows.append(head | summarise(chosen))
    return rows
