"""Connected driving: highway-env's traffic on a street full of look-alikes, watched by the cars that we drive.

The world frame mirrors highway-env's y axis: highway-env is right-handed with z into the screen, our z points up.
Headings and steering turn over with it, so a positive steering control turns left. `to_world` and its callers are the
only place where the two frames meet.
"""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from .collision_kernels import touching
from .driving_maps import RoadMap, Start, road_map
from .driving_params import CAR, CLASSES, KINDS, PRESETS, WHITE, DrivingParams, Tint, draw_kind, draw_paint, preset
from .kerbs import Ground, to_world
from .lighting import sample_light
from .road_surface import road_surface
from .street import Catalogue, Street
from .street_meshes import barrier, building, bus, car, person, post, sign, signal, tree, truck, van
from .traffic import FastRoad, Obstacle, make_road
from .traffic_lanes import FastNetwork
from .traffic_vehicles import ConnectedVehicle, TrafficVehicle
from .world import Array, Light, Mesh, SceneGenerationError, Snapshot

SIMULATION_HZ = 15
SUBSTEPS = 3
STATE_COLUMNS = ("speed_m_s", "yaw_rate_rad_s", "lane_offset_m", "lane_heading_rad", "speed_limit_m_s")
MAX_TRIES = 30
GIVE_WAY_M_S2 = -4.0
GROUNDS = ((104, 118, 84), (118, 120, 96), (122, 116, 104), (96, 110, 92))
FOOTPRINTS = ((12.0, 9.0), (9.0, 9.0), (15.0, 10.0), (10.0, 8.0))
FLOORS = (3, 5, 4, 2)

__all__ = ["PRESETS", "ConnectedDrivingWorld", "DrivingParams", "preset"]


@dataclass
class _Episode:
    """Everything that changes; copying it saves the world's state."""

    rng: np.random.Generator
    road: FastRoad
    street: Street
    connected: list[ConnectedVehicle]
    looks: dict[int, tuple[int, Tint]]  # identity of a vehicle in traffic -> mesh, tint
    street_identity: NDArray[np.int64]  # (k,) identities of the street's objects
    crossers: dict[int, Obstacle]  # index of a walker on the road -> what highway-env's drivers see of it
    light: Light
    collided: list[bool]
    next_identity: int = 0
    time: float = 0.0


