"""`covis tune`: a matcher's settings compared on datasets, over the grid that its tuning used."""

from __future__ import annotations

from typing import Annotated, Any

import typer
from rich.table import Table

from ..evaluation.tuning import GRIDS, compare_settings, mean_over_targets, setting_of
from .console import fail, out, progress_bar, write_rows


def tune(
    method: Annotated[str, typer.Argument(help=f"{' | '.join(GRIDS)}.")],
    targets: Annotated[list[str], typer.Argument(help="Dataset folders.", metavar="TARGET...")],
    frames: Annotated[int | None, typer.Option(help="At most so many of each dataset, evenly spread.")] = None,
    seed: Annotated[int, typer.Option(help="Of shuffling and matchers.")] = 0,
    json_target: Annotated[str | None, typer.Option("--json", help="Write rows to FILE; - prints them.")] = None,
) -> None:
    """F1 of one matcher over a grid of its settings, averaged over the datasets."""
    if method not in GRIDS:
        fail(f"no grid is kept for {method!r}; there are {', '.join(GRIDS)}")
    try:
        with progress_bar(f"tune {method}") as progress:
            rows = compare_settings(targets, method, GRIDS[method], frames=frames, seed=seed, progress=progress)
    except (ValueError, RuntimeError) as error:
        fail(error)
    write_rows(rows, json_target)
    if json_target != "-":
        out.print(table(method, mean_over_targets(rows)))


def table(method: str, rows: list[dict[str, Any]]) -> Table:
    """Settings, best first."""
    view = Table(title=f"{method}, {rows[0]['target']}", header_style="bold")
    for name in setting_of(rows[0]):
        view.add_column(name)
    for name in ("pairs", "precision", "recall", "F1"):
        view.add_column(name, justify="right")
    for row in sorted(rows, key=lambda row: -row["f1"]):
        setting = [str(value) for value in setting_of(row).values()]
        view.add_row(*setting, str(row["pairs"]), *(f"{row[name]:.3f}" for name in ("precision", "recall", "f1")))
    return view
