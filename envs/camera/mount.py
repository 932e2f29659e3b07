"""How a camera sits on a robot."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np

from ..worlds.world import Array, Snapshot
from .frame import Frame


@dataclass(frozen=True)
class Mount:
    """A camera on a body (x forward, y left, z up).

    Attributes:
        forward_m, left_m, height_m: place of the camera in the body frame, m.
        tilt_rad: how far it looks down from level; pi / 2 is straight down.
        pan_rad: how far it looks to the left of forward.
        horizontal_fov_rad: full horizontal field of view.
        rate_hz: pictures a second; None is one every step.
        own_body: whether it sees the robot it sits on, which then is an object of its picture like any other.

    Raises:
        ValueError: a value that is not finite, a field of view outside (0, pi), a tilt beyond straight down or up, a
            rate that is not positive.
    """

    forward_m: float = 0.0
    left_m: float = 0.0
    height_m: float = 0.5
    tilt_rad: float = 0.0
    pan_rad: float = 0.0
    horizontal_fov_rad: float = np.radians(70.0)
    rate_hz: float | None = None
    own_body: bool = False

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            absent = value is None and field.name == "rate_hz"
            if not absent and not (isinstance(value, int | float | np.number) and np.isfinite(value)):
                raise ValueError(f"{field.name} must be a finite number, got {value!r}")
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


def checked_mounts(mounts: Sequence[Mount | None] | None, n_robots: int) -> tuple[Mount | None, ...]:
    """One mount per robot; None keeps the camera that the scene gives it.

    Raises:
        ValueError: another number of mounts than robots.
        TypeError: something that is not a mount.
    """
    if mounts is None:
        return (None,) * n_robots
    if not isinstance(mounts, Sequence) or len(mounts) != n_robots:
        raise ValueError(f"mounts must hold one Mount or None per robot, {n_robots} of them, got {mounts!r}")
    for i, mount in enumerate(mounts):
        if mount is not None and not isinstance(mount, Mount):
            raise TypeError(f"mounts[{i}] must be a Mount or None, got {type(mount).__name__}")
    return tuple(mounts)


def with_mounts(snapshot: Snapshot, mounts: Sequence[Mount | None]) -> Snapshot:
    """The snapshot with cameras where the mounts put them.

    Raises:
        ValueError: a mount for a robot without a body.
    """
    if not any(mounts):
        return snapshot
    cameras = snapshot.T_world_camera.copy()
    for i, mount in enumerate(mounts):
        if mount is not None:
            own = np.flatnonzero(snapshot.body_object == snapshot.robot_object[i])
            if snapshot.robot_object[i] < 0 or len(own) == 0:
                raise ValueError(f"mounts[{i}]: robot {i} has no body in this world to mount a camera on")
            cameras[i] = mount.T_world_camera(snapshot.body_poses[own[0]])
    return replace(snapshot, T_world_camera=cameras)


def kept_picture(frame: Frame, taken: Snapshot, now: Snapshot) -> Frame:
    """An old picture with the object indices of the present snapshot; objects that are gone become background."""
    index = {identity: j for j, identity in enumerate(now.identity.tolist())}
    lookup = np.array([-1, *(index.get(identity, -1) for identity in taken.identity.tolist())], dtype=np.int32)
    return Frame(frame.rgb, frame.depth, lookup[frame.instances + 1])