class ConnectedDrivingWorld:
    """highway-env's traffic with N connected vehicles whose forward cameras share a scene; see `World`.

    Controls are (N, 2): acceleration (of `max_acceleration`; braking ends at a standstill) and steering (of
    `max_steering_rad`, positive left). `robot_state` has the columns `STATE_COLUMNS`: own speed, yaw rate, offset to
    the left of the lane's centre, heading relative to the lane, and speed limit (0: none).
    """

    def __init__(self, n_robots: int = 2, params: DrivingParams | None = None) -> None:
        """Raises ValueError for a number of connected vehicles that no map takes, TypeError for others' parameters."""
        if not isinstance(n_robots, (int, np.integer)) or not 2 <= n_robots <= 6:
            raise ValueError(f"n_robots must be a whole number between 2 and 6, got {n_robots!r}")
        if params is not None and not isinstance(params, DrivingParams):
            raise TypeError(f"params must be DrivingParams, got {type(params).__name__}")
        self.params = params or DrivingParams()
        self.n_robots = n_robots
        self.map: RoadMap = road_map(self.params.map)
        self._network = FastNetwork(self.map.network, connected_lanes=True)
        self._ground = Ground(self.map, self._network.table)
        self.classes = CLASSES
        self.meshes, self._catalogue, self._surface = _meshes(self.map, self._ground)
        self.max_objects = self.params.max_objects + n_robots
        self.control_size = 2
        self.state_size = len(STATE_COLUMNS)
        self.horizontal_fov_rad = np.full(n_robots, self.params.horizontal_fov_rad)
        self.step_seconds = SUBSTEPS / SIMULATION_HZ
        self.ends_on_collision = True
        self._episode: _Episode | None = None

    # --- World -------------------------------------------------------------------------------------------------------

    def reset(self, rng: np.random.Generator) -> None:
        """Generate a new scene from `rng` alone; SceneGenerationError after `MAX_TRIES` scenes without room."""
        for _ in range(MAX_TRIES):
            episode = self._generate(rng)
            if episode is not None:
                self._replace(episode)
                return
        raise SceneGenerationError(
            f"no room for {self.n_robots} connected vehicles on map {self.params.map!r} "
            f"with {self.params.n_vehicles} others in {MAX_TRIES} tries"
        )

    def step(self, controls: Array) -> None:
        """Advance by `step_seconds` under controls (N, 2) in [-1, 1]."""
        episode = self._running()
        wanted = np.asarray(controls, dtype=np.float64)
        if wanted.shape != (self.n_robots, 2) or not np.isfinite(wanted).all():
            raise ValueError(f"controls must be finite with shape ({self.n_robots}, 2), got {controls!r}")
        self._spawn(episode)
        self._move_street(episode)
        bodies = np.vstack([episode.street.solids, _pedestrians(episode.street)])
        for _ in range(SUBSTEPS):
            episode.road.act()
            for vehicle, control in zip(episode.connected, np.clip(wanted, -1.0, 1.0).tolist(), strict=True):
                vehicle.act(self._command(vehicle, *control))
            episode.road.step(1 / SIMULATION_HZ)
            for vehicle, hit in zip(episode.connected, touching(_cars(episode.connected), bodies), strict=True):
                vehicle.crashed = bool(vehicle.crashed or hit)
        self._remove_leaving(episode)
        episode.collided = [bool(v.crashed) for v in episode.connected]
        episode.time += self.step_seconds

    def snapshot(self) -> Snapshot:
        """The present instant."""
        episode = self._running()
        n, street = self.n_robots, episode.street
        objects, scenery = street.objects, street.scenery
        vehicles = [*episode.connected, *(v for v in episode.road.vehicles if not isinstance(v, ConnectedVehicle))]
        kinds = [KINDS[v.kind] for v in vehicles]
        positions = np.vstack([to_world(np.array([v.position for v in vehicles])), objects.positions])
        headings = np.concatenate([[-v.heading for v in vehicles], objects.headings])
        heights = np.concatenate([[kind.size[2] / 2 for kind in kinds], objects.heights])
        m, moving = len(positions), len(vehicles)
        velocities = np.zeros((m, 3))
        speeds = np.array([v.speed for v in vehicles])
        velocities[:moving, 0] = speeds * np.cos(headings[:moving])
        velocities[:moving, 1] = speeds * np.sin(headings[:moving])
        velocities[moving:, :2] = street.velocities()
        meshes, tints = zip(*(episode.looks[v.identity] for v in vehicles), strict=True)
        poses = planar_poses(
            np.vstack([positions, scenery.positions, to_world(self.map.obstacles), np.zeros((1, 2))]),
            np.concatenate([headings, scenery.headings, np.zeros(len(self.map.obstacles) + 1)]),
        )
        fixed = [self._surface - 1] * len(self.map.obstacles) + [self._surface]
        return Snapshot(
            time=episode.time,
            identity=np.concatenate([[v.identity for v in vehicles], episode.street_identity]).astype(np.int64),
            object_class=np.concatenate([[kind.object_class for kind in kinds], objects.classes]),
            positions=np.column_stack([positions, heights]),
            velocities=velocities,
            headings=headings,
            sizes=np.vstack([[kind.size for kind in kinds], objects.sizes]),
            body_mesh=np.concatenate([meshes, objects.meshes, scenery.meshes, fixed]).astype(np.int64),
            body_poses=poses,
            body_tints=np.vstack([tints, objects.tints, scenery.tints, [WHITE] * len(fixed)]),
            body_object=np.concatenate([np.arange(m), np.full(len(poses) - m, -1)]).astype(np.int64),
            T_world_camera=poses[:n] @ self._T_body_camera(),
            robot_object=np.arange(n, dtype=np.int64),
            robot_velocity=velocities[:n].copy(),
            robot_state=np.array([_own_state(v) for v in episode.connected]),
            collided=np.array(episode.collided, dtype=bool),
            light=episode.light,
        )

    def close(self) -> None:
        """Forget the episode."""
        self._replace(None)

    # --- beyond the protocol -----------------------------------------------------------------------------------------

    def idm_controls(self) -> Array:
        """Controls (N, 2) of a careful driver: highway-env's IDM that also gives way; privileged, changes nothing.

        The IDM only sees who is ahead on its lane. This driver brakes as well for whoever would meet it within 3 s
        along both routes and is not behind it.
        """
        episode = self._running()
        vehicles, advice = episode.road.vehicles, np.array(episode.road.advice())
        for pair in episode.road.conflicts():
            for ego, other in (pair, pair[::-1]):
                if vehicles[ego] in episode.connected and _must_give_way(vehicles[ego], vehicles[other]):
                    advice[ego, 0] = min(advice[ego, 0], GIVE_WAY_M_S2)
        mine = advice[[vehicles.index(vehicle) for vehicle in episode.connected]]
        return np.clip(mine * [1.0, -1.0] / [self.params.max_acceleration, self.params.max_steering_rad], -1.0, 1.0)

    def traffic(self) -> list[TrafficVehicle]:
        """highway-env's vehicles on the road now, connected ones included, in highway-env's frame; not copies."""
        return self._running().road.vehicles

    def save_state(self) -> Any:
        """An opaque copy of the whole state; `restore_state` continues from it bit-identically."""
        saved = self._copied(self._running())
        saved.road.unbind()
        return saved

    def restore_state(self, state: Any) -> None:
        """Go back to a state of `save_state`, any number of times.

        Raises:
            ValueError: something else.
        """
        if not isinstance(state, _Episode):
            raise ValueError(f"state must come from save_state, got {type(state).__name__}")
        episode = self._copied(state)
        episode.road.bind()
        self._replace(episode)

    # --- a step ------------------------------------------------------------------------------------------------------

    def _running(self) -> _Episode:
        if self._episode is None:
            raise RuntimeError("the world has no scene: call reset(rng) first")
        return self._episode

    def _replace(self, episode: _Episode | None) -> None:
        if self._episode is not None:
            self._episode.road.unbind()
        self._episode = episode

    def _copied(self, episode: _Episode) -> _Episode:
        table = self._network.table
        shared = [self._network, table, *table.lanes, self._ground, self._catalogue, self.params]
        shared += [*self._ground.pavements, *self._ground.crossings]
        return copy.deepcopy(episode, {id(item): item for item in shared})

    def _T_body_camera(self) -> Array:
        T = np.zeros((4, 4))
        T[:3, :3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]
        T[:, 3] = self.params.camera_forward_m, 0.0, self.params.camera_height_m, 1.0
        return T

    def _command(self, vehicle: ConnectedVehicle, pedal: float, wheel: float) -> dict[str, float]:
        # Braking stops at a standstill: no reversing.
        acceleration = max(pedal * self.params.max_acceleration, -max(vehicle.speed, 0.0) * SIMULATION_HZ)
        return {"acceleration": acceleration, "steering": -wheel * self.params.max_steering_rad}

    def _move_street(self, episode: _Episode) -> None:
        """Pedestrians and signals; those who cross the road become obstacles that highway-env's drivers brake for."""
        vehicles = episode.road.vehicles
        arms = {lane: arm for arm, (lane, _) in enumerate(self.map.entries)}
        held_back = {arms[v.lane_index] for v in vehicles if getattr(v, "is_yielding", False) and v.lane_index in arms}
        moving = np.array([(*v.position.tolist(), v.heading, v.speed) for v in vehicles])
        moving[:, 1:3] *= -1
        episode.street.step(self.step_seconds, episode.time, lambda point: _safe_to_cross(point, moving), held_back)
        crossers = {}
        for k, walker in enumerate(episode.street.walkers):
            if walker.on_road:
                position = to_world(np.array(walker.site()[0]))
                crossers[k] = episode.crossers.get(k) or _pedestrian_obstacle(episode.road, position)
                crossers[k].position = position
        episode.crossers = crossers
        episode.road.objects = episode.road.objects[: len(self.map.obstacles)] + list(crossers.values())

    def _spawn(self, episode: _Episode) -> None:
        rng = episode.rng
        if not self.map.entries or rng.uniform() > self.params.spawn_probability:
            return
        if len(episode.road.vehicles) - len(episode.connected) >= self.params.max_vehicles:
            return
        lane, _ = self.map.entries[int(rng.integers(len(self.map.entries)))]
        self._add_vehicle(episode, lane, 0.0, gap=20.0)

    def _remove_leaving(self, episode: _Episode) -> None:
        graph, road = self.map.network.graph, episode.road
        road.vehicles = [
            v
            for v in road.vehicles
            if isinstance(v, ConnectedVehicle)
            or v.lane_index[1] in graph
            or v.lane.local_coordinates(v.position)[0] < v.lane.length - 20.0
        ]

    # --- generation --------------------------------------------------------------------------------------------------

    def _generate(self, rng: np.random.Generator) -> _Episode | None:
        light = sample_light(rng, self.params.times_of_day, GROUNDS)
        street = Street(rng, self.params, self._ground, self._catalogue)
        road = make_road(self.map, rng, self._network)
        nobody = np.zeros(0, dtype=np.int64)
        episode = _Episode(rng, road, street, [], {}, nobody, {}, light, [False] * self.n_robots)
        self._populate(episode)
        for _ in range(round(self.params.prewarm_s * SIMULATION_HZ)):
            road.act()
            road.step(1 / SIMULATION_HZ)
        self._remove_leaving(episode)
        road.vehicles = [v for v in road.vehicles if not v.crashed]
        if not self._place_connected(episode):
            road.unbind()
            return None
        episode.street_identity = episode.next_identity + np.arange(len(street.objects))
        episode.next_identity += len(street.objects)
        return episode

    def _populate(self, episode: _Episode) -> None:
        """Fill the map with traffic, a bounded number of tries."""
        rng, lanes = episode.rng, self.map.populated
        weights = np.array([end - begin for _, (begin, end) in lanes])
        for _ in range(6 * self.params.n_vehicles):
            if len(episode.road.vehicles) >= self.params.n_vehicles:
                return
            lane, (begin, end) = lanes[int(rng.choice(len(lanes), p=weights / weights.sum()))]
            self._add_vehicle(episode, lane, float(rng.uniform(begin, end)), gap=9.0)

    def _add_vehicle(self, episode: _Episode, lane: tuple[str, str, int], longitudinal: float, gap: float) -> None:
        """Add one vehicle of the traffic, unless another is nearer than `gap` m."""
        rng, road = episode.rng, episode.road
        where = self.map.network.get_lane(lane)
        speed = float(rng.uniform(*self.map.traffic_speed))
        kind = draw_kind(rng)
        if not _far_from(road.vehicles, where.position(longitudinal, 0.0), gap):
            return
        vehicle = TrafficVehicle.make_on_lane(road, lane, longitudinal, speed)
        self._enroll(episode, vehicle, kind)
        vehicle.randomize_behavior()
        goals = dict(self.map.entries).get(lane) or self.map.goals
        if goals:
            vehicle.plan_route_to(str(rng.choice(goals)))
        road.vehicles.append(vehicle)

    def _enroll(self, episode: _Episode, vehicle: TrafficVehicle, kind: int) -> None:
        """Give a new vehicle its identity, size, look and driving style."""
        vehicle.identity, vehicle.kind = episode.next_identity, kind
        episode.next_identity += 1
        vehicle.resize(*KINDS[kind].size[:2])
        for name, value in self.map.driving_style.items():
            setattr(vehicle, name, value)
        episode.looks[vehicle.identity] = draw_paint(episode.rng, kind, self.params.look_alike_fraction)

    def _place_connected(self, episode: _Episode) -> bool:
        """Put the connected vehicles at their starts and clear what is too close; False when there is no room."""
        rng, road = episode.rng, episode.road
        convoys: dict[Start, tuple[float, float, str | None]] = {}  # last one's longitudinal and speed, and their goal
        for _ in range(self.n_robots):
            start = self._draw_start(rng, list(convoys))
            if start in convoys:
                longitudinal, speed, goal = convoys[start]
                longitudinal -= float(rng.uniform(0.68, 0.9)) * self.map.queue_gap_m
            else:
                longitudinal, speed = float(rng.uniform(*start.longitudinal)), float(rng.uniform(*self.map.speed))
                goal = str(rng.choice(start.destinations)) if start.destinations else None
            convoys[start] = longitudinal, speed, goal
            vehicle = ConnectedVehicle.make_on_lane(road, start.lane, longitudinal, speed)
            if not _far_from(episode.connected, vehicle.position, 6.5):
                return False
            self._enroll(episode, vehicle, CAR)
            vehicle.cruise_speed = self.map.cruise_speed
            # Connected vehicles know of each other: they keep a platoon's gaps.
            vehicle.DISTANCE_WANTED, vehicle.TIME_WANTED = 6.5, 0.5
            vehicle.target_speed = vehicle.lane.speed_limit or 10.0
            if goal is not None:
                vehicle.plan_route_to(goal)
            road.vehicles = [
                v for v in road.vehicles if v in episode.connected or _far_from([v], vehicle.position, 11.0)
            ]
            road.vehicles.append(vehicle)
            episode.connected.append(vehicle)
        return not touching(_cars(episode.connected), episode.street.solids).any()

    def _draw_start(self, rng: np.random.Generator, used: list[Start]) -> Start:
        """A fresh start, or with probability `same_approach_share` (or for want of a fresh one) one used before."""
        fresh = [start for start in self.map.starts if start not in used]
        if used and (not fresh or rng.uniform() < self.params.same_approach_share):
            return used[int(rng.integers(len(used)))]
        return fresh[int(rng.integers(len(fresh)))]


