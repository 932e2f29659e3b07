"""S-MRC (section 4.3): a team of identical Husky-like robots seen by observers with partly overlapping views."""

from __future__ import annotations

from dataclasses import dataclass

from .robots import RobotSceneParams, RobotWorld


@dataclass(frozen=True, kw_only=True)
class MultiRobotParams(RobotSceneParams):
    """Parameters of the S-MRC scene; the defaults are 15 robots within about eight metres."""


class MultiRobotWorld(RobotWorld):
    """N observers among a team of robots of identical look; obstacles are scenery that hides some of them."""

    def __init__(self, n_observers: int = 2, params: MultiRobotParams | None = None) -> None:
        """Raises ValueError for a number of observers that does not fit."""
        super().__init__(n_observers, params or MultiRobotParams())
