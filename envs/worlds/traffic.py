"""Traffic: highway-env's vehicles and rules, with its lane geometry and arithmetic in compiled kernels.

`FastRoad` moves the same vehicles by the same rules as highway-env's `Road` and `RegulatedRoad`: per substep it gathers
their state into one table, and kernels do what highway-env does vehicle by vehicle (projections onto lanes, neighbours,
the Intelligent Driver Model, steering, the bicycle model, the closest lane, collisions, predicted conflicts). Rare
decisions (routes, lane changes, who yields) run highway-env's own code. `stock_twin` copies a road into highway-env's
own classes; the tests drive both side by side.

Everything here is in highway-env's frame (x right, y down on its screen).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from .driving_maps import RoadMap  # first: it silences pygame before highway-env imports it

# isort: split
from highway_env.road.lane import AbstractLane, CircularLane, SineLane, StraightLane
from highway_env.road.regulation import RegulatedRoad
from highway_env.road.road import Road, RoadNetwork
from highway_env.vehicle.behavior import IDMVehicle
from highway_env.vehicle.kinematics import Vehicle
from highway_env.vehicle.objects import Landmark, Obstacle

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
LaneIndex = tuple[str, str, int]

STRAIGHT, SINE, CIRCULAR = 0, 1, 2
# Columns of the lane table.
L_KIND, L_X, L_Y, L_DX, L_DY, L_LENGTH, L_WIDTH, L_HEADING, L_AMPLITUDE, L_PULSATION, L_PHASE = range(11)
L_RADIUS, L_START_PHASE, L_TURN, L_SPEED_LIMIT, LANE_COLUMNS = range(11, 16)
# Columns of the vehicle table.
V_X, V_Y, V_HEADING, V_SPEED, V_LANE, V_TARGET, V_TARGET_SPEED, V_DELTA, V_LENGTH, V_WIDTH = range(10)
V_ACC_MAX, V_COMFORT_MAX, V_COMFORT_MIN, V_DISTANCE, V_TIME, V_CRASHED, V_STEERING, V_ACCELERATION = range(10, 18)
V_IMPACT_X, V_IMPACT_Y, V_IMPACTED, VEHICLE_COLUMNS = range(18, 22)

LOOK_AHEAD_S = np.arange(0.25, 3, 0.25)  # RegulatedRoad.is_conflict_possible: horizon 3 s, step 0.25 s
MAX_STEERING_RAD = IDMVehicle.MAX_STEERING_ANGLE
VEHICLE_END_M = AbstractLane.VEHICLE_LENGTH


class TrafficVehicle(IDMVehicle):
    """One of highway-env's IDM drivers, with an identity, a kind and its own size.

    Attributes:
        identity: stable over an episode; -1 until assigned.
        kind: index into the street's vehicle kinds.
    """

    def __init__(self, *args: Any, identity: int = -1, kind: int = 0, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.identity = identity
        self.kind = kind

    def resize(self, length: float, width: float) -> None:
        """Give this vehicle its own length and width (m); highway-env's dynamics and collisions use them."""
        self.LENGTH, self.WIDTH = length, width
        self.diagonal = math.hypot(length, width)


