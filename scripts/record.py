"""`covis record` and `covis check`: scenes to dataset folders, and their verification."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ..evaluation.dataset_check import check as check_folder
from ..evaluation.datasets import DatasetError
from ..evaluation.extras import require_scene
from ..evaluation.recording import EPISODES, unfinished
from ..evaluation.recording import record as record_scene
from ..evaluation.settings import Settings
from .console import err, fail, out, progress_bar


def record(
    scene: Annotated[str, typer.Argument(help="Name of a scene, or package.module:World.")],
    folder: Annotated[Path, typer.Option("--out", help="Folder of the dataset.")],
    episodes: Annotated[int, typer.Option(help="Episodes of 5 s.")] = EPISODES,
    preset: Annotated[str | None, typer.Option(help="Difficulty: easy | paper | hard.")] = None,
    seed: Annotated[int, typer.Option(help="Of scenes and eyes.")] = 0,
    perception: Annotated[str, typer.Option(help="learned | simulated.")] = "learned",
    workers: Annotated[int, typer.Option(help="Local processes; they change nothing but the time.")] = 1,
    resume: Annotated[bool, typer.Option("--resume", help="Go on with an unfinished recording.")] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace the dataset that the folder holds.")] = False,
) -> None:
    """Record episodes of a scene in the dataset format, with images, masks, poses and truth."""
    try:
        if resume and overwrite:
            raise ValueError("give --resume or --overwrite, not both")
        require_scene(perception)
        settings = Settings(preset=preset, seed=seed, episodes=episodes, perception=perception)
        with progress_bar(f"record {scene}") as progress:
            record_scene(
                scene, settings, folder, workers=workers, resume=resume, overwrite=overwrite, progress=progress
            )
    except (ValueError, RuntimeError, OSError) as error:
        fail(error)
    except KeyboardInterrupt:
        kept = unfinished(folder) or 0
        err.print(f"stopped; {kept} of {episodes} episodes are kept: the same command with --resume goes on")
        raise typer.Exit(130) from None
    out.print(f"{episodes} episodes of {scene} in {folder}")


def check(folder: Annotated[Path, typer.Argument(help="A dataset folder.")]) -> None:
    """Verify a dataset folder: its checksums, its tables against the format, its images and masks."""
    try:
        checked = check_folder(folder)
    except DatasetError as error:
        fail(error)
    sums = "checksums agree" if checked.verified else "well-formed, but there is no checksums.json to compare with"
    out.print(f"{folder}: {checked.frames} frames, {sums}")
