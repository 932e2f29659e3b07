"""Scripted controllers for the robot scenes: waypoints, patrol, an orbiting drone, and one that seeks good viewpoints.

A controller is called with one robot's observation (`pose` is all it reads) and returns that robot's control (d,) in
[-1, 1]: forward, turn to the left, and for d = 4 sideways to the left, climb. It knows where things are only as well as
the noisy pose and the caller's estimates say; `lively_controls` drives a whole world from its truth instead.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from ...envs.worlds.world import Array, World
from ...matching.pose import transform

TURN_GAIN = 1.6
"""Turn control per rad of heading error."""


class Waypoints:
    """Drive to points in turn, the first again after the last.

    Args:
        points: (w, 2) m, world frame.
        control_size: d.
        cruise: forward control at most.
        arrived_m: distance at which a point counts as reached.

    Raises:
        ValueError: no point, or points of another shape.
    """

    def __init__(
        self, points: ArrayLike, *, control_size: int = 2, cruise: float = 0.6, arrived_m: float = 0.6
    ) -> None:
        self.points = np.array(points, dtype=np.float64)
        if self.points.ndim != 2 or self.points.shape[1] != 2 or not len(self.points):
            raise ValueError(f"points must have shape (w, 2) with w >= 1, got {self.points.shape}")
        self.control_size, self.cruise, self.arrived_m = control_size, cruise, arrived_m
        self.next = 0

    def reset(self) -> None:
        """Begin with the first point again."""
        self.next = 0

    def __call__(self, observation: Mapping[str, Any]) -> Array:
        """The control (d,) for this step."""
        position, heading = planar(observation["pose"])
        if np.hypot(*(self.points[self.next] - position)) < self.arrived_m:
            self.next = (self.next + 1) % len(self.points)
        error = bearing_error(position, heading, self.points[self.next])
        control = np.zeros(self.control_size)
        control[0] = self.cruise * max(math.cos(error), 0.0)
        control[1] = np.clip(TURN_GAIN * error, -1.0, 1.0)
        return control


def patrol(a: ArrayLike, b: ArrayLike, **options: Any) -> Waypoints:
    """Drive to and fro between two points (2,) m; options are those of `Waypoints`."""
    return Waypoints(np.stack([np.asarray(a, dtype=np.float64), np.asarray(b, dtype=np.float64)]), **options)


@dataclass(frozen=True)
class Orbit:
    """A drone that circles round a point, facing it.

    Attributes:
        centre: (x, y) m, world frame.
        radius_m, altitude_m: of the circle.
        speed: sideways control in (0, 1].
        clockwise: sense of rotation seen from above.
    """

    centre: tuple[float, float] = (0.0, 0.0)
    radius_m: float = 4.0
    altitude_m: float = 8.0
    speed: float = 0.4
    clockwise: bool = False

    def __post_init__(self) -> None:
        """Raise ValueError for a radius, altitude or speed that is not positive."""
        for name in ("radius_m", "altitude_m", "speed"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} must be positive, got {getattr(self, name)}")

    def __call__(self, observation: Mapping[str, Any]) -> Array:
        """The control (4,) for this step."""
        position, heading = planar(observation["pose"])
        error = bearing_error(position, heading, self.centre)
        outside = float(np.hypot(*(np.asarray(self.centre) - position))) - self.radius_m
        above = float(np.asarray(observation["pose"])[2, 3]) - self.altitude_m
        sense = 1.0 if self.clockwise else -1.0  # facing the centre, left is clockwise
        facing = max(math.cos(error), 0.0)
        control = np.array([0.5 * outside * facing, TURN_GAIN * error, sense * self.speed * facing, -0.7 * above])
        return np.clip(control, -1.0, 1.0)


@dataclass(frozen=True)
class SeekView:
    """Go where one's next measurements would tell most about the objects.

    Of a few controls, the one is taken after which the expected measurements add the most information, in nats: half
    the log determinant of 1 + (covariance known so far) x (information of a measurement). A measurement is good across
    the viewing ray and poor along it, worse with distance, and there is none outside the field of view. So the robot
    turns to objects, approaches, and looks across the partners' rays.

    Attributes:
        horizontal_fov_rad: of the camera.
        max_speed_mps, max_turn_radps: at full control.
        control_size: d.
        horizon_s: how far ahead a control is judged.
        depth_noise: standard deviation along the ray as a share of the distance.
        bearing_noise: across it, likewise.
        range_m: (nearest, farthest) an object can be measured at.
        keep_away_m: controls that lead nearer to an object than this are not taken.
        search: turn control while no object is known.
    """

    horizontal_fov_rad: float
    max_speed_mps: float = 1.5
    max_turn_radps: float = 1.2
    control_size: int = 2
    horizon_s: float = 1.5
    depth_noise: float = 0.06
    bearing_noise: float = 0.01
    range_m: tuple[float, float] = (0.5, 15.0)
    keep_away_m: float = 1.3
    search: float = 0.5

    def __call__(
        self, observation: Mapping[str, Any], positions: Array | None = None, covariances: Array | None = None
    ) -> Array:
        """The control (d,) for this step.

        Args:
            observation: of this robot.
            positions: (n, 3) m, objects as far as known, in this robot's camera frame (its claims of the last step).
            covariances: (n, 3, 3) m^2 in the same frame; 1 m^2 in every direction unless given.
        """
        control = np.zeros(self.control_size)
        if positions is None or len(positions) == 0:
            control[1] = self.search
            return control
        T = np.asarray(observation["pose"], dtype=np.float64)
        prior = np.tile(np.eye(3), (len(positions), 1, 1)) if covariances is None else np.asarray(covariances)
        R = T[:3, :3]
        control[:2] = self.best(T, transform(T, np.asarray(positions, dtype=np.float64)), R @ prior @ R.T)
        return control

    def best(self, T_world_camera: Array, objects: Array, prior: Array) -> Array:
        """Forward and turn (2,) for objects (n, 3) m of covariance (n, 3, 3) m^2, world frame."""
        position, heading = planar(T_world_camera)
        choices = np.array(list(product((0.0, 0.5, 1.0, -0.4), (0.0, -0.4, 0.4, -1.0, 1.0))))
        turned = heading + choices[:, 1] * (self.max_turn_radps * self.horizon_s)
        middle = 0.5 * (heading + turned)
        way = choices[:, 0] * (self.max_speed_mps * self.horizon_s)
        goals = position + way[:, None] * np.column_stack([np.cos(middle), np.sin(middle)])
        gain = self.information(goals, turned, float(T_world_camera[2, 3]), objects, prior)
        gain -= 1e-3 * np.abs(choices).sum(1)  # effort
        gain[(way != 0) & self._too_near(position, goals, objects)] = -np.inf
        return choices[int(np.argmax(gain))]

    def information(self, goals: Array, headings: Array, height_m: float, objects: Array, prior: Array) -> Array:
        """What measuring from each of (c, 2) m, looking along (c,) rad, is expected to add: (c,) nats.

        Without any object in view it is minus the least angle to turn in rad, less than any view is worth.
        """
        near, far = self.range_m
        return view_information(
            np.ascontiguousarray(goals),
            headings,
            height_m,
            np.ascontiguousarray(objects),
            np.ascontiguousarray(prior),
            0.45 * self.horizontal_fov_rad,
            near,
            far,
            self.depth_noise,
            self.bearing_noise,
        )

    def _too_near(self, position: Array, goals: Array, objects: Array) -> NDArray[np.bool_]:
        after = np.linalg.norm(objects[:, :2] - goals[:, None], axis=2)
        before = np.linalg.norm(objects[:, :2] - position, axis=1)
        return np.asarray(((after < self.keep_away_m) & (after < before)).any(1))


@njit(cache=True)
def view_information(
    goals: Array,
    headings: Array,
    height_m: float,
    objects: Array,
    prior: Array,
    half_fov_rad: float,
    near_m: float,
    far_m: float,
    depth_noise: float,
    bearing_noise: float,
) -> Array:
    """See `SeekView.information`; goals (c, 2), headings (c,), objects (n, 3), prior (n, 3, 3)."""
    out = np.zeros(len(goals))
    ray, M = np.zeros(3), np.zeros((3, 3))
    for c in range(len(goals)):
        least, seen = np.pi, False
        for i in range(len(objects)):
            ray[0], ray[1], ray[2] = objects[i, 0] - goals[c, 0], objects[i, 1] - goals[c, 1], objects[i, 2] - height_m
            r = max(math.sqrt(ray[0] ** 2 + ray[1] ** 2 + ray[2] ** 2), 1e-6)
            off = math.atan2(ray[1], ray[0]) - headings[c]
            off = abs(off - 2 * math.pi * round(off / (2 * math.pi)))
            least = min(least, off)
            if off >= half_fov_rad or r <= near_m or r >= far_m:
                continue
            seen = True
            across = 1.0 / (bearing_noise * r) ** 2
            along = 1.0 / (depth_noise * r) ** 2
            for a in range(3):
                for b in range(3):  # M = 1 + P (across (1 - u u') + along u u')
                    M[a, b] = 1.0 if a == b else 0.0
                    for k in range(3):
                        unit = across if k == b else 0.0
                        M[a, b] += prior[i, a, k] * (unit + (along - across) * ray[k] * ray[b] / r**2)
            det = (
                M[0, 0] * (M[1, 1] * M[2, 2] - M[1, 2] * M[2, 1])
                - M[0, 1] * (M[1, 0] * M[2, 2] - M[1, 2] * M[2, 0])
                + M[0, 2] * (M[1, 0] * M[2, 1] - M[1, 1] * M[2, 0])
            )
            out[c] += 0.5 * math.log(max(det, 1.0))
        if not seen:
            out[c] = -least
    return out


def lively_controls(world: World) -> Array:
    """Controls (N, d) for a robot scene at the present instant: drones orbit at their altitude, others seek viewpoints.

    They act on the true positions of all objects, so that an episode does not depend on the method that is scored on
    it. What the partners see from where they are counts as known.
    """
    s = world.snapshot()
    controls = np.zeros((world.n_robots, world.control_size))
    for k, T in enumerate(s.T_world_camera):
        own = int(s.robot_object[k])
        others = np.arange(len(s.positions)) != own
        if world.control_size == 4 and world.classes[int(s.object_class[own])].name == "drone":
            middle = s.positions[others, :2].mean(0) if others.any() else np.zeros(2)
            orbit = Orbit((float(middle[0]), float(middle[1])), 4.0, max(float(T[2, 3]), 1.0), speed=0.3)
            controls[k] = orbit({"pose": T})
        else:
            scale = float(s.sizes[own, 0])  # of a robot's length
            seeker = SeekView(
                float(world.horizontal_fov_rad[k]),
                max_speed_mps=1.5 * scale,
                keep_away_m=1.3 * scale,
                range_m=(scale, 14 * scale),
            )
            partners = [P for j, P in enumerate(s.T_world_camera) if j != k]
            if others.any():
                best = seeker.best(T, s.positions[others], _known(partners, s.positions[others]))
                controls[k, :2] = 0.6 * best[: world.control_size]
    return controls


def _known(cameras: Sequence[Array], objects: Array, depth_noise: float = 0.06, bearing_noise: float = 0.01) -> Array:
    """Covariance (n, 3, 3) m^2 of objects (n, 3) after one measurement by each camera (4, 4) that faces them."""
    information = np.tile(np.eye(3), (len(objects), 1, 1))  # 1 m^2 to begin with
    for T in cameras:
        ray = objects - T[:3, 3]
        r = np.maximum(np.linalg.norm(ray, axis=1), 1e-6)
        unit = ray / r[:, None]
        faced = (unit @ T[:3, 2] > 0.8)[:, None, None]
        outer = unit[:, :, None] * unit[:, None, :]
        along, across = 1.0 / (depth_noise * r) ** 2, 1.0 / (bearing_noise * r) ** 2
        information = information + faced * (across[:, None, None] * (np.eye(3) - outer) + along[:, None, None] * outer)
    return np.asarray(np.linalg.inv(information), dtype=np.float64)


def planar(T_world_camera: ArrayLike) -> tuple[Array, float]:
    """Position (2,) m and heading rad of the robot that carries a camera; its x axis points to the robot's right."""
    T = np.asarray(T_world_camera, dtype=np.float64)
    return T[:2, 3].copy(), math.atan2(T[0, 0], -T[1, 0])


def bearing_error(position: Array, heading: float, target: ArrayLike) -> float:
    """How far to turn to the left to face `target` (2,) m, in [-pi, pi] rad."""
    dx, dy = np.asarray(target, dtype=np.float64) - position
    error = math.atan2(dy, dx) - heading
    return error - 2 * math.pi * round(error / (2 * math.pi))
