"""`covis train`: perception from rendered frames, policies from episodes, the matcher's calibration from pairs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from ..evaluation.extras import require
from .console import err, fail, progress_bar, require_writable, write_json
from .console import out as console
from .tables import Column, number, print_rows, share, words

app = typer.Typer(help="Train what learns: perception, policies, calibration.", no_args_is_help=True)


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
    network: Annotated[
        str, typer.Option(help="compact (ours) | maskrcnn (the paper's; needs torchvision).")
    ] = "compact",
    validation_images: Annotated[int, typer.Option(help="Per scene, for figures on the way; 0 = none.")] = 16,
    calibration_images: Annotated[int, typer.Option(help="Per scene, to calibrate uncertainty; 0 = do not.")] = 300,
    calibrate: Annotated[bool, typer.Option("--calibrate", help="Only calibrate the weights in --out anew.")] = False,
) -> None:
    """Learn to see objects, their classes and distances, from frames of the four scenes rendered on the fly.

    Killed at any time, the same command with --resume goes on. The weights come to OUT/eyes.safetensors,
    OUT/eyes.json and OUT/familiar.safetensors.
    """
    try:
        require("envs")
        require("torchvision" if network == "maskrcnn" else "learned")
        import torch

        from ..agents.perception.training import train
        from ..agents.perception.training_step import TrainingParams
        from ..evaluation.perception_training import finish, recalibrate, validation_figures

        torch.set_num_threads(1)
        if calibrate:
            recalibrate(out, calibration_images)
            err.print(f"{out / 'eyes.json'}: calibrated on {calibration_images} images a scene", soft_wrap=True)
            return
        params = TrainingParams(
            minutes=None if steps else minutes, steps=steps, seed=seed, workers=workers, network=network
        )
        state = train(
            params,
            out,
            resume=resume,
            validate=(lambda network: validation_figures(network, validation_images)) if validation_images else None,
            report=_print,
        )
        finish(state, params, out, calibration_images)
    except (ValueError, RuntimeError, OSError) as error:
        fail(error)
    err.print(f"{out / 'eyes.safetensors'}: {state.step} steps, {state.images} images", soft_wrap=True)


@app.command()
def policy(
    scene: Annotated[str, typer.Argument(help="Name of a scene, or package.module:World.")],
    out: Annotated[Path, typer.Option(help="Folder of the checkpoint, the log, the policy and its evaluation.")],
    steps: Annotated[int, typer.Option(help="Robot-steps of experience; after --resume they may be more.")] = 50_000,
    resume: Annotated[bool, typer.Option("--resume", help="Go on from the checkpoint in --out.")] = False,
    seed: Annotated[int, typer.Option(help="Of episodes, first weights and updates.")] = 0,
    preset: Annotated[str | None, typer.Option(help="Difficulty: easy | paper | hard.")] = None,
    method: Annotated[str, typer.Option(help="Matcher behind the claims; it knows the noisy poses.")] = "hungarian",
    perception: Annotated[str, typer.Option(help="simulated | learned.")] = "simulated",
    evaluation_episodes: Annotated[int, typer.Option(help="Episodes per controller afterwards; 0 = none.")] = 40,
) -> None:
    """Learn to move the robots by PPO, on `control` alone; a localizer claims for the team.

    Killed at any time, the same command with --resume goes on and ends with the same weights. Afterwards the policy
    is compared with scripted, random and standing robots on episodes it has not seen.
    """
    try:
        require("envs")
        require("policy")
        import torch

        from ..evaluation.policy_training import COLUMNS, PolicyParams, evaluate_policy, load_policy, train_policy

        torch.set_num_threads(1)
        params = PolicyParams(scene, preset, method, perception, steps, seed)
        file = train_policy(params, out, resume=resume, report=_print_iteration)
        rows: list[dict[str, Any]] = []
        if evaluation_episodes:
            with progress_bar("evaluation") as progress:
                rows = evaluate_policy(params, load_policy(file), evaluation_episodes, progress)
    except (ValueError, RuntimeError, OSError) as error:
        fail(error)
    if rows:
        write_json({"rows": rows}, str(out / "evaluation.json"))
        print_rows(rows, [Column(title, number(key, form), key == "controller") for key, title, form in COLUMNS])
    err.print(f"{file}: trained", soft_wrap=True)


@app.command()
def calibration(
    kind: Annotated[str, typer.Argument(help="Which weights: unseen | eyes | fields.")],
    targets: Annotated[
        list[str],
        typer.Argument(help="Dataset folders, or generated problems such as synthetic-cad-hard.", metavar="TARGET..."),
    ],
    weight: Annotated[
        list[str] | None, typer.Option(help="TARGET=W: its pairs count W times; TARGET may be a pattern. Default 1.")
    ] = None,
    frames: Annotated[
        int | None, typer.Option(help="At most so many of each, evenly spread; of generated ones so many, else 100.")
    ] = None,
    ridge: Annotated[float, typer.Option(help="Penalty on the weights, nats a pair: for few episodes, more.")] = 1e-4,
    seed: Annotated[int, typer.Option(help="Of shuffling, generated pairs and halves.")] = 0,
    json_target: Annotated[
        str | None, typer.Option("--json", help="Write weights, rows to FILE; - prints them.")
    ] = None,
) -> None:
    """Fit how far `bayes` trusts its evidence to pairs of views, and measure it on halves of them.

    Poses are unknown to the matcher. Prints the weights as `covis.matching.bayes_calibration` holds them, and F1 and
    ECE with evidence that counts whole, the package's weights, the fitted ones, and half by half.
    """
    from ..evaluation.calibration_fit import collect, fittable, refit

    try:
        if kind not in fittable():
            raise ValueError(f"no weights are kept for {kind!r}; there are {', '.join(fittable())}")
        if not ridge >= 0:
            raise ValueError(f"--ridge must not be negative, got {ridge}")
        require_writable(json_target)
        weights = _weights(weight or [])
        pairs = []
        for target in targets:
            with progress_bar(f"evidence of {Path(target).name}") as progress:
                pairs += collect(target, kind, frames=frames, seed=seed, progress=progress)
        found = refit(kind, pairs, weights, ridge=ridge, seed=seed)
    except (ValueError, RuntimeError, OSError) as error:
        fail(error)
    fitted = {
        name: value if isinstance(value, float) else value.round(3).tolist()
        for name, value in found.fitted._asdict().items()
    }
    content = {"kind": kind, **fitted, "weights": weights, "ridge": ridge, "seed": seed, "bound": found.bound}
    write_json(content | {"rows": found.rows}, json_target)
    if json_target != "-":
        _print_comparison(found.rows)
        for name, value in fitted.items():
            console.print(f"{name}: {value}", highlight=False)
        console.print(f"ECE of some target after any monotone map of the held scores: at least {found.bound:.3f}")
    if found.left_out:
        err.print(f"{found.left_out} pairs are of another kind and were left out")


def _weights(texts: list[str]) -> dict[str, float]:
    weights = {}
    for text in texts:
        name, _, value = text.rpartition("=")
        try:
            weights[name] = float(value)
        except ValueError:
            raise ValueError(f"a weight is TARGET=W, got {text!r}") from None
        if not (name and weights[name] > 0):
            raise ValueError(f"a weight is TARGET=W with W above 0, got {text!r}")
    return weights


def _print_comparison(rows: list[dict[str, Any]]) -> None:
    """F1 and ECE of every set under each calibration."""
    columns = [Column("target", words("target"), label=True), Column("pairs", words("pairs"))]
    columns.append(Column("emitted", words("fitted_emitted")))
    for key, title in (("f1", "F1"), ("ece", "ECE")):
        columns += [Column(f"{title}\n{x}", share(f"{x}_{key}")) for x in ("whole", "held", "fitted", "halves")]
    print_rows(rows, columns)


def _print_iteration(row: dict[str, float]) -> None:
    err.print(
        f"{row['done']:6.1%}  {row['steps']:.0f} robot-steps  return of the last episodes {row['episode_return']:.2f}",
        highlight=False,
    )


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


_SHOWN = ("heat", "box", "mask", "overlap", "classes", "depth", "centre", "embedding", "total")
