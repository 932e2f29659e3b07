"""What a robot knows of itself: noisy pose, odometry, and the privileged view that simulated perception reads."""

from __future__ import annotations

from dataclasses import dataclass
from math import sqrt

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ..matching.pose import Array, rotation_from_vector

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
        return _covariance(up, self.position_m**2, self.heading_rad**2)

    def pose(self, T_world_camera: Array, rng: np.random.Generator) -> Array:
        """A reported pose (4, 4), of which the true one is a right perturbation, as the covariance is understood."""
        normal = rng.standard_normal(4)
        turn = rotation_from_vector(-self.heading_rad * normal[3] * T_world_camera[2, :3])
        return _perturbed(T_world_camera, turn, -self.position_m, normal, True)

    def odometry(self, T_world_last: Array, T_world_now: Array, rng: np.random.Generator) -> Array:
        """Reported own motion (4, 4): the present camera frame in the last one."""
        normal = rng.standard_normal(4)
        turn = rotation_from_vector(self.odometry_heading_rad * normal[3] * T_world_now[2, :3])
        return _travelled(T_world_last, T_world_now, turn, self.odometry_position, normal)


def up_in_camera(T_world_camera: Array) -> Array:
    """Unit vector against gravity (3,), camera frame."""
    return np.ascontiguousarray(T_world_camera[2, :3])


@njit(cache=True)
def _covariance(up: Array, position_m2: float, heading_rad2: float) -> Array:
    out = np.zeros((6, 6))
    for i in range(3):
        out[i, i] = position_m2
        for j in range(3):
            out[3 + i, 3 + j] = heading_rad2 * (up[i] * up[j])
    return out


@njit(cache=True)
def _perturbed(T: Array, turn: Array, position_m: float, normal: Array, turned: bool) -> Array:
    """A pose (4, 4) turned by a rotation on its right, and moved by `position_m` times each of `normal` along its axes.

    The axes are those after the turn if `turned`, else those before.
    """
    out = np.zeros((4, 4))
    out[3, 3] = 1.0
    axes = out if turned else T
    for i in range(3):
        for j in range(3):
            out[i, j] = T[i, 0] * turn[0, j] + T[i, 1] * turn[1, j] + T[i, 2] * turn[2, j]
        out[i, 3] = T[i, 3] + position_m * (axes[i, 0] * normal[0] + axes[i, 1] * normal[1] + axes[i, 2] * normal[2])
    return out


@njit(cache=True)
def _travelled(T_last: Array, T_now: Array, turn: Array, position: float, normal: Array) -> Array:
    """The pose (4, 4) of the present in the last frame, turned and moved, the latter as a share of its length."""
    motion = np.zeros((4, 4))
    for i in range(3):
        for j in range(3):
            motion[i, j] = T_last[0, i] * T_now[0, j] + T_last[1, i] * T_now[1, j] + T_last[2, i] * T_now[2, j]
        for k in range(3):
            motion[i, 3] += T_last[k, i] * (T_now[k, 3] - T_last[k, 3])
    length = sqrt(motion[0, 3] ** 2 + motion[1, 3] ** 2 + motion[2, 3] ** 2)
    return _perturbed(motion, turn, position * length, normal, False)


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
