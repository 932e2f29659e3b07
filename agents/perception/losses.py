"""What the network is trained to minimise, and the batches it is computed on."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from ...envs.camera.effects import EffectRanges, expose
from .frames import Frame
from .network import (
    FINE_STRIDE,
    REFERENCE_FOCAL_PX,
    DenseFeatures,
    Eyes,
    Geometry,
    bilinear,
    boxes_from,
    centre_features,
    depth_features,
    mask_logits,
    normalised,
)
from .targets import draw_heat, pixels_inside, points_around

LOCATIONS = 3
"""Places per object from which it may be described: its visible centre and random pixels near it."""
MASK_POINTS = 192
DEPTH_POINTS = 8
MIN_PIXELS = 40
"""Objects with fewer visible pixels are neither wanted nor forbidden."""
MIN_DEPTH_M = 0.2
NO_HEIGHT = 0.1
"""Share of images whose camera's height is withheld."""


@dataclass(frozen=True, eq=False)
class Batch:
    """b images with k objects; arrays per object are in the order of images.

    Attributes:
        images: (b, H, W, 3) uint8.
        intrinsics, up: (b, 3, 3), (b, 3).
        height, height_std: (b,) m, of the cameras as the robots report it, and 1 sigma.
        heat, heat_weight: (b, H/2, W/2).
        image: (k,) index of each object's image.
        pair: (k,) number of each object's pair of images; side (k,) 0 or 1 in it.
        identity: (k,) equal for the same object in both images of a pair.
        object_class: (k,).
        boxes: (k, 4) px.
        centre: (k, 2) px, where the true centre projects to; with `located` (k,) false where it cannot.
        depth: (k,) m, of the true centre, along the optical axis.
        locations: (k, LOCATIONS, 2) px.
        mask_points, mask_labels: (k, MASK_POINTS, 2) px, (k, MASK_POINTS) in {0, 1}.
        depth_points: (k, DEPTH_POINTS, 2) px.
        masks: (k, H, W) uint8, visible pixels, where asked for.
    """

    images: Tensor
    intrinsics: Tensor
    up: Tensor
    height: Tensor
    height_std: Tensor
    heat: Tensor
    heat_weight: Tensor
    image: Tensor
    pair: Tensor
    side: Tensor
    identity: Tensor
    object_class: Tensor
    boxes: Tensor
    centre: Tensor
    located: Tensor
    depth: Tensor
    locations: Tensor
    mask_points: Tensor
    mask_labels: Tensor
    depth_points: Tensor
    masks: Tensor | None = None

    @property
    def geometry(self) -> Geometry:
        return Geometry.of(self.intrinsics, self.up, self.height, self.height_std)


