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
MEDIAN_CHI_SQUARED_2 = 2 * np.log(2)
SMALLEST_TALLY = 30
RIDGE = 0.001
SMALLEST_ERROR = 0.01


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

    weights = _weights(state.averaged)
    if images:
        weights = replace(weights, calibration=calibrate([found for _, found in _tallies(weights, images, 1)]))
    weights = replace(weights, notes=training_notes(state, params) | {"calibration_images_per_scene": images})
    stored.save(weights, out)
    return weights


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

    Scenes count alike. The correction of the depth has the least absolute logarithmic error; the correction of its
    variance makes the errors most likely, see `_variance_correction`; the factor on the centre's variance makes the
    median of the squared lateral error that of two Gaussian axes; the temperature has the least negative log-likelihood
    of the true classes. Scenes with too few detections are left out.
    """
    from ..agents.perception.weights import Calibration

    used = [t for t in tallies if len(t.of("u")) >= SMALLEST_TALLY]
    if not used:
        return Calibration()
    scale, exponent = _depth_correction([t.of("distance") for t in used], [t.of("depth_ratio") for t in used])
    corrected = [scale * t.of("distance") ** exponent for t in used]
    squared = [(d - t.of("true_distance")) ** 2 for t, d in zip(used, corrected, strict=True)]
    ratios = [e / (t.of("u") * (d / t.of("distance")) ** 2) for t, d, e in zip(used, corrected, squared, strict=True)]
    lateral = [np.median(t.of("lateral") ** 2 / t.of("across")) / MEDIAN_CHI_SQUARED_2 for t in used]
    temperatures = np.exp(np.linspace(np.log(0.3), np.log(3), 61))
    surprise = [np.mean([_negative_log_likelihood(t, x) for t in used]) for x in temperatures]
    return Calibration(
        scale=scale,
        exponent=exponent,
        depth=_variance_correction([t.of("known") for t in used], ratios),
        centre=float(np.exp(np.mean(np.log(lateral)))),
        class_temperature=float(temperatures[int(np.argmin(surprise))]),
    )


def _depth_correction(distances: Sequence[Array], ratios: Sequence[Array]) -> tuple[float, float]:
    """Scale and exponent that bring distances (k,) of each scene nearest to the truth, given their ratios (k,) to it.

    Least absolute error of the logarithm, by least squares reweighted.
    """
    x, y = np.log(np.concatenate(distances)), -np.log(np.concatenate(ratios))
    share = np.concatenate([np.full(len(r), 1 / len(r)) for r in ratios])
    line, weight = np.zeros(2), share
    for _ in range(50):
        line = np.polyfit(x, y, 1, w=np.sqrt(weight))
        weight = share / np.maximum(np.abs(y - np.polyval(line, x)), SMALLEST_ERROR)
    return float(np.exp(line[1])), float(1 + line[0])


def _variance_correction(known: Sequence[Array], ratios: Sequence[Array]) -> tuple[float, ...]:
    """Coefficients of the log of the factor on the variance that make the errors of all scenes together most likely.

    Args:
        known: (k, VARIANCE_TERMS) features of each scene's detections.
        ratios: (k,) squared errors over reported variances.
    """
    features, ratio = np.concatenate(known), np.concatenate(ratios)
    weight = np.concatenate([np.full(len(r), 1 / (len(r) * len(ratios))) for r in ratios])

    def cost(theta: Array) -> tuple[float, Array]:
        log_factor = np.clip(features @ theta, -20, 20)
        surprise = ratio * np.exp(-log_factor)
        value = weight @ (log_factor + surprise) + RIDGE * (theta[1:] ** 2).sum()
        slope = features.T @ (weight * (1 - surprise))
        slope[1:] += 2 * RIDGE * theta[1:]
        return float(value), slope

    found = minimize(cost, np.zeros(features.shape[1]), jac=True, method="BFGS")
    return tuple(float(x) for x in found.x)


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
