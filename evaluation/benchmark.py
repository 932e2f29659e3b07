"""Targets x methods -> rows."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from .engine import Results, make_executor, run
from .experiments import Experiment, target_name, units_of
from .extras import require
from .methods import Method
from .provenance import RENDERER, provenance
from .records import summarise
from .settings import SCENE_NAMES, Settings, scene_preset
from .shards import ROWS, Shards, write_json


def plan(targets: Sequence[str], methods: Sequence[Method], settings: Settings) -> list[Experiment]:
    """One experiment per target: names of scenes, `package.module:World`, dataset folders.

    Raises:
        ValueError: a target that is neither.
        MissingExtraError: a scene without the packages it needs.
    """
    texts = tuple(method.label for method in methods)
    experiments = []
    for target in dict.fromkeys(targets):
        if target in SCENE_NAMES or (":" in target and not Path(target).exists()):
            require("envs")
            experiments.append(Experiment(target, "scene", target, texts, settings, (settings.seed,)))
        elif Path(target).is_dir():
            experiments.append(Experiment(target, "dataset", target, texts, settings, (settings.seed,)))
        else:
            raise ValueError(f"target {target!r} is neither a dataset folder nor a scene ({', '.join(SCENE_NAMES)})")
    return experiments


def benchmark(
    targets: Sequence[str],
    methods: Sequence[Method],
    settings: Settings,
    *,
    workers: int = 1,
    engine: str = "local",
    ray_address: str | None = None,
    out: Path | None = None,
    resume: bool = False,
    overwrite: bool = False,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> list[dict[str, Any]]:
    """One row per target and method, as docs/reference/commands.md describes.

    Args:
        targets: see `plan`.
        methods: see `covis.evaluation.methods`.
        settings: options of the run.
        workers, engine, ray_address: see `covis.evaluation.engine.make_executor`.
        out: folder that keeps records, run.json and rows.json.
        resume: go on with the run in `out`.
        overwrite: replace the run in `out`.
        progress: called with (units done, units in all).

    Raises:
        ValueError: a target or setting that makes no sense.
        FileExistsError: `out` holds another run, or this one and neither `resume` nor `overwrite` is on.
        UnitFailedError: a part of the work failed again and again; the rest is in `out`.
    """
    for method in methods:
        method.load()
    executor = make_executor(engine, workers, ray_address)
    experiments = plan(targets, methods, settings)
    units = units_of(experiments)
    session = provenance()
    shards = None if out is None else Shards(out, len(units))
    if shards is not None:
        request = {
            "experiments": [asdict(e) for e in experiments],
            "units": [[u.experiment.id, u.seed, u.episodes] for u in units],
        }
        shards.open(request, session, resume=resume, overwrite=overwrite)
    about = {"commit": session["commit"]}
    results = run(units, executor, shards=shards, shared_folder=engine == "local", about=about, progress=progress)
    rows = [row for experiment in experiments for row in _rows(experiment, results, session["versions"])]
    if shards is not None:
        write_json(shards.out / ROWS, {"rows": rows})
    return rows


def _rows(experiment: Experiment, results: Results, versions: dict[str, str]) -> list[dict[str, Any]]:
    records = results.records(experiment.id)
    settings, name = experiment.settings, target_name(experiment)
    # A resumed run may have gone on with other code.
    commits = sorted({facts["commit"] or "unknown" for facts in results.facts(experiment.id)})
    scene = experiment.kind == "scene"
    rows = []
    for text in experiment.methods:
        method = Method.parse(text)
        head = {
            "target": name,
            "method": method.name,
            "options": dict(method.options),
            "pose": settings.pose,
            "preset": scene_preset(name, settings),
            "sequence": settings.sequence,
            "min_common": settings.min_common,
            "seed": experiment.seeds[0],
            "seeds": list(experiment.seeds),
            "experiment": experiment.id,
            "perception": settings.perception if scene else None,
            "renderer": RENDERER if scene else None,
            "commit": ", ".join(commits),
            "versions": versions,
        }
        rows.append(head | summarise([r for r in records if r.method == text]))
    return rows