def planar_poses(positions: Array, headings: Array) -> Array:
    """T_world_body (n, 4, 4) of bodies standing at positions (n, 2) m with headings (n,) rad."""
    poses = np.zeros((len(positions), 4, 4))
    c, s = np.cos(headings), np.sin(headings)
    poses[:, 0, 0], poses[:, 0, 1], poses[:, 1, 0], poses[:, 1, 1] = c, -s, s, c
    poses[:, 2, 2] = poses[:, 3, 3] = 1.0
    poses[:, :2, 3] = positions
    return poses


@njit(cache=True)
def _safe_to_cross(point: Array, vehicles: Array) -> bool:
    """Whether no vehicle, rows x, y, heading, speed, is too near to brake comfortably for somebody at `point`."""
    for k in range(len(vehicles)):
        x, y, heading, speed = vehicles[k]
        ahead = math.cos(heading) * (point[0] - x) + math.sin(heading) * (point[1] - y)
        beside = math.cos(heading) * (point[1] - y) - math.sin(heading) * (point[0] - x)
        if abs(beside) < 7.0 and -4.0 < ahead < speed * speed / 5.0 + 8.0 and speed > 0.5:
            return False
    return True


def _must_give_way(ego: ConnectedVehicle, other: TrafficVehicle) -> bool:
    """Whether `ego` brakes for `other`, with which it is in conflict; of two connected vehicles the later one does."""
    if isinstance(other, ConnectedVehicle) and other.identity > ego.identity:
        return False
    return other.speed > 0.5 and float(ego.front_distance_to(other)) > 0.0


