"""Traffic: highway-env's vehicles and rules, with its lane geometry and arithmetic in compiled kernels.

`FastRoad` moves the same vehicles by the same rules as highway-env's `Road` and `RegulatedRoad`: per substep it gathers
their state into one table, and kernels do what highway-env does vehicle by vehicle (projections onto lanes, neighbours,
the Intelligent Driver Model, steering, the bicycle model, the closest lane, collisions, predicted conflicts). Rare
decisions (routes, lane changes, who yields) run highway-env's own code. `traffic_twin` copies a road into highway-env's
own classes; the tests drive both side by side. Traffic amplifies a difference in the last bit, so wherever such a
difference would reach a vehicle's motion the transcendental functions are NumPy's, as in highway-env, and not the
compiler's. Sums of two products remain: BLAS, which highway-env calls for them, rounds them once on CPUs with AVX-512.

Everything here is in highway-env's frame (x right, y down on its screen).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from .collision_kernels import collisions, translation
from .driving_maps import RoadMap  # first: it silences pygame before highway-env imports it
from .lane_kernels import (
    V_ACCELERATION,
    V_COS,
    V_HEADING,
    V_IMPACTED,
    V_LENGTH,
    V_SIN,
    V_SPEED,
    V_STEERING,
    V_TARGET,
    V_WIDTH,
    V_X,
    V_Y,
    VEHICLE_COLUMNS,
    closest_lanes,
    past_end,
)
from .traffic_kernels import LOOK_AHEAD_S, idm_commands, move, neighbours, predicted_conflicts, situations
from .traffic_lanes import FastNetwork, LaneIndex, LaneTable
from .traffic_vehicles import ConnectedVehicle, TrafficVehicle

# isort: split
from highway_env.road.regulation import RegulatedRoad
from highway_env.vehicle.objects import Landmark, Obstacle

Array = NDArray[np.float64]
Ints = NDArray[np.int64]


class FastRoad(RegulatedRoad):
    """highway-env's road, regulated or not, for `TrafficVehicle` and `ConnectedVehicle`.

    Same vehicles, rules and order of decisions as highway-env's; the tests compare them.
    """

    def __init__(self, network: FastNetwork, rng: np.random.Generator, regulated: bool) -> None:
        super().__init__(network=network, np_random=rng, neighbour_vehicles_connected_lanes=network.connected_lanes)
        self.regulated = regulated

    def bind(self) -> None:
        """Tell every vehicle and obstacle that this is its road; they cannot move without one."""
        for body in (*self.vehicles, *self.objects):
            body.road = self

    def unbind(self) -> None:
        """Undo `bind`: a road that nobody holds is then freed at once, and not when Python looks for cycles.

        Python seldom does in a big process. Roads of a thousand episodes would be waiting by then.
        """
        for body in (*self.vehicles, *self.objects):
            body.road = None

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


def make_road(road_map: RoadMap, rng: np.random.Generator, network: FastNetwork) -> FastRoad:
    """An empty fast road of this map, with highway-env's own obstacles on it."""
    road = FastRoad(network, rng, road_map.regulated)
    road.objects = [Obstacle(road, position) for position in road_map.obstacles]
    return road
