"""`covis localize`: how well teams localise, when all is well, under faults, and by their size."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer
from rich.table import Table

from ..evaluation.extras import require
from ..evaluation.figures import save, team_figure
from .console import fail, out, progress_bar, write_rows

COLUMNS = {
    "scenes": (
        "target",
        "estimator",
        "objects",
        "precision",
        "recall",
        "n",
        "single_m",
        "fused_m",
        "ratio",
        "fused_median_m",
        "fused_p95_m",
        "nees_per_dof",
        "alone_n",
        "alone_fused_m",
        "alone_nees_per_dof",
        "gospa_m",
        "identity_switches",
    ),
    "faults": ("fault", "matches", "protections", "precision", "f1", "fused_m", "growth", "nees_per_dof"),
    "team": (
        "what",
        "robots",
        "fused_m",
        "fused_median_m",
        "fused_p95_m",
        "nees_per_dof",
        "pairwise_f1",
        "f1",
        "convex_f1",
        "spectral_f1",
    ),
}


def localize(
    parts: Annotated[list[str] | None, typer.Argument(help="scenes, faults, team. Default: all.")] = None,
    seed: Annotated[int, typer.Option(help="Of the scenes; constants were chosen on 7003.")] = 9001,
    episodes: Annotated[int | None, typer.Option(help="Per scene; default 50 of the case study, else 10 or 5.")] = None,
    perception: Annotated[str, typer.Option(help="simulated | learned.")] = "simulated",
    min_score: Annotated[float | None, typer.Option(help="Less probable matches are not used.")] = None,
    exact_poses: Annotated[bool, typer.Option("--exact-poses", help="Scenes: robots know where they are.")] = False,
    figure: Annotated[Path | None, typer.Option(help="Write a figure of the error against the team's size.")] = None,
    json_target: Annotated[str | None, typer.Option("--json", help="Write rows to FILE; - prints them.")] = None,
) -> None:
    """Displacement error, consistency and resilience of teams that match, fuse and track with noisy poses."""
    try:
        require("envs")
        if figure is not None:
            require("viz")
        from ..evaluation.localization import MIN_SCORE, PARTS, localization_rows

        with progress_bar("localize") as progress:
            rows = localization_rows(
                parts or PARTS,
                seed=seed,
                episodes=episodes,
                perception=perception,
                min_score=MIN_SCORE if min_score is None else min_score,
                exact_poses=exact_poses,
                progress=progress,
            )
    except (ValueError, RuntimeError) as error:
        fail(error)
    write_rows(rows, json_target)
    if figure is not None:
        save(team_figure(rows), figure)
    if json_target != "-":
        for part in dict.fromkeys(row["part"] for row in rows):
            out.print(table([row for row in rows if row["part"] == part], COLUMNS[part]))


def table(rows: list[dict[str, Any]], columns: tuple[str, ...]) -> Table:
    """The rows for a person; a change of the first column draws a line."""
    view = Table(header_style="bold")
    for name in columns:
        text = isinstance(rows[0].get(name), str)
        view.add_column(name.replace("_", " "), justify="left" if text else "right")
    for row, following in zip(rows, [*rows[1:], None], strict=True):
        cells = [row.get(name) for name in columns]
        last = following is None or following[columns[0]] != row[columns[0]]
        view.add_row(
            *("" if c is None else f"{c:.3f}" if isinstance(c, float) else str(c) for c in cells), end_section=last
        )
    return view
