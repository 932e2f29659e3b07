"""Counting what eyes saw against what is true: masks matched one-to-one, and all that the figures are made of."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..matching.pose import Array
from .perception_images import Image, PerceptionTarget, make_env, test_images

if TYPE_CHECKING:
    from ..agents.perception.learned import Seen
    from ..agents.perception.weights import Weights

MIN_PIXELS = 60
MIN_IOU = 0.5
MIN_DEPTH_M = 0.2


@dataclass
class Tally:
    """What was found over many images.

    The lists of arrays have one entry per detection that meets a true object: those whose mask does, and those whose
    box does, as the environment ties them. The former count in the figures, where their object is large enough.

    Attributes:
        objects: number of true objects that count.
        detections: number of detections; `true_detections` of them meet a true object by their mask, however small.
        counts: (k,) whether the entry counts in the figures.
        right_class: (k,) whether the most probable class is the true one.
        error: (k,) m, estimated minus true distance.
        distance, true_distance: (k,) m.
        depth_ratio: (k,) estimated over true depth.
        offset: (k, 3) m, true minus estimated position along the viewing ray and across it, to the right and down.
        variances: (k, 3) m^2, reported variances of these.
        u, v: (k,) reported uncertainties; `u_epistemic`, `v_epistemic` their parts that are variance between samples.
        attributes, true_class: (k, c), (k,).
        size: (k,) visible pixels.
        features: (k, TERMS) of which the calibration is a function.
        backbone: (k, d) features of the network, where its eyes give them.
        milliseconds: per image.
    """

    objects: int = 0
    detections: int = 0
    true_detections: int = 0
    images: int = 0
    counts: list[NDArray[np.bool_]] = field(default_factory=list)
    right_class: list[Array] = field(default_factory=list)
    error: list[Array] = field(default_factory=list)
    distance: list[Array] = field(default_factory=list)
    true_distance: list[Array] = field(default_factory=list)
    depth_ratio: list[Array] = field(default_factory=list)
    offset: list[Array] = field(default_factory=list)
    variances: list[Array] = field(default_factory=list)
    u: list[Array] = field(default_factory=list)
    v: list[Array] = field(default_factory=list)
    u_epistemic: list[Array] = field(default_factory=list)
    v_epistemic: list[Array] = field(default_factory=list)
    attributes: list[Array] = field(default_factory=list)
    true_class: list[NDArray[np.int64]] = field(default_factory=list)
    size: list[Array] = field(default_factory=list)
    features: list[Array] = field(default_factory=list)
    backbone: list[Array] = field(default_factory=list)
    milliseconds: list[float] = field(default_factory=list)
    coco: CocoRecords = field(default_factory=lambda: CocoRecords())

    def of(self, name: str, *, every: bool = False) -> Array:
        """The entries of one list that count as one array; `every` = also those that do not."""
        parts = getattr(self, name)
        if not parts:
            return np.zeros(0)
        values = np.concatenate(parts)
        return values if every else values[np.concatenate(self.counts)]


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


def count(out: Tally, image: Image, seen: Seen, score: float) -> None:
    """Add one image's detections to a tally; those below `score` count for AP alone."""
    from ..agents.perception.detections import ray_frames
    from ..envs.scoring import tie, tight_boxes

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
    counted = (partner >= 0) & (wanted[partner] if len(wanted) else False)
    boxes, visible = tight_boxes(image.instances, len(image.pixels))
    partner = np.where(counted, partner, tie(seen.detections.boxes[sure], boxes, visible))
    hit = (partner >= 0) & (image.centres[partner, 2] > MIN_DEPTH_M if len(wanted) else False)
    found, true = sure[hit], partner[hit]
    if len(found) == 0:
        return
    graph = seen.detections.graph.take(found)
    centres = image.centres[true]
    distance = np.linalg.norm(graph.positions, axis=1)
    true_distance = np.linalg.norm(centres, axis=1)
    frames = ray_frames(graph.positions)
    out.counts.append(counted[hit])
    out.right_class.append(graph.attributes.argmax(axis=1) == image.object_class[true])
    out.error.append(distance - true_distance)
    out.distance.append(distance)
    out.true_distance.append(true_distance)
    out.depth_ratio.append(graph.positions[:, 2] / centres[:, 2])
    out.offset.append(np.einsum("nki,ni->nk", frames, centres - graph.positions))
    out.variances.append(np.einsum("nki,nij,nkj->nk", frames, graph.full_covariances(), frames))
    out.u.append(graph.position_variance)
    out.v.append(graph.attribute_variance)
    out.u_epistemic.append(graph.position_variance * (seen.depth_epistemic / seen.depth_variance)[found])
    out.v_epistemic.append(seen.attribute_epistemic[found])
    out.attributes.append(graph.attributes)
    out.true_class.append(image.object_class[true])
    out.features.append(seen.features[found])
    if seen.backbone is not None:
        out.backbone.append(seen.backbone[found])
    out.size.append(image.pixels[true].astype(np.float64))


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
