"""What training needs of evaluation: figures on the way, and calibration of the uncertainty on validation scenes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.optimize import minimize

from ..matching.pose import Array
from .perception_benchmark import row
from .perception_images import PerceptionTarget, default_targets
from .perception_tally import Tally, tally

if TYPE_CHECKING:
    from torch import nn

    from ..agents.perception.training_step import State, TrainingParams
    from ..agents.perception.weights import Calibration, Weights

FIGURES = ("ap50", "class_accuracy", "depth_abs_rel", "depth_spearman", "ence")
SMALLEST_TALLY = 30
RIDGE = 0.001
SMALLEST_ERROR = 0.01
SMALLEST_RATIO = 0.05


def known_targets() -> list[PerceptionTarget]:
    """The scenes of the training."""
    return [target for target in default_targets() if not target.ood]


def validation_figures(network: nn.Module, images: int, seed: int = 0) -> dict[str, float]:
    """Means over the scenes of the main figures, on validation seeds."""
    weights = _weights(network)
    rows = [row(target, found) for target, found in _tallies(weights, images, seed)]
    out = {}
    for name in FIGURES:
        values = [r[name] for r in rows if r[name] is not None]
        if values:
            out[name] = float(np.mean(values))
    return out


def finish(state: State, params: TrainingParams, out: Path, images: int) -> Weights:
    """Calibrate the averaged network of a training on `images` validation images a scene, and save it in `out`."""
    from ..agents.perception import weights as stored

    weights = _calibrated(replace(_weights(state.averaged), notes=training_notes(state, params)), images)
    stored.save(weights, out)
    return weights


def recalibrate(folder: Path, images: int) -> Weights:
    """Fit the calibration of the weights in a folder anew, on `images` validation images a scene, and store it there.

    Raises:
        WeightsError: no weights, altered ones, or of a format whose tensors are others.
        ValueError: no images.
    """
    from ..agents.perception import weights as stored

    if images < 1:
        raise ValueError(f"calibration needs at least 1 image a scene, got {images}")
    weights = _calibrated(stored.load(folder, calibrated=False), images)
    stored.save(weights, folder)
    return weights


def _calibrated(weights: Weights, images: int) -> Weights:
    notes = dict(weights.notes) | {"calibration_images_per_scene": images}
    if not images:
        return replace(weights, notes=notes)
    calibration = calibrate([found for _, found in _tallies(weights, images, 1)])
    # What was seen had been divided by the temperature that the weights came with.
    temperature = calibration.class_temperature * weights.calibration.class_temperature
    return replace(weights, calibration=replace(calibration, class_temperature=temperature), notes=notes)


def training_notes(state: State, params: TrainingParams) -> dict[str, Any]:
    """How the network was trained, as the manifest keeps it."""
    return {
        "seed": params.seed,
        "workers": params.workers,
        "steps": state.step,
        "images": state.images,
        "minutes": round(state.seconds / 60, 1),
        "learned_from": sorted({f"{v.scene}:{v.preset}" + (f":{v.map}" if v.map else "") for v in params.variants}),
    }


def calibrate(tallies: Sequence[Tally]) -> Calibration:
    """Corrections of depth and variances, and the class temperature, that fit what uncalibrated eyes saw.

    Of all detections that meet a true object, scenes counting alike; those with too few detections are left out. The
    correction of the depth has the least absolute logarithmic error; those of the variances make the errors most
    likely, see `_variance_correction`; the temperature, relative to that with which they saw, has the least negative
    log-likelihood of the true classes.
    """
    from ..agents.perception.weights import Calibration, Familiar, with_strangeness

    used = [t for t in tallies if len(t.of("u", every=True)) >= SMALLEST_TALLY]
    if not used:
        return Calibration()
    share = np.concatenate([np.full(n, 1 / (n * len(used))) for n in (len(t.of("u", every=True)) for t in used)])
    names = ("features", "distance", "offset", "variances")
    features, distance, offset, variances = (np.concatenate([t.of(name, every=True) for t in used]) for name in names)
    familiar = None
    if all(t.backbone for t in used):
        backbone = np.concatenate([t.of("backbone", every=True) for t in used])
        familiar = Familiar.of(backbone, share)
        features = with_strangeness(features, familiar.strangeness(backbone))
    depth = _depth_correction(features, np.log(np.maximum(1 + offset[:, 0] / distance, SMALLEST_RATIO)), share)
    factor = np.exp(features @ depth)
    offset[:, 0] += (1 - factor) * distance
    ratios = offset**2 / (variances * factor[:, None] ** 2)
    along, horizontal, vertical = (_variance_correction(features, ratio, share) for ratio in ratios.T)
    temperatures = np.exp(np.linspace(np.log(0.3), np.log(3), 61))
    surprise = [np.mean([_negative_log_likelihood(t, x) for t in used]) for x in temperatures]
    return Calibration(
        depth=tuple(depth.tolist()),
        along=tuple(along.tolist()),
        horizontal=tuple(horizontal.tolist()),
        vertical=tuple(vertical.tolist()),
        class_temperature=float(temperatures[int(np.argmin(surprise))]),
        familiar=familiar,
    )


def _depth_correction(features: Array, wanted: Array, share: Array) -> Array:
    """Coefficients of the features (k, terms) whose sum is nearest to the `wanted` (k,) logarithms of factors.

    Least absolute error, by least squares reweighted.
    """
    penalty = np.diag([0.0, *[RIDGE] * (features.shape[1] - 1)])
    found, weight = np.zeros(features.shape[1]), share
    for _ in range(50):
        weighted = features * weight[:, None]
        found = np.linalg.solve(features.T @ weighted + weight.sum() * penalty, weighted.T @ wanted)
        weight = share / np.maximum(np.abs(wanted - features @ found), SMALLEST_ERROR)
    return found


def _variance_correction(features: Array, ratio: Array, share: Array) -> Array:
    """Coefficients (terms,) of the log of the factor on the variance that make Gaussian errors most likely.

    Args:
        features: (k, terms).
        ratio: (k,) squared errors over reported variances.
        share: (k,) how much each counts.
    """

    def cost(theta: Array) -> tuple[float, Array]:
        log_factor = np.clip(features @ theta, -20, 20)
        surprise = ratio * np.exp(-log_factor)
        value = share @ (log_factor + surprise) + RIDGE * (theta[1:] ** 2).sum()
        slope = features.T @ (share * (1 - surprise))
        slope[1:] += 2 * RIDGE * theta[1:]
        return float(value), slope

    return np.asarray(minimize(cost, np.zeros(features.shape[1]), jac=True, method="BFGS").x)


def _negative_log_likelihood(found: Tally, temperature: float) -> float:
    total, number = 0.0, 0
    for attributes, true in zip(found.attributes, found.true_class, strict=True):
        logits: Array = np.log(np.maximum(attributes, 1e-9)) / temperature
        logits = logits - np.logaddexp.reduce(logits, axis=1, keepdims=True)
        total -= logits[np.arange(len(true)), true].sum()
        number += len(true)
    return total / max(number, 1)


def _weights(network: nn.Module) -> Weights:
    from ..agents.perception.weights import Weights

    return Weights({k: v.detach().clone() for k, v in network.state_dict().items()}, network.params.to_dict())


def _tallies(weights: Weights, images: int, seed: int) -> list[tuple[PerceptionTarget, Tally]]:
    from ..agents.perception.frames import VALIDATION_KEY

    return [(target, tally(target, weights, images, (VALIDATION_KEY, seed))) for target in known_targets()]
