"""R-MRC (section 4.4): a drone looks down on a team of robots that ground observers see from the side."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from .checks import Range, check_preset, require
from .layout import in_disc
from .robot_generation import Scene, camera_mount, planar_poses
from .robot_params import RobotSceneParams
from .robots import RobotWorld, State
from .world import Array

GRAVITY = 9.81


@dataclass(frozen=True, kw_only=True)
class AerialGroundParams(RobotSceneParams):
    """Parameters of the R-MRC scene: those of all robot scenes, and the drone's.

    Attributes:
        drone_altitude_m: at the start.
        drone_offset_m: at the start, how far from above the origin.
        drone_tilt_deg: of its camera, downwards.
        drone_fov_deg: horizontal field of view.
        drone_speed_mps: horizontally at full control.
        drone_climb_mps: vertically at full control.
        drone_lag_s: time constant with which the velocity follows the command.
        drone_ceiling_m: lowest and highest altitude it can be steered to.
    """

    n_team: int = 14
    n_obstacles: tuple[int, int] = (2, 4)
    team_radius_m: Range = (4.0, 5.5)
    team_speed_mps: Range = (0.2, 0.8)
    unique_share: float = 0.2
    observer_distance_m: Range = (6.5, 8.0)
    observer_gaze_m: float = 1.5
    camera_height_m: Range = (0.65, 0.9)
    camera_tilt_deg: Range = (2.0, 7.0)
    horizontal_fov_deg: float = 55.0
    drone_altitude_m: Range = (7.0, 9.5)
    drone_offset_m: float = 3.0
    drone_tilt_deg: Range = (60.0, 88.0)
    drone_fov_deg: float = 80.0
    drone_speed_mps: float = 3.0
    drone_climb_mps: float = 1.5
    drone_lag_s: float = 0.4
    drone_ceiling_m: Range = (3.0, 20.0)

    def __post_init__(self) -> None:
        """Raise ValueError naming the first impossible value."""
        super().__post_init__()
        for name in ("drone_speed_mps", "drone_climb_mps", "drone_lag_s"):
            require(getattr(self, name) > 0, name, getattr(self, name), "positive")
        require(1 <= self.drone_fov_deg < 179, "drone_fov_deg", self.drone_fov_deg, "in [1, 179)")
        require(self.drone_offset_m >= 0, "drone_offset_m", self.drone_offset_m, "at least 0")
        require(
            self.drone_ceiling_m[0] >= 2.0, "drone_ceiling_m", self.drone_ceiling_m, "at least 2, clear of all robots"
        )
        require(self.drone_tilt_deg[0] >= -90, "drone_tilt_deg", self.drone_tilt_deg, "in [-90, 90]")
        require(self.drone_tilt_deg[1] <= 90, "drone_tilt_deg", self.drone_tilt_deg, "in [-90, 90]")
        low, high = self.drone_ceiling_m
        within = low <= self.drone_altitude_m[0] and self.drone_altitude_m[1] <= high
        require(within, "drone_altitude_m", self.drone_altitude_m, f"within drone_ceiling_m = {self.drone_ceiling_m}")


class AerialGroundWorld(RobotWorld):
    """Robot 0 is a drone, the others look along the ground; most of the team is identical, some look unlike the rest.

    Controls of every robot: forward, turn to the left, sideways to the left, climb; ground robots ignore the last two.
    Columns of `robot_state`: m/s forward, rad/s to the left, m/s to the left, m/s up, altitude of the body in m.
    The drone flies above everything and collides with nothing.
    """

    control_size = 4
    state_size = 5
    n_flyers = 1
    params: AerialGroundParams

    def __init__(self, n_robots: int = 2, params: AerialGroundParams | None = None) -> None:
        """Raises ValueError for a number of observers that does not fit."""
        super().__init__(n_robots, params or AerialGroundParams())
        self.horizontal_fov_rad[0] = math.radians(self.params.drone_fov_deg)

    def _place_flyers(self, rng: np.random.Generator) -> Array:
        p = self.params
        flight = np.zeros((1, 10))
        flight[0, :2] = in_disc(rng, p.drone_offset_m)
        flight[0, 2] = rng.uniform(*p.drone_altitude_m)
        # Facing the origin, so that a camera which looks ahead sees the team.
        flight[0, 3] = math.atan2(-flight[0, 1], -flight[0, 0]) + rng.uniform(-0.6, 0.6)
        return flight

    def _mounts(self, rng: np.random.Generator) -> Array:
        mounts = super()._mounts(rng)
        mounts[0] = camera_mount((0.0, 0.0, 0.0), math.radians(rng.uniform(*self.params.drone_tilt_deg)))
        return mounts

    def _fly(self, flight: Array, controls: Array) -> Array:
        """A quadrotor that tilts to accelerate: velocity follows the command with a first-order lag."""
        p, dt = self.params, self.step_seconds
        rate = controls[:, 1] * p.max_turn_radps
        heading = flight[:, 3] + 0.5 * dt * rate
        c, s = np.cos(heading), np.sin(heading)
        forward, left = controls[:, 0] * p.drone_speed_mps, controls[:, 2] * p.drone_speed_mps
        wanted = np.column_stack([c * forward - s * left, s * forward + c * left, controls[:, 3] * p.drone_climb_mps])
        decay = math.exp(-dt / p.drone_lag_s)
        gap = flight[:, 4:7] - wanted
        out = np.empty_like(flight)
        out[:, :3] = flight[:, :3] + wanted * dt + gap * (p.drone_lag_s * (1 - decay))
        out[:, 4:7] = wanted + gap * decay
        turned = flight[:, 3] + dt * rate
        out[:, 3] = turned - 2 * np.pi * np.round(turned / (2 * np.pi))
        out[:, 7] = rate
        acceleration = -gap[:, :2] * (decay / p.drone_lag_s)
        c, s = np.cos(out[:, 3]), np.sin(out[:, 3])
        out[:, 8] = np.arctan((c * acceleration[:, 0] + s * acceleration[:, 1]) / GRAVITY)  # nose down
        out[:, 9] = np.arctan((s * acceleration[:, 0] - c * acceleration[:, 1]) / GRAVITY)  # right side down
        bounded = np.clip(out[:, 2], *p.drone_ceiling_m)
        out[bounded != out[:, 2], 6] = 0.0
        out[:, 2] = bounded
        return out

    def _robot_poses(self, state: State) -> Array:
        return np.concatenate([_attitude(state.flight), planar_poses(state.bodies.planar)])

    def _camera_poses(self, scene: Scene, state: State, robot_poses: Array) -> Array:
        """The drone's camera hangs in a gimbal: it turns with the heading and stays level."""
        level = planar_poses(state.flight[:, [0, 1, 3]])
        level[:, 2, 3] = state.flight[:, 2]
        return np.concatenate([level, robot_poses[1:]]) @ scene.T_robot_camera

    def _robot_state(self, state: State) -> Array:
        out = np.zeros((self.n_robots, 5))
        out[1:, :2] = super()._robot_state(state)
        z, heading, vx, vy, vz, rate = state.flight[0, 2:8]
        c, s = math.cos(heading), math.sin(heading)
        out[0] = (c * vx + s * vy, rate, c * vy - s * vx, vz, z)
        return out


