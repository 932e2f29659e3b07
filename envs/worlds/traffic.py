"""Traffic: highway-env's vehicles and rules, with its lane geometry and arithmetic in compiled kernels.

`FastRoad` moves the same vehicles by the same rules as highway-env's `Road` and `RegulatedRoad`: per substep it gathers
their state into one table, and kernels do what highway-env does vehicle by vehicle (projections onto lanes, neighbours,
the Intelligent Driver Model, steering, the bicycle model, the closest lane, collisions, predicted conflicts). Rare
decisions (routes, lane changes, who yields) run highway-env's own code. `stock_twin` copies a road into highway-env's
own classes; the tests drive both side by side. Traffic amplifies a difference in the last bit, so wherever such a
difference would reach a vehicle's motion the transcendental functions are NumPy's, as in highway-env, and not the
compiler's.

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
V_IMPACT_X, V_IMPACT_Y, V_IMPACTED, V_COS, V_SIN, VEHICLE_COLUMNS = range(18, 24)
# Columns of the situation table: what an IDM driver needs to know.
S_WANTED, S_GAP, S_TARGET_GAP, S_LATERAL, S_HEADING, S_SLOPE, SITUATION_COLUMNS = range(7)

LOOK_AHEAD_S = np.arange(0.25, 3, 0.25)  # RegulatedRoad.is_conflict_possible: horizon 3 s, step 0.25 s
MAX_STEERING_RAD = IDMVehicle.MAX_STEERING_ANGLE
VEHICLE_END_M = AbstractLane.VEHICLE_LENGTH
PURSUIT_S = IDMVehicle.TAU_PURSUIT


class TrafficVehicle(IDMVehicle):
    """One of highway-env's IDM drivers, with an identity, a kind and its own size.

    Attributes:
        identity: stable over an episode; -1 until assigned.
        kind: index into `KINDS`.
    """

    # highway-env's intersection changes these on its IDMVehicle class for the whole process; ours must not notice.
    ACC_MAX, COMFORT_ACC_MAX, COMFORT_ACC_MIN = 6.0, 3.0, -5.0
    DISTANCE_WANTED, TIME_WANTED, DELTA = 10.0, 1.5, 4.0

    def __init__(self, *args: Any, identity: int = -1, kind: int = 0, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.identity = identity
        self.kind = kind

    def resize(self, length: float, width: float) -> None:
        """Give this vehicle its own length and width (m); highway-env's dynamics and collisions use them."""
        self.LENGTH, self.WIDTH = length, width
        self.diagonal = math.sqrt(length**2 + width**2)


class ConnectedVehicle(TrafficVehicle):
    """A vehicle that we drive: it holds our acceleration and steering, and still knows its route.

    Attributes:
        cruise_speed: m/s that an IDM driver would not exceed in it, whatever highway-env's rules set.
    """

    cruise_speed = math.inf

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.enable_lane_change = False

    @property
    def target_speed(self) -> float:
        """m/s that an IDM driver would like to go."""
        return self._target_speed

    @target_speed.setter
    def target_speed(self, speed: float) -> None:
        self._target_speed = min(speed, self.cruise_speed)

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
        self._circular = np.flatnonzero(self.rows[:, L_KIND] == CIRCULAR)

    def angles(self, bodies: Array) -> Array:
        """Direction (rad) of each body from the centre of each circular lane, (n, L); 0 for other lanes."""
        out = np.zeros((len(bodies), len(self.rows)))
        lanes = self.rows[self._circular]
        out[:, self._circular] = np.arctan2(bodies[:, V_Y, None] - lanes[:, L_Y], bodies[:, V_X, None] - lanes[:, L_X])
        return out


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
        self.connected_lanes = connected_lanes
        self.table = LaneTable(network, connected_lanes)

    def get_closest_lane_index(self, position: Array, heading: float | None = None) -> LaneIndex:
        row = closest_lane(self.table.rows, position[0], position[1], math.nan if heading is None else heading)
        return self.table.indices[row]


