"""`covis import`: other people's data as dataset folders."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ..evaluation.mrclam import import_mrclam
from .console import fail, out

app = typer.Typer(help="Other people's data as dataset folders.", no_args_is_help=True)


@app.command()
def mrclam(
    source: Annotated[Path, typer.Argument(help="Folder or archive with the raw files of one sequence.")],
    target: Annotated[Path, typer.Argument(help="Dataset folder to write.")],
    window: Annotated[float, typer.Option(help="Seconds of readings that make one frame.")] = 1.0,
) -> None:
    """UTIAS MRCLAM: five robots, fifteen landmarks, range and bearing, odometry, motion capture."""
    try:
        imported = import_mrclam(source, target, window=window)
    except (ValueError, OSError) as error:
        fail(error)
    out.print(f"{target}: {imported.frames} frames, {imported.robots} robots, {imported.detections} detections")
