"""What a robot knows of itself: noisy pose, odometry, and the privileged view that simulated perception reads."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..matching.pose import Array, exp_se3, invert

MAX_DEPTH_M = 1000.0
"""Depth images report the sky at this depth."""


@dataclass(frozen=True)
class PoseNoise:
    """Errors (1 sigma) of the poses and odometry that robots report; drawn anew at every step.

    Attributes:
        position_m: of the position, per axis.
        heading_rad: of the rotation about the vertical; roll and pitch come from the IMU and are exact.
        odometry_position: of the motion since the last step, as a share of the distance moved.
        odometry_heading_rad: of the turn since the last step.
    """

    position_m: float = 0.3
    heading_rad: float = 0.02
    odometry_position: float = 0.02
    odometry_heading_rad: float = 0.002

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not (np.isfinite(value) and value >= 0):
                raise ValueError(f"PoseNoise.{name} must be finite and non-negative, got {value}")

    def covariance(self, up: Array) -> Array:
        """Covariance (6, 6) of the reported pose, right perturbation; `up` (3,) in the camera frame."""
        out = np.zeros((6, 6))
        out[0, 0] = out[1, 1] = out[2, 2] = self.position_m**2
        out[3:, 3:] = self.heading_rad**2 * (up[:, None] * up)
        return out

    def pose(self, T_world_camera: Array, rng: np.random.Generator) -> Array:
        """A reported pose (4, 4)."""
        up = up_in_camera(T_world_camera)
        xi = np.concatenate([rng.normal(0, self.position_m, 3), rng.normal(0, self.heading_rad) * up])
        # Right perturbation of the report: truth = reported * exp(xi), as the covariance is understood.
        return T_world_camera @ invert(exp_se3(xi))

    def odometry(self, T_world_last: Array, T_world_now: Array, rng: np.random.Generator) -> Array:
        """Reported own motion (4, 4): the present camera frame in the last one."""
        motion = invert(T_world_last) @ T_world_now
        distance = float(np.linalg.norm(motion[:3, 3]))
        up = up_in_camera(T_world_now)
        shift = rng.normal(0, self.odometry_position, 3) * distance
        turn = rng.normal(0, self.odometry_heading_rad) * up
        return motion @ exp_se3(np.concatenate([shift, turn]))


def up_in_camera(T_world_camera: Array) -> Array:
    """Unit vector against gravity (3,), camera frame."""
    return np.ascontiguousarray(T_world_camera[2, :3])


def permuted_instances(
    instances: NDArray[np.int32], object_class: NDArray[np.int64], max_objects: int, rng: np.random.Generator
) -> tuple[NDArray[np.int32], NDArray[np.int64]]:
    """Instance image (H, W) with ids drawn anew, so that they carry no identity: 0 = background, 1..max_objects.

    Also the class of each id (max_objects + 1,), -1 for ids that no object has.
    """
    m = len(object_class)
    ids = rng.permutation(max_objects)[:m] + 1
    lookup = np.zeros(m + 1, dtype=np.int32)
    lookup[1:] = ids
    classes = np.full(max_objects + 1, -1, dtype=np.int64)
    classes[ids] = object_class
    return lookup[instances + 1], classes
