"""`covis export`: dataset folders in other people's formats."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ..evaluation.coco import export_coco
from .console import fail, out, progress_bar

app = typer.Typer(help="Dataset folders in other people's formats.", no_args_is_help=True)


@app.callback()
def main() -> None:
    """Dataset folders in other people's formats."""


@app.command()
def coco(
    source: Annotated[Path, typer.Argument(help="A dataset folder with images.")],
    target: Annotated[Path, typer.Argument(help="Folder to write.")],
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace the export that the folder holds.")] = False,
) -> None:
    """COCO: images as PNG files, annotations.json with boxes and masks, detections.json with the robots' own."""
    try:
        with progress_bar("export") as progress:
            done = export_coco(source, target, overwrite=overwrite, progress=progress)
    except (ValueError, OSError) as error:
        fail(error)
    out.print(f"{target}: {done.images} images, {done.annotations} annotations, {done.detections} detections")
