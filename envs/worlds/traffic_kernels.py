"""The arithmetic of highway-env's traffic over tables of lanes and vehicles: kernels, and NumPy where bits matter.

Drivers, motion and the right of way; `lane_kernels` has the geometry and the columns L_* and V_* of the tables,
`collision_kernels` what follows when vehicles meet. Each function names the one of highway-env that it stands for, and
all are in its frame (x right, y down on its screen).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from .driving_maps import MAPS  # noqa: F401 - first: it says what to install when highway-env is missing
from .lane_kernels import (
    L_HEADING,
    L_KIND,
    L_LENGTH,
    L_SPEED_LIMIT,
    L_WIDTH,
    SINE,
    V_ACC_MAX,
    V_ACCELERATION,
    V_COMFORT_MAX,
    V_COMFORT_MIN,
    V_COS,
    V_CRASHED,
    V_DELTA,
    V_DISTANCE,
    V_HEADING,
    V_IMPACT_X,
    V_IMPACT_Y,
    V_LANE,
    V_LENGTH,
    V_SIN,
    V_SPEED,
    V_STEERING,
    V_TARGET,
    V_TARGET_SPEED,
    V_TIME,
    V_WIDTH,
    V_X,
    V_Y,
    VEHICLE_END_M,
    heading_at,
    local_coordinates,
    position_at,
    projected,
    slope_at,
)

# isort: split
from highway_env.vehicle.behavior import IDMVehicle
from highway_env.vehicle.kinematics import Vehicle

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

# Columns of the situation table: what an IDM driver needs to know.
S_WANTED, S_GAP, S_TARGET_GAP, S_LATERAL, S_HEADING, S_SLOPE, SITUATION_COLUMNS = range(7)

LOOK_AHEAD_S = np.arange(0.25, 3, 0.25)  # RegulatedRoad.is_conflict_possible: horizon 3 s, step 0.25 s
MAX_STEERING_RAD = IDMVehicle.MAX_STEERING_ANGLE
PURSUIT_S = IDMVehicle.TAU_PURSUIT


# --- drivers -------------------------------------------------------------------------------------------------------


@njit(cache=True)
def neighbours(
    lanes: Array, connected: Ints, offsets: Array, row: int, me: int, bodies: Array, angles: Array
) -> tuple[int, int]:
    """Indices of the bodies ahead of and behind `me` on lane `row`, -1: none. `Road.neighbour_vehicles`."""
    s, _ = local_coordinates(lanes[row], bodies[me, V_X], bodies[me, V_Y], angles[me, row])
    front, rear, s_front, s_rear = -1, -1, np.inf, -np.inf
    for k in range(len(bodies)):
        if k == me:
            continue
        for c in range(connected.shape[1]):
            other = connected[row, c]
            if other < 0:
                break
            s_k, lateral = local_coordinates(lanes[other], bodies[k, V_X], bodies[k, V_Y], angles[k, other])
            inside = -VEHICLE_END_M <= s_k < lanes[other, L_LENGTH] + VEHICLE_END_M
            if not (inside and abs(lateral) <= lanes[other, L_WIDTH] / 2 + 1):
                continue
            s_k += offsets[row, c]
            if s <= s_k and s_k <= s_front:
                front, s_front = k, s_k
            if s_k < s and s_k > s_rear:
                rear, s_rear = k, s_k
            break
    return front, rear


@njit(cache=True)
def not_zero(x: float) -> float:
    """highway_env.utils.not_zero."""
    if abs(x) > 1e-2:
        return x
    return 1e-2 if x >= 0 else -1e-2


@njit(cache=True)
def relative_gap(lanes: Array, bodies: Array, me: int, front: int, angles: Array) -> float:
    """Desired gap to the one ahead over the real one: `IDMVehicle.desired_gap` / `lane_distance_to`."""
    ego, other = bodies[me], bodies[front]
    row = int(ego[V_LANE])
    ahead, _ = local_coordinates(lanes[row], other[V_X], other[V_Y], angles[front, row])
    here, _ = local_coordinates(lanes[row], ego[V_X], ego[V_Y], angles[me, row])
    dvx = ego[V_SPEED] * ego[V_COS] - other[V_SPEED] * other[V_COS]
    dvy = ego[V_SPEED] * ego[V_SIN] - other[V_SPEED] * other[V_SIN]
    closing = dvx * ego[V_COS] + dvy * ego[V_SIN]
    ab = -ego[V_COMFORT_MAX] * ego[V_COMFORT_MIN]
    gap = ego[V_DISTANCE] + ego[V_SPEED] * ego[V_TIME] + ego[V_SPEED] * closing / (2 * math.sqrt(ab))
    return gap / not_zero(ahead - here)


@njit(cache=True)
def situations(lanes: Array, connected: Ints, offsets: Array, bodies: Array, n: int, angles: Array) -> Array:
    """What each of the first n bodies sees, (n, SITUATION_COLUMNS).

    Wanted speed, relative gaps on the own and the target lane (0: nobody ahead), offset from the target lane's centre,
    and its heading and slope a moment ahead.
    """
    out = np.zeros((n, SITUATION_COLUMNS))
    for k in range(n):
        v = bodies[k]
        own, target = int(v[V_LANE]), int(v[V_TARGET])
        limit, wanted = lanes[own, L_SPEED_LIMIT], v[V_TARGET_SPEED]
        out[k, S_WANTED] = wanted if math.isnan(limit) else min(max(wanted, 0.0), limit)
        front, _ = neighbours(lanes, connected, offsets, own, k, bodies, angles)
        if front >= 0:
            out[k, S_GAP] = relative_gap(lanes, bodies, k, front, angles)
        out[k, S_TARGET_GAP] = out[k, S_GAP]
        if own != target:
            front, _ = neighbours(lanes, connected, offsets, target, k, bodies, angles)
            out[k, S_TARGET_GAP] = relative_gap(lanes, bodies, k, front, angles) if front >= 0 else 0.0
        s, lateral = local_coordinates(lanes[target], v[V_X], v[V_Y], angles[k, target])
        ahead = s + v[V_SPEED] * PURSUIT_S
        out[k, S_LATERAL] = lateral
        if lanes[target, L_KIND] == SINE:
            out[k, S_HEADING], out[k, S_SLOPE] = lanes[target, L_HEADING], slope_at(lanes[target], ahead)
        else:
            out[k, S_HEADING] = heading_at(lanes[target], ahead)
    return out


def idm_commands(vehicles: Array, seen: Array) -> tuple[Array, Array]:
    """Acceleration (n,) m/s^2 and steering (n,) rad.

    `IDMVehicle.acceleration` and `ControlledVehicle.steering_control`.
    """
    speed, comfort = vehicles[:, V_SPEED], vehicles[:, V_COMFORT_MAX]
    ratio = np.maximum(speed, 0) / np.abs(not_zeros(seen[:, S_WANTED]))
    free = comfort * (1 - np.power(ratio, vehicles[:, V_DELTA]))
    acceleration = np.minimum(
        free - comfort * np.power(seen[:, S_GAP], 2), free - comfort * np.power(seen[:, S_TARGET_GAP], 2)
    )
    moving = not_zeros(speed)
    lateral_speed = -IDMVehicle.KP_LATERAL * seen[:, S_LATERAL]
    heading_command = np.arcsin(_clip(lateral_speed / moving, 1.0))
    reference = seen[:, S_HEADING] + np.arctan(seen[:, S_SLOPE]) + _clip(heading_command, np.pi / 4)
    rate = IDMVehicle.KP_HEADING * (((reference - vehicles[:, V_HEADING] + np.pi) % (2 * np.pi)) - np.pi)
    slip = np.arcsin(_clip(vehicles[:, V_LENGTH] / 2 / moving * rate, 1.0))
    steering = _clip(np.arctan(2 * np.tan(slip)), MAX_STEERING_RAD)
    return _clip(acceleration, vehicles[:, V_ACC_MAX]), steering


def not_zeros(x: Array) -> Array:
    """`highway_env.utils.not_zero` of each element."""
    return np.where(np.abs(x) > 1e-2, x, np.where(x >= 0, 1e-2, -1e-2))


def _clip(x: Array, bound: Any) -> Array:
    return np.minimum(np.maximum(x, -bound), bound)


# --- motion --------------------------------------------------------------------------------------------------------


def move(vehicles: Array, dt: float) -> None:
    """Advance the table by `dt` s in place: `Vehicle.step`, a bicycle model."""
    crashed, speed = vehicles[:, V_CRASHED] > 0, vehicles[:, V_SPEED].copy()
    steering = np.where(crashed, 0.0, vehicles[:, V_STEERING])
    acceleration = np.where(crashed, -1.0 * speed, vehicles[:, V_ACCELERATION])
    top, bottom = Vehicle.MAX_SPEED, Vehicle.MIN_SPEED
    acceleration = np.where(speed > top, np.minimum(acceleration, top - speed), acceleration)
    acceleration = np.where(speed < bottom, np.maximum(acceleration, bottom - speed), acceleration)
    beta = np.arctan(0.5 * np.tan(steering))
    course = vehicles[:, V_HEADING] + beta
    vehicles[:, V_X] += speed * np.cos(course) * dt
    vehicles[:, V_Y] += speed * np.sin(course) * dt
    vehicles[:, V_X] += vehicles[:, V_IMPACT_X]
    vehicles[:, V_Y] += vehicles[:, V_IMPACT_Y]
    vehicles[:, V_HEADING] += speed * np.sin(beta) / (vehicles[:, V_LENGTH] / 2) * dt
    vehicles[:, V_SPEED] += acceleration * dt
    vehicles[:, V_STEERING], vehicles[:, V_ACCELERATION] = steering, acceleration


# --- right of way --------------------------------------------------------------------------------------------------


@njit(cache=True)
def predicted_path(lanes: Array, vehicle: Array, route: Ints, times: Array) -> Array:
    """(t, 3) x, y, heading along the route at constant speed: `predict_trajectory_constant_speed`."""
    s, _ = projected(lanes[int(vehicle[V_LANE])], vehicle[V_X], vehicle[V_Y])
    path = np.empty((len(times), 3))
    for k in range(len(times)):
        longitudinal = s + vehicle[V_SPEED] * times[k]
        r = 0
        while r + 1 < len(route) and route[r + 1] >= 0 and longitudinal > lanes[route[r], L_LENGTH]:
            longitudinal -= lanes[route[r], L_LENGTH]
            r += 1
        path[k, 0], path[k, 1] = position_at(lanes[route[r]], longitudinal)
        path[k, 2] = heading_at(lanes[route[r]], longitudinal)
    return path


@njit(cache=True)
def covers_corner(
    x1: float, y1: float, h1: float, l1: float, w1: float, x2: float, y2: float, h2: float, l2: float, w2: float
) -> bool:
    """Whether rectangle 2 holds a corner, an edge's midpoint or the centre of rectangle 1: `has_corner_inside`.

    highway-env turns the point by +heading, where -heading would be right; its traffic depends on it, so it stays.
    """
    c1, s1, c2, s2 = math.cos(h1), math.sin(h1), math.cos(h2), math.sin(h2)
    for i in (-1, 0, 1):
        for j in (-1, 0, 1):
            px, py = i * l1 / 2, j * w1 / 2
            dx = c1 * px - s1 * py + x1 - x2
            dy = s1 * px + c1 * py + y1 - y2
            u, v = c2 * dx - s2 * dy, s2 * dx + c2 * dy
            if -l2 / 2 <= u <= l2 / 2 and -w2 / 2 <= v <= w2 / 2:
                return True
    return False


@njit(cache=True)
def predicted_conflicts(lanes: Array, vehicles: Array, routes: Ints, times: Array) -> Ints:
    """Pairs (c, 2) of vehicles whose predicted paths conflict: `RegulatedRoad.is_conflict_possible` over all pairs."""
    n = len(vehicles)
    paths = np.empty((n, len(times), 3))
    for k in range(n):
        paths[k] = predicted_path(lanes, vehicles[k], routes[k], times)
    found = []
    for i in range(n - 1):
        for j in range(i + 1, n):
            for t in range(len(times)):
                p, q = paths[i, t], paths[j, t]
                if math.sqrt((q[0] - p[0]) ** 2 + (q[1] - p[1]) ** 2) > vehicles[i, V_LENGTH]:
                    continue
                l1, w1 = 1.5 * vehicles[i, V_LENGTH], 0.9 * vehicles[i, V_WIDTH]
                l2, w2 = 1.5 * vehicles[j, V_LENGTH], 0.9 * vehicles[j, V_WIDTH]
                if covers_corner(p[0], p[1], p[2], l1, w1, q[0], q[1], q[2], l2, w2) or covers_corner(
                    q[0], q[1], q[2], l2, w2, p[0], p[1], p[2], l1, w1
                ):
                    found.append((i, j))
                    break
    out = np.empty((len(found), 2), dtype=np.int64)
    for k in range(len(found)):
        out[k, 0], out[k, 1] = found[k]
    return out
