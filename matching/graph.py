"""What a matcher takes and what it returns: `ObjectGraph` in, `Matching` out."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .checks import bounded, check_covariances, finite, for_each, numbers, pixels, shaped, unit_vector, variances
from .pose import Array, RelativePose, check_pose, transform

DEFAULT_BEARING_STD_RAD = 0.007
"""Bearing error (1 sigma) assumed across the viewing ray where a graph carries no full covariances: 0.4 degrees."""


@dataclass(frozen=True, eq=False)
class ObjectGraph:
    """All detections of one robot at one instant, in its sensor frame (the paper's G, section 3.2).

    Attributes:
        positions: (n, 3) m, sensor frame; n may be 0.
        attributes: (n, c) non-negative class confidences, the paper's a.
        position_variance: (n,) m^2, variance of the distance along the viewing ray, the paper's u; inf = unknown.
        attribute_variance: (n,) mean variance of the attribute's elements, the paper's v; inf = unknown.
        covariances: optional (n, 3, 3) m^2, full position covariance in the sensor frame.
        up: optional (3,) unit vector against gravity, sensor frame (from the IMU).
        forward: optional (3,) unit vector of the optical axis, sensor frame.
        embedding: optional (n, e) appearance vectors.
        intrinsics: optional (3, 3) pinhole matrix; the sensor frame is then a camera's (x right, y down, z forward).
        image_size: optional (width, height) in pixels.
        horizontal_fov_rad: optional full horizontal field of view, radians; of use only with `forward` and `up`.

    Raises:
        ValueError: a wrong shape, something that is no number, a value that is not finite or above
            `covis.matching.checks.LARGEST`, a negative variance, or a matrix that is no covariance.
    """

    positions: Array
    attributes: Array
    position_variance: Array
    attribute_variance: Array
    covariances: Array | None = None
    up: Array | None = None
    forward: Array | None = None
    embedding: Array | None = None
    intrinsics: Array | None = None
    image_size: tuple[int, int] | None = None
    horizontal_fov_rad: float | None = None

    def __post_init__(self) -> None:
        put = object.__setattr__
        positions = bounded(self.positions, "positions")
        if positions.ndim != 2 or positions.shape[1] != 3:
            raise ValueError(f"positions must have shape (n, 3), got {positions.shape}")
        n = len(positions)
        put(self, "positions", positions)
        attributes = bounded(self.attributes, "attributes")
        if attributes.ndim != 2 or len(attributes) != n or attributes.shape[1] < 1:
            raise ValueError(f"attributes must have shape ({n}, c) with c >= 1, got {attributes.shape}")
        if (attributes < 0).any():
            raise ValueError(f"attributes must be non-negative, got {attributes.min():.3g}")
        put(self, "attributes", attributes)
        for name in ("position_variance", "attribute_variance"):
            put(self, name, variances(getattr(self, name), name, n))
        if self.covariances is not None:
            covariances = finite(self.covariances, "covariances")
            check_covariances(covariances, n)
            put(self, "covariances", covariances)
        for name in ("up", "forward"):
            if getattr(self, name) is not None:
                put(self, name, unit_vector(getattr(self, name), name))
        if self.embedding is not None:
            embedding = bounded(self.embedding, "embedding")
            if embedding.ndim != 2 or len(embedding) != n:
                raise ValueError(f"embedding must have shape ({n}, e), got {embedding.shape}")
            put(self, "embedding", embedding)
        if self.intrinsics is not None:
            K = finite(self.intrinsics, "intrinsics")
            if K.shape != (3, 3) or K[0, 0] <= 0 or K[1, 1] <= 0:
                raise ValueError(f"intrinsics must be (3, 3) with positive focal lengths, got\n{K}")
            put(self, "intrinsics", K)
        if self.image_size is not None:
            put(self, "image_size", pixels(self.image_size))
        if self.horizontal_fov_rad is not None:
            fov = shaped(self.horizontal_fov_rad, "horizontal_fov_rad", ())
            if not 0 < fov <= 2 * np.pi:
                raise ValueError(f"horizontal_fov_rad must lie in (0, 2 pi], got {fov}")
            put(self, "horizontal_fov_rad", float(fov))

    def __len__(self) -> int:
        return len(self.positions)

    @classmethod
    def from_positions(
        cls,
        positions: ArrayLike,
        *,
        attributes: ArrayLike | None = None,
        position_variance: ArrayLike = 0.01,
        attribute_variance: ArrayLike = 0.0,
        **optional: Any,
    ) -> ObjectGraph:
        """The quickest graph: positions (n, 3) m, one class, the same standard deviation (0.1 m) for all.

        A scalar `position_variance` (m^2) or `attribute_variance` holds for every object; `optional` takes the other
        fields of `ObjectGraph`. An empty list stands for no object.

        Raises:
            ValueError: as `ObjectGraph`.
        """
        p = numbers(positions, "positions")
        if p.shape == (0,):
            p = p.reshape(0, 3)
        if p.ndim != 2:
            raise ValueError(f"positions must have shape (n, 3), got {p.shape}")
        n = len(p)
        a = np.ones((n, 1)) if attributes is None else numbers(attributes, "attributes")
        u = for_each(position_variance, "position_variance", n)
        v = for_each(attribute_variance, "attribute_variance", n)
        return cls(p, a, u, v, **optional)

    def take(self, index: NDArray[np.int64]) -> ObjectGraph:
        """The graph of the objects at `index`, in that order."""
        return replace(
            self,
            positions=self.positions[index],
            attributes=self.attributes[index],
            position_variance=self.position_variance[index],
            attribute_variance=self.attribute_variance[index],
            covariances=None if self.covariances is None else self.covariances[index],
            embedding=None if self.embedding is None else self.embedding[index],
        )

    def transformed(self, T_new_sensor: Array) -> ObjectGraph:
        """The same objects in another frame. Camera intrinsics no longer apply there and are dropped."""
        T = check_pose(T_new_sensor, "T_new_sensor")
        R = T[:3, :3]
        return replace(
            self,
            positions=transform(T, self.positions),
            covariances=R @ self.full_covariances() @ R.T,
            up=None if self.up is None else R @ self.up,
            forward=None if self.forward is None else R @ self.forward,
            intrinsics=None,
        )

    def full_covariances(
        self, bearing_std_rad: float = DEFAULT_BEARING_STD_RAD, unknown_variance: float = 1e6
    ) -> Array:
        """Position covariances (n, 3, 3) m^2, sensor frame.

        `covariances` where given; else `position_variance` along the viewing ray and (range * bearing_std_rad)^2
        across it. An infinite variance becomes `unknown_variance` (m^2).
        """
        if self.covariances is not None:
            return self.covariances
        squared_range = (self.positions**2).sum(axis=1)
        ray = self.positions / np.sqrt(np.maximum(squared_range, 1e-12))[:, None]
        along = np.minimum(self.position_variance, unknown_variance)
        across = np.minimum(squared_range * bearing_std_rad**2, unknown_variance)
        outer = ray[:, :, None] * ray[:, None, :]
        covariances = across[:, None, None] * np.eye(3) + (along - across)[:, None, None] * outer
        at_origin = squared_range < 1e-12
        covariances[at_origin] = along[at_origin, None, None] * np.eye(3)
        return covariances


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """One explanation of a pair of views: a relative pose, its posterior probability and the matches under it."""

    pose: RelativePose
    probability: float
    pairs: NDArray[np.int64]
    scores: Array


@dataclass(frozen=True, eq=False)
class Matching:
    """Which detection of the source is which detection of the target.

    Attributes:
        pairs: (k, 2) int64, [index in source, index in target]; each index at most once a column; k may be 0.
        scores: (k,) in [0, 1]; a probability where the matcher says so.
        pose: the matcher's estimate of the relative pose, if it makes one.
        hypotheses: alternative explanations, most probable first, if the matcher keeps them.
        diagnostics: numbers about the solve, for people.

    Raises:
        ValueError: a wrong shape, a repeated index, a score outside [0, 1].
    """

    pairs: NDArray[np.int64]
    scores: Array
    pose: RelativePose | None = None
    hypotheses: tuple[Hypothesis, ...] = ()
    diagnostics: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        pairs = np.asarray(self.pairs)
        if pairs.size == 0:
            pairs = np.zeros((0, 2), dtype=np.int64)
        if pairs.ndim != 2 or pairs.shape[1] != 2 or not np.issubdtype(pairs.dtype, np.integer):
            raise ValueError(f"pairs must be integers of shape (k, 2), got {pairs.dtype} {pairs.shape}")
        scores = numbers(self.scores, "scores")
        if scores.shape != (len(pairs),):
            raise ValueError(f"scores must have shape ({len(pairs)},), got {scores.shape}")
        if len(pairs):
            if pairs.min() < 0:
                raise ValueError(f"pairs must be non-negative, got {pairs.min()}")
            for side in (0, 1):
                if len(np.unique(pairs[:, side])) < len(pairs):
                    raise ValueError(f"pairs repeat an index in column {side}: {pairs[:, side].tolist()}")
            if not ((scores >= 0) & (scores <= 1)).all():
                raise ValueError(f"scores must lie in [0, 1], got {scores.tolist()}")
        object.__setattr__(self, "pairs", pairs.astype(np.int64))
        object.__setattr__(self, "scores", scores)

    def __len__(self) -> int:
        return len(self.pairs)

    @classmethod
    def empty(cls) -> Matching:
        """No match at all."""
        return cls(np.zeros((0, 2), dtype=np.int64), np.zeros(0))


Matcher = Callable[..., Matching]
"""`(source, target, *, prior: RelativePose | None = None, rng: numpy Generator | None = None, **options) -> Matching`.

Without an `rng` a stochastic matcher draws from `default_rng(0)`, so that the same call gives the same answer.
"""


class PriorRequiredError(ValueError):
    """A matcher that needs a relative pose was called without one."""


def generator(rng: np.random.Generator | None) -> np.random.Generator:
    """The matcher's random stream: `rng`, or the fixed default stream. Raises TypeError unless it is a Generator."""
    if rng is None:
        return np.random.default_rng(0)
    if not isinstance(rng, np.random.Generator):
        raise TypeError(f"rng must be a numpy Generator such as numpy.random.default_rng(3), got {rng!r}")
    return rng


def check_comparable(source: ObjectGraph, target: ObjectGraph, prior: RelativePose | None = None) -> None:
    """What every matcher asks of its arguments.

    Raises:
        TypeError: something else than two graphs and a relative pose or None.
        ValueError: the graphs speak of different numbers of classes.
    """
    for name, graph in (("source", source), ("target", target)):
        if not isinstance(graph, ObjectGraph):
            raise TypeError(
                f"{name} must be an ObjectGraph, got {type(graph).__name__}; ObjectGraph.from_positions makes one"
            )
    if prior is not None and not isinstance(prior, RelativePose):
        raise TypeError(f"prior must be a RelativePose or None, got {type(prior).__name__}")
    if source.attributes.shape[1] != target.attributes.shape[1]:
        raise ValueError(
            f"source has {source.attributes.shape[1]} attribute classes, target has {target.attributes.shape[1]}"
        )
