"""`covis benchmark`: methods on dataset folders, scenes and suites."""

from __future__ import annotations

import shlex
import sys
from pathlib import Path
from typing import Annotated, Any, NoReturn

import typer

from ..evaluation.benchmark import benchmark as run_benchmark
from ..evaluation.benchmark import benchmark_suite
from ..evaluation.extras import require
from ..evaluation.methods import Method
from ..evaluation.settings import Settings
from ..evaluation.suites import SUITES
from .console import complain, err, fail, out, progress_bar, require_writable, require_writable_figure, write_rows
from .tables import Column, number, print_rows, share, short, words


def benchmark(
    targets: Annotated[list[str], typer.Argument(help="Dataset folders, scenes or suites.", metavar="TARGET...")],
    method: Annotated[
        list[str] | None,
        typer.Option(help="NAME[:option=value,...] or package.module:callable; repeatable. Default: every method."),
    ] = None,
    pose: Annotated[str | None, typer.Option(help="unknown | known: hand the noisy poses to the matcher.")] = None,
    preset: Annotated[str | None, typer.Option(help="Difficulty of scenes: easy | paper | hard.")] = None,
    min_common: Annotated[int | None, typer.Option(help="Leave out pairs with fewer common objects.")] = None,
    sequence: Annotated[bool, typer.Option("--sequence", help="Carry a tracker through each episode.")] = False,
    seed: Annotated[int | None, typer.Option(help="Seed of shuffling, scenes and matchers.")] = None,
    episodes: Annotated[int | None, typer.Option(help="Episodes per scene, or the first so many of a dataset.")] = None,
    perception: Annotated[
        str | None, typer.Option(help="Eyes in scenes: learned (default) | learned:FOLDER | simulated.")
    ] = None,
    images: Annotated[int | None, typer.Option(help="perception: images per scene (300).")] = None,
    figure: Annotated[
        Path | None, typer.Option(help="Draw F1, or robustness; for perception, what the eyes see.")
    ] = None,
    workers: Annotated[int, typer.Option(help="Processes; on Ray, units at a time (1: one per CPU).")] = 1,
    engine: Annotated[str, typer.Option(help="local | ray.")] = "local",
    ray_address: Annotated[str | None, typer.Option(help="A running Ray cluster: auto, or HOST:PORT.")] = None,
    out_dir: Annotated[Path | None, typer.Option("--out", help="Keep the records here; needed to resume.")] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Go on with the run in --out.")] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace the run in --out.")] = False,
    json_target: Annotated[str | None, typer.Option("--json", help="Write rows to FILE; - prints them.")] = None,
) -> None:
    """Score matchers by precision, recall, F1, calibration and displacement error."""
    given = {"pose": pose, "preset": preset, "min_common": min_common, "sequence": sequence or None, "seed": seed}
    changes = {"episodes": episodes, "perception": perception}
    if "perception" in targets:
        left = given | changes | {"method": method, "out": out_dir, "resume": resume or None}
        unused = [name for name in _only(left) if name not in ("seed", "perception")]
        _perception(targets, unused, seed or 0, perception or "learned", images, figure, json_target)
        return
    verdicts: list[dict[str, Any]] = []
    how: dict[str, Any] = {"workers": workers, "engine": engine, "ray_address": ray_address}
    how |= {"out": out_dir, "resume": resume, "overwrite": overwrite}
    try:
        if (resume or overwrite) and out_dir is None:
            raise ValueError(f"{'--resume' if resume else '--overwrite'} needs --out")
        if resume and overwrite:
            raise ValueError("give --resume or --overwrite, not both")
        require_writable(json_target)
        if figure is not None:
            require("viz")
            require_writable_figure(figure)
        with progress_bar("benchmark") as progress:
            how |= {"progress": progress, "judge": verdicts.extend, "complain": complain}
            rows = _run(targets, method or [], _only(given), _only(changes), how)
    except (ValueError, RuntimeError, OSError) as error:
        fail(error)
    except KeyboardInterrupt:
        _interrupted(out_dir)
    write_rows(rows, json_target)
    if figure is not None:
        from ..evaluation.figures import benchmark_figure, save

        save(benchmark_figure(rows), figure)
    if json_target != "-":
        print_benchmark(rows)
        print_verdicts(verdicts)
    if any(row["n_failed"] for row in rows):
        for row in rows:
            if row["n_failed"]:
                where = f"{row['n_failed']} of {row['pairs']} pairs of {_target(row)}"
                complain(f"{_method(row)} failed on {where}, and counts as having found nothing there")
        raise typer.Exit(1)


def _run(
    targets: list[str], texts: list[str], given: dict[str, Any], changes: dict[str, Any], how: dict[str, Any]
) -> list[dict[str, Any]]:
    """A suite alone, or targets under `given` and `changes` as settings; a suite takes no more than `changes`."""
    methods = [Method.parse(text) for text in texts]
    suites = [target for target in targets if target in SUITES]
    if not suites:
        settings = Settings(**given, **changes)
        methods = methods or [Method.parse(text) for text in default_methods(settings)]
        return run_benchmark(targets, methods, settings, **how)
    if len(targets) > 1:
        raise ValueError(f"a suite is run alone, got the targets {' '.join(targets)}")
    if given:
        raise ValueError(f"the suite {suites[0]} fixes {', '.join(given)}: leave the option away")
    return benchmark_suite(SUITES[suites[0]], methods, changes, **how)


def _only(options: dict[str, Any]) -> dict[str, Any]:
    """Those that were given."""
    return {name: value for name, value in options.items() if value is not None}


