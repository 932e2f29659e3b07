"""The case study (section 4.5): two observers, two moving targets, look-alike obstacles, an arena of a few metres."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

from .checks import Range, check_preset
from .robot_params import RobotSceneParams
from .robots import RobotWorld

SCALE = 0.36
"""A robot of 35 cm."""


@dataclass(frozen=True, kw_only=True)
class TargetLocalizationParams(RobotSceneParams):
    """Parameters of the case study: the team are the targets, obstacles are objects."""

    n_team: int = 2
    n_obstacles: tuple[int, int] = (20, 24)
    obstacles: str = "husky"
    backdrop: str = "lab"
    scale: float = SCALE
    team_radius_m: Range = (2.2, 2.6)
    layouts: tuple[str, ...] = ("scatter",)
    separation_m: float = 0.55
    obstacle_distance_m: float = 0.9
    moving_share: float = 1.0
    team_speed_mps: Range = (0.1, 0.3)
    observer_distance_m: Range = (1.3, 2.0)
    observer_angle_deg: Range = (75.0, 145.0)
    observer_gaze_m: float = 1.0
    camera_height_m: Range = (0.14, 0.18)
    camera_tilt_deg: Range = (2.0, 8.0)
    horizontal_fov_deg: float = 69.0
    max_speed_mps: float = 0.4
    max_turn_radps: float = 1.0
    times_of_day: tuple[str, ...] = ("lab",)


class TargetLocalizationWorld(RobotWorld):
    """Observers and targets drive, obstacles stand; all may look the same and all are objects."""

    def __init__(self, n_robots: int = 2, params: TargetLocalizationParams | None = None) -> None:
        """Raises ValueError for a number of observers that does not fit."""
        super().__init__(n_robots, params or TargetLocalizationParams())


PRESETS = {
    "easy": TargetLocalizationParams(
        n_obstacles=(5, 7),
        obstacles="crate",
        observer_distance_m=(2.0, 2.6),
        observer_angle_deg=(25.0, 60.0),
        observer_gaze_m=0.4,
        camera_height_m=(0.28, 0.34),
    ),
    "paper": TargetLocalizationParams(),
    "hard": TargetLocalizationParams(
        n_obstacles=(26, 30),
        team_radius_m=(2.4, 2.8),
        observer_distance_m=(1.4, 2.2),
        observer_angle_deg=(100.0, 170.0),
        observer_gaze_m=1.6,
        team_speed_mps=(0.2, 0.5),
        camera_height_m=(0.13, 0.16),
    ),
}


def preset(name: str, **changes: Any) -> TargetLocalizationParams:
    """The parameters called `name` (easy, paper or hard), some of them changed. Raises ValueError for another name."""
    return dataclasses.replace(PRESETS[check_preset("target_localization", name, PRESETS)], **changes)
