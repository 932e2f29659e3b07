"""`covis benchmark perception`: how well eyes see, on test scenes that no training has used.

Objects with at least 60 visible pixels count. Masks are judged by COCO's AP at IoU 0.5, class-agnostic (pycocotools);
everything else over detections whose mask meets a true object's with IoU >= 0.5, one-to-one, best score first.
"""

from __future__ import annotations

import contextlib
import io
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import spearmanr

from ..matching.pose import Array, invert, transform
from .extras import MissingExtraError, require

if TYPE_CHECKING:
    from ..agents.perception.learned import Seen
    from ..agents.perception.weights import Weights
    from ..envs.collaborative import CollaborativeEnv

MIN_PIXELS = 60
MIN_IOU = 0.5
IMAGES = 300
STEPS_BETWEEN = 5
INSTANTS = 3
ENCE_BINS = 10


@dataclass(frozen=True)
class PerceptionTarget:
    """What is looked at: a scene at a difficulty (and on a map); `ood` = never trained on."""

    scene: str
    preset: str = "paper"
    map: str | None = None
    ood: bool = False

    @property
    def name(self) -> str:
        return ":".join([self.scene, *([self.preset] if self.preset != "paper" else []), *([self.map or ""])]).rstrip(
            ":"
        )


def default_targets() -> tuple[PerceptionTarget, ...]:
    """The four scenes, and the map and the preset that are held out."""
    from ..agents.perception.frames import HELD_OUT_MAP, HELD_OUT_PRESET
    from ..envs.scenes import SCENES

    known = tuple(PerceptionTarget(scene) for scene in SCENES)
    held_out = (
        PerceptionTarget("connected_driving", map=HELD_OUT_MAP, ood=True),
        PerceptionTarget(*HELD_OUT_PRESET, ood=True),
    )
    return known + held_out


@dataclass(frozen=True, eq=False)
class Image:
    """One robot's observation with what is true of it.

    Attributes:
        observation: as agents get it.
        instances: (H, W) row of the object at each pixel; -1 for none.
        pixels: (m,) visible pixels.
        object_class: (m,).
        centres: (m, 3) m, camera frame.
    """

    observation: dict[str, Any]
    instances: NDArray[np.int32]
    pixels: NDArray[np.int64]
    object_class: NDArray[np.int64]
    centres: Array


@dataclass
class Tally:
    """What was found over many images; one entry per pair of a detection and its true object in the lists of arrays.

    Attributes:
        objects: number of true objects that count.
        detections: number of detections; `true_detections` of them meet a true object, however small.
        right_class: (k,) whether the most probable class is the true one.
        error: (k,) m, estimated minus true distance.
        distance, true_distance: (k,) m.
        lateral: (k,) m, distance of the true centre from the estimated viewing ray.
        u, v: (k,) reported uncertainties; across (k,) m^2, reported variance per axis across the viewing ray.
        attributes, true_class: (k, c), (k,).
        size: (k,) visible pixels.
        known: (k, 4) `variance_features` of the reported variances.
        milliseconds: per image.
    """

    objects: int = 0
    detections: int = 0
    true_detections: int = 0
    images: int = 0
    right_class: list[Array] = field(default_factory=list)
    error: list[Array] = field(default_factory=list)
    distance: list[Array] = field(default_factory=list)
    true_distance: list[Array] = field(default_factory=list)
    depth_ratio: list[Array] = field(default_factory=list)
    lateral: list[Array] = field(default_factory=list)
    u: list[Array] = field(default_factory=list)
    v: list[Array] = field(default_factory=list)
    across: list[Array] = field(default_factory=list)
    attributes: list[Array] = field(default_factory=list)
    true_class: list[NDArray[np.int64]] = field(default_factory=list)
    size: list[Array] = field(default_factory=list)
    known: list[Array] = field(default_factory=list)
    milliseconds: list[float] = field(default_factory=list)
    coco: CocoRecords = field(default_factory=lambda: CocoRecords())

    def of(self, name: str) -> Array:
        """All entries of one list as one array."""
        parts = getattr(self, name)
        return np.concatenate(parts) if parts else np.zeros(0)


