"""What a robot knows of itself: noisy pose, odometry, and the privileged view that simulated perception reads."""

from __future__ import annotations

from dataclasses import dataclass
from math import cos, sin, sqrt

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ..matching.pose import Array

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
            if not (isinstance(value, int | float | np.number) and np.isfinite(value) and value >= 0):
                raise ValueError(f"PoseNoise.{name} must be finite and non-negative, got {value!r}")

    def covariance(self, up: Array) -> Array:
        """Covariance (6, 6) of the reported pose, right perturbation; `up` (3,) in the camera frame."""
        out = np.zeros((6, 6))
        out[0, 0] = out[1, 1] = out[2, 2] = self.position_m**2
        out[3:, 3:] = self.heading_rad**2 * (up[:, None] * up)
        return out

    def pose(self, T_world_camera: Array, rng: np.random.Generator) -> Array:
        """A reported pose (4, 4)."""
        normal = rng.standard_normal(4)
        return _reported(T_world_camera, self.position_m, self.heading_rad, normal)

    def odometry(self, T_world_last: Array, T_world_now: Array, rng: np.random.Generator) -> Array:
        """Reported own motion (4, 4): the present camera frame in the last one."""
        normal = rng.standard_normal(4)
        return _travelled(T_world_last, T_world_now, self.odometry_position, self.odometry_heading_rad, normal)


def up_in_camera(T_world_camera: Array) -> Array:
    """Unit vector against gravity (3,), camera frame."""
    return np.ascontiguousarray(T_world_camera[2, :3])


@njit(cache=True)
def _reported(T: Array, position_m: float, heading_rad: float, normal: Array) -> Array:
    """A pose (4, 4) with errors drawn as standard normal numbers (4,), of the position and about the vertical.

    The error is a right perturbation of the report, truth = reported * exp(xi), as the covariance is understood.
    """
    angle = heading_rad * normal[3]
    turn = _rotation(T[2, 0] * angle, T[2, 1] * angle, T[2, 2] * angle)
    out = np.zeros((4, 4))
    out[3, 3] = 1.0
    for i in range(3):
        for j in range(3):
            out[i, j] = T[i, 0] * turn[j, 0] + T[i, 1] * turn[j, 1] + T[i, 2] * turn[j, 2]
        shift = position_m * (out[i, 0] * normal[0] + out[i, 1] * normal[1] + out[i, 2] * normal[2])
        out[i, 3] = T[i, 3] - shift
    return out


@njit(cache=True)
def _travelled(T_last: Array, T_now: Array, position: float, heading_rad: float, normal: Array) -> Array:
    """The pose (4, 4) of the present in the last frame, the motion's errors drawn as `_reported` takes them."""
    motion, moved = np.empty((3, 3)), np.empty(3)
    for i in range(3):
        for j in range(3):
            motion[i, j] = T_last[0, i] * T_now[0, j] + T_last[1, i] * T_now[1, j] + T_last[2, i] * T_now[2, j]
        moved[i] = 0.0
        for k in range(3):
            moved[i] += T_last[k, i] * (T_now[k, 3] - T_last[k, 3])
    error = position * sqrt(moved[0] ** 2 + moved[1] ** 2 + moved[2] ** 2)
    angle = heading_rad * normal[3]
    turn = _rotation(T_now[2, 0] * angle, T_now[2, 1] * angle, T_now[2, 2] * angle)
    out = np.zeros((4, 4))
    out[3, 3] = 1.0
    for i in range(3):
        for j in range(3):
            out[i, j] = motion[i, 0] * turn[0, j] + motion[i, 1] * turn[1, j] + motion[i, 2] * turn[2, j]
        shift = motion[i, 0] * normal[0] + motion[i, 1] * normal[1] + motion[i, 2] * normal[2]
        out[i, 3] = moved[i] + error * shift
    return out


@njit(cache=True)
def _rotation(x: float, y: float, z: float) -> Array:
    """`matching.pose.rotation_from_vector` of (x, y, z)."""
    angle = sqrt(x * x + y * y + z * z)
    s, c = (1.0, 0.5) if angle < 1e-8 else (sin(angle) / angle, (1.0 - cos(angle)) / angle**2)
    return np.array(
        [
            [1.0 - c * (y * y + z * z), c * x * y - s * z, c * x * z + s * y],
            [c * x * y + s * z, 1.0 - c * (x * x + z * z), c * y * z - s * x],
            [c * x * z - s * y, c * y * z + s * x, 1.0 - c * (x * x + y * y)],
        ]
    )


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
