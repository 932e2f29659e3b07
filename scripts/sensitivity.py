"""`covis sensitivity`: how the paper's method depends on its two weights."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from ..evaluation.extras import require
from ..evaluation.figures import save, sensitivity_figure
from ..evaluation.sensitivity import sensitivity as run_sensitivity
from ..evaluation.tuning import mean_over_targets
from .console import fail, out, progress_bar, require_writable, require_writable_figure, write_rows


def sensitivity(
    targets: Annotated[list[str], typer.Argument(help="Dataset folders.", metavar="TARGET...")],
    frames: Annotated[int | None, typer.Option(help="At most so many of each dataset, evenly spread.")] = None,
    seed: Annotated[int, typer.Option(help="Of shuffling and chains.")] = 0,
    figure: Annotated[
        Path | None, typer.Option(help="Write a figure of F1 over both weights, averaged over the datasets.")
    ] = None,
    json_target: Annotated[str | None, typer.Option("--json", help="Write rows to FILE; - prints them.")] = None,
) -> None:
    """F1 of rgm over lambda_1 and lambda_2, the analysis by which the paper chose 0.1 and 0.4."""
    try:
        require_writable(json_target)
        if figure is not None:
            require("viz")
            require_writable_figure(figure)
        with progress_bar("sensitivity") as progress:
            rows = run_sensitivity(targets, frames=frames, seed=seed, progress=progress)
    except (ValueError, RuntimeError, OSError) as error:
        fail(error)
    write_rows(rows, json_target)
    several = len({row["target"] for row in rows}) > 1
    means = mean_over_targets(rows) if several else []
    if figure is not None:
        save(sensitivity_figure(means or rows), figure)
    if json_target != "-":
        for target in dict.fromkeys(row["target"] for row in [*rows, *means]):
            out.print(summary([row for row in [*rows, *means] if row["target"] == target]))


def summary(rows: list[dict[str, Any]]) -> str:
    """One target's F1 at the published weights and at the best ones."""
    best = max(rows, key=lambda row: row["f1"])
    (published,) = [row for row in rows if (row["uncertainty_weight"], row["noncovisibility_weight"]) == (0.1, 0.4)]
    return (
        f"{rows[0]['target']}: F1 {published['f1']:.3f} at the published weights, best {best['f1']:.3f} "
        f"at lambda_1 = {best['uncertainty_weight']:g}, lambda_2 = {best['noncovisibility_weight']:g}"
    )
