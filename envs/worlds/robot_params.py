"""What the generator of a robot scene draws from, and what it refuses."""

from __future__ import annotations

import math
from dataclasses import dataclass

from .checks import Range, check_fields, check_names, require
from .layout import LAYOUTS
from .lighting import TIMES_OF_DAY


@dataclass(frozen=True, kw_only=True)
class RobotSceneParams:
    """What the generator of a robot scene draws from. Pairs are (low, high) of a uniform draw per episode or per item.

    Attributes:
        n_team: robots besides the observers; they move by script.
        n_obstacles: things that stand around and hide others.
        obstacles: "scenery" (not objects: nobody detects them), "crate" (identical objects) or "husky" (objects that
            look like the robots).
        obstacle_distance_m: observers start no nearer to an obstacle, where there is room.
        n_backdrop: trees and sheds beyond the arena.
        backdrop: "yard" (those) or "lab" (walls around the arena, no trees).
        scale: size of robots and obstacles relative to a Husky of 0.97 m.
        team_radius_m: the team starts and stays within this distance of the origin.
        layouts: how the team stands at first; one is drawn.
        separation_m: least distance between the centres of two robots or obstacles.
        moving_share: share of the team that moves at all.
        team_speed_mps: cruising speed of those.
        unique_share: share of the team with a class or colour of its own; the others look identical.
        observer_distance_m: from the team's origin.
        observer_angle_deg: between the bearings of an observer and the one placed next to it.
        observer_gaze_m: how far from the origin an observer may aim.
        camera_height_m: above ground.
        camera_tilt_deg: downwards.
        horizontal_fov_deg: of every camera.
        max_speed_mps, max_turn_radps: of an observer at full control.
        times_of_day: names of `lighting.TIMES_OF_DAY`; one is drawn.
        dynamics: "box" (a unicycle with a box body) or "wheels" (pybullet's Husky on four wheel motors).
        meshes: "low" (our low-poly Husky, about 400 triangles) or "stock" (the one pybullet ships).
        mesh_detail_m: level of detail of the stock mesh: parts nearer than this are drawn as one; 0 keeps all 36,000
            triangles, 0.02 7,700, 0.04 2,600.
        step_seconds: simulated time per step.
    """

    n_team: int = 15
    n_obstacles: tuple[int, int] = (3, 6)
    obstacles: str = "scenery"
    obstacle_distance_m: float = 3.0
    n_backdrop: tuple[int, int] = (6, 12)
    backdrop: str = "yard"
    scale: float = 1.0
    team_radius_m: Range = (6.5, 8.5)
    layouts: tuple[str, ...] = ("scatter", "clusters", "rows", "ring")
    separation_m: float = 1.5
    moving_share: float = 0.7
    team_speed_mps: Range = (0.3, 1.0)
    unique_share: float = 0.0
    observer_distance_m: Range = (8.5, 12.0)
    observer_angle_deg: Range = (35.0, 100.0)
    observer_gaze_m: float = 3.0
    camera_height_m: Range = (0.8, 1.2)
    camera_tilt_deg: Range = (3.0, 9.0)
    horizontal_fov_deg: float = 75.0
    max_speed_mps: float = 1.5
    max_turn_radps: float = 1.2
    times_of_day: tuple[str, ...] = ("morning", "noon", "afternoon", "evening", "overcast")
    dynamics: str = "box"
    meshes: str = "low"
    mesh_detail_m: float = 0.04
    step_seconds: float = 0.2

    def __post_init__(self) -> None:
        """Raise ValueError naming the first impossible value."""
        check_fields(self)
        for name in ("scale", "separation_m", "max_speed_mps", "max_turn_radps", "step_seconds"):
            require(getattr(self, name) > 0, name, getattr(self, name), "positive")
        for name in ("moving_share", "unique_share"):
            require(0 <= getattr(self, name) <= 1, name, getattr(self, name), "in [0, 1]")
        require(self.team_radius_m[0] > 0, "team_radius_m", self.team_radius_m, "positive")
        require(self.camera_height_m[0] > 0, "camera_height_m", self.camera_height_m, "positive")
        require(self.observer_gaze_m >= 0, "observer_gaze_m", self.observer_gaze_m, "at least 0")
        require(1 <= self.horizontal_fov_deg < 179, "horizontal_fov_deg", self.horizontal_fov_deg, "in [1, 179)")
        require(self.camera_tilt_deg[0] >= -90, "camera_tilt_deg", self.camera_tilt_deg, "in [-90, 90]")
        require(self.camera_tilt_deg[1] <= 90, "camera_tilt_deg", self.camera_tilt_deg, "in [-90, 90]")
        require(self.obstacles in ("scenery", "crate", "husky"), "obstacles", self.obstacles, "scenery, crate or husky")
        require(self.backdrop in ("yard", "lab"), "backdrop", self.backdrop, '"yard" or "lab"')
        require(self.dynamics in ("box", "wheels"), "dynamics", self.dynamics, '"box" or "wheels"')
        require(self.meshes in ("low", "stock"), "meshes", self.meshes, '"low" or "stock"')
        for name in ("mesh_detail_m", "obstacle_distance_m"):
            require(getattr(self, name) >= 0, name, getattr(self, name), "at least 0")
        check_names("layouts", self.layouts, LAYOUTS)
        check_names("times_of_day", self.times_of_day, TIMES_OF_DAY)
        footprint = math.pi * (0.5 * self.separation_m) ** 2
        room = math.pi * (self.team_radius_m[1] + 0.5 * self.separation_m) ** 2
        require(
            0.5 * room >= self.n_team * footprint,
            "n_team",
            self.n_team,
            "few enough for team_radius_m and separation_m",
        )
