"""`covis demo`: the main job, small."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ..evaluation.demo import demo as run_demo
from .benchmark import print_benchmark
from .console import fail, out, progress_bar


def demo(
    folder: Annotated[Path, typer.Option("--out", help="Folder of the report.")] = Path("covis-demo"),
    seed: Annotated[int, typer.Option(help="Of scenes, eyes and matchers.")] = 0,
) -> None:
    """Scenes x methods, from pixels to displacement error: a table here, a report with pictures in a folder."""
    made = not folder.exists()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with progress_bar("demo") as progress:
            rows = run_demo(folder, seed, progress)
    except (ValueError, RuntimeError, OSError) as error:
        if made and folder.is_dir() and not any(folder.iterdir()):
            folder.rmdir()
        fail(error)
    print_benchmark(rows)
    out.print(f"Report with pictures: {folder / 'report.md'}", soft_wrap=True)
