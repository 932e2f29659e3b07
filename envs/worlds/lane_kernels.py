"""Lane geometry, and where vehicles are on lanes: kernels over tables of lanes (columns L_*) and of vehicles and
obstacles (columns V_*).

Each function names the one of highway-env that it stands for, and all are in its frame (x right, y down on its screen).
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from .driving_maps import MAPS  # noqa: F401 - first: it says what to install when highway-env is missing

# isort: split
from highway_env.road.lane import AbstractLane

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

STRAIGHT, SINE, CIRCULAR = 0, 1, 2
# Columns of the lane table.
L_KIND, L_X, L_Y, L_DX, L_DY, L_LENGTH, L_WIDTH, L_HEADING, L_AMPLITUDE, L_PULSATION, L_PHASE = range(11)
L_RADIUS, L_START_PHASE, L_TURN, L_SPEED_LIMIT, LANE_COLUMNS = range(11, 16)
# Columns of the vehicle table.
V_X, V_Y, V_HEADING, V_SPEED, V_LANE, V_TARGET, V_TARGET_SPEED, V_DELTA, V_LENGTH, V_WIDTH = range(10)
V_ACC_MAX, V_COMFORT_MAX, V_COMFORT_MIN, V_DISTANCE, V_TIME, V_CRASHED, V_STEERING, V_ACCELERATION = range(10, 18)
V_IMPACT_X, V_IMPACT_Y, V_IMPACTED, V_COS, V_SIN, VEHICLE_COLUMNS = range(18, 24)

VEHICLE_END_M = AbstractLane.VEHICLE_LENGTH
"""m. A lane is passed half of it before its end; neighbours are looked for as far beyond its ends."""


@njit(cache=True)
def wrap_to_pi(x: float) -> float:
    """highway_env.utils.wrap_to_pi."""
    return ((x + math.pi) % (2 * math.pi)) - math.pi


@njit(cache=True)
def local_coordinates(lane: Array, x: float, y: float, angle: float) -> tuple[float, float]:
    """(longitudinal, lateral) m of a point on a lane: `AbstractLane.local_coordinates`.

    `angle` is the point's direction (rad) from the lane's centre, used by circular lanes only.
    """
    dx, dy = x - lane[L_X], y - lane[L_Y]
    if lane[L_KIND] == CIRCULAR:
        phi = lane[L_START_PHASE] + wrap_to_pi(angle - lane[L_START_PHASE])
        longitudinal = lane[L_TURN] * (phi - lane[L_START_PHASE]) * lane[L_RADIUS]
        return longitudinal, lane[L_TURN] * (lane[L_RADIUS] - math.sqrt(dx * dx + dy * dy))
    longitudinal = dx * lane[L_DX] + dy * lane[L_DY]
    lateral = dy * lane[L_DX] - dx * lane[L_DY]
    if lane[L_KIND] == SINE:
        lateral -= lane[L_AMPLITUDE] * math.sin(lane[L_PULSATION] * longitudinal + lane[L_PHASE])
    return longitudinal, lateral


@njit(cache=True)
def projected(lane: Array, x: float, y: float) -> tuple[float, float]:
    """`local_coordinates` with the compiler's own arctangent: right to the last bit or two."""
    angle = math.atan2(y - lane[L_Y], x - lane[L_X]) if lane[L_KIND] == CIRCULAR else 0.0
    return local_coordinates(lane, x, y, angle)


@njit(cache=True)
def slope_at(lane: Array, longitudinal: float) -> float:
    """Tangent of a sine lane's deviation from its axis."""
    return lane[L_AMPLITUDE] * lane[L_PULSATION] * math.cos(lane[L_PULSATION] * longitudinal + lane[L_PHASE])


@njit(cache=True)
def heading_at(lane: Array, longitudinal: float) -> float:
    """Heading (rad) of a lane: `AbstractLane.heading_at`."""
    if lane[L_KIND] == CIRCULAR:
        phi = lane[L_TURN] * longitudinal / lane[L_RADIUS] + lane[L_START_PHASE]
        return phi + math.pi / 2 * lane[L_TURN]
    if lane[L_KIND] == SINE:
        return lane[L_HEADING] + math.atan(slope_at(lane, longitudinal))
    return lane[L_HEADING]


@njit(cache=True)
def position_at(lane: Array, longitudinal: float) -> tuple[float, float]:
    """Point (m) of a lane's centre line: `AbstractLane.position(longitudinal, 0)`."""
    if lane[L_KIND] == CIRCULAR:
        phi = lane[L_TURN] * longitudinal / lane[L_RADIUS] + lane[L_START_PHASE]
        return lane[L_X] + lane[L_RADIUS] * math.cos(phi), lane[L_Y] + lane[L_RADIUS] * math.sin(phi)
    lateral = 0.0
    if lane[L_KIND] == SINE:
        lateral = lane[L_AMPLITUDE] * math.sin(lane[L_PULSATION] * longitudinal + lane[L_PHASE])
    x = lane[L_X] + longitudinal * lane[L_DX] - lateral * lane[L_DY]
    y = lane[L_Y] + longitudinal * lane[L_DY] + lateral * lane[L_DX]
    return x, y


@njit(cache=True)
def closest_lane(lanes: Array, x: float, y: float, heading: float) -> int:
    """Row of the closest lane in position and heading (nan: position alone): `RoadNetwork.get_closest_lane_index`."""
    best, best_distance = 0, np.inf
    for row in range(len(lanes)):
        lane = lanes[row]
        s, lateral = projected(lane, x, y)
        distance = abs(lateral) + max(s - lane[L_LENGTH], 0.0) + max(0.0 - s, 0.0)
        if not math.isnan(heading):
            if distance >= best_distance:
                continue
            distance += abs(wrap_to_pi(heading - heading_at(lane, s)))
        if distance < best_distance:
            best, best_distance = row, distance
    return best


@njit(cache=True)
def closest_lanes(lanes: Array, vehicles: Array) -> Ints:
    """Row (n,) of each vehicle's closest lane."""
    rows = np.zeros(len(vehicles), dtype=np.int64)
    for k in range(len(vehicles)):
        rows[k] = closest_lane(lanes, vehicles[k, V_X], vehicles[k, V_Y], vehicles[k, V_HEADING])
    return rows


@njit(cache=True)
def past_end(lanes: Array, vehicles: Array, angles: Array) -> NDArray[np.bool_]:
    """(n,) whether each vehicle has passed the end of its target lane: `AbstractLane.after_end`."""
    ended = np.zeros(len(vehicles), dtype=np.bool_)
    for k in range(len(vehicles)):
        row = int(vehicles[k, V_TARGET])
        s, _ = local_coordinates(lanes[row], vehicles[k, V_X], vehicles[k, V_Y], angles[k, row])
        ended[k] = s > lanes[row, L_LENGTH] - VEHICLE_END_M / 2
    return ended