def perception_benchmark(
    targets: Sequence[PerceptionTarget] | None = None,
    *,
    weights: Weights | None = None,
    images: int = IMAGES,
    seed: int = 0,
    split_key: int | None = None,
    samples: int = 16,
    progress: Callable[[int, int], None] = lambda done, total: None,
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
    computed = {"precision": str(dense_type(LearnedPerceptionParams().precision)).removeprefix("torch.")}
    for n, target in enumerate(targets):
        part = partial(_part_of, progress, n, images, len(targets))
        tallies[target] = tally(target, weights, images, (key, seed), samples, part)
        rows.append(row(target, tallies[target]) | {"images": tallies[target].images, "seed": seed} | computed)
        known = PerceptionTarget(target.scene)
        if target.ood and known in tallies:
            rows[-1] |= shift(tallies[known], tallies[target])
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


def _part_of(progress: Callable[[int, int], None], part: int, size: int, parts: int, done: int) -> None:
    progress(part * size + done, parts * size)


def tally(
    target: PerceptionTarget,
    weights: Weights,
    images: int,
    seed: tuple[int, int],
    samples: int = 16,
    progress: Callable[[int], None] = lambda done: None,
) -> Tally:
    """Look at `images` images of a target and count."""
    from ..agents.perception.kinds import open_eyes
    from ..agents.perception.learned import LearnedPerceptionParams

    out = Tally()
    env = make_env(target)
    try:
        # AP wants the unsure detections too; the other figures keep those that the eyes would report.
        eyes = open_eyes(weights, env.classes, LearnedPerceptionParams(samples=samples, score=0.05))
        report = LearnedPerceptionParams().score
        for number, image in enumerate(test_images(env, images, seed)):
            seen = eyes.see(image.observation, np.random.default_rng((*seed, number)))
            count(out, image, seen, report)
            progress(number + 1)
    finally:
        env.close()
    return out


def make_env(target: PerceptionTarget) -> CollaborativeEnv:
    """The scene of a target."""
    from ..agents.perception.frames import Variant
    from ..envs.scenes import parallel_env

    return parallel_env(target.scene, params=Variant(target.scene, target.preset, target.map).params())


def test_images(env: CollaborativeEnv, number: int, seed: tuple[int, int]) -> Iterator[Image]:
    """`number` images of a scene's episodes: every robot's view of a few instants of each."""
    given, episode = 0, 0
    while True:
        env_observations, _ = env.reset(seed=[*seed, episode])
        for instant in range(INSTANTS):
            for robot, agent in enumerate(env.possible_agents):
                if given == number:
                    return
                yield image_of(env, env_observations[agent], robot)
                given += 1
            if instant + 1 < INSTANTS and not _advance(env, env_observations):
                break
        episode += 1


def _advance(env: CollaborativeEnv, observations: dict[str, Any]) -> bool:
    """Let some steps pass, in place; False when the episode has ended."""
    from ..agents.controllers import scripted_controls
    from ..envs.claims import Claims, claims_to_action

    for _ in range(STEPS_BETWEEN):
        if not env.agents:
            return False
        silent = Claims.empty(env.max_detections, len(env.possible_agents) - 1)
        controls = scripted_controls(env.world)
        fresh, *_ = env.step({a: claims_to_action(silent, controls[i]) for i, a in enumerate(env.agents)})
        observations.update(fresh)
    return bool(env.agents)


def image_of(env: CollaborativeEnv, observation: dict[str, Any], robot: int) -> Image:
    """One robot's present view with its truth."""
    truth = env.ground_truth()
    return Image(
        observation=observation,
        instances=env.camera_frames()[robot].instances,
        pixels=truth.pixels[robot],
        object_class=truth.object_class,
        centres=transform(invert(truth.T_world_camera[robot]), truth.positions),
    )


def count(out: Tally, image: Image, seen: Seen, score: float) -> None:
    """Add one image's detections to a tally; those below `score` count for AP alone."""
    masks = seen.detections.masks
    assert masks is not None
    out.images += 1
    out.milliseconds.append(sum(seen.milliseconds.values()))
    out.coco.add(image.instances, image.pixels, masks, seen.scores)
    sure = np.flatnonzero(seen.scores >= score)
    wanted = image.pixels >= MIN_PIXELS
    out.objects += int(wanted.sum())
    out.detections += len(sure)
    partner = match_masks(masks[sure], image.instances, image.pixels)
    out.true_detections += int((partner >= 0).sum())
    hit = (partner >= 0) & (wanted[partner] if len(wanted) else False) & (image.centres[partner, 2] > 0.2)
    found, true = sure[hit], partner[hit]
    if len(found) == 0:
        return
    graph = seen.detections.graph.take(found)
    centres = image.centres[true]
    distance = np.linalg.norm(graph.positions, axis=1)
    true_distance = np.linalg.norm(centres, axis=1)
    ray = graph.positions / distance[:, None]
    across = centres - ray * (centres * ray).sum(axis=1, keepdims=True)
    out.right_class.append(graph.attributes.argmax(axis=1) == image.object_class[true])
    out.error.append(distance - true_distance)
    out.distance.append(distance)
    out.true_distance.append(true_distance)
    out.depth_ratio.append(graph.positions[:, 2] / centres[:, 2])
    out.lateral.append(np.linalg.norm(across, axis=1))
    out.u.append(graph.position_variance)
    out.v.append(graph.attribute_variance)
    covariances = graph.full_covariances()
    out.across.append(0.5 * (np.trace(covariances, axis1=1, axis2=2) - graph.position_variance))
    out.attributes.append(graph.attributes)
    out.true_class.append(image.object_class[true])
    out.known.append(_known(seen, found))
    out.size.append(image.pixels[true].astype(np.float64))


def _known(seen: Seen, found: NDArray[np.int64]) -> Array:
    from ..agents.perception.weights import variance_features

    variance, depth = seen.depth_variance[found], seen.depth[found]
    return variance_features(variance / depth**2, seen.depth_epistemic[found] / variance, seen.scores[found])


def match_masks(masks: NDArray[np.bool_], instances: NDArray[np.int32], pixels: NDArray[np.int64]) -> NDArray[np.int64]:
    """True object (n,) of each mask (n, H, W), best first, one-to-one, IoU >= 0.5; -1 = none."""
    partner = np.full(len(masks), -1, dtype=np.int64)
    taken = np.zeros(len(pixels), dtype=bool)
    for i, mask in enumerate(masks):
        under = instances[mask]
        shared = np.bincount(under[under >= 0], minlength=len(pixels))
        iou = np.where(taken, 0.0, shared / np.maximum(mask.sum() + pixels - shared, 1))
        if len(iou) and iou.max() >= MIN_IOU:
            partner[i] = int(iou.argmax())
            taken[partner[i]] = True
    return partner


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
        "v_mean": _mean(found.of("v")),
        "squared_error_mean_m2": _mean(squared),
        "lateral_mean_m": _mean(found.of("lateral")),
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


def shift(known: Tally, strange: Tally) -> dict[str, float | None]:
    """How much u, v and the squared errors rise out of distribution, among objects matched in range and size.

    Objects fall into bins a third of an octave of range by an octave of visible pixels; each bin counts by the smaller
    of its two numbers. Ratios of weighted means, strange over known.
    """
    bins = [
        np.stack([np.floor(3 * np.log2(t.of("true_distance"))), np.floor(np.log2(t.of("size")))], axis=1)
        for t in (known, strange)
    ]
    names = ("u_ratio_matched", "v_ratio_matched", "squared_error_ratio_matched")
    out: dict[str, float | None] = dict.fromkeys(names) | {"matched_objects": 0}
    keys = np.unique(np.concatenate(bins), axis=0)
    sums = np.zeros((2, 3))
    total = 0.0
    for key in keys:
        chosen = [(b == key).all(axis=1) for b in bins]
        weight = float(min(c.sum() for c in chosen))
        if weight == 0:
            continue
        total += weight
        for side, (t, c) in enumerate(zip((known, strange), chosen, strict=True)):
            sums[side] += weight * np.array([values[c].mean() for values in (t.of("u"), t.of("v"), t.of("error") ** 2)])
    if total and (sums[0] > 0).all():
        ratio = sums[1] / sums[0]
        out |= dict(zip(names, ratio.tolist(), strict=True)) | {"matched_objects": int(total)}
    return out


class CocoRecords:
    """Masks in COCO's form, class-agnostic, for pycocotools to judge."""

    def __init__(self) -> None:
        self.images: list[dict[str, Any]] = []
        self.truths: list[dict[str, Any]] = []
        self.results: list[dict[str, Any]] = []

    def add(
        self, instances: NDArray[np.int32], pixels: NDArray[np.int64], masks: NDArray[np.bool_], scores: Array
    ) -> None:
        """One image: what is true, what was found."""
        from pycocotools import mask as coco_mask  # type: ignore[import-untyped]

        number = len(self.images) + 1
        self.images.append({"id": number, "height": instances.shape[0], "width": instances.shape[1]})
        for obj in np.flatnonzero(pixels):
            code = coco_mask.encode(np.asfortranarray((instances == obj).astype(np.uint8)))
            self.truths.append(
                {
                    "id": len(self.truths) + 1,
                    "image_id": number,
                    "category_id": 1,
                    "segmentation": code,
                    "area": float(pixels[obj]),
                    "bbox": coco_mask.toBbox(code).tolist(),
                    "iscrowd": 0,
                }
            )
        for mask, score in zip(masks, scores, strict=True):
            code = coco_mask.encode(np.asfortranarray(mask.astype(np.uint8)))
            self.results.append({"image_id": number, "category_id": 1, "segmentation": code, "score": float(score)})

    def ap50(self) -> float | None:
        """COCO's AP at IoU 0.5 of masks, objects of at least 60 visible pixels; None without such objects."""
        from pycocotools.coco import COCO  # type: ignore[import-untyped]
        from pycocotools.cocoeval import COCOeval  # type: ignore[import-untyped]

        if not any(t["area"] >= MIN_PIXELS for t in self.truths):
            return None
        if not self.results:
            return 0.0
        with contextlib.redirect_stdout(io.StringIO()):
            truth = COCO()
            truth.dataset = {
                "images": self.images,
                "annotations": self.truths,
                "categories": [{"id": 1, "name": "object"}],
            }
            truth.createIndex()
            judge = COCOeval(truth, truth.loadRes(self.results), "segm")
            judge.params.iouThrs = np.array([MIN_IOU])
            judge.params.areaRng = [[MIN_PIXELS, 1e9]]
            judge.params.areaRngLbl = ["counted"]
            judge.params.maxDets = [100]
            judge.evaluate()
            judge.accumulate()
        precision = judge.eval["precision"]
        return float(precision[precision > -1].mean())


def _mean(values: Array) -> float | None:
    return float(np.mean(values)) if len(values) else None


def _ratio(part: int, whole: int) -> float | None:
    return part / whole if whole else None


def table_columns() -> Iterable[tuple[str, str]]:
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
        ("u_ratio_matched", "u ratio"),
        ("v_ratio_matched", "v ratio"),
        ("squared_error_ratio_matched", "e² ratio"),
    )