def _far_from(vehicles: list[Any], position: Array, distance_m: float) -> bool:
    x, y = float(position[0]), float(position[1])
    return all(math.hypot(v.position[0] - x, v.position[1] - y) >= distance_m for v in vehicles)


def _cars(vehicles: list[ConnectedVehicle]) -> Array:
    """(n, 5) x, y, heading, length, width in the world frame."""
    return np.array([(v.position[0], -v.position[1], -v.heading, v.LENGTH, v.WIDTH) for v in vehicles])


def _pedestrians(street: Street) -> Array:
    return street.objects.footprints()[len(street.objects) - len(street.walkers) :]


def _pedestrian_obstacle(road: FastRoad, position: Array) -> Obstacle:
    obstacle = Obstacle(road, position)
    obstacle.LENGTH = obstacle.WIDTH = 0.6
    obstacle.diagonal = math.sqrt(2) * 0.6
    return obstacle


def _own_state(vehicle: ConnectedVehicle) -> list[float]:
    longitudinal, lateral = vehicle.lane.local_coordinates(vehicle.position)
    slip = math.atan(0.5 * math.tan(vehicle.action["steering"]))
    yaw_rate = vehicle.speed * math.sin(slip) / (vehicle.LENGTH / 2)
    turned = float(vehicle.lane.local_angle(vehicle.heading, longitudinal))
    return [vehicle.speed, -yaw_rate, -float(lateral), -turned, vehicle.lane.speed_limit or 0.0]


def _meshes(roads: RoadMap, ground: Ground) -> tuple[tuple[Mesh, ...], Catalogue, int]:
    """Every mesh of a map, where the street's are among them, and the index of the ground; the barrier is before it."""
    meshes = [car("sedan"), car("hatchback"), car("estate"), van(), truck(), bus(), person()]
    groups = {
        "signals": [signal(color) for color in ("red", "amber", "green")],
        "signs": [sign(kind) for kind in ("limit", "stop", "yield", "info")],
        "posts": [post(0.08, 2.4), post(0.045, 2.2)],
        "trees": [tree("round"), tree("tall")],
        "houses": [building(*size, floors) for size, floors in zip(FOOTPRINTS, FLOORS, strict=True)],
    }
    indices = {}
    for name, group in groups.items():
        indices[name] = tuple(range(len(meshes), len(meshes) + len(group)))
        meshes += group
    meshes += [barrier(), road_surface(roads, ground.runs)]
    catalogue = Catalogue(person=6, footprints=FOOTPRINTS, **indices)  # type: ignore[arg-type]
    return tuple(meshes), catalogue, len(meshes) - 1
