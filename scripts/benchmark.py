"""`covis benchmark`: methods on dataset folders, scenes and suites."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, NoReturn

import typer
from rich.table import Table

from ..evaluation.benchmark import benchmark as run_benchmark
from ..evaluation.methods import Method
from ..evaluation.settings import Settings
from .console import err, fail, out, progress_bar, write_rows


def benchmark(
    targets: Annotated[list[str], typer.Argument(help="Dataset folders, scenes or suites.", metavar="TARGET...")],
    method: Annotated[
        list[str] | None,
        typer.Option(help="NAME[:option=value,...] or package.module:callable; repeatable. Default: every method."),
    ] = None,
    pose: Annotated[str, typer.Option(help="unknown | known: hand the noisy poses to the matcher.")] = "unknown",
    preset: Annotated[str | None, typer.Option(help="Difficulty of scenes: easy | paper | hard.")] = None,
    min_common: Annotated[int, typer.Option(help="Leave out pairs with fewer common objects.")] = 0,
    sequence: Annotated[bool, typer.Option("--sequence", help="Carry a tracker through each episode.")] = False,
    seed: Annotated[int, typer.Option(help="Seed of shuffling, scenes and matchers.")] = 0,
    episodes: Annotated[int | None, typer.Option(help="Episodes per scene, or the first so many of a dataset.")] = None,
    perception: Annotated[str, typer.Option(help="simulated | learned.")] = "simulated",
    workers: Annotated[int, typer.Option(help="Processes; on Ray, units at a time.")] = 1,
    engine: Annotated[str, typer.Option(help="local | ray.")] = "local",
    ray_address: Annotated[str | None, typer.Option(help="A running Ray cluster: auto, or HOST:PORT.")] = None,
    out_dir: Annotated[Path | None, typer.Option("--out", help="Keep the records here; needed to resume.")] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Go on with the run in --out.")] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace the run in --out.")] = False,
    json_target: Annotated[str | None, typer.Option("--json", help="Write rows to FILE; - prints them.")] = None,
) -> None:
    """Score matchers by precision, recall, F1, calibration and displacement error."""
    if "perception" in targets:
        _perception(targets, seed, json_target)
        return
    try:
        settings = Settings(pose, preset, min_common, sequence, seed, episodes, perception)  # type: ignore[arg-type]
        methods = [Method.parse(text) for text in method or default_methods(settings)]
        if (resume or overwrite) and out_dir is None:
            raise ValueError(f"{'--resume' if resume else '--overwrite'} needs --out")
        if resume and overwrite:
            raise ValueError("give --resume or --overwrite, not both")
        with progress_bar("benchmark") as progress:
            rows = run_benchmark(
                targets,
                methods,
                settings,
                workers=workers,
                engine=engine,
                ray_address=ray_address,
                out=out_dir,
                resume=resume,
                overwrite=overwrite,
                progress=progress,
            )
    except (ValueError, RuntimeError, OSError) as error:
        fail(error)
    except KeyboardInterrupt:
        _interrupted(out_dir)
    write_rows(rows, json_target)
    if json_target != "-":
        out.print(table(rows))


def _interrupted(out_dir: Path | None) -> NoReturn:
    """One line on what is left, exit status 130."""
    if out_dir is None:
        err.print("interrupted; nothing is kept without --out")
    else:
        again = [*sys.argv[1:], *([] if "--resume" in sys.argv else ["--resume"])]
        again = [word for word in again if word != "--overwrite"]
        err.print(f"interrupted; go on with: covis {shlex.join(again)}", highlight=False, markup=False, soft_wrap=True)
    raise typer.Exit(130)


def _perception(targets: list[str], seed: int, json_target: str | None) -> None:
    """`covis benchmark perception`: the shipped eyes alone, on test scenes."""
    from ..evaluation.perception_benchmark import perception_benchmark, table_columns

    try:
        if targets != ["perception"]:
            raise ValueError(f"perception is benchmarked alone, got the targets {' '.join(targets)}")
        with progress_bar("perception") as progress:
            rows = perception_benchmark(seed=seed, progress=progress)
    except (ValueError, RuntimeError) as error:
        fail(error)
    write_rows(rows, json_target)
    if json_target != "-":
        view = Table(header_style="bold")
        for key, title in table_columns():
            view.add_column(title, justify="left" if key == "target" else "right")
        for row in rows:
            cells = (row.get(key) for key, _ in table_columns())
            view.add_row(*(c if isinstance(c, str) else "" if c is None else f"{c:.3f}" for c in cells))
        out.print(view)


def default_methods(settings: Settings) -> list[str]:
    """Every registered method that runs without what this run does not have."""
    from ..matching import METHODS

    return [name for name in METHODS if settings.pose == "known" or name != "hungarian"]


def table(rows: list[dict[str, Any]]) -> Table:
    """The rows for a person: target, method and the figures that are there."""
    view = Table(title=None, header_style="bold")
    columns: list[tuple[str, str, Callable[[Any], str] | None]] = [
        ("target", "target", str),
        ("method", "method", str),
        ("pairs", "pairs", str),
        ("precision", "precision", "{:.3f}".format),
        ("recall", "recall", "{:.3f}".format),
        ("f1", "F1", "{:.3f}".format),
        ("f1_low", "95 %", None),
        ("ece", "ECE", "{:.3f}".format),
        ("displacement_single_m", "single m", "{:.3f}".format),
        ("displacement_fused_m", "fused m", "{:.3f}".format),
        ("match_ms", "ms", "{:.2f}".format),
    ]
    shown = [c for c in columns if any(row.get(c[0]) is not None for row in rows)]
    for key, title, _ in shown:
        view.add_column(title, justify="left" if key in ("target", "method") else "right", no_wrap=True)
    for i, row in enumerate(rows):
        cells = []
        for key, _, form in shown:
            if form is None:
                cells.append(f"{row['f1_low']:.3f}-{row['f1_high']:.3f}")
            elif key == "method" and row["options"]:
                cells.append(row["method"] + ":" + ",".join(f"{k}={v}" for k, v in row["options"].items()))
            else:
                cells.append("" if row.get(key) is None else form(row[key]))
        last = i + 1 == len(rows) or rows[i + 1]["target"] != row["target"]
        view.add_row(*cells, end_section=last)
    return view
