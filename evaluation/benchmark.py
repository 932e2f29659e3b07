"""Targets x methods, or suites -> rows."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from .comparison import Entry, Ordering, compared, judged
from .engine import Results, make_executor, run
from .experiments import Experiment, absolute, target_name, units_of
from .extras import require_scene
from .methods import Method
from .progress import Progress, silent
from .provenance import RENDERER, provenance
from .records import Tally
from .settings import SCENE_NAMES, Settings, scene_preset
from .shards import Shards
from .suites import Suite
from .synthetic import PREFIX, problem_names

GENERATED = tuple(PREFIX + name for name in problem_names())
"""Targets that are generated on the spot."""


def plan(targets: Sequence[str], methods: Sequence[Method], settings: Settings) -> list[Experiment]:
    """One experiment per target: names of scenes, `package.module:World`, generated problems, dataset folders.

    Raises:
        ValueError: a target that is none of them.
        MissingExtraError: a scene without the packages it needs.
    """
    texts = tuple(dict.fromkeys(method.label for method in methods))
    experiments = []
    for target in dict.fromkeys(targets):
        if target in SCENE_NAMES or (":" in target and not Path(target).exists()):
            require_scene(settings.perception)
            experiments.append(Experiment(target, "scene", target, texts, settings, (settings.seed,)))
        elif target in GENERATED:
            problem = target.removeprefix(PREFIX)
            experiments.append(Experiment(target, "synthetic", problem, texts, settings, (settings.seed,)))
        elif Path(target).is_dir():
            experiments.append(Experiment(target, "dataset", target, texts, settings, (settings.seed,)))
        else:
            known = ", ".join((*SCENE_NAMES, *GENERATED))
            raise ValueError(f"target {target!r} is neither a dataset folder nor one of {known}")
    return experiments


def benchmark(
    targets: Sequence[str], methods: Sequence[Method], settings: Settings, **how: Any
) -> list[dict[str, Any]]:
    """One row per target and method, as docs/reference/commands.md describes.

    Args:
        targets: see `plan`.
        methods: see `covis.evaluation.methods`; one that is given twice runs once.
        settings: options of the run.
        how: see `run_experiments`.

    Raises:
        ValueError: a target or setting that makes no sense.
    """
    for method in methods:
        method.check()
    return run_experiments(plan(targets, methods, settings), **how)


def benchmark_suite(
    suite: Suite, methods: Sequence[Method] = (), changes: Mapping[str, Any] | None = None, **how: Any
) -> list[dict[str, Any]]:
    """One row per experiment and method of a suite, further `methods` added to its own.

    Args:
        suite: one of SUITES, or another.
        methods: added to every experiment.
        changes: of the suite's settings, e.g. `{"episodes": 1}`; rows show them.
        how: see `run_experiments`.
    """
    experiments = suite.plan([method.label for method in methods], **(changes or {}))
    for experiment in experiments:
        if experiment.kind == "scene":
            require_scene(experiment.settings.perception)
    about = {"suite": suite.id, "suite_version": suite.version}
    return run_experiments(experiments, about=about, orderings=suite.orderings, **how)


def run_experiments(
    experiments: Sequence[Experiment],
    *,
    about: Mapping[str, Any] | None = None,
    orderings: Sequence[Ordering] = (),
    judge: Callable[[list[dict[str, Any]]], object] = lambda verdicts: None,
    workers: int = 1,
    engine: str = "local",
    ray_address: str | None = None,
    out: Path | None = None,
    resume: bool = False,
    overwrite: bool = False,
    progress: Progress = silent,
    complain: Callable[[str], object] = lambda message: None,
) -> list[dict[str, Any]]:
    """Rows of experiments.

    Args:
        experiments: what to run.
        about: put at the head of every row, and into run.json.
        orderings: held against every experiment; the verdicts go to `judge`, and into rows.json.
        judge: called once with them: `experiment` and what `covis.evaluation.comparison.judged` returns.
        workers, engine, ray_address: see `covis.evaluation.engine.make_executor`.
        out: folder that keeps records, run.json and rows.json.
        resume: go on with the run in `out`.
        overwrite: replace the run in `out`.
        progress: called with (units done, units in all).
        complain: called with what a method failed of, once for each method. On a pair on which it fails it counts as
            having found nothing; rows tell how many these are (`n_failed`).

    Raises:
        FileExistsError: `out` holds another run, or this one and neither `resume` nor `overwrite` is on.
        UnitFailedError: a part of the work failed again and again; the rest is in `out`.
    """
    about = about or {"suite": None}
    for text in dict.fromkeys(text for experiment in experiments for text in experiment.methods):
        Method.parse(text).check()
    executor = make_executor(engine, workers, ray_address)
    units = units_of(experiments)
    session = provenance()
    shards = None if out is None else Shards(out, len(units))
    if shards is not None:
        request = {
            **about,
            "experiments": [asdict(e) for e in experiments],
            "units": [[u.experiment.id, u.seed, u.episodes] for u in units],
        }
        shards.open(request, session, resume=resume, overwrite=overwrite)
    noted = {"commit": session["commit"]}
    if engine == "ray":  # elsewhere the working directory is another
        units = [replace(unit, experiment=absolute(unit.experiment)) for unit in units]
    results = run(
        units,
        executor,
        shards=shards,
        shared_folder=engine == "local",
        about=noted,
        progress=progress,
        complain=complain,
    )
    rows, verdicts = [], []
    for experiment in experiments:
        entries = _entries(experiment, results, session["versions"])
        rows += [{**about, **row} for row in compared(entries)]
        verdicts += [{"experiment": experiment.id, **judged(ordering, entries)} for ordering in orderings]
    judge(verdicts)
    if shards is not None:
        content = {"rows": rows} | ({"orderings": verdicts} if verdicts else {})
        shards.close(content, [_cost(experiment, results, rows) for experiment in experiments])
    return rows


def _entries(experiment: Experiment, results: Results, versions: dict[str, str]) -> list[Entry]:
    found = results.tallies(experiment.id)
    # A resumed run may have gone on with other code.
    commits = sorted({facts["commit"] or "unknown" for facts in results.facts(experiment.id)})
    head = _head(experiment) | {"commit": ", ".join(commits), "versions": versions}
    entries = []
    for text in experiment.methods:
        method = Method.parse(text)
        tally = found.get(text) or Tally.pool([])
        names = {"target": head["target"], "method": method.name, "options": dict(method.options)}
        row = names | head | {"disturbance": method.disturbance.rates()} | tally.row()
        entries.append(Entry(method, row, tally.episodes))
    return entries


def _cost(experiment: Experiment, results: Results, rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """What an experiment has cost: the time of its units, on whichever machine they ran."""
    facts = results.facts(experiment.id)
    return {
        "experiment": experiment.id,
        "units": len(facts),
        "frames": max((row["frames"] for row in rows if row["experiment"] == experiment.id), default=0),
        "seconds": sum(f["seconds"] for f in facts),
        "cpu_seconds": sum(f["cpu_seconds"] for f in facts),
    }


def _head(experiment: Experiment) -> dict[str, Any]:
    """What all rows of an experiment share."""
    settings, scene = experiment.settings, experiment.kind == "scene"
    name = target_name(experiment)
    return {
        "target": name,
        "pose": settings.pose,
        "preset": scene_preset(name, settings),
        "sequence": settings.sequence,
        "min_common": settings.min_common,
        "seed": experiment.seeds[0],
        "seeds": list(experiment.seeds),
        "experiment": experiment.id,
        "n_robots": settings.n_robots,
        "perception": settings.perception if scene else None,
        "renderer": RENDERER if scene else None,
    }
