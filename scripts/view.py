"""`covis view`: a scene or a dataset folder as a recording for the Rerun viewer."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from ..evaluation.methods import Method
from ..evaluation.settings import Settings
from ..evaluation.view import view as write_view
from .console import fail, out, progress_bar


def view(
    target: Annotated[str, typer.Argument(help="A scene, package.module:World, or a dataset folder.")],
    file: Annotated[Path, typer.Option("--out", help="Recording to write, FILE.rrd.")],
    method: Annotated[
        list[str] | None, typer.Option(help="As in `covis benchmark`; repeatable. Default: bayes.")
    ] = None,
    pose: Annotated[str, typer.Option(help="unknown | known: hand the noisy poses to the matcher.")] = "unknown",
    preset: Annotated[str | None, typer.Option(help="Difficulty of a scene: easy | paper | hard.")] = None,
    sequence: Annotated[bool, typer.Option("--sequence", help="Carry a tracker through each episode.")] = False,
    seed: Annotated[int, typer.Option(help="Seed of shuffling, scenes and matchers.")] = 0,
    episodes: Annotated[int | None, typer.Option(help="Of a scene, by default 1; a dataset's first so many.")] = None,
    perception: Annotated[str, typer.Option(help="Eyes in scenes: learned | simulated.")] = "learned",
) -> None:
    """Cameras, boxes, matches, objects with covariances, trajectories and figures over time, as a Rerun recording."""
    try:
        given: dict[str, Any] = {"pose": pose, "preset": preset, "sequence": sequence, "seed": seed}
        settings = Settings(**given, episodes=episodes, perception=perception)
        methods = [Method.parse(text) for text in method or ["bayes"]]
        with progress_bar("view") as progress:
            frames = write_view(target, file, methods, settings, progress)
    except (ValueError, RuntimeError, OSError) as error:
        fail(error)
    out.print(f"{file}: {frames} frames. Open it with: rerun {file}")
