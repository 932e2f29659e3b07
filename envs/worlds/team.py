"""How the team moves by itself: waypoint and patrol routes with mutual avoidance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .layout import in_disc
from .world import Array

ARRIVED_M = 0.6
TURN_GAIN = 2.5


@dataclass(frozen=True, eq=False)
class TeamRoutes:
    """What each of t robots does all episode long; drawn once, at the reset.

    Attributes:
        waypoints: (t, w, 2) m, visited in turn, the first again after the last.
        speed: (t,) m/s cruising speed; 0 = parked.
        max_turn: rad/s.
        keep_away_m: distance at which a robot begins to swerve.
    """

    waypoints: Array
    speed: Array
    max_turn: float
    keep_away_m: float


def draw_routes(
    rng: np.random.Generator,
    start: Array,
    radius_m: float,
    moving_share: float,
    speed_mps: tuple[float, float],
    max_turn: float,
    keep_away_m: float,
    waypoints: int = 4,
) -> TeamRoutes:
    """Routes for robots that start at (t, 2): of the moving ones half wander between points, half patrol to and fro."""
    t = len(start)
    points = np.array([[in_disc(rng, radius_m) for _ in range(waypoints)] for _ in range(t)]).reshape(t, waypoints, 2)
    patrols = rng.uniform(size=t) < 0.5
    points[patrols, 1::2] = start[patrols, None]  # to the first waypoint and back
    points[patrols, 2::2] = points[patrols, :1]
    speed = rng.uniform(*speed_mps, size=t) * (rng.uniform(size=t) < moving_share)
    return TeamRoutes(points, speed, max_turn, keep_away_m)


def advance_waypoints(routes: TeamRoutes, target: NDArray[np.int64], planar: Array) -> NDArray[np.int64]:
    """Index (t,) of the waypoint each robot at planar poses (t, 3) heads for, given the one (t,) it headed for."""
    t = len(target)
    gap = routes.waypoints[np.arange(t), target] - planar[:, :2]
    arrived = (gap**2).sum(1) < (ARRIVED_M + 0.5 * routes.speed) ** 2
    return np.where(arrived, (target + 1) % routes.waypoints.shape[1], target)


def team_commands(routes: TeamRoutes, target: NDArray[np.int64], planar: Array, others: Array) -> Array:
    """Commands (t, 2) m/s forward, rad/s at planar poses (t, 3); all avoid each other and `others` (k, 2)."""
    t = len(target)
    position, heading = planar[:, :2], planar[:, 2]
    wish = _unit(routes.waypoints[np.arange(t), target] - position)
    away = position[:, None] - np.vstack([position, others])[None]
    distance = np.sqrt((away**2).sum(2))
    distance[np.arange(t), np.arange(t)] = np.inf
    push = np.clip(1.0 - distance / routes.keep_away_m, 0.0, 1.0) / np.maximum(distance, 1e-6)
    swerve = np.stack(
        [away[..., 0] - 0.6 * away[..., 1], away[..., 1] + 0.6 * away[..., 0]], -1
    )  # all pass on one side
    wish = wish + 3.0 * (push[..., None] * swerve).sum(1)
    error = np.arctan2(wish[:, 1], wish[:, 0]) - heading
    error -= 2 * np.pi * np.round(error / (2 * np.pi))
    forward = routes.speed * np.clip(np.cos(error), 0.0, 1.0)
    turn = np.clip(TURN_GAIN * error, -routes.max_turn, routes.max_turn) * (routes.speed > 0)
    return np.column_stack([forward, turn])


def _unit(v: Array) -> Array:
    return v / np.maximum(np.sqrt((v**2).sum(-1, keepdims=True)), 1e-9)
