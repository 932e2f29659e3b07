"""`covis benchmark perception`: how well eyes see, on test scenes that no training has used.

Objects with at least 60 visible pixels count. Masks are judged by COCO's AP at IoU 0.5, class-agnostic (pycocotools);
everything else over detections whose mask meets a true object's with IoU >= 0.5, one-to-one, best score first.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.stats import spearmanr

from ..matching.pose import Array
from .extras import MissingExtraError, require
from .perception_images import PerceptionTarget, default_targets
from .perception_tally import Tally, tally
from .progress import Progress, silent

if TYPE_CHECKING:
    from ..agents.perception.weights import Weights

IMAGES = 300
ENCE_BINS = 10


def perception_benchmark(
    targets: Sequence[PerceptionTarget] | None = None,
    *,
    weights: Weights | None = None,
    images: int = IMAGES,
    seed: int = 0,
    split_key: int | None = None,
    samples: int = 16,
    progress: Progress = silent,
) -> list[dict[str, Any]]:
    """One row per target.

    Args:
        weights: of the eyes; None = those that come with the package.
        images: at least so many per target.
        split_key: first word of the episodes' seeds; None = that of the test split.
        samples: T of the Monte Carlo dropout.

    Raises:
        MissingExtraError: torch, the simulators or pycocotools are not installed.
        WeightsError: no weights, or altered ones.
    """
    require("envs")
    require("learned")
    if images < 1:
        raise ValueError(f"images must be at least 1, got {images}")
    if find_spec("pycocotools") is None:
        raise MissingExtraError("pycocotools is missing: install covis[learned]")
    from ..agents.perception import weights as stored
    from ..agents.perception.frames import TEST_KEY
    from ..agents.perception.learned import LearnedPerceptionParams, dense_type

    weights = stored.load() if weights is None else weights
    key = TEST_KEY if split_key is None else split_key
    targets = default_targets() if targets is None else targets
    tallies: dict[PerceptionTarget, Tally] = {}
    rows = []
    computed = {"computed_in": str(dense_type(LearnedPerceptionParams().precision)).removeprefix("torch.")}
    for n, target in enumerate(targets):
        part = partial(_part_of, progress, n, images, len(targets))
        tallies[target] = tally(target, weights, images, (key, seed), samples, part)
        rows.append(row(target, tallies[target]) | {"images": tallies[target].images, "seed": seed} | computed)
        known = PerceptionTarget(target.scene)
        if target.ood and known in tallies:
            rows[-1] |= {"known_ap50": rows[targets.index(known)]["ap50"]} | shift(tallies[known], tallies[target])
    return rows


def weights_of(eyes: str) -> Weights:
    """The weights that a setting of `--perception` names: `learned` or `learned:FOLDER`.

    Raises:
        ValueError: another setting.
        MissingExtraError: what they need is not installed.
        WeightsError: no weights, or altered ones.
    """
    name, _, folder = eyes.partition(":")
    if name != "learned":
        raise ValueError(
            f"only learned eyes are benchmarked: perception must be learned or learned:FOLDER, got {eyes!r}"
        )
    require("learned")
    from ..agents.perception import weights as stored

    return stored.load(Path(folder) if folder else None)


def _part_of(progress: Progress, part: int, size: int, parts: int, done: int) -> None:
    progress(part * size + done, parts * size)


def row(target: PerceptionTarget, found: Tally) -> dict[str, Any]:
    """The figures of one target; None where there is nothing to judge."""
    error, u = found.of("error"), found.of("u")
    squared = error**2
    return {
        "target": target.name,
        "ood": target.ood,
        "objects": found.objects,
        "ap50": found.coco.ap50(),
        "recall": _ratio(len(error), found.objects),
        "precision": _ratio(found.true_detections, found.detections),
        "class_accuracy": _mean(found.of("right_class")),
        "depth_abs_rel": _mean(np.abs(found.of("depth_ratio") - 1)),
        "depth_bias": _mean(found.of("depth_ratio") - 1),
        "depth_spearman": spearman(u, squared),
        "depth_spearman_exact": exact_spearman(u),
        "depth_only_spearman": spearman(found.of("distance"), squared),
        "ence": ence(u, squared),
        "u_mean_m2": _mean(u),
        "u_epistemic_mean_m2": _mean(found.of("u_epistemic")),
        "v_mean": _mean(found.of("v")),
        "v_epistemic_mean": _mean(found.of("v_epistemic")),
        "squared_error_mean_m2": _mean(squared),
        "lateral_mean_m": _mean(np.linalg.norm(found.of("offset").reshape(-1, 3)[:, 1:], axis=1)),
        **consistency(found),
        "milliseconds": float(np.median(found.milliseconds)) if found.milliseconds else None,
    }


def spearman(a: Array, b: Array) -> float | None:
    """Rank correlation; None below three entries or where one side is constant."""
    if len(a) < 3 or np.ptp(a) == 0 or np.ptp(b) == 0:
        return None
    return float(spearmanr(a, b).statistic)


def exact_spearman(variance: Array, draws: int = 20) -> float | None:
    """What `spearman` of these variances would be if errors were Gaussian with exactly them: the most to be hoped for.

    It is small where all variances are about the same, however true they are.
    """
    rng = np.random.default_rng(0)
    found = [spearman(variance, variance * rng.chisquare(1, len(variance))) for _ in range(draws)]
    return None if found[0] is None else float(np.mean([f for f in found if f is not None]))


def ence(variance: Array, squared_error: Array, bins: int = ENCE_BINS) -> float | None:
    """Expected normalised calibration error: over bins of equal count by variance, mean |RMV - RMSE| / RMV."""
    if len(variance) < bins:
        return None
    parts = np.array_split(np.argsort(variance, kind="stable"), bins)
    rmv = np.sqrt([variance[p].mean() for p in parts])
    rmse = np.sqrt([squared_error[p].mean() for p in parts])
    return float(np.mean(np.abs(rmv - rmse) / np.maximum(rmv, 1e-12)))


def consistency(found: Tally) -> dict[str, float | None]:
    """NEES per degree of freedom, 1 where covariances are true, of all detections that the environment would tie.

    By axis, of all three, and without the hundredth of the objects that have the largest: errors have heavier tails
    than a Gaussian.
    """
    names = ("nees_along", "nees_horizontal", "nees_vertical")
    normalised = found.of("offset", every=True).reshape(-1, 3) ** 2
    if len(normalised) == 0:
        return dict.fromkeys((*names, "nees", "nees_without_1_percent"))
    normalised = normalised / found.of("variances", every=True)
    whole = np.sort(normalised.mean(axis=1))
    least = whole[: max(round(0.99 * len(whole)), 1)]
    by_axis = dict(zip(names, normalised.mean(axis=0).tolist(), strict=True))
    return by_axis | {"nees": float(whole.mean()), "nees_without_1_percent": float(least.mean())}


def shift(known: Tally, strange: Tally) -> dict[str, float | None]:
    """How much u, v, their parts and the squared errors rise out of distribution, objects matched in range and size.

    Objects fall into bins a third of an octave of range by an octave of visible pixels; each bin counts by the smaller
    of its two numbers. Ratios of weighted means, strange over known.
    """
    bins = [
        np.stack([np.floor(3 * np.log2(t.of("true_distance"))), np.floor(np.log2(t.of("size")))], axis=1)
        for t in (known, strange)
    ]
    values = [_shifting(t) for t in (known, strange)]
    names = [f"{name}_ratio_matched" for name in values[0]]
    out: dict[str, float | None] = dict.fromkeys(names) | {"matched_objects": 0}
    keys = np.unique(np.concatenate(bins), axis=0)
    sums = np.zeros((2, len(names)))
    total = 0.0
    for key in keys:
        chosen = [(b == key).all(axis=1) for b in bins]
        weight = float(min(c.sum() for c in chosen))
        if weight == 0:
            continue
        total += weight
        for side, c in enumerate(chosen):
            sums[side] += weight * np.array([x[c].mean() for x in values[side].values()])
    if total:
        ratios = [b / a if a > 0 else None for a, b in sums.T.tolist()]
        out |= dict(zip(names, ratios, strict=True)) | {"matched_objects": int(total)}
    return out


def _shifting(found: Tally) -> dict[str, Array]:
    """What `shift` compares, by name."""
    parts = {name: found.of(name) for name in ("u", "u_epistemic", "v", "v_epistemic")}
    parts |= {f"{name}_aleatoric": parts[name] - parts[f"{name}_epistemic"] for name in ("u", "v")}
    return parts | {"squared_error": found.of("error") ** 2}


def _mean(values: Array) -> float | None:
    return float(np.mean(values)) if len(values) else None


def _ratio(part: int, whole: int) -> float | None:
    return part / whole if whole else None


def table_columns() -> Sequence[tuple[str, str]]:
    """Keys and titles of the figures worth a column."""
    return (
        ("target", "target"),
        ("ap50", "AP50"),
        ("recall", "recall"),
        ("class_accuracy", "class"),
        ("depth_abs_rel", "AbsRel"),
        ("depth_spearman", "rho(u)"),
        ("depth_spearman_exact", "rho exact"),
        ("depth_only_spearman", "rho(z)"),
        ("ence", "ENCE"),
        ("nees", "NEES"),
    )


def shift_columns() -> Sequence[tuple[str, str]]:
    """Keys and titles of how targets out of distribution compare with the known scene."""
    return (
        ("target", "out of distribution"),
        ("ap50", "AP50"),
        ("known_ap50", "known"),
        ("u_ratio_matched", "u ratio"),
        ("u_epistemic_ratio_matched", "epistemic"),
        ("u_aleatoric_ratio_matched", "aleatoric"),
        ("squared_error_ratio_matched", "e² ratio"),
        ("v_ratio_matched", "v ratio"),
        ("v_epistemic_ratio_matched", "epistemic"),
        ("v_aleatoric_ratio_matched", "aleatoric"),
    )