def _interrupted(out_dir: Path | None) -> NoReturn:
    """One line on what is left, exit status 130."""
    if out_dir is None:
        err.print("interrupted; nothing is kept without --out")
    else:
        again = [*sys.argv[1:], *([] if "--resume" in sys.argv else ["--resume"])]
        again = [word for word in again if word != "--overwrite"]
        err.print(f"interrupted; go on with: covis {shlex.join(again)}", highlight=False, markup=False, soft_wrap=True)
    raise typer.Exit(130)


def _perception(
    targets: list[str],
    unused: list[str],
    seed: int,
    eyes: str,
    images: int | None,
    figure: Path | None,
    json_target: str | None,
) -> None:
    """`covis benchmark perception`: learned eyes alone, on test scenes."""
    from ..evaluation.perception_benchmark import (
        IMAGES,
        perception_benchmark,
        shift_columns,
        table_columns,
        weights_of,
    )

    try:
        if targets != ["perception"]:
            raise ValueError(f"perception is benchmarked alone, got the targets {' '.join(targets)}")
        if unused:
            raise ValueError(f"perception has no {', '.join('--' + name.replace('_', '-') for name in unused)}")
        weights = weights_of(eyes)
        require_writable(json_target)
        if figure is not None:
            require("envs")
            from ..evaluation.perception_figure import require_drawable, save_figure

            require_drawable(figure)
        number = IMAGES if images is None else images
        with progress_bar("perception") as progress:
            rows = perception_benchmark(weights=weights, images=number, seed=seed, progress=progress)
        if figure is not None:
            save_figure(figure, weights, seed)
    except (ValueError, RuntimeError, OSError) as error:
        fail(error)
    write_rows(rows, json_target)
    if json_target != "-":
        for part, columns in ((rows, table_columns()), ([r for r in rows if "known_ap50" in r], shift_columns())):
            print_rows(part, [Column(t, words(k) if k == "target" else share(k), k == "target") for k, t in columns])


def default_methods(settings: Settings) -> list[str]:
    """Every registered method that runs without what this run does not have."""
    from ..matching import METHODS

    return [name for name in METHODS if settings.pose == "known" or name != "hungarian"]


def print_benchmark(rows: list[dict[str, Any]]) -> None:
    """The rows for a person, a table per target: methods and the figures that are there."""
    groups: dict[str, list[dict[str, Any]]] = {}
    for row in _told_apart(rows):
        groups.setdefault(_target(row), []).append(row)
    for target, own in groups.items():
        print_rows(own, COLUMNS, f"{target}: {own[0]['pairs']} pairs of views, {own[0]['episodes']} episodes")
    if any(row.get("ties_best") is not None for row in rows):
        out.print("to best: difference of F1 to the highest; ~ where noise alone may explain it (paired over episodes)")


def _told_apart(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Data sets of the same name by their folders."""
    folders: dict[str, set[str]] = {}
    for row in rows:
        folders.setdefault(row["target"], set()).add(row["experiment"])
    return [row | {"target": row["experiment"]} if len(folders[row["target"]]) > 1 else row for row in rows]


def print_verdicts(verdicts: list[dict[str, Any]]) -> None:
    """What the data say of orderings, a table per experiment."""
    for experiment in dict.fromkeys(verdict["experiment"] for verdict in verdicts):
        own = [_verdict(verdict) for verdict in verdicts if verdict["experiment"] == experiment]
        print_rows(own, VERDICT_COLUMNS, str(experiment))


def _verdict(verdict: dict[str, Any]) -> dict[str, Any]:
    """What the data say of an ordering, with the pair that fits the least."""
    least = min(verdict["pairs"], key=lambda pair: pair["difference"], default=None)
    shown = None if least is None else f"{short(least['difference'], '{:+.3f}')} {least['higher']} to {least['lower']}"
    return verdict | {"least": shown}


def _target(row: dict[str, Any]) -> str:
    """The experiment where a suite has several of one target, else the target."""
    return str(row["experiment"] if row.get("suite") else row["target"])


def _method(row: dict[str, Any]) -> str:
    options = ",".join(f"{k}={v}" for k, v in row["options"].items())
    disturbance = ",".join(f"{k}={v}" for k, v in row.get("disturbance", {}).items())
    return row["method"] + (f":{options}" if options else "") + (f"@{disturbance}" if disturbance else "")


def _to_best(row: dict[str, Any]) -> str:
    difference = row.get("f1_minus_best")
    if difference is None:
        return ""
    if difference == 0.0 and row["ties_best"]:
        return "best"
    return f"{'~ ' if row['ties_best'] else ''}{short(difference, '{:+.3f}')}"


def _interval(row: dict[str, Any]) -> str:
    if row["episodes"] < 2:
        return ""
    return "-".join(short(row[key]).replace("1.000", "1") for key in ("f1_low", "f1_high"))


def _milliseconds(row: dict[str, Any]) -> str:
    """Three digits, where there are as many."""
    ms = row["match_ms"]
    return "" if ms is None else f"{ms:.2f}" if ms < 9.995 else f"{ms:.1f}" if ms < 99.95 else f"{ms:.0f}"


COLUMNS = (
    Column("method", _method, label=True),
    Column("prec.", share("precision")),
    Column("recall", share("recall")),
    Column("F1", share("f1")),
    Column("95 %", _interval),
    Column("to best", _to_best),
    Column("ECE", share("ece")),
    Column("alone\nm", number("displacement_single_m")),
    Column("fused\nm", number("displacement_fused_m")),
    Column("ms a\npair", _milliseconds),
)
VERDICT_COLUMNS = (
    Column("who says what of F1", words("says"), label=True),
    Column("verdict", words("verdict")),
    Column("least difference", words("least")),
)
