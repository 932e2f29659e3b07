"""`covis train`: perception from rendered frames."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from ..evaluation.extras import require
from .console import err, fail

app = typer.Typer(help="Train what learns: perception.", no_args_is_help=True)


@app.callback()
def main() -> None:
    """Train what learns."""


@app.command()
def perception(
    out: Annotated[Path, typer.Option(help="Folder of the checkpoint, the log and the weights.")],
    minutes: Annotated[float, typer.Option(help="Wall time of the training over all its sessions.")] = 60.0,
    steps: Annotated[int | None, typer.Option(help="Stop after so many steps instead.")] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Go on from the checkpoint in --out.")] = False,
    seed: Annotated[int, typer.Option(help="Of frames, batches, dropout and first weights.")] = 0,
    workers: Annotated[int, typer.Option(help="Processes that learn side by side, one thread each.")] = 2,
    validation_images: Annotated[int, typer.Option(help="Per scene, for figures on the way; 0 = none.")] = 16,
    calibration_images: Annotated[int, typer.Option(help="Per scene, to calibrate uncertainty; 0 = do not.")] = 120,
) -> None:
    """Learn to see objects, their classes and distances, from frames of the four scenes rendered on the fly.

    Killed at any time, the same command with --resume goes on. The weights come to OUT/eyes.safetensors and
    OUT/eyes.json.
    """
    try:
        require("envs")
        require("learned")
        import torch

        from ..agents.perception.training import TrainingParams, train
        from ..evaluation.perception_training import finish, validation_figures

        torch.set_num_threads(1)
        params = TrainingParams(minutes=None if steps else minutes, steps=steps, seed=seed, workers=workers)
        state = train(
            params,
            out,
            resume=resume,
            validate=(lambda network: validation_figures(network, validation_images)) if validation_images else None,
            report=_print,
        )
        weights = finish(state, params, out, calibration_images)
    except (ValueError, RuntimeError, FileExistsError) as error:
        fail(error)
    err.print(f"{out / 'eyes.safetensors'}: {state.step} steps, {state.images} images; {weights.calibration}")


def _print(row: dict[str, Any]) -> None:
    """One line of progress."""
    losses = " ".join(f"{k} {v:.3f}" for k, v in row.items() if isinstance(v, float) and k in _SHOWN)
    figures = " ".join(f"{k[4:]} {v:.3f}" for k, v in row.items() if k.startswith("val_") and v is not None)
    err.print(
        f"{row['done']:6.1%}  step {row['step']}  {row['images_per_s']:.1f} images/s  {losses}"
        + (f"  [bold]{figures}[/]" if figures else ""),
        highlight=False,
        soft_wrap=True,
    )


_SHOWN = ("heat", "box", "mask", "classes", "depth", "centre", "embedding", "total")