def _attitude(flight: Array) -> Array:
    """T_world_body (f, 4, 4) of flyers (f, 10): heading, then pitch, then roll."""
    poses = planar_poses(flight[:, [0, 1, 3]])
    poses[:, 2, 3] = flight[:, 2]
    pitch, roll = np.zeros_like(poses), np.zeros_like(poses)
    c, s = np.cos(flight[:, 8]), np.sin(flight[:, 8])
    pitch[:, 0, 0] = pitch[:, 2, 2] = c
    pitch[:, 0, 2], pitch[:, 2, 0] = s, -s
    pitch[:, 1, 1] = pitch[:, 3, 3] = 1.0
    c, s = np.cos(flight[:, 9]), np.sin(flight[:, 9])
    roll[:, 1, 1] = roll[:, 2, 2] = c
    roll[:, 1, 2], roll[:, 2, 1] = -s, s
    roll[:, 0, 0] = roll[:, 3, 3] = 1.0
    return poses @ pitch @ roll


PRESETS = {
    "easy": AerialGroundParams(
        n_team=8,
        n_obstacles=(0, 2),
        unique_share=0.5,
        observer_gaze_m=1.0,
        camera_height_m=(1.0, 1.3),
        horizontal_fov_deg=75.0,
    ),
    "paper": AerialGroundParams(
        n_team=25,
        n_obstacles=(4, 7),
        unique_share=0.18,
        team_radius_m=(6.0, 7.5),
        observer_distance_m=(7.0, 9.0),
        observer_gaze_m=3.0,
        camera_height_m=(0.5, 0.65),
        horizontal_fov_deg=60.0,
        drone_altitude_m=(5.2, 6.6),
        drone_offset_m=5.0,
    ),
    "hard": AerialGroundParams(
        n_team=30,
        n_obstacles=(6, 9),
        unique_share=0.1,
        team_radius_m=(7.0, 8.5),
        observer_distance_m=(7.5, 10.0),
        observer_gaze_m=4.0,
        camera_height_m=(0.45, 0.55),
        horizontal_fov_deg=50.0,
        drone_altitude_m=(5.0, 6.5),
        drone_offset_m=5.0,
    ),
}


def preset(name: str, **changes: Any) -> AerialGroundParams:
    """The parameters called `name` (easy, paper or hard), some of them changed. Raises ValueError for another name."""
    return dataclasses.replace(PRESETS[check_preset("aerial_ground", name, PRESETS)], **changes)
