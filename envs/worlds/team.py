"""How the team moves by itself: waypoint and patrol routes with mutual avoidance."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from .layout import in_disc
from .world import Array

TURN_GAIN = 2.5
AVOIDANCE = 3.0
SIDESTEP = 0.6


@dataclass(frozen=True, eq=False)
class TeamRoutes:
    """What each of t robots does all episode long; drawn once, at the reset.

    Attributes:
        waypoints: (t, w, 2) m, visited in turn, the first again after the last.
        speed: (t,) m/s cruising speed; 0 = parked.
        max_turn: rad/s.
        keep_away_m: distance at which a robot begins to swerve.
        arrived_m: distance at which a waypoint counts as reached, for a slow robot.
    """

    waypoints: Array
    speed: Array
    max_turn: float
    keep_away_m: float
    arrived_m: float


def draw_routes(
    rng: np.random.Generator,
    start: Array,
    radius_m: float,
    *,
    moving_share: float,
    speed_mps: tuple[float, float],
    max_turn: float,
    keep_away_m: float,
    arrived_m: float,
    waypoints: int = 4,
) -> TeamRoutes:
    """Routes for robots that start at (t, 2): of the moving ones half wander between points, half patrol to and fro."""
    t = len(start)
    points = np.array([[in_disc(rng, radius_m) for _ in range(waypoints)] for _ in range(t)]).reshape(t, waypoints, 2)
    patrols = rng.uniform(size=t) < 0.5
    points[patrols, 1::2] = start[patrols, None]  # to the first waypoint and back
    points[patrols, 2::2] = points[patrols, :1]
    speed = rng.uniform(*speed_mps, size=t) * (rng.uniform(size=t) < moving_share)
    return TeamRoutes(points, speed, max_turn, keep_away_m, arrived_m)


@njit(cache=True)
def advance_waypoints(
    waypoints: Array, speed: Array, target: NDArray[np.int64], planar: Array, arrived_m: float
) -> NDArray[np.int64]:
    """Index (t,) of the waypoint each robot at planar poses (t, 3) heads for, given the one (t,) it headed for.

    `waypoints` (t, w, 2) and `speed` (t,) are those of `TeamRoutes`.
    """
    out = target.copy()
    for i in range(len(target)):
        dx = waypoints[i, target[i], 0] - planar[i, 0]
        dy = waypoints[i, target[i], 1] - planar[i, 1]
        if math.hypot(dx, dy) < arrived_m + 0.5 * speed[i]:
            out[i] = (target[i] + 1) % waypoints.shape[1]
    return out


@njit(cache=True)
def team_commands(
    waypoints: Array,
    speed: Array,
    max_turn: float,
    keep_away_m: float,
    target: NDArray[np.int64],
    planar: Array,
    others: Array,
) -> Array:
    """Commands (t, 2) m/s forward, rad/s at planar poses (t, 3); robots avoid each other and `others` (k, 2).

    A robot wishes to go to its waypoint, plus, for everything nearer than `keep_away_m`, away from it and a little to
    the side (the same for all, so that two that meet do not mirror each other).
    """
    t = len(target)
    out = np.zeros((t, 2))
    for i in range(t):
        if speed[i] <= 0.0:
            continue
        x, y, heading = planar[i, 0], planar[i, 1], planar[i, 2]
        dx = waypoints[i, target[i], 0] - x
        dy = waypoints[i, target[i], 1] - y
        length = max(math.hypot(dx, dy), 1e-9)
        wish_x, wish_y = dx / length, dy / length
        for j in range(t + len(others)):
            if j == i:
                continue
            ax = x - (planar[j, 0] if j < t else others[j - t, 0])
            ay = y - (planar[j, 1] if j < t else others[j - t, 1])
            distance = math.hypot(ax, ay)
            if distance < keep_away_m:
                push = AVOIDANCE * (1.0 - distance / keep_away_m) / max(distance, 1e-6)
                wish_x += push * (ax - SIDESTEP * ay)
                wish_y += push * (ay + SIDESTEP * ax)
        error = math.atan2(wish_y, wish_x) - heading
        error -= 2.0 * math.pi * round(error / (2.0 * math.pi))
        out[i, 0] = speed[i] * max(math.cos(error), 0.0)
        out[i, 1] = min(max(TURN_GAIN * error, -max_turn), max_turn)
    return out