class FastRoad(RegulatedRoad):
    """highway-env's road, regulated or not, for `TrafficVehicle` and `ConnectedVehicle`.

    Same vehicles, rules and order of decisions as highway-env's; the tests compare them.
    """

    def __init__(self, network: FastNetwork, rng: np.random.Generator, regulated: bool) -> None:
        super().__init__(network=network, np_random=rng, neighbour_vehicles_connected_lanes=network.connected_lanes)
        self.regulated = regulated

    def act(self) -> None:
        """Decide all actions: highway-env's `Road.act`."""
        if not self.vehicles:
            return
        lanes = self.network.table
        bodies, angles = self._bodies()
        ended = past_end(lanes.rows, bodies, angles).tolist()
        for k, vehicle in enumerate(self.vehicles):
            if not vehicle.crashed and _choose_lane(vehicle, ended[k]):
                bodies[k, V_TARGET] = lanes.row_of[vehicle.target_lane_index]
        for vehicle, (pedal, wheel) in zip(self.vehicles, self._commands(bodies, angles), strict=True):
            if not (vehicle.crashed or isinstance(vehicle, ConnectedVehicle)):
                vehicle.action = {"steering": wheel, "acceleration": pedal}

    def advice(self) -> list[tuple[float, float]]:
        """Acceleration (m/s^2) and steering (rad) that the IDM gives each vehicle on its present target lane."""
        return self._commands(*self._bodies())

    def _commands(self, bodies: Array, angles: Array) -> list[tuple[float, float]]:
        lanes, n = self.network.table, len(self.vehicles)
        seen = situations(lanes.rows, lanes.connected, lanes.offsets, bodies, n, angles)
        accelerations, steering = idm_commands(bodies[:n], seen)
        return list(zip(accelerations.tolist(), steering.tolist(), strict=True))

    def conflicts(self) -> list[tuple[int, int]]:
        """Pairs of vehicles that would meet within 3 s along their routes at their present speeds."""
        lanes = self.network.table
        table, routes = vehicle_table(self.vehicles, lanes), route_table(self.vehicles, lanes)
        return [(i, j) for i, j in predicted_conflicts(lanes.rows, table, routes, LOOK_AHEAD_S).tolist()]

    def _bodies(self) -> tuple[Array, Array]:
        """The table of vehicles and obstacles, and their directions from the lanes' centres."""
        bodies = np.vstack([vehicle_table(self.vehicles, self.network.table), obstacle_table(self.objects)])
        return bodies, self.network.table.angles(bodies)

    def step(self, dt: float) -> None:
        """Move all by `dt` s: `Road.step`, and on a regulated road the right of way twice a second."""
        self.steps += 1
        if not self.vehicles:
            return
        if self.regulated and self.steps % int(1 / dt / self.REGULATION_FREQUENCY) == 0:
            self.enforce_road_rules()
        lanes = self.network.table
        table = vehicle_table(self.vehicles, lanes)
        move(table, dt)
        self._write_back(table, closest_lanes(lanes.rows, table), dt)
        table[:, V_COS], table[:, V_SIN] = np.cos(table[:, V_HEADING]), np.sin(table[:, V_HEADING])
        self._handle_all_collisions(table, dt)

    def neighbour_vehicles(self, vehicle: Any, lane_index: LaneIndex | None = None) -> tuple[Any, Any]:
        """The ones ahead of and behind a vehicle on a lane: `Road.neighbour_vehicles`."""
        lanes = self.network.table
        others = [*self.vehicles, *(o for o in self.objects if not isinstance(o, Landmark))]
        bodies = np.zeros((len(others), VEHICLE_COLUMNS))
        bodies[:, :2] = [o.position for o in others]
        row = lanes.row_of[lane_index or vehicle.lane_index]
        me = others.index(vehicle)
        found = neighbours(lanes.rows, lanes.connected, lanes.offsets, row, me, bodies, lanes.angles(bodies))
        front, rear = (others[k] if k >= 0 else None for k in found)
        return front, rear

    def enforce_road_rules(self) -> None:
        """Find conflicts and let one of each two yield: `RegulatedRoad.enforce_road_rules`."""
        self._release_yielding()
        for i, j in self.conflicts():
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
        for i, j, hits, will_hit in collisions(table, n, dt).tolist():
            a, b = bodies[i], bodies[j]
            if will_hit:
                shift = translation(a.polygon(), b.polygon(), a.velocity * dt, b.velocity * dt)
                if j >= n:
                    a.impact = shift
                else:
                    a.impact, b.impact = shift / 2, -shift / 2
            if hits:
                a.crashed = b.crashed = True


def _choose_lane(vehicle: TrafficVehicle, ended: bool) -> bool:
    """highway-env's `follow_road` and `change_lane_policy`, entered only when they can change something; whether so."""
    if ended:
        vehicle.follow_road()
    if not vehicle.enable_lane_change:
        return ended
    if vehicle.lane_index != vehicle.target_lane_index or vehicle.timer > vehicle.LANE_CHANGE_DELAY:
        vehicle.change_lane_policy()
        return True
    return ended


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
    table[:, :V_COS] = rows
    table[:, V_COS], table[:, V_SIN] = np.cos(table[:, V_HEADING]), np.sin(table[:, V_HEADING])
    return table


