"""`covis record` and `covis check`: scenes to dataset folders, and their verification."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ..evaluation.datasets import DatasetError
from ..evaluation.extras import require
from ..evaluation.recording import check as check_folder
from ..evaluation.recording import record as record_scene
from ..evaluation.settings import Settings
from .console import fail, out, progress_bar


def record(
    scene: Annotated[str, typer.Argument(help="Name of a scene, or package.module:World.")],
    folder: Annotated[Path, typer.Option("--out", help="Folder of the dataset.")],
    episodes: Annotated[int, typer.Option(help="Episodes of 5 s.")] = 50,
    preset: Annotated[str | None, typer.Option(help="Difficulty: easy | paper | hard.")] = None,
    seed: Annotated[int, typer.Option(help="Of scenes and eyes.")] = 0,
    perception: Annotated[str, typer.Option(help="simulated | learned.")] = "simulated",
    resume: Annotated[bool, typer.Option("--resume", help="Go on with an unfinished recording.")] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace what the folder holds.")] = False,
) -> None:
    """Record episodes of a scene in the dataset format, with images, poses and truth."""
    try:
        require("envs")
        settings = Settings(preset=preset, seed=seed, episodes=episodes, perception=perception)  # type: ignore[arg-type]
        with progress_bar(f"record {scene}") as progress:
            record_scene(scene, settings, folder, resume=resume, overwrite=overwrite, progress=progress)
    except (ValueError, RuntimeError, FileExistsError) as error:
        fail(error)
    out.print(f"{episodes} episodes of {scene} in {folder}")


def check(folder: Annotated[Path, typer.Argument(help="A dataset folder that covis recorded.")]) -> None:
    """Verify a recorded dataset folder against its checksums and read it whole."""
    try:
        frames = check_folder(folder)
    except DatasetError as error:
        fail(error)
    out.print(f"{folder}: {frames} frames, checksums agree")
