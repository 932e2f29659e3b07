"""Eyes that look at the privileged depth and instance images and err the way a monocular detector errs.

The parameters were fixed, from what the paper says of its perception (depth error about 6 % of range), before any
matcher was run on them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ...envs.worlds.world import ObjectClass
from ...matching import ObjectGraph
from ...matching.pose import Array
from .detections import Detections, ray_covariances, rays


@dataclass(frozen=True)
class SimulatedPerceptionParams:
    """How simulated eyes err. `occlusion` is the share of an object's outline that something nearer cuts off.

    Attributes:
        min_pixels: objects with fewer visible pixels are not detected.
        miss_rate: probability to miss an object that nothing occludes.
        miss_rate_occluded: added in proportion to the occlusion.
        false_positives: expected number per image, at random places.
        depth_noise: standard deviation of the distance, as a share of it.
        depth_noise_occluded: added to that share in proportion to the occlusion.
        centre_noise: standard deviation of the distance from surface to centre, as a share of the class's typical one.
        pixel_noise: standard deviation of the centre in the image, pixels.
        centre_noise_image: the same from shape and occlusion, as a share of the box's size.
        hidden_extent: half the width of an object, as a multiple of its class's surface-to-centre distance, where that
            is more than half of what is visible; the centre of an occluded or cut-off object may lie that far beside
            the middle of what is visible. It is not drawn: the picture itself makes this error, and the reported
            covariance allows for it.
        hidden_occluded: share of that half width that is one sigma, per unit of occlusion.
        hidden_upright: the same vertically in the image, as a share of what holds sideways.
        hidden_cut: share of that half width that is one sigma across an edge of the image that cuts an object off.
        box_noise: standard deviation of each edge of the box, as a share of the box's size.
        class_margin: logit by which the true class leads on a large, free object.
        class_noise: standard deviation of each logit; with the margin it makes the confusion.
        class_margin_pixels: visible pixels at which half of the margin is lost.
        uncertainty_noise: standard deviation of the log of the reported u and v about their true values.
    """

    min_pixels: int = 60
    miss_rate: float = 0.02
    miss_rate_occluded: float = 0.3
    false_positives: float = 0.1
    depth_noise: float = 0.06
    depth_noise_occluded: float = 0.06
    centre_noise: float = 0.3
    pixel_noise: float = 0.7
    centre_noise_image: float = 0.06
    hidden_extent: float = 2.5
    hidden_occluded: float = 2.0
    hidden_upright: float = 0.4
    hidden_cut: float = 0.7
    box_noise: float = 0.04
    class_margin: float = 5.0
    class_noise: float = 1.2
    class_margin_pixels: float = 40.0
    uncertainty_noise: float = 0.3

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not (np.isfinite(value) and value >= 0):
                raise ValueError(f"SimulatedPerceptionParams.{name} must be finite and non-negative, got {value}")


@dataclass(frozen=True)
class SimulatedPerception:
    """A perceptor for observations with `depth`, `instances` and `instance_classes`.

    Attributes:
        classes: the world's, in the order of the attribute vector.
        params: how the eyes err.
    """

    classes: Sequence[ObjectClass]
    params: SimulatedPerceptionParams = SimulatedPerceptionParams()

    def __call__(self, observation: Mapping[str, Any], rng: np.random.Generator) -> Detections:
        """Detections of one observation.

        Raises:
            ValueError: the observation lacks a privileged image.
        """
        missing = [k for k in ("depth", "instances", "instance_classes") if k not in observation]
        if missing:
            raise ValueError(
                f"simulated perception needs the observation's {missing[0]!r}: "
                'make the environment with sensors=("image", "depth", "instances")'
            )
        p = self.params
        seen = measure(observation["instances"], observation["depth"], len(observation["instance_classes"]))
        ids = np.flatnonzero(seen[:, PIXELS] >= p.min_pixels)
        occlusion = seen[ids, OCCLUSION]
        detected = rng.random(len(ids)) >= np.minimum(p.miss_rate + p.miss_rate_occluded * occlusion, 0.95)
        ids = ids[detected]
        # Ids are random numbers drawn by the environment: their order carries nothing.
        return self._detect(seen[ids], observation["instance_classes"][ids], observation, rng)

    def _detect(
        self, seen: Array, true_class: NDArray[np.int64], observation: Mapping[str, Any], rng: np.random.Generator
    ) -> Detections:
        p, n = self.params, len(seen)
        K = np.asarray(observation["intrinsics"], dtype=np.float64)
        height, width = observation["depth"].shape
        box = seen[:, BOX]
        size = np.stack([box[:, 2] - box[:, 0], box[:, 3] - box[:, 1]], axis=1)

        edges = np.array([0, 0, width, height])
        pixel_std = np.sqrt(p.pixel_noise**2 + (p.centre_noise_image * size) ** 2)
        centre = 0.5 * (box[:, :2] + box[:, 2:]) + pixel_std * rng.standard_normal((n, 2))
        ray = rays(centre, K)
        stretch = np.linalg.norm(ray, axis=1)

        to_centre = np.array([c.depth_to_centre_m for c in self.classes])[true_class]
        distance = seen[:, DEPTH] * stretch + to_centre
        relative = p.depth_noise + p.depth_noise_occluded * seen[:, OCCLUSION]
        along = (relative * distance) ** 2 + (p.centre_noise * to_centre) ** 2
        half = np.maximum(p.hidden_extent * to_centre[:, None], 0.5 * size * (distance / K[0, 0])[:, None])
        hidden = half * self._hidden_share(seen[:, OCCLUSION], box == edges)
        across = (distance / K[0, 0]) ** 2 * (pixel_std**2).mean(axis=1)
        # The surface-to-centre error is there already: the typical distance is not this object's.
        noisy = np.maximum(distance + relative * distance * rng.standard_normal(n), 0.1)
        positions = ray / stretch[:, None] * noisy[:, None]

        noisy_box = box + p.box_noise * np.tile(size, 2) * rng.standard_normal((n, 4))
        boxes = np.clip(noisy_box, 0, [width, height, width, height])
        attributes = self._attributes(true_class, seen[:, PIXELS], rng)

        along, across, hidden, positions, attributes, boxes = self._add_false_positives(
            along, across, hidden, positions, attributes, boxes, observation, rng
        )
        n = len(positions)
        reported = along * np.exp(p.uncertainty_noise * rng.standard_normal(n))
        variance = (attributes * (1 - attributes)).mean(axis=1)
        covariances = ray_covariances(positions, reported, np.stack([across, across], axis=1))
        covariances[:, :2, :2] += (hidden**2)[:, :, None] * np.eye(2)
        graph = ObjectGraph(
            positions=positions,
            attributes=attributes,
            position_variance=reported,
            attribute_variance=variance * np.exp(p.uncertainty_noise * rng.standard_normal(n)),
            covariances=covariances,
            up=np.asarray(observation["up"], dtype=np.float64),
            forward=np.array([0.0, 0.0, 1.0]),
            intrinsics=K,
            image_size=(width, height),
        )
        return Detections(graph, boxes)

    def _hidden_share(self, occlusion: Array, cut: NDArray[np.bool_]) -> Array:
        """Sigma of the centre (n, 2), right and down, in half widths of the object; `cut` (n, 4): by which edge."""
        p = self.params
        sideways = np.minimum(p.hidden_occluded * occlusion, p.hidden_cut)
        occluded = np.stack([sideways, p.hidden_upright * sideways], axis=1)
        return np.where(cut[:, :2] | cut[:, 2:], p.hidden_cut, occluded)

    def _attributes(self, true_class: NDArray[np.int64], pixels: Array, rng: np.random.Generator) -> Array:
        """Class distributions (n, c): softmax of noisy logits, less decided the fewer pixels there are."""
        p = self.params
        logits = p.class_noise * rng.standard_normal((len(true_class), len(self.classes)))
        logits[np.arange(len(true_class)), true_class] += p.class_margin * pixels / (pixels + p.class_margin_pixels)
        exponent = np.exp(logits - logits.max(axis=1, keepdims=True))
        return exponent / exponent.sum(axis=1, keepdims=True)

    def _add_false_positives(
        self,
        along: Array,
        across: Array,
        hidden: Array,
        positions: Array,
        attributes: Array,
        boxes: Array,
        observation: Mapping[str, Any],
        rng: np.random.Generator,
    ) -> tuple[Array, ...]:
        n = rng.poisson(self.params.false_positives)
        if n == 0 or len(positions) == 0:
            return along, across, hidden, positions, attributes, boxes
        # A false positive looks like the true ones in its view: size, distance and confidence come from among them.
        height, width = observation["depth"].shape
        like = rng.integers(0, len(positions), n)
        size = boxes[like, 2:] - boxes[like, :2]
        corner = rng.uniform(0, 1, (n, 2)) * np.maximum([width, height] - size, 0)
        ray = rays(corner + size / 2, np.asarray(observation["intrinsics"], dtype=np.float64))
        distance = np.linalg.norm(positions[like], axis=1)
        place = ray / np.linalg.norm(ray, axis=1, keepdims=True) * distance[:, None]
        decided = self._attributes(rng.integers(0, len(self.classes), n), np.full(n, 60.0), rng)
        return (
            np.concatenate([along, along[like]]),
            np.concatenate([across, across[like]]),
            np.concatenate([hidden, hidden[like]]),
            np.concatenate([positions, place]),
            np.concatenate([attributes, decided]),
            np.concatenate([boxes, np.concatenate([corner, corner + size], axis=1)]),
        )


PIXELS, DEPTH, OCCLUSION = 0, 1, 2
BOX = slice(3, 7)


@njit(cache=True)
def measure(instances: NDArray[np.int32], depth: NDArray[np.float32], n_ids: int) -> Array:
    """Per id (n_ids, 7): visible pixels, mean depth m, occlusion in [0, 1], tight box [u0, v0, u1, v1].

    Occlusion is the share of the outline's pixel edges beyond which something else is nearer. Id 0 is background.
    """
    height, width = instances.shape
    out = np.zeros((n_ids, 7))
    outline = np.zeros(n_ids)
    for v in range(height):
        for u in range(width):
            i = instances[v, u]
            if i == 0:
                continue
            if out[i, PIXELS] == 0:
                out[i, 3], out[i, 4], out[i, 5], out[i, 6] = u, v, u + 1, v + 1
            out[i, PIXELS] += 1
            out[i, DEPTH] += depth[v, u]
            out[i, 3] = min(out[i, 3], u)
            out[i, 5] = max(out[i, 5], u + 1)
            out[i, 6] = v + 1
            for dv, du in ((0, 1), (1, 0), (0, -1), (-1, 0)):
                w, x = v + dv, u + du
                if w < 0 or w >= height or x < 0 or x >= width:
                    outline[i] += 1
                    out[i, OCCLUSION] += 1  # the image's edge cuts it off
                elif instances[w, x] != i:
                    outline[i] += 1
                    if (depth[w, x] < depth[v, u] - 0.1 and w <= v) or (
                        instances[w, x] != 0 and depth[w, x] < depth[v, u]
                    ):
                        out[i, OCCLUSION] += 1
    for i in range(1, n_ids):
        if out[i, PIXELS] > 0:
            out[i, DEPTH] /= out[i, PIXELS]
            out[i, OCCLUSION] /= outline[i]
    return out