class ConnectedVehicle(TrafficVehicle):
    """A vehicle that we drive: it holds our acceleration and steering, and still knows its route.

    Attributes:
        advised: (acceleration m/s^2, steering rad) that an IDM driver would apply now.
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.enable_lane_change = False
        self.advised = (0.0, 0.0)

    def act(self, action: dict[str, float] | None = None) -> None:
        """Hold `action`; without one, only keep following the route (highway-env's road calls this)."""
        if action is not None:
            self.action = dict(action)
        elif not self.crashed:
            self.follow_road()


class LaneTable:
    """A road network's lanes as arrays, in highway-env's own order.

    Attributes:
        rows: (L, 16) geometry, columns L_*.
        indices: lane index of each row; `row_of` is its inverse.
        connected: (L, c) rows searched for neighbours of a vehicle on that lane, itself first, -1 padded.
        offsets: (L, c) m added to the longitudinal coordinate on each of them.
    """

    def __init__(self, network: RoadNetwork, connected_lanes: bool = False) -> None:
        lanes = network.lanes_dict()
        self.indices: list[LaneIndex] = list(lanes)
        self.lanes: list[AbstractLane] = list(lanes.values())
        self.row_of = {index: row for row, index in enumerate(self.indices)}
        self.rows = np.array([_lane_row(lane) for lane in self.lanes])
        found = [_connections(network, self.row_of, index, connected_lanes) for index in self.indices]
        width = max(len(f) for f in found)
        self.connected = np.full((len(found), width), -1, dtype=np.int64)
        self.offsets = np.zeros((len(found), width))
        for row, links in enumerate(found):
            for k, (other, offset) in enumerate(links):
                self.connected[row, k], self.offsets[row, k] = other, offset


def _lane_row(lane: AbstractLane) -> Array:
    row = np.zeros(LANE_COLUMNS)
    row[L_LENGTH], row[L_WIDTH] = lane.length, lane.width_at(0.0)
    row[L_SPEED_LIMIT] = np.nan if lane.speed_limit is None else lane.speed_limit
    if type(lane) is CircularLane:
        row[L_KIND] = CIRCULAR
        row[[L_X, L_Y]] = lane.center
        row[L_RADIUS], row[L_START_PHASE], row[L_TURN] = lane.radius, lane.start_phase, lane.direction
        return row
    if type(lane) not in (StraightLane, SineLane):
        raise TypeError(f"no fast geometry for lanes of type {type(lane).__name__}")
    row[[L_X, L_Y]], row[[L_DX, L_DY]], row[L_HEADING] = lane.start, lane.direction, lane.heading
    if type(lane) is SineLane:
        row[L_KIND] = SINE
        row[L_AMPLITUDE], row[L_PULSATION], row[L_PHASE] = lane.amplitude, lane.pulsation, lane.phase
    return row


def _connections(
    network: RoadNetwork, row_of: dict[LaneIndex, int], index: LaneIndex, connected_lanes: bool
) -> list[tuple[int, float]]:
    """Lanes (row, offset m) that highway-env's `neighbour_vehicles` searches for `index`, in its order."""
    start, end, lane_id = index
    found = [(row_of[index], 0.0)]
    if not connected_lanes:
        return found
    own_length = float(network.get_lane(index).length)
    for after, lanes in network.graph.get(end, {}).items():
        found.append((row_of[end, after, lane_id if lane_id < len(lanes) else 0], own_length))
    for before, roads in network.graph.items():
        if start in roads:
            chosen = (before, start, lane_id if lane_id < len(roads[start]) else 0)
            found.append((row_of[chosen], -float(network.get_lane(chosen).length)))
    return found


class FastNetwork(RoadNetwork):
    """highway-env's road network with a compiled closest-lane search."""

    def __init__(self, network: RoadNetwork, connected_lanes: bool = False) -> None:
        super().__init__()
        self.graph = network.graph
        self.table = LaneTable(network, connected_lanes)

    def get_closest_lane_index(self, position: Array, heading: float | None = None) -> LaneIndex:
        row = closest_lane(self.table.rows, position[0], position[1], math.nan if heading is None else heading)
        return self.table.indices[row]


class FastRoad(RegulatedRoad):
    """highway-env's road, regulated or not, for `TrafficVehicle` and `ConnectedVehicle`.

    Same vehicles, rules and order of decisions as highway-env's; the tests compare them.
    """

    def __init__(self, network: FastNetwork, rng: np.random.Generator, regulated: bool, connected_lanes: bool) -> None:
        super().__init__(network=network, np_random=rng, neighbour_vehicles_connected_lanes=connected_lanes)
        self.regulated = regulated

    def act(self) -> None:
        """Decide all actions: highway-env's `Road.act`."""
        if not self.vehicles:
            return
        lanes = self.network.table
        table = vehicle_table(self.vehicles, lanes)
        ended = past_end(lanes.rows, table)
        for k, vehicle in enumerate(self.vehicles):
            if not vehicle.crashed:
                _choose_lane(vehicle, bool(ended[k]))
                table[k, V_TARGET] = lanes.row_of[vehicle.target_lane_index]
        commands = idm_commands(lanes.rows, lanes.connected, lanes.offsets, table, obstacle_table(self.objects))
        for vehicle, (acceleration, steering) in zip(self.vehicles, commands.tolist(), strict=True):
            if isinstance(vehicle, ConnectedVehicle):
                vehicle.advised = (acceleration, steering)
            elif not vehicle.crashed:
                vehicle.action = {"steering": steering, "acceleration": acceleration}

    def step(self, dt: float) -> None:
        """Move all by `dt` s: `Road.step`, and on a regulated road the right of way twice a second."""
        self.steps += 1
        if not self.vehicles:
            return
        if self.regulated and self.steps % int(1 / dt / self.REGULATION_FREQUENCY) == 0:
            self.enforce_road_rules()
        lanes = self.network.table
        table = vehicle_table(self.vehicles, lanes)
        closest = move(lanes.rows, table, dt, Vehicle.MAX_SPEED, Vehicle.MIN_SPEED)
        self._write_back(table, closest, dt)
        self._handle_all_collisions(table, dt)

    def enforce_road_rules(self) -> None:
        """Find conflicts and let one of each two yield: `RegulatedRoad.enforce_road_rules`."""
        self._release_yielding()
        lanes = self.network.table
        routes = route_table(self.vehicles, lanes)
        conflicts = predicted_conflicts(lanes.rows, vehicle_table(self.vehicles, lanes), routes, LOOK_AHEAD_S)
        for i, j in conflicts.tolist():
            yielding = self.respect_priorities(self.vehicles[i], self.vehicles[j])
            yielding.color = self.YIELDING_COLOR
            yielding.target_speed = 0
            yielding.is_yielding = True
            yielding.yield_timer = 0

    def _release_yielding(self) -> None:
        for vehicle in self.vehicles:
            if getattr(vehicle, "is_yielding", False):
                if vehicle.yield_timer >= self.YIELD_DURATION * self.REGULATION_FREQUENCY:
                    vehicle.target_speed = vehicle.lane.speed_limit
                    vehicle.is_yielding = False
                else:
                    vehicle.yield_timer += 1

    def _write_back(self, table: Array, closest: Ints, dt: float) -> None:
        lanes = self.network.table
        for vehicle, row, lane in zip(self.vehicles, table.tolist(), closest.tolist(), strict=True):
            vehicle.position[0], vehicle.position[1] = row[V_X], row[V_Y]
            vehicle.heading, vehicle.speed = row[V_HEADING], row[V_SPEED]
            vehicle.action["steering"], vehicle.action["acceleration"] = row[V_STEERING], row[V_ACCELERATION]
            vehicle.timer += dt
            vehicle.lane_index, vehicle.lane = lanes.indices[lane], lanes.lanes[lane]
            if row[V_IMPACTED]:
                vehicle.crashed, vehicle.impact = True, None

    def _handle_all_collisions(self, table: Array, dt: float) -> None:
        """`RoadObject.handle_collisions` over every pair, in highway-env's order."""
        bodies = self.vehicles + self.objects
        n = len(self.vehicles)
        if self.objects:
            table = np.vstack([table, obstacle_table(self.objects)])
        for i, j, hits, will_hit, x, y in collisions(table, n, dt).tolist():
            a, b = bodies[int(i)], bodies[int(j)]
            if will_hit:
                shift = np.array([x, y])
                if j >= n:
                    a.impact = shift
                else:
                    a.impact, b.impact = shift / 2, -shift / 2
            if hits:
                a.crashed = b.crashed = True


def _choose_lane(vehicle: TrafficVehicle, ended: bool) -> None:
    """highway-env's `follow_road` and `change_lane_policy`, entered only when they can change something."""
    if ended:
        vehicle.follow_road()
    if not vehicle.enable_lane_change:
        return
    if vehicle.lane_index != vehicle.target_lane_index or vehicle.timer > vehicle.LANE_CHANGE_DELAY:
        vehicle.change_lane_policy()


def vehicle_table(vehicles: list[TrafficVehicle], lanes: LaneTable) -> Array:
    """State of n vehicles as one (n, VEHICLE_COLUMNS) array."""
    row_of = lanes.row_of
    rows = []
    for v in vehicles:
        impact, action = v.impact, v.action
        x, y = v.position.tolist()
        rows.append(
            (
                x,
                y,
                v.heading,
                v.speed,
                row_of[v.lane_index],
                row_of[v.target_lane_index],
                v.target_speed,
                v.DELTA,
                v.LENGTH,
                v.WIDTH,
                v.ACC_MAX,
                v.COMFORT_ACC_MAX,
                v.COMFORT_ACC_MIN,
                v.DISTANCE_WANTED,
                v.TIME_WANTED,
                v.crashed,
                action["steering"],
                action["acceleration"],
                0.0 if impact is None else impact[0],
                0.0 if impact is None else impact[1],
                impact is not None,
            )
        )
    table = np.zeros((len(rows), VEHICLE_COLUMNS))
    if rows:
        table[:, :VEHICLE_COLUMNS] = rows
    return table


def obstacle_table(objects: list[Any]) -> Array:
    """Position, heading, speed and size of road objects as (k, VEHICLE_COLUMNS); landmarks are no obstacles."""
    solid = [o for o in objects if not isinstance(o, Landmark)]
    table = np.zeros((len(solid), VEHICLE_COLUMNS))
    for row, o in zip(table, solid, strict=True):
        row[V_X], row[V_Y], row[V_HEADING], row[V_SPEED] = o.position[0], o.position[1], o.heading, o.speed
        row[V_LENGTH], row[V_WIDTH] = o.LENGTH, o.WIDTH
    return table


def route_table(vehicles: list[TrafficVehicle], lanes: LaneTable) -> Ints:
    """Rows of the lanes of each vehicle's route (n, r), -1 padded: `position_heading_along_route`'s choice of lanes."""
    routes = []
    for v in vehicles:
        lane_id = v.lane_index[2]
        route = []
        for a, b, k in v.route or [v.lane_index]:
            same = k is None and (a, b, lane_id) in lanes.row_of
            route.append(lanes.row_of[a, b, lane_id if same else (k or 0)])
        routes.append(route)
    table = np.full((len(routes), max(len(r) for r in routes)), -1, dtype=np.int64)
    for row, route in zip(table, routes, strict=True):
        row[: len(route)] = route
    return table


# --- lane geometry -------------------------------------------------------------------------------------------------


@njit(cache=True)
def wrap_to_pi(x: float) -> float:
    """highway_env.utils.wrap_to_pi."""
    return ((x + math.pi) % (2 * math.pi)) - math.pi


@njit(cache=True)
def not_zero(x: float) -> float:
    """highway_env.utils.not_zero."""
    if abs(x) > 1e-2:
        return x
    return 1e-2 if x >= 0 else -1e-2


@njit(cache=True)
def local_coordinates(lane: Array, x: float, y: float) -> tuple[float, float]:
    """(longitudinal, lateral) m of a point on a lane: `AbstractLane.local_coordinates`."""
    dx, dy = x - lane[L_X], y - lane[L_Y]
    if lane[L_KIND] == CIRCULAR:
        turned = wrap_to_pi(math.atan2(dy, dx) - lane[L_START_PHASE])
        phi = lane[L_START_PHASE] + turned
        longitudinal = lane[L_TURN] * (phi - lane[L_START_PHASE]) * lane[L_RADIUS]
        return longitudinal, lane[L_TURN] * (lane[L_RADIUS] - math.sqrt(dx * dx + dy * dy))
    longitudinal = dx * lane[L_DX] + dy * lane[L_DY]
    lateral = dy * lane[L_DX] - dx * lane[L_DY]
    if lane[L_KIND] == SINE:
        lateral -= lane[L_AMPLITUDE] * math.sin(lane[L_PULSATION] * longitudinal + lane[L_PHASE])
    return longitudinal, lateral


@njit(cache=True)
def heading_at(lane: Array, longitudinal: float) -> float:
    """Heading (rad) of a lane: `AbstractLane.heading_at`."""
    if lane[L_KIND] == CIRCULAR:
        phi = lane[L_TURN] * longitudinal / lane[L_RADIUS] + lane[L_START_PHASE]
        return phi + math.pi / 2 * lane[L_TURN]
    if lane[L_KIND] == SINE:
        slope = lane[L_AMPLITUDE] * lane[L_PULSATION] * math.cos(lane[L_PULSATION] * longitudinal + lane[L_PHASE])
        return lane[L_HEADING] + math.atan(slope)
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
        s, lateral = local_coordinates(lane, x, y)
        distance = abs(lateral) + max(s - lane[L_LENGTH], 0.0) + max(0.0 - s, 0.0)
        if not math.isnan(heading):
            if distance >= best_distance:
                continue
            distance += abs(wrap_to_pi(heading - heading_at(lane, s)))
        if distance < best_distance:
            best, best_distance = row, distance
    return best


@njit(cache=True)
def past_end(lanes: Array, vehicles: Array) -> NDArray[np.bool_]:
    """(n,) whether each vehicle has passed the end of its target lane: `AbstractLane.after_end`."""
    ended = np.zeros(len(vehicles), dtype=np.bool_)
    for k in range(len(vehicles)):
        lane = lanes[int(vehicles[k, V_TARGET])]
        s, _ = local_coordinates(lane, vehicles[k, V_X], vehicles[k, V_Y])
        ended[k] = s > lane[L_LENGTH] - VEHICLE_END_M / 2
    return ended


# --- drivers -------------------------------------------------------------------------------------------------------


@njit(cache=True)
def front_neighbour(
    lanes: Array, connected: Ints, offsets: Array, row: int, me: int, vehicles: Array, obstacles: Array
) -> int:
    """Index of the one ahead of vehicle `me` on lane `row` (vehicles, then obstacles; -1: none).

    `Road.neighbour_vehicles`, preceding vehicle only.
    """
    s, _ = local_coordinates(lanes[row], vehicles[me, V_X], vehicles[me, V_Y])
    n = len(vehicles)
    front, s_front = -1, np.inf
    for k in range(n + len(obstacles)):
        if k == me:
            continue
        x, y = (vehicles[k, V_X], vehicles[k, V_Y]) if k < n else (obstacles[k - n, V_X], obstacles[k - n, V_Y])
        for c in range(connected.shape[1]):
            if connected[row, c] < 0:
                break
            lane = lanes[connected[row, c]]
            s_k, lateral = local_coordinates(lane, x, y)
            if not (abs(lateral) <= lane[L_WIDTH] / 2 + 1 and -VEHICLE_END_M <= s_k < lane[L_LENGTH] + VEHICLE_END_M):
                continue
            s_k += offsets[row, c]
            if s <= s_k and (front < 0 or s_k <= s_front):
                front, s_front = k, s_k
            break
    return front


@njit(cache=True)
def idm_acceleration(lanes: Array, vehicles: Array, me: int, front: int, obstacles: Array) -> float:
    """Acceleration (m/s^2) of the Intelligent Driver Model: `IDMVehicle.acceleration`."""
    ego = vehicles[me]
    lane = lanes[int(ego[V_LANE])]
    wanted = ego[V_TARGET_SPEED]
    if not math.isnan(lane[L_SPEED_LIMIT]):
        wanted = min(max(wanted, 0.0), lane[L_SPEED_LIMIT])
    acceleration = ego[V_COMFORT_MAX] * (1 - (max(ego[V_SPEED], 0.0) / abs(not_zero(wanted))) ** ego[V_DELTA])
    if front < 0:
        return acceleration
    n = len(vehicles)
    other = vehicles[front] if front < n else obstacles[front - n]
    ahead, _ = local_coordinates(lane, other[V_X], other[V_Y])
    here, _ = local_coordinates(lane, ego[V_X], ego[V_Y])
    c, s = math.cos(ego[V_HEADING]), math.sin(ego[V_HEADING])
    dvx = ego[V_SPEED] * c - other[V_SPEED] * math.cos(other[V_HEADING])
    dvy = ego[V_SPEED] * s - other[V_SPEED] * math.sin(other[V_HEADING])
    closing = dvx * c + dvy * s
    ab = -ego[V_COMFORT_MAX] * ego[V_COMFORT_MIN]
    gap = ego[V_DISTANCE] + ego[V_SPEED] * ego[V_TIME] + ego[V_SPEED] * closing / (2 * math.sqrt(ab))
    return acceleration - ego[V_COMFORT_MAX] * (gap / not_zero(ahead - here)) ** 2


@njit(cache=True)
def clip(x: float, low: float, high: float) -> float:
    """x limited to [low, high]."""
    return min(max(x, low), high)


@njit(cache=True)
def lane_steering(lane: Array, x: float, y: float, heading: float, speed: float, length: float) -> float:
    """Steering angle (rad) that follows a lane: `ControlledVehicle.steering_control`."""
    s, lateral = local_coordinates(lane, x, y)
    future_heading = heading_at(lane, s + speed * 0.1)
    lateral_speed = -(1 / 0.6) * lateral
    heading_command = math.asin(clip(lateral_speed / not_zero(speed), -1.0, 1.0))
    reference = future_heading + clip(heading_command, -math.pi / 4, math.pi / 4)
    rate = 1 / 0.2 * wrap_to_pi(reference - heading)
    slip = math.asin(clip(length / 2 / not_zero(speed) * rate, -1.0, 1.0))
    return clip(math.atan(2 * math.tan(slip)), -MAX_STEERING_RAD, MAX_STEERING_RAD)


@njit(cache=True)
def idm_commands(lanes: Array, connected: Ints, offsets: Array, vehicles: Array, obstacles: Array) -> Array:
    """(n, 2) acceleration (m/s^2) and steering (rad) of every vehicle: `IDMVehicle.act` after its choice of lane."""
    commands = np.zeros((len(vehicles), 2))
    for k in range(len(vehicles)):
        v = vehicles[k]
        own, target = int(v[V_LANE]), int(v[V_TARGET])
        front = front_neighbour(lanes, connected, offsets, own, k, vehicles, obstacles)
        acceleration = idm_acceleration(lanes, vehicles, k, front, obstacles)
        if own != target:
            front = front_neighbour(lanes, connected, offsets, target, k, vehicles, obstacles)
            acceleration = min(acceleration, idm_acceleration(lanes, vehicles, k, front, obstacles))
        commands[k, 0] = clip(acceleration, -v[V_ACC_MAX], v[V_ACC_MAX])
        commands[k, 1] = lane_steering(lanes[target], v[V_X], v[V_Y], v[V_HEADING], v[V_SPEED], v[V_LENGTH])
    return commands


# --- motion --------------------------------------------------------------------------------------------------------


@njit(cache=True)
def move(lanes: Array, vehicles: Array, dt: float, max_speed: float, min_speed: float) -> Ints:
    """Advance the table by `dt` s (`Vehicle.step`, bicycle model) and return the closest lane (n,) of each."""
    closest = np.zeros(len(vehicles), dtype=np.int64)
    for k in range(len(vehicles)):
        v = vehicles[k]
        if v[V_CRASHED]:
            v[V_STEERING], v[V_ACCELERATION] = 0.0, -1.0 * v[V_SPEED]
        if v[V_SPEED] > max_speed:
            v[V_ACCELERATION] = min(v[V_ACCELERATION], max_speed - v[V_SPEED])
        elif v[V_SPEED] < min_speed:
            v[V_ACCELERATION] = max(v[V_ACCELERATION], min_speed - v[V_SPEED])
        beta = math.atan(0.5 * math.tan(v[V_STEERING]))
        v[V_X] += v[V_SPEED] * math.cos(v[V_HEADING] + beta) * dt + v[V_IMPACT_X]
        v[V_Y] += v[V_SPEED] * math.sin(v[V_HEADING] + beta) * dt + v[V_IMPACT_Y]
        v[V_HEADING] += v[V_SPEED] * math.sin(beta) / (v[V_LENGTH] / 2) * dt
        v[V_SPEED] += v[V_ACCELERATION] * dt
        closest[k] = closest_lane(lanes, v[V_X], v[V_Y], v[V_HEADING])
    return closest


# --- collisions ----------------------------------------------------------------------------------------------------


@njit(cache=True)
def corners(x: float, y: float, heading: float, length: float, width: float) -> Array:
    """(4, 2) m corners of a rectangle in order around it: `RoadObject.polygon` without its closing point."""
    c, s = math.cos(heading), math.sin(heading)
    out = np.empty((4, 2))
    for k in range(4):
        dx = -length / 2 if k < 2 else length / 2
        dy = width / 2 if k == 1 or k == 2 else -width / 2
        out[k, 0] = x + c * dx - s * dy
        out[k, 1] = y + s * dx + c * dy
    return out


@njit(cache=True)
def polygons_intersect(
    a: Array, b: Array, ax: float, ay: float, bx: float, by: float
) -> tuple[bool, bool, float, float]:
    """Two rectangles displaced by (ax, ay) and (bx, by): intersecting, will intersect, translation (x, y).

    `utils.are_polygons_intersecting`.
    """
    intersecting, will_intersect = True, True
    shortest, axis_x, axis_y = np.inf, 0.0, 0.0
    toward_x = a[:, 0].mean() - b[:, 0].mean()
    toward_y = a[:, 1].mean() - b[:, 1].mean()
    for polygon in (a, b):
        for k in range(4):
            nx = -(polygon[(k + 1) % 4, 1] - polygon[k, 1])
            ny = polygon[(k + 1) % 4, 0] - polygon[k, 0]
            norm = math.sqrt(nx * nx + ny * ny)
            nx, ny = nx / norm, ny / norm
            a_projected, b_projected = a[:, 0] * nx + a[:, 1] * ny, b[:, 0] * nx + b[:, 1] * ny
            min_a, max_a = a_projected.min(), a_projected.max()
            min_b, max_b = b_projected.min(), b_projected.max()
            if (min_b - max_a if min_a < min_b else min_a - max_b) > 0:
                intersecting = False
            moved = nx * (ax - bx) + ny * (ay - by)
            if moved < 0:
                min_a += moved
            else:
                max_a += moved
            distance = min_b - max_a if min_a < min_b else min_a - max_b
            if distance > 0:
                will_intersect = False
            if not intersecting and not will_intersect:
                break
            if abs(distance) < shortest:
                shortest = abs(distance)
                sign = 1.0 if toward_x * nx + toward_y * ny > 0 else -1.0
                axis_x, axis_y = sign * nx, sign * ny
    if will_intersect:
        return intersecting, will_intersect, shortest * axis_x, shortest * axis_y
    return intersecting, will_intersect, 0.0, 0.0


@njit(cache=True)
def collisions(bodies: Array, n: int, dt: float) -> Array:
    """Pairs (i, j) of bodies, i one of the first n, that touch or will within `dt` s.

    Rows [i, j, intersecting, will intersect, translation x, y], in the order of `Road.step`: for every vehicle the
    later vehicles, then all obstacles.
    """
    found = []
    for i in range(n):
        a = bodies[i]
        for j in range(i + 1, len(bodies)):
            b = bodies[j]
            reach = (math.hypot(a[V_LENGTH], a[V_WIDTH]) + math.hypot(b[V_LENGTH], b[V_WIDTH])) / 2 + a[V_SPEED] * dt
            if math.sqrt((b[V_X] - a[V_X]) ** 2 + (b[V_Y] - a[V_Y]) ** 2) > reach:
                continue
            hits, will_hit, x, y = polygons_intersect(
                corners(a[V_X], a[V_Y], a[V_HEADING], a[V_LENGTH], a[V_WIDTH]),
                corners(b[V_X], b[V_Y], b[V_HEADING], b[V_LENGTH], b[V_WIDTH]),
                a[V_SPEED] * math.cos(a[V_HEADING]) * dt,
                a[V_SPEED] * math.sin(a[V_HEADING]) * dt,
                b[V_SPEED] * math.cos(b[V_HEADING]) * dt,
                b[V_SPEED] * math.sin(b[V_HEADING]) * dt,
            )
            if hits or will_hit:
                found.append((float(i), float(j), 1.0 if hits else 0.0, 1.0 if will_hit else 0.0, x, y))
    out = np.empty((len(found), 6))
    for k in range(len(found)):
        for c in range(6):
            out[k, c] = found[k][c]
    return out


# --- right of way --------------------------------------------------------------------------------------------------


@njit(cache=True)
def predicted_path(lanes: Array, vehicle: Array, route: Ints, times: Array) -> Array:
    """(t, 3) x, y, heading along the route at constant speed: `predict_trajectory_constant_speed`."""
    s, _ = local_coordinates(lanes[int(vehicle[V_LANE])], vehicle[V_X], vehicle[V_Y])
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


# --- highway-env's own, for comparison -----------------------------------------------------------------------------


def make_road(road_map: RoadMap, rng: np.random.Generator, connected_lanes: bool = False) -> FastRoad:
    """An empty fast road of this map, with highway-env's own obstacles on it."""
    road = FastRoad(FastNetwork(road_map.network, connected_lanes), rng, road_map.regulated, connected_lanes)
    road.objects = [Obstacle(road, position) for position in road_map.obstacles]
    return road


def stock_twin(road: FastRoad) -> Road:
    """highway-env's own `Road` or `RegulatedRoad`, lanes and vehicle code, in the same state.

    Connected vehicles become ones that hold their present action.
    """
    network = RoadNetwork()
    network.graph = road.network.graph
    kind = RegulatedRoad if road.regulated else Road
    twin = kind(
        network=network,
        np_random=np.random.default_rng(0),
        neighbour_vehicles_connected_lanes=road.neighbour_vehicles_connected_lanes,
    )
    twin.objects = [_twin_body(o, twin) for o in road.objects]
    twin.vehicles = [_twin_body(v, twin) for v in road.vehicles]
    if road.regulated:
        twin.steps = road.steps
    return twin


def _twin_body(body: Any, road: Road) -> Any:
    twin = body.__class__.__new__(body.__class__)
    twin.__dict__.update(body.__dict__)
    twin.road, twin.position = road, body.position.copy()
    if isinstance(body, Vehicle):
        twin.action = dict(body.action)
        twin.route = None if body.route is None else list(body.route)
        twin.impact = None if body.impact is None else np.array(body.impact)
    return twin
