"""`covis tune`: a matcher's settings compared on datasets, over the grid that its tuning used."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from ..evaluation.tuning import GRIDS, compare_settings, mean_over_targets, setting_of
from .console import fail, progress_bar, require_writable, write_rows
from .tables import Column, print_rows, share, words


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
        require_writable(json_target)
        with progress_bar(f"tune {method}") as progress:
            rows = compare_settings(targets, method, GRIDS[method], frames=frames, seed=seed, progress=progress)
    except (ValueError, RuntimeError, OSError) as error:
        fail(error)
    write_rows(rows, json_target)
    if json_target != "-":
        print_settings(method, mean_over_targets(rows))


def print_settings(method: str, rows: list[dict[str, Any]]) -> None:
    """Settings, best first."""
    settings = [Column(name.replace("_", "\n"), words(name), label=True) for name in setting_of(rows[0])]
    figures = [Column("pairs", words("pairs"))]
    figures += [
        Column(title, share(key)) for title, key in (("prec.", "precision"), ("recall", "recall"), ("F1", "f1"))
    ]
    print_rows(sorted(rows, key=lambda row: -row["f1"]), [*settings, *figures], f"{method}, {rows[0]['target']}")
