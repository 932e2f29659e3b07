"""Rigid motions and their uncertainty.

A pose `T_a_b` (4, 4) maps coordinates of frame b to frame a, in metres. Its covariance (6, 6) is ordered
[translation, rotation] and perturbs on the right: T = T_hat exp(xi), xi ~ N(0, covariance); the translation part of xi
is thus expressed in frame b.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import cos, sin, sqrt

import numpy as np
from numba import njit
from numpy.typing import ArrayLike

from .checks import Array, shaped

ROTATION_TOLERANCE = 1e-3

# Copies of these take a fifth of the time of np.eye.
_EYE3, _EYE4 = np.eye(3), np.eye(4)


def skew(v: Array) -> Array:
    """Matrix (3, 3) with skew(v) @ w = cross(v, w)."""
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def rotation_from_vector(w: Array) -> Array:
    """Rotation (3, 3) about the axis w (3,) by the angle |w| in radians (Rodrigues)."""
    return _rodrigues(np.asarray(w, dtype=np.float64))


@njit(cache=True)
def _rodrigues(w: Array) -> Array:
    x, y, z = w[0], w[1], w[2]
    angle = sqrt(x * x + y * y + z * z)
    s, c = (1.0, 0.5) if angle < 1e-8 else (sin(angle) / angle, (1.0 - cos(angle)) / angle**2)
    return np.array(
        [
            [1.0 - c * (y * y + z * z), c * x * y - s * z, c * x * z + s * y],
            [c * x * y + s * z, 1.0 - c * (x * x + z * z), c * y * z - s * x],
            [c * x * z - s * y, c * y * z + s * x, 1.0 - c * (x * x + y * y)],
        ]
    )


def exp_se3(xi: Array) -> Array:
    """Pose (4, 4) of xi (6,) = [translation m, rotation rad], the translation taken as it is (first order)."""
    T = _EYE4.copy()
    T[:3, :3] = rotation_from_vector(xi[3:])
    T[:3, 3] = xi[:3]
    return T


def invert(T_a_b: Array) -> Array:
    """T_b_a (4, 4)."""
    T = _EYE4.copy()
    T[:3, :3] = T_a_b[:3, :3].T
    T[:3, 3] = -T_a_b[:3, :3].T @ T_a_b[:3, 3]
    return T


def transform(T_a_b: Array, positions_b: Array) -> Array:
    """Positions (n, 3) m of frame b, in frame a."""
    return positions_b @ T_a_b[:3, :3].T + T_a_b[:3, 3]


def adjoint(T_a_b: Array) -> Array:
    """Adjoint (6, 6), order [translation, rotation]: exp(adjoint(T) xi) = T exp(xi) T^-1."""
    R, t = T_a_b[:3, :3], T_a_b[:3, 3]
    out = np.zeros((6, 6))
    out[:3, :3] = R
    out[3:, 3:] = R
    out[:3, 3:] = skew(t) @ R
    return out


def check_pose(pose: ArrayLike, name: str) -> Array:
    """The pose as float64 (4, 4). Raises ValueError naming `name` unless it is a finite rigid motion."""
    T = shaped(pose, name, (4, 4))
    R = T[:3, :3]
    error = float(np.abs(R @ R.T - _EYE3).max())
    if error > ROTATION_TOLERANCE or np.linalg.det(R) < 0 or not np.allclose(T[3], (0, 0, 0, 1)):
        raise ValueError(f"{name} is not a rigid motion: |R R^T - I| = {error:.2g}, det R = {np.linalg.det(R):.3g}")
    return T


def check_covariance(covariance: ArrayLike, name: str) -> Array:
    """As float64 (6, 6). Raises ValueError naming `name` unless finite, symmetric and positive semidefinite."""
    C = shaped(covariance, name, (6, 6))
    scale = max(float(np.abs(C).max()), 1e-12)
    skew = float(np.abs(C - C.T).max())
    if skew > 1e-6 * scale:
        raise ValueError(f"{name} must be symmetric, it differs from its transpose by {skew:.3g}")
    lowest = float(np.linalg.eigvalsh(C)[0])
    if lowest < -1e-6 * scale:
        raise ValueError(f"{name} must be positive semidefinite, its lowest eigenvalue is {lowest:.3g}")
    return C


@dataclass(frozen=True)
class RelativePose:
    """Noisy pose of the target robot's sensor in the source robot's sensor frame: the `prior` of a matcher.

    Attributes:
        T_source_target: (4, 4), target sensor frame to source sensor frame, m.
        covariance: (6, 6), [translation m^2, rotation rad^2], right perturbation.

    Raises:
        ValueError: not a rigid motion, or not a covariance.
    """

    T_source_target: Array
    covariance: Array

    def __post_init__(self) -> None:
        object.__setattr__(self, "T_source_target", check_pose(self.T_source_target, "T_source_target"))
        object.__setattr__(self, "covariance", check_covariance(self.covariance, "covariance of T_source_target"))

    @classmethod
    def between(
        cls,
        T_world_source: ArrayLike,
        covariance_source: ArrayLike,
        T_world_target: ArrayLike,
        covariance_target: ArrayLike,
    ) -> RelativePose:
        """Relative pose of two independent world poses (4, 4), covariances (6, 6) each propagated to first order.

        Raises:
            ValueError: a wrong shape, a value that is not finite; as the class.
        """
        T_source = shaped(T_world_source, "T_world_source", (4, 4))
        T = invert(T_source) @ shaped(T_world_target, "T_world_target", (4, 4))
        to_target = adjoint(invert(T))
        C_source = shaped(covariance_source, "covariance_source", (6, 6))
        C_target = shaped(covariance_target, "covariance_target", (6, 6))
        return cls(T, C_target + to_target @ C_source @ to_target.T)

    def inverse(self) -> RelativePose:
        """The same knowledge with source and target exchanged."""
        Ad = adjoint(self.T_source_target)
        return RelativePose(invert(self.T_source_target), Ad @ self.covariance @ Ad.T)

    def position_covariances(self, positions: Array) -> Array:
        """Covariance (n, 3, 3) m^2, source axes, that the pose's error gives to mapped target positions (n, 3) m."""
        R = self.T_source_target[:3, :3]
        J = np.zeros((len(positions), 3, 6))
        J[:, :, :3] = R
        J[:, :, 3:] = -R @ skews(positions)
        return J @ self.covariance @ J.transpose(0, 2, 1)


def skews(v: Array) -> Array:
    """`skew` of each of v (n, 3): (n, 3, 3)."""
    out = np.zeros((len(v), 3, 3))
    out[:, 0, 1], out[:, 0, 2], out[:, 1, 2] = -v[:, 2], v[:, 1], -v[:, 0]
    out[:, 1, 0], out[:, 2, 0], out[:, 2, 1] = v[:, 2], -v[:, 1], v[:, 0]
    return out
