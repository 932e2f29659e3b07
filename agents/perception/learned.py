"""Eyes that see only pixels: sections 3.1, 3.3.1 and 3.3.2 with a compact network and Monte Carlo dropout."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from ...matching import ObjectGraph
from ...matching.pose import Array
from . import weights as stored
from .decode import draw_masks, find_peaks, full_masks, mask_quality, spread_pixels, suppress
from .detections import Detections, ray_covariances, rays
from .losses import iou
from .network import (
    CENTRE_GEOMETRY,
    FINE_STRIDE,
    REFERENCE_FOCAL_PX,
    DenseFeatures,
    Eyes,
    Geometry,
    NetworkParams,
    boxes_from,
    centre_features,
    depth_features,
    normalised,
)

PRECISIONS = ("auto", "bfloat16", "float32")
LEAST_PIXEL_VARIANCE = 0.05
"""Of a projected centre per axis before calibration, px^2."""


@dataclass(frozen=True)
class LearnedPerceptionParams:
    """How the network's outputs become detections.

    Attributes:
        samples: T of Eq. (6); 1 switches dropout off, and epistemic variance with it.
        score: least confidence of a detection.
        candidates: most peaks looked at per image.
        min_pixels: least visible pixels of a detection.
        depth_pixels: pixels per object over which depth is averaged, spread evenly over its mask.
        max_iou, max_inside: a mask goes when a better one overlaps it more, see `decode.suppress`.
        precision: of the part that runs once per image, in which it was trained as well: `bfloat16`, `float32`, or
            `auto`, which is bfloat16 where the processor multiplies such numbers (twice as fast) and float32 elsewhere.
    """

    samples: int = 16
    score: float = 0.55
    candidates: int = 64
    min_pixels: int = 40
    depth_pixels: int = 12
    max_iou: float = 0.5
    max_inside: float = 0.75
    precision: str = "auto"

    def __post_init__(self) -> None:
        for name in ("samples", "candidates", "min_pixels", "depth_pixels"):
            value = getattr(self, name)
            if not isinstance(value, (int, np.integer)) or value < 1:
                raise ValueError(f"{name} must be a whole number >= 1, got {value!r}")
        for name in ("score", "max_iou", "max_inside"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"{name} must be in [0, 1], got {getattr(self, name)}")
        if self.precision not in PRECISIONS:
            raise ValueError(f"precision must be one of {', '.join(PRECISIONS)}, got {self.precision!r}")


@dataclass(frozen=True, eq=False)
class Seen:
    """Everything the eyes make of one image, n objects, best score first.

    Attributes:
        detections: as the pipeline takes them.
        scores: (n,) confidence that this is an object, in [0, 1].
        pixels: (n,) visible pixels.
        depth: (n,) m, of each object's centre along the optical axis.
        depth_variance: (n,) m^2 of that, calibrated; the sum of epistemic and aleatoric.
        depth_epistemic: (n,) m^2, the variance between samples, calibrated alike.
        attribute_epistemic: (n,) the part of v that is variance between samples.
        features: (n, weights.TERMS) of which the calibration is a function.
        backbone: (n, d) features of the network at the objects, or None.
        milliseconds: time per stage.
    """

    detections: Detections
    scores: Array
    pixels: NDArray[np.int64]
    depth: Array
    depth_variance: Array
    depth_epistemic: Array
    attribute_epistemic: Array
    features: Array
    backbone: Array | None
    milliseconds: Mapping[str, float]


@dataclass(frozen=True, eq=False)
class View:
    """One robot's observation, checked.

    Attributes:
        image: (H, W, 3) uint8.
        intrinsics: (3, 3).
        up: (3,) against gravity, camera frame.
        height, height_std: m, of the camera above the ground, see `camera_height`.
    """

    image: NDArray[np.uint8]
    intrinsics: Array
    up: Array
    height: float
    height_std: float


@dataclass(frozen=True, eq=False)
class Objects:
    """What a network makes of one image before calibration, n objects, best score first.

    Attributes:
        scores, pixels, masks (n, H, W): see `Seen`.
        tight: (n, 4) px, boxes of the masks.
        attributes: (n, c) class distributions, Eq. (6); attribute_variance (n,), section 3.3.1, and its epistemic part.
        pixel: (n, 2) where the centre projects to.
        size: (n, 2) px, width and height of the box that the network gives.
        centre_variance: (n,) of `pixel` per axis, in squares of the size along it.
        depth, depth_variance, depth_epistemic: (n,) m and m^2.
        depth_spread: (n,) variance of the log depth between the pixels of the mask.
        box_overlap: (n,) IoU of the box that the network gives with `tight`.
        embedding: (n, e), or None.
        backbone: (n, d) features at the centres, or None.
    """

    scores: Array
    pixels: NDArray[np.int64]
    masks: NDArray[np.bool_]
    tight: Array
    attributes: Array
    attribute_variance: Array
    attribute_epistemic: Array
    pixel: Array
    size: Array
    centre_variance: Array
    depth: Array
    depth_variance: Array
    depth_epistemic: Array
    depth_spread: Array
    box_overlap: Array
    embedding: Array | None = None
    backbone: Array | None = None


class LearnedPerception:
    """A perceptor for observations with `image`, `intrinsics` and `up`; nothing privileged is read.

    Args:
        classes: the scene's classes, in the order of the attribute vector; each must be one the network knows.
        weights: trained weights; None loads those that come with the package.
        params: how outputs become detections.
        image_size: (width, height) that images must have; None takes any.

    Attributes:
        last: what was seen last, with scores, timing and the parts of the uncertainty.

    Raises:
        WeightsError: no weights, or altered ones.
        ValueError: a class that the network does not know.
    """

    def __init__(
        self,
        classes: Sequence[str],
        weights: stored.Weights | None = None,
        params: LearnedPerceptionParams | None = None,
        image_size: tuple[int, int] | None = None,
    ) -> None:
        weights = stored.load() if weights is None else weights
        self.params = params or LearnedPerceptionParams()
        self.calibration = weights.calibration
        self.image_size = image_size
        known = weights.classes
        unknown = [c for c in classes if c not in known]
        if unknown or not classes:
            raise ValueError(
                f"learned perception does not know the class {unknown or classes!r}; it knows {known}. "
                "Simulated perception (`--perception simulated`) takes any."
            )
        self.classes = tuple(classes)
        self._class_index = torch.tensor([known.index(c) for c in classes])
        self.network = self._build(weights)
        self.last: Seen | None = None

    def _build(self, weights: stored.Weights) -> nn.Module:
        return build(weights, dense_type(self.params.precision))

    @classmethod
    def from_folder(cls, folder: Path, classes: Sequence[str], **options: Any) -> LearnedPerception:
        """Eyes with the weights of a folder, see `covis.agents.perception.weights`."""
        return cls(classes, stored.load(folder), **options)

    def __call__(self, observation: Mapping[str, Any], rng: np.random.Generator) -> Detections:
        """Detections of one observation; `rng` feeds the dropout.

        Raises:
            ValueError: no image, or one of the wrong type or size.
        """
        self.last = self.see(observation, rng)
        return self.last.detections

    @torch.inference_mode()
    def see(self, observation: Mapping[str, Any], rng: np.random.Generator) -> Seen:
        """Like calling, with all there is to know."""
        clock = Clock()
        view = self._checked(observation)
        generator = torch.Generator().manual_seed(int(rng.integers(2**62)))
        seen = self._calibrated(self._objects(view, generator, clock), view)
        clock.lap("graph")
        return replace(seen, milliseconds=clock.laps)

    def _objects(self, view: View, generator: torch.Generator, clock: Clock) -> Objects:
        """What the network makes of one image."""
        rows, columns = view.image.shape[:2]
        K, up = torch.from_numpy(view.intrinsics[None]), torch.from_numpy(view.up[None])
        geometry = Geometry.of(K, up, torch.tensor([view.height]), torch.tensor([view.height_std]))
        dense = self.network(normalised(torch.from_numpy(view.image[None])), geometry)
        clock.lap("backbone")
        found = self._find(dense, geometry, rows, columns)
        clock.lap("masks")
        attributes, v, v_epistemic = self._classify(found.features, generator)
        clock.lap("classes")
        depth, variance, epistemic, spread = self._depths(dense, geometry, found, generator)
        clock.lap("depth")
        size = (found.boxes[:, 2:] - found.boxes[:, :2]).clamp(min=2.0)
        return Objects(
            scores=found.scores,
            pixels=found.pixels,
            masks=found.masks,
            tight=found.tight,
            attributes=attributes,
            attribute_variance=v,
            attribute_epistemic=v_epistemic,
            pixel=(found.at + found.centre * size).double().numpy(),
            size=size.double().numpy(),
            centre_variance=np.exp(found.centre_log_variance.double().numpy()),
            depth=depth,
            depth_variance=variance,
            depth_epistemic=epistemic,
            depth_spread=spread,
            box_overlap=iou(found.boxes, torch.from_numpy(found.tight)).double().numpy(),
            embedding=found.embedding.double().numpy(),
            backbone=found.features[:, :-CENTRE_GEOMETRY].double().numpy(),
        )

    def _calibrated(self, found: Objects, view: View) -> Seen:
        """Depths and uncertainties as validation scenes have shown that they should be."""
        familiar, strangeness = self.calibration.familiar, np.ones(len(found.depth))
        if familiar is not None and found.backbone is not None:
            strangeness = familiar.strangeness(found.backbone)
        features = stored.calibration_features(
            depth=found.depth,
            depth_variance=found.depth_variance,
            depth_epistemic=found.depth_epistemic,
            centre_variance=found.centre_variance,
            confidence=found.scores,
            size=found.size,
            class_epistemic=found.attribute_epistemic,
            depth_spread=found.depth_spread,
            box_overlap=found.box_overlap,
            strangeness=strangeness,
        )
        nearer, along, *axes = self.calibration.factors(features).T
        depth, factor = found.depth * nearer, along * nearer**2
        ray = rays(found.pixel, view.intrinsics)
        positions = ray * depth[:, None]
        u = factor * found.depth_variance * (ray**2).sum(axis=1)  # of the distance along the ray
        pixel_variance = np.maximum(found.centre_variance[:, None] * found.size**2, LEAST_PIXEL_VARIANCE)
        across = (depth[:, None] / view.intrinsics[(0, 1), (0, 1)]) ** 2 * pixel_variance * np.stack(axes, axis=1)
        graph = ObjectGraph(
            positions=positions,
            attributes=found.attributes,
            position_variance=u,
            attribute_variance=found.attribute_variance,
            covariances=ray_covariances(positions, u, across),
            up=view.up / np.linalg.norm(view.up),
            forward=np.array([0.0, 0.0, 1.0]),
            embedding=found.embedding,
            intrinsics=view.intrinsics,
            image_size=(view.image.shape[1], view.image.shape[0]),
        )
        return Seen(
            detections=Detections(graph, found.tight, found.masks),
            scores=found.scores,
            pixels=found.pixels,
            depth=depth,
            depth_variance=factor * found.depth_variance,
            depth_epistemic=factor * found.depth_epistemic,
            attribute_epistemic=found.attribute_epistemic,
            features=features,
            backbone=found.backbone,
            milliseconds={},
        )

    def _checked(self, observation: Mapping[str, Any]) -> View:
        if "image" not in observation:
            raise ValueError('learned perception needs the observation\'s "image": make the environment with it')
        image = np.asarray(observation["image"])
        if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3:
            raise ValueError(f"image must be uint8 of shape (H, W, 3), got {image.dtype} {image.shape}")
        height, width = image.shape[:2]
        if self.image_size is not None and (width, height) != self.image_size:
            raise ValueError(f"image must be {self.image_size[0]}x{self.image_size[1]} pixels, got {width}x{height}")
        if width < 64 or height < 64 or width % FINE_STRIDE**2 or height % FINE_STRIDE**2:
            raise ValueError(f"image sides must be multiples of 4 and at least 64 pixels, got {width}x{height}")
        K, up = finite(observation, "intrinsics", (3, 3)), finite(observation, "up", (3,))
        return View(np.ascontiguousarray(image), K, up, *camera_height(observation))

    def _find(self, dense: DenseFeatures, geometry: Geometry, height: int, width: int) -> _Found:
        """Objects with their masks, the better of two claims to one thing kept."""
        p = self.params
        cells, peak = find_peaks(torch.sigmoid(dense.heat[0]).numpy(), p.score**3)
        best = np.argsort(-peak, kind="stable")[: p.candidates]
        cells, peak = cells[best], peak[best]
        at = torch.from_numpy((FINE_STRIDE * (cells[:, ::-1] + 0.5)).astype(np.float32))
        image = torch.zeros(len(at), dtype=torch.int64)
        features = centre_features(dense, geometry, image, at)
        out = self.network.objects(features)
        boxes = boxes_from(out.box, at)
        size = (boxes[:, 2:] - boxes[:, :2]).clamp(min=2.0)
        region = _region(boxes.numpy(), size.numpy(), height, width)
        logits = draw_masks(
            dense.mask[0].numpy(),
            out.mask.numpy(),
            self.network.params.mask_hidden,
            at.numpy(),
            (0.5 * size).numpy(),
            region,
            FINE_STRIDE,
        )
        covered, quality = mask_quality(logits, region)
        overlap = torch.sigmoid(out.overlap).double().numpy()
        scores = np.cbrt(peak * quality * overlap)
        keep = suppress(logits, region, covered, scores, p.max_iou, p.max_inside)
        keep = keep[scores[keep] >= p.score]
        masks, pixels, tight = full_masks(logits[keep], region[keep], height, width)
        seen = pixels >= p.min_pixels
        rows = torch.from_numpy(keep[seen])
        return _Found(
            features=features[rows],
            at=at[rows],
            boxes=boxes[rows],
            centre=out.centre[rows],
            centre_log_variance=out.centre_log_variance[rows],
            embedding=out.embedding[rows],
            scores=scores[keep[seen]],
            masks=masks[seen],
            pixels=pixels[seen],
            tight=tight[seen],
        )

    def _classify(self, features: Tensor, generator: torch.Generator) -> tuple[Array, Array, Array]:
        """Class distributions (n, c), Eq. (6), their uncertainty v (n,), section 3.3.1, and its epistemic part."""
        T = self.params.samples
        sampled = features.expand(T, *features.shape)
        logits = self.network.class_logits(sampled, T > 1, generator)[..., self._class_index]
        return class_uncertainty(logits, self.calibration.class_temperature)

    def _depths(
        self, dense: DenseFeatures, geometry: Geometry, found: _Found, generator: torch.Generator
    ) -> tuple[Array, Array, Array, Array]:
        """Depth (n,) m as mean over each mask, its variance (n,) as mean over its pixels, the epistemic part, and
        how the log depth varies between pixels (n,).
        """
        n, T, D = len(found.scores), self.params.samples, self.params.depth_pixels
        if n == 0:
            return np.zeros(0), np.zeros(0), np.zeros(0), np.zeros(0)
        pixels = torch.from_numpy(spread_pixels(found.masks, found.pixels, found.tight, D))
        image = torch.zeros(n * D, dtype=torch.int64)
        box = found.boxes[:, None].expand(n, D, 4).reshape(-1, 4)
        seen = depth_features(dense, geometry, image, pixels.reshape(-1, 2), box)
        log_depth, log_variance = self.network.depth(seen, T > 1, generator, draws=T)
        return depth_uncertainty(log_depth.view(T, n, D), log_variance.view(T, n, D), float(geometry.focal[0]))


def depth_uncertainty(log_depth: Tensor, log_variance: Tensor, focal: float) -> tuple[Array, Array, Array, Array]:
    """Depth (n,) m, its variance (n,) m^2, section 3.3.2, the epistemic part of that, and the variance (n,) of the log
    depth between pixels, of samples (T, n, pixels).
    """
    z = focal / REFERENCE_FOCAL_PX * torch.exp(log_depth.double())
    aleatoric = (z**2 * torch.exp(log_variance.double())).mean((0, 2)).numpy()
    epistemic = z.var(0, unbiased=False).mean(1).numpy()
    spread = log_depth.double().mean(0).var(1, unbiased=False).numpy()
    return z.mean((0, 2)).numpy(), aleatoric + epistemic, epistemic, spread


def class_uncertainty(logits: Tensor, temperature: float) -> tuple[Array, Array, Array]:
    """Class distributions (n, c), Eq. (6), their uncertainty v (n,), section 3.3.1, and the epistemic part of that, of
    samples (T, n, c).
    """
    p = torch.softmax(logits / temperature, dim=2).double().numpy()
    mean = p.mean(axis=0)  # Eq. (6)
    epistemic = p.var(axis=0).mean(axis=1)
    aleatoric = (p * (1 - p)).mean(axis=(0, 2))
    return mean / mean.sum(axis=1, keepdims=True), epistemic + aleatoric, epistemic


def finite(observation: Mapping[str, Any], name: str, shape: tuple[int, ...]) -> Array:
    """A leaf of an observation as floats.

    Raises:
        ValueError: it is not there, of another shape, or not finite.
    """
    if name not in observation:
        raise ValueError(f'learned perception needs the observation\'s "{name}"')
    value = np.asarray(observation[name], dtype=np.float64)
    if value.shape != shape or not np.isfinite(value).all():
        raise ValueError(f"{name} must be finite and of shape {shape}, got shape {value.shape}: {value.tolist()}")
    return value


def camera_height(observation: Mapping[str, Any]) -> tuple[float, float]:
    """Height of a robot's camera above the ground, m, and its deviation, by its own noisy pose; infinite without one.

    The ground is z = 0 of the world.

    Raises:
        ValueError: a pose or covariance of another shape, or not finite.
    """
    if "pose" not in observation:
        return 0.0, math.inf
    pose = finite(observation, "pose", (4, 4))
    covariance = finite(observation, "pose_covariance", (6, 6))
    up = pose[2, :3]  # right perturbation: the covariance is in the camera frame
    return float(pose[2, 3]), math.sqrt(max(float(up @ covariance[:3, :3] @ up), 0.0))


@dataclass(frozen=True, eq=False)
class _Found:
    """n objects of one image: where they are, their masks, what the heads read and said."""

    features: Tensor
    at: Tensor
    boxes: Tensor
    centre: Tensor
    centre_log_variance: Tensor
    embedding: Tensor
    scores: Array
    masks: NDArray[np.bool_]
    pixels: NDArray[np.int64]
    tight: Array


class Clock:
    """Milliseconds of the stages that end with each `lap`."""

    def __init__(self) -> None:
        self.laps: dict[str, float] = {}
        self._since = time.perf_counter()

    def lap(self, name: str) -> None:
        now = time.perf_counter()
        self.laps[name] = 1e3 * (now - self._since)
        self._since = now


def dense_type(precision: str) -> torch.dtype:
    """The type that `LearnedPerceptionParams.precision` stands for on this machine."""
    if precision == "auto":
        native: dict[str, Any] = getattr(torch.cpu, "get_capabilities", dict)()  # older torch: none
        precision = "bfloat16" if native.get("avx512_bf16") or native.get("amx_bf16") else "float32"
    return torch.bfloat16 if precision == "bfloat16" else torch.float32


def build(weights: stored.Weights, dense: torch.dtype = torch.float32) -> Eyes:
    """The network of these weights, for inference: normalisation folded into the convolutions, dense part cast."""
    network = Eyes(NetworkParams.from_dict(dict(weights.network)))
    network.load_state_dict(dict(weights.tensors))
    network.eval().requires_grad_(False)
    _fold(network)
    network.dense_to(dense)
    return network.to(memory_format=torch.channels_last)


def _fold(module: nn.Module) -> None:
    for child in module.children():
        _fold(child)
    if isinstance(module, nn.Sequential):
        layers = list(module)
        for i, (conv, norm) in enumerate(pairwise(layers)):
            if isinstance(conv, nn.Conv2d) and isinstance(norm, nn.BatchNorm2d):
                module[i], module[i + 1] = fuse_conv_bn_eval(conv, norm), nn.Identity()


def _region(boxes: NDArray[np.float32], size: NDArray[np.float32], height: int, width: int) -> NDArray[np.int64]:
    """Cells [x0, y0, x1, y1) of the fine maps in which an object's mask is sought: its box with a margin."""
    margin = 0.15 * size + 3
    low = np.floor((boxes[:, :2] - margin) / FINE_STRIDE)
    high = np.ceil((boxes[:, 2:] + margin) / FINE_STRIDE)
    limit = np.array([width, height]) // FINE_STRIDE
    return np.concatenate([np.clip(low, 0, limit), np.clip(high, 0, limit)], axis=1).astype(np.int64)
