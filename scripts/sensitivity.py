"""`covis sensitivity`: how the paper's method depends on its two weights."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ..evaluation.extras import require
from ..evaluation.figures import save, sensitivity_figure
from ..evaluation.sensitivity import sensitivity as run_sensitivity
from .console import fail, out, progress_bar, write_rows


def sensitivity(
    targets: Annotated[list[str], typer.Argument(help="Dataset folders.", metavar="TARGET...")],
    every: Annotated[int, typer.Option(help="Take every so many-th frame.")] = 1,
    seed: Annotated[int, typer.Option(help="Of shuffling and chains.")] = 0,
    figure: Annotated[Path | None, typer.Option(help="Write a figure of F1 over both weights.")] = None,
    json_target: Annotated[str | None, typer.Option("--json", help="Write rows to FILE; - prints them.")] = None,
) -> None:
    """F1 of rgm over lambda_1 and lambda_2, the analysis by which the paper chose 0.1 and 0.4."""
    try:
        if figure is not None:
            require("viz")
        with progress_bar("sensitivity") as progress:
            rows = run_sensitivity(targets, every=every, seed=seed, progress=progress)
    except (ValueError, RuntimeError) as error:
        fail(error)
    write_rows(rows, json_target)
    if figure is not None:
        save(sensitivity_figure(rows), figure)
    if json_target != "-":
        for target in dict.fromkeys(row["target"] for row in rows):
            best = max((row for row in rows if row["target"] == target), key=lambda row: row["f1"])
            (published,) = [
                row
                for row in rows
                if row["target"] == target and (row["uncertainty_weight"], row["noncovisibility_weight"]) == (0.1, 0.4)
            ]
            out.print(
                f"{target}: F1 {published['f1']:.3f} at the published weights, best {best['f1']:.3f} "
                f"at lambda_1 = {best['uncertainty_weight']:g}, lambda_2 = {best['noncovisibility_weight']:g}"
            )
