"""S-MRC (section 4.3): a team of identical Husky-like robots seen by observers with partly overlapping views."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

from .checks import check_preset
from .robot_params import RobotSceneParams
from .robots import RobotWorld


@dataclass(frozen=True, kw_only=True)
class MultiRobotParams(RobotSceneParams):
    """Parameters of the S-MRC scene; the defaults are 15 robots within about eight metres."""


class MultiRobotWorld(RobotWorld):
    """N observers among a team of robots of identical look; obstacles are scenery that hides some of them."""

    def __init__(self, n_robots: int = 2, params: MultiRobotParams | None = None) -> None:
        """Raises ValueError for a number of observers that does not fit."""
        super().__init__(n_robots, params or MultiRobotParams())


PRESETS = {
    "easy": MultiRobotParams(
        n_team=8, n_obstacles=(0, 2), observer_angle_deg=(20.0, 60.0), observer_gaze_m=1.5, unique_share=0.5
    ),
    "paper": MultiRobotParams(
        n_team=28,
        n_obstacles=(4, 7),
        team_radius_m=(8.0, 10.0),
        observer_angle_deg=(50.0, 128.0),
        observer_gaze_m=5.0,
    ),
    "hard": MultiRobotParams(
        n_team=36,
        n_obstacles=(7, 11),
        team_radius_m=(9.5, 11.5),
        observer_distance_m=(10.0, 14.0),
        observer_angle_deg=(60.0, 140.0),
        observer_gaze_m=5.0,
        camera_height_m=(0.65, 0.8),
    ),
}


def preset(name: str, **changes: Any) -> MultiRobotParams:
    """The parameters called `name` (easy, paper or hard), some of them changed. Raises ValueError for another name."""
    return dataclasses.replace(PRESETS[check_preset("multi_robot", name, PRESETS)], **changes)
