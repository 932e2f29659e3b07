"""How a camera sits on a robot."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..worlds.world import Array


@dataclass(frozen=True)
class Mount:
    """A camera on a body (x forward, y left, z up).

    Attributes:
        forward_m, left_m, height_m: place of the camera in the body frame, m.
        tilt_rad: how far it looks down from level; pi / 2 is straight down.
        pan_rad: how far it looks to the left of forward.
        horizontal_fov_rad: full horizontal field of view.
        rate_hz: pictures a second; None is one every step.

    Raises:
        ValueError: a field of view outside (0, pi), a tilt beyond straight down or up, a rate that is not positive.
    """

    forward_m: float = 0.0
    left_m: float = 0.0
    height_m: float = 0.5
    tilt_rad: float = 0.0
    pan_rad: float = 0.0
    horizontal_fov_rad: float = np.radians(70.0)
    rate_hz: float | None = None

    def __post_init__(self) -> None:
        if not 0 < self.horizontal_fov_rad < np.pi:
            raise ValueError(f"horizontal_fov_rad must be in (0, pi), got {self.horizontal_fov_rad}")
        if not abs(self.tilt_rad) <= np.pi / 2:
            raise ValueError(f"tilt_rad must be in [-pi/2, pi/2], got {self.tilt_rad}")
        if self.rate_hz is not None and not self.rate_hz > 0:
            raise ValueError(f"rate_hz must be positive, got {self.rate_hz}")

    @property
    def T_body_camera(self) -> Array:
        """(4, 4), camera frame (x right, y down, z forward) to body frame."""
        down, side = (np.sin(self.tilt_rad), np.cos(self.tilt_rad)), (np.sin(self.pan_rad), np.cos(self.pan_rad))
        T = np.eye(4)
        T[:3, 0] = (side[0], -side[1], 0.0)
        T[:3, 2] = (down[1] * side[1], down[1] * side[0], -down[0])
        T[:3, 1] = np.cross(T[:3, 2], T[:3, 0])
        T[:3, 3] = (self.forward_m, self.left_m, self.height_m)
        return T

    def T_world_camera(self, T_world_body: Array) -> Array:
        """(4, 4) of the camera, given that of the body."""
        return T_world_body @ self.T_body_camera

    def is_due(self, step: int, step_seconds: float) -> bool:
        """Whether a new picture is taken at a step (0 is the reset); between pictures the last one stays."""
        if self.rate_hz is None or step == 0:
            return True
        now, before = (int(np.floor(n * step_seconds * self.rate_hz + 1e-9)) for n in (step, step - 1))
        return now > before