def make_batch(
    pairs: Sequence[tuple[Frame, Frame]], rng: np.random.Generator, augment: bool = True, masks: bool = False
) -> Batch:
    """A batch of pairs of frames; with `augment` some mirrored, and their light and sharpness varied."""
    frames = [frame.mirrored() if augment and rng.random() < 0.5 else frame for pair in pairs for frame in pair]
    height, width = frames[0].instances.shape
    heat = np.zeros((len(frames), height // FINE_STRIDE, width // FINE_STRIDE), np.float32)
    weight = np.ones_like(heat)
    rows: dict[str, list[NDArray[np.generic]]] = {name: [] for name in _PER_OBJECT}
    for i, frame in enumerate(frames):
        table = frame.objects
        draw_heat(heat[i], weight[i], table.centres, table.boxes, table.pixels, MIN_PIXELS, FINE_STRIDE)
        for obj in np.flatnonzero(table.pixels >= MIN_PIXELS):
            for name, value in _object_rows(frame, int(obj), rng).items():
                rows[name].append(value)
            for name, number in (("image", i), ("pair", i // 2), ("side", i % 2), ("identity", frame.identity[obj])):
                rows[name].append(np.asarray(number, np.int64))
    images = np.stack([frame.image for frame in frames])
    heights = np.array([_reported_height(frame, rng) for frame in frames], np.float32)
    return Batch(
        images=torch.from_numpy(vary(images, rng) if augment else images),
        intrinsics=torch.from_numpy(np.stack([f.intrinsics for f in frames])).float(),
        up=torch.from_numpy(np.stack([f.up for f in frames])).float(),
        height=torch.from_numpy(heights[:, 0]),
        height_std=torch.from_numpy(heights[:, 1]),
        heat=torch.from_numpy(heat),
        heat_weight=torch.from_numpy(weight),
        masks=torch.from_numpy(_masks(frames)) if masks else None,
        **{name: _stacked(values, _PER_OBJECT[name]) for name, values in rows.items()},
    )


def _masks(frames: Sequence[Frame]) -> NDArray[np.uint8]:
    height, width = frames[0].instances.shape
    found = [f.instances == obj for f in frames for obj in np.flatnonzero(f.objects.pixels >= MIN_PIXELS)]
    return np.array(found, np.uint8).reshape(-1, height, width)


def _reported_height(frame: Frame, rng: np.random.Generator) -> tuple[float, float]:
    """Height of a camera as a robot with a worse or better receiver would report it, with 1 sigma; some have none."""
    sigma = frame.height_sigma_m * math.exp(rng.normal(0, 0.3))
    if rng.random() < NO_HEIGHT:
        return 0.0, math.inf
    return frame.camera_height_m + rng.normal(0, sigma), sigma


_PER_OBJECT: dict[str, tuple[tuple[int, ...], torch.dtype]] = {
    "image": ((), torch.int64),
    "pair": ((), torch.int64),
    "side": ((), torch.int64),
    "identity": ((), torch.int64),
    "object_class": ((), torch.int64),
    "boxes": ((4,), torch.float32),
    "centre": ((2,), torch.float32),
    "located": ((), torch.bool),
    "depth": ((), torch.float32),
    "locations": ((LOCATIONS, 2), torch.float32),
    "mask_points": ((MASK_POINTS, 2), torch.float32),
    "mask_labels": ((MASK_POINTS,), torch.float32),
    "depth_points": ((DEPTH_POINTS, 2), torch.float32),
}


def _stacked(values: list[NDArray[np.generic]], form: tuple[tuple[int, ...], torch.dtype]) -> Tensor:
    shape, dtype = form
    if not values:
        return torch.zeros((0, *shape), dtype=dtype)
    return torch.from_numpy(np.stack(values)).to(dtype)


def _object_rows(frame: Frame, obj: int, rng: np.random.Generator) -> dict[str, NDArray[np.generic]]:
    table = frame.objects
    height, width = frame.instances.shape
    box = table.boxes[obj]
    size = np.maximum(box[2:] - box[:2], 1.0)
    centre = frame.centres[obj]
    K = frame.intrinsics
    located = centre[2] > MIN_DEPTH_M
    projected = K[:2, :2] @ (centre[:2] / max(centre[2], MIN_DEPTH_M)) + K[:2, 2]
    # Centres far outside the visible box belong to cut-off objects about which a picture says little.
    located = located and bool((np.abs(projected - table.centres[obj]) < 3 * size + 20).all())
    near = pixels_inside(table, obj, 8, width, rng)
    away = np.abs((near - table.centres[obj]) / size).max(axis=1)
    near = near[np.argsort(away)[: LOCATIONS - 1]]
    cell = FINE_STRIDE * (np.floor(np.concatenate([table.centres[obj][None], near]) / FINE_STRIDE) + 0.5)
    points = points_around(table, obj, MASK_POINTS, width, height, rng)
    labels = frame.instances[points[:, 1].astype(np.int64), points[:, 0].astype(np.int64)] == obj
    return {
        "object_class": np.asarray(frame.object_class[obj]),
        "boxes": box,
        "centre": projected,
        "located": np.asarray(located),
        "depth": np.asarray(max(centre[2], MIN_DEPTH_M)),
        "locations": cell,
        "mask_points": points,
        "mask_labels": labels,
        "depth_points": pixels_inside(table, obj, DEPTH_POINTS, width, rng),
    }


EFFECTS = EffectRanges()
"""What cameras add to pictures; the lens stays straight, since geometry and truth are those of a pinhole."""


def vary(images: NDArray[np.uint8], rng: np.random.Generator) -> NDArray[np.uint8]:
    """Images (b, H, W, 3) as other cameras would take them: exposure, colour, contrast, blur, vignette, noise.

    Half of them stay as they were rendered.
    """
    out = images.copy()
    for picture in out:
        if rng.random() < 0.5:
            expose(picture, EFFECTS.sample(rng), rng, out=picture)
    return out


@dataclass(frozen=True)
class LossWeights:
    """How much each part counts."""

    heat: float = 1.0
    box: float = 1.0
    mask: float = 2.0
    overlap: float = 0.3
    classes: float = 1.0
    depth: float = 1.0
    centre: float = 0.3
    embedding: float = 0.1


def losses(
    network: Eyes, batch: Batch, weights: LossWeights, generator: torch.Generator | None, *, bf16: bool = True
) -> dict[str, Tensor]:
    """Every part of the loss by name, and their weighted sum as `total`."""
    geometry = batch.geometry
    with torch.autocast("cpu", torch.bfloat16, enabled=bf16):
        dense = network(normalised(batch.images), geometry)
    parts = {"heat": heat_loss(dense.heat, batch.heat, batch.heat_weight)}
    if len(batch.image):
        parts |= _object_losses(network, dense, geometry, batch, generator)
    parts["total"] = torch.stack([getattr(weights, name) * value for name, value in parts.items()]).sum()
    return parts


def _object_losses(
    network: Eyes, dense: DenseFeatures, geometry: Geometry, batch: Batch, generator: torch.Generator | None
) -> dict[str, Tensor]:
    k = len(batch.image)
    image = batch.image[:, None].expand(k, LOCATIONS).reshape(-1)
    at = batch.locations.reshape(-1, 2)
    found = centre_features(dense, geometry, image, at)
    out = network.objects(found)
    logits = network.class_logits(found, True, generator)
    repeated = batch.object_class[:, None].expand(k, LOCATIONS).reshape(-1)
    size = (batch.boxes[:, 2:] - batch.boxes[:, :2]).clamp(min=2.0)

    box = boxes_from(out.box, at)
    true_box = batch.boxes[:, None].expand(k, LOCATIONS, 4).reshape(-1, 4)
    edges = torch.cat([at - true_box[:, :2], true_box[:, 2:] - at], dim=1).clamp(min=0.5)
    box_loss = F.smooth_l1_loss(out.box, torch.log(edges / 16.0), beta=0.1) + (1 - iou(box, true_box)).mean()

    one = slice(None, None, LOCATIONS)
    which = torch.randint(0, LOCATIONS, (k,), generator=generator) + LOCATIONS * torch.arange(k)
    points = batch.mask_points
    features = bilinear(
        dense.mask, batch.image[:, None].expand(k, MASK_POINTS).reshape(-1), points.reshape(-1, 2), FINE_STRIDE
    ).view(k, MASK_POINTS, -1)
    jitter = torch.exp(0.1 * torch.randn((k, 2), generator=generator))
    coordinates = (points - at[which][:, None]) / (0.5 * size * jitter)[:, None]
    mask = mask_logits(out.mask[which], features, coordinates.clamp(-4, 4), network.params)

    seen = depth_features(
        dense,
        geometry,
        batch.image[:, None].expand(k, DEPTH_POINTS).reshape(-1),
        batch.depth_points.reshape(-1, 2),
        box.detach()[one][:, None].expand(k, DEPTH_POINTS, 4).reshape(-1, 4),
    )
    log_depth, log_variance = network.depth(seen, True, generator)
    wanted = torch.log(batch.depth / (geometry.focal[batch.image] / REFERENCE_FOCAL_PX))
    error = log_depth.view(k, DEPTH_POINTS) - wanted[:, None]
    return {
        "box": box_loss,
        "mask": mask_loss(mask, batch.mask_labels),
        "overlap": overlap_loss(out.overlap[which], mask.detach(), batch.mask_labels),
        "classes": F.cross_entropy(logits, repeated),
        "depth": gaussian_loss(error, log_variance.view(k, DEPTH_POINTS), batch.located[:, None]),
        "centre": gaussian_loss(
            out.centre - ((batch.centre[:, None] - batch.locations) / size[:, None]).reshape(-1, 2),
            out.centre_log_variance[:, None],
            batch.located[:, None].expand(k, LOCATIONS).reshape(-1, 1),
        ),
        "embedding": embedding_loss(out.embedding[one], batch),
    }


def heat_loss(logits: Tensor, target: Tensor, weight: Tensor) -> Tensor:
    """Focal loss of centre heat maps, per object."""
    p = torch.sigmoid(logits).clamp(1e-4, 1 - 1e-4)
    at_centre = target == 1
    positive = torch.log(p) * (1 - p) ** 2 * at_centre
    negative = torch.log(1 - p) * p**2 * (1 - target) ** 4 * ~at_centre * weight
    return -(positive + negative).sum() / at_centre.sum().clamp(min=1)


def mask_loss(logits: Tensor, labels: Tensor) -> Tensor:
    """Cross entropy and dice of masks at points (k, s)."""
    p = torch.sigmoid(logits)
    dice = 1 - (2 * (p * labels).sum(1) + 1) / ((p * p).sum(1) + labels.sum(1) + 1)
    return F.binary_cross_entropy_with_logits(logits, labels) + dice.mean()


def overlap_loss(overlap: Tensor, logits: Tensor, labels: Tensor) -> Tensor:
    """Cross entropy of the expected IoU (k,) with that at those of the points (k, s) that are spread evenly."""
    even = slice(0, labels.shape[1] // 2)  # see `targets.points_around`
    found, true = logits[:, even] > 0, labels[:, even] > 0.5
    iou = ((found & true).sum(1) + 0.5) / ((found | true).sum(1) + 0.5)
    return F.binary_cross_entropy_with_logits(overlap, iou)


def gaussian_loss(error: Tensor, log_variance: Tensor, valid: Tensor) -> Tensor:
    """Negative log-likelihood, each term weighted by its own deviation (beta-NLL, beta = 1/2), and a share of plain L1.

    Without the weight, errors that are predicted to be large stop being learned from.
    """
    variance = torch.exp(log_variance)
    likelihood = 0.5 * (error**2 / variance + log_variance) * variance.detach().sqrt() / 0.1
    value = (0.5 * likelihood + 2 * error.abs()) * valid
    return value.sum() / (valid.expand_as(value).sum().clamp(min=1))


def iou(a: Tensor, b: Tensor) -> Tensor:
    """IoU (k,) of boxes (k, 4)."""
    low, high = torch.maximum(a[:, :2], b[:, :2]), torch.minimum(a[:, 2:], b[:, 2:])
    shared = (high - low).clamp(min=0).prod(1)
    return shared / ((a[:, 2:] - a[:, :2]).prod(1) + (b[:, 2:] - b[:, :2]).prod(1) - shared).clamp(min=1e-6)


def embedding_loss(embedding: Tensor, batch: Batch, temperature: float = 0.1) -> Tensor:
    """Contrast each object with all objects of the pair's other image, where it is seen there too."""
    same_pair = batch.pair[:, None] == batch.pair[None]
    other = same_pair & (batch.side[:, None] != batch.side[None])
    positive = other & (batch.identity[:, None] == batch.identity[None])
    rows = positive.any(1)
    if not rows.any():
        return embedding.sum() * 0
    logits = (embedding @ embedding.T / temperature).masked_fill(~other, -1e4)
    return F.cross_entropy(logits[rows], positive[rows].float().argmax(1))
