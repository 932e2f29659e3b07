"""`covis localize`: how well teams localise, when all is well, under faults, and by their size."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from ..evaluation.extras import require
from ..evaluation.figures import save, team_figure
from .console import fail, progress_bar, require_writable, require_writable_figure, write_rows
from .tables import Column, number, print_rows, share, words

COLUMNS = {
    "scenes": (
        Column("estimator", words("estimator"), label=True),
        Column("prec.", share("precision")),
        Column("recall", share("recall")),
        Column("n", words("n")),
        Column("alone\nm", number("single_m")),
        Column("fused\nm", number("fused_m")),
        Column("ratio", number("ratio")),
        Column("median\nm", number("fused_median_m")),
        Column("95 %\nm", number("fused_p95_m")),
        Column("NEES\na dof", number("nees_per_dof", "{:.2f}")),
        Column("unmatched\nn", words("alone_n")),
        Column("unmatched\nm", number("alone_fused_m")),
        Column("unmatched\nNEES a dof", number("alone_nees_per_dof", "{:.2f}")),
        Column("GOSPA\nm", number("gospa_m")),
        Column("track\nswitches", words("identity_switches")),
    ),
    "faults": (
        Column("fault", words("fault"), label=True),
        Column("matches", words("matches"), label=True),
        Column("prec.", share("precision")),
        Column("F1", share("f1")),
        Column("fused\nm", number("fused_m")),
        Column("growth", number("growth", "{:+.1%}")),
        Column("NEES\na dof", number("nees_per_dof", "{:.2f}")),
    ),
    "team": (
        Column("robots", words("robots"), label=True),
        Column("fused\nm", number("fused_m")),
        Column("median\nm", number("fused_median_m")),
        Column("95 %\nm", number("fused_p95_m")),
        Column("NEES\na dof", number("nees_per_dof", "{:.2f}")),
        Column("F1\npairwise", share("pairwise_f1")),
        Column("F1\njoint", share("f1")),
        Column("F1\nconvex", share("convex_f1")),
        Column("F1\nspectral", share("spectral_f1")),
    ),
}
TITLES = {"scenes": "{target}, {objects}", "faults": "faults, {protections} protections", "team": "team, {what}"}
"""Of the tables of a part, one for each title that its rows give."""


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
        require_writable(json_target)
        if figure is not None:
            require("viz")
            require_writable_figure(figure)
            if parts and "team" not in parts:
                raise ValueError(f"--figure draws the part team, got {' '.join(parts)}")
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
    except (ValueError, RuntimeError, OSError) as error:
        fail(error)
    write_rows(rows, json_target)
    if figure is not None:
        save(team_figure(rows), figure)
    if json_target != "-":
        print_parts(rows)


def print_parts(rows: list[dict[str, Any]]) -> None:
    """The rows for a person."""
    groups: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for row in rows:
        groups.setdefault((row["part"], TITLES[row["part"]].format_map(row)), []).append(row)
    for (part, title), own in groups.items():
        print_rows(own, COLUMNS[part], title)
