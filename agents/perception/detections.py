"""What eyes give: one robot's detections, and the interface every perceptor shares."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ...matching import ObjectGraph
from ...matching.pose import Array


@dataclass(frozen=True, eq=False)
class Detections:
    """One robot's detections at one instant, in one order throughout.

    Attributes:
        graph: positions (camera frame), attributes and their uncertainties.
        boxes: (n, 4) [u0, v0, u1, v1] pixels.
        masks: (n, H, W) bool, or None.
    """

    graph: ObjectGraph
    boxes: Array
    masks: NDArray[np.bool_] | None = None

    def __len__(self) -> int:
        return len(self.graph)


class Perceptor(Protocol):
    """One robot's observation in, its detections out; `rng` feeds whatever is random in the eyes."""

    def __call__(self, observation: Mapping[str, Any], rng: np.random.Generator) -> Detections: ...


def rays(pixels: Array, intrinsics: Array) -> Array:
    """Directions (n, 3) with unit z, camera frame, of pixels (n, 2)."""
    focal = intrinsics[(0, 1), (0, 1)]
    centre = intrinsics[:2, 2]
    return np.concatenate([(pixels - centre) / focal, np.ones((len(pixels), 1))], axis=1)


def ray_frames(positions: Array) -> Array:
    """Unit vectors (n, 3, 3), one a row: along the viewing rays of positions (n, 3), and the image's right and down
    as far as they are across those.
    """
    along = positions / np.maximum(np.linalg.norm(positions, axis=1), 1e-9)[:, None]
    right = np.stack([along[:, 2], np.zeros(len(along)), -along[:, 0]], axis=1)
    right /= np.maximum(np.linalg.norm(right, axis=1), 1e-9)[:, None]
    return np.stack([along, right, np.cross(along, right)], axis=1)


def ray_covariances(positions: Array, along: Array, across: Array) -> Array:
    """Covariances (n, 3, 3) m^2 with variance `along` (n,) the viewing ray of positions (n, 3) and `across` (n, 2) it,
    to the image's right and down.
    """
    frames = ray_frames(positions)
    variances = np.concatenate([along[:, None], across], axis=1)
    return np.einsum("nki,nk,nkj->nij", frames, variances, frames)