def obstacle_table(objects: list[Any]) -> Array:
    """Position, heading, speed and size of road objects as (k, VEHICLE_COLUMNS); landmarks are no obstacles."""
    solid = [o for o in objects if not isinstance(o, Landmark)]
    table = np.zeros((len(solid), VEHICLE_COLUMNS))
    for row, o in zip(table, solid, strict=True):
        row[V_X], row[V_Y], row[V_HEADING], row[V_SPEED] = o.position[0], o.position[1], o.heading, o.speed
        row[V_LENGTH], row[V_WIDTH] = o.LENGTH, o.WIDTH
        row[V_COS], row[V_SIN] = np.cos(o.heading), np.sin(o.heading)
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
def rectangles_intersect(a: Array, b: Array, ax: float, ay: float, bx: float, by: float) -> tuple[bool, bool]:
    """Whether two rectangles (4, 2) intersect now, and after moving by (ax, ay) and (bx, by).

    The yes or no of `utils.are_polygons_intersecting`.
    """
    intersecting, will_intersect = True, True
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
            if (min_b - max_a if min_a < min_b else min_a - max_b) > 0:
                will_intersect = False
            if not intersecting and not will_intersect:
                return False, False
    return intersecting, will_intersect


@njit(cache=True)
def translation(a: Array, b: Array, moved_a: Array, moved_b: Array) -> Array:
    """(2,) m by which highway-env moves colliding rectangles apart; a, b (5, 2) are its closed polygons.

    The translation of `utils.are_polygons_intersecting`.
    """
    shortest, axis = np.inf, np.zeros(2)
    toward_x, toward_y = a[:4, 0].mean() - b[:4, 0].mean(), a[:4, 1].mean() - b[:4, 1].mean()
    for polygon in (a, b):
        for k in range(4):
            nx, ny = -polygon[k + 1, 1] + polygon[k, 1], polygon[k + 1, 0] - polygon[k, 0]
            norm = math.sqrt(nx * nx + ny * ny)
            nx, ny = nx / norm, ny / norm
            a_projected, b_projected = a[:, 0] * nx + a[:, 1] * ny, b[:, 0] * nx + b[:, 1] * ny
            min_a, max_a = a_projected.min(), a_projected.max()
            min_b, max_b = b_projected.min(), b_projected.max()
            moved = nx * (moved_a[0] - moved_b[0]) + ny * (moved_a[1] - moved_b[1])
            if moved < 0:
                min_a += moved
            else:
                max_a += moved
            distance = min_b - max_a if min_a < min_b else min_a - max_b
            if abs(distance) < shortest:
                shortest = abs(distance)
                sign = 1.0 if toward_x * nx + toward_y * ny > 0 else -1.0
                axis[0], axis[1] = sign * nx, sign * ny
    return shortest * axis


@njit(cache=True)
def diagonal(body: Array) -> float:
    """Length (m) of a body's diagonal."""
    return math.sqrt(body[V_LENGTH] ** 2 + body[V_WIDTH] ** 2)


@njit(cache=True)
def outline(body: Array) -> Array:
    """(4, 2) m corners of a body."""
    return corners(body[V_X], body[V_Y], body[V_HEADING], body[V_LENGTH], body[V_WIDTH])


@njit(cache=True)
def collisions(bodies: Array, n: int, dt: float) -> Ints:
    """Pairs of bodies, the first of them one of the first n, that touch or will within `dt` s.

    Rows [i, j, intersecting, will intersect], in the order of `Road.step`: for every vehicle the
    later vehicles, then all obstacles.
    """
    found = [(0, 0, 0, 0)]
    for i in range(n):
        a = bodies[i]
        for j in range(i + 1, len(bodies)):
            b = bodies[j]
            reach = (diagonal(a) + diagonal(b)) / 2 + a[V_SPEED] * dt
            if math.sqrt((b[V_X] - a[V_X]) ** 2 + (b[V_Y] - a[V_Y]) ** 2) > reach:
                continue
            hits, will_hit = rectangles_intersect(
                outline(a),
                outline(b),
                a[V_SPEED] * a[V_COS] * dt,
                a[V_SPEED] * a[V_SIN] * dt,
                b[V_SPEED] * b[V_COS] * dt,
                b[V_SPEED] * b[V_SIN] * dt,
            )
            if hits or will_hit:
                found.append((i, j, 1 if hits else 0, 1 if will_hit else 0))
    out = np.empty((len(found) - 1, 4), dtype=np.int64)
    for k in range(1, len(found)):
        out[k - 1, 0], out[k - 1, 1], out[k - 1, 2], out[k - 1, 3] = found[k]
    return out


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


# --- highway-env's own, for comparison -----------------------------------------------------------------------------


def make_road(road_map: RoadMap, rng: np.random.Generator, network: FastNetwork) -> FastRoad:
    """An empty fast road of this map, with highway-env's own obstacles on it."""
    road = FastRoad(network, rng, road_map.regulated)
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
