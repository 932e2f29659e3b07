"""Connected driving: highway-env's traffic on a street full of look-alikes, watched by the cars that we drive.

The world frame mirrors highway-env's y axis: highway-env is right-handed with z into the screen, our z points up.
Headings and steering turn over with it, so a positive steering control turns left. `to_world` and its callers are the
only place where the two frames meet.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass
from typing import Any

import numpy as np

from .driving_maps import MAPS, RoadMap, Start, road_map
from .street_meshes import bus, car, strip, truck, van
from .traffic import ConnectedVehicle, FastRoad, TrafficVehicle, make_road
from .world import Array, Light, Mesh, ObjectClass, SceneGenerationError, Snapshot

SIMULATION_HZ = 15
SUBSTEPS = 3
STATE_COLUMNS = ("speed_m_s", "yaw_rate_rad_s", "lane_offset_m", "lane_heading_rad", "speed_limit_m_s")
MAX_TRIES = 30

CLASSES = (
    ObjectClass("car", 1.3),
    ObjectClass("van", 1.5),
    ObjectClass("truck", 2.0),
    ObjectClass("bus", 2.3),
    ObjectClass("pedestrian", 0.15),
    ObjectClass("traffic light", 0.15),
    ObjectClass("road sign", 0.05),
)


@dataclass(frozen=True)
class DrivingParams:
    """What a connected-driving scene contains.

    Attributes:
        map: "intersection", "roundabout", "highway", "merge" or "racetrack".
        n_vehicles: other vehicles at the start, as many as fit.
        max_vehicles: other vehicles at any time.
        spawn_probability: chance per step that another vehicle enters.
        prewarm_s: traffic runs this long before the connected vehicles appear (s).
        look_alike_fraction: share of objects whose look is drawn from the few common ones.
        horizontal_fov_rad: full field of view of the cameras.
        camera_height_m, camera_forward_m: mounting, from the ground below the vehicle's centre.
        max_acceleration: m/s^2 at control 1.
        max_steering_rad: steering angle at control 1.
    """

    map: str = "intersection"
    n_vehicles: int = 14
    max_vehicles: int = 18
    spawn_probability: float = 0.3
    prewarm_s: float = 3.0
    look_alike_fraction: float = 0.8
    horizontal_fov_rad: float = float(np.pi / 2)
    camera_height_m: float = 1.5
    camera_forward_m: float = 0.5
    max_acceleration: float = 5.0
    max_steering_rad: float = 0.6

    def __post_init__(self) -> None:
        if self.map not in MAPS:
            raise ValueError(f"map must be one of {', '.join(sorted(MAPS))}, got {self.map!r}")
        for name in ("n_vehicles", "max_vehicles", "prewarm_s"):
            if getattr(self, name) < 0:
                raise ValueError(f"{name} must not be negative, got {getattr(self, name)}")
        for name in ("spawn_probability", "look_alike_fraction"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"{name} must be in [0, 1], got {getattr(self, name)}")
        if self.n_vehicles > self.max_vehicles:
            raise ValueError(f"n_vehicles {self.n_vehicles} exceeds max_vehicles {self.max_vehicles}")
        if not 0 < self.horizontal_fov_rad < np.pi:
            raise ValueError(f"horizontal_fov_rad must be in (0, pi), got {self.horizontal_fov_rad}")
        for name in ("camera_height_m", "max_acceleration", "max_steering_rad"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} must be positive, got {getattr(self, name)}")


@dataclass(frozen=True)
class VehicleKind:
    """A kind of vehicle: its class, its meshes (indices into the catalogue), size (m), and how common it is."""

    object_class: int
    meshes: tuple[int, ...]
    size: tuple[float, float, float]
    share: float


VEHICLE_MESHES = ("sedan", "hatchback", "estate", "van", "truck", "bus")
KINDS = (
    VehicleKind(0, (0, 1, 2), (4.5, 1.8, 1.5), 0.66),
    VehicleKind(1, (3,), (5.3, 1.95, 2.25), 0.16),
    VehicleKind(2, (4,), (7.6, 2.3, 3.12), 0.1),
    VehicleKind(3, (5,), (8.6, 2.35, 3.15), 0.08),
)
COMMON_TINTS = ((0.95, 0.95, 0.95), (0.62, 0.63, 0.66))
RARE_TINTS = ((0.75, 0.12, 0.1), (0.12, 0.25, 0.6), (0.1, 0.35, 0.2), (0.85, 0.65, 0.1), (0.12, 0.12, 0.14))


def to_world(points: Array) -> Array:
    """Points (..., 2) of highway-env's road in our world: y mirrored (headings change sign too)."""
    return points * np.array([1.0, -1.0])


@dataclass
class _Episode:
    """Everything that changes; copying it saves the world's state."""

    rng: np.random.Generator
    road: FastRoad
    connected: list[ConnectedVehicle]
    light: Light
    time: float
    next_identity: int
    collided: list[bool]
    looks: dict[int, tuple[int, tuple[float, float, float]]]  # identity -> mesh, tint


class ConnectedDrivingWorld:
    """highway-env's traffic with N connected vehicles whose forward cameras share a scene; see `World`.

    Controls are (N, 2): acceleration (of `max_acceleration`; braking ends at a standstill) and steering (of
    `max_steering_rad`, positive left). `robot_state` has the columns `STATE_COLUMNS`: own speed, yaw rate, offset to
    the left of the lane's centre, heading relative to the lane, and speed limit (0: none).
    """

    def __init__(self, n_robots: int = 2, params: DrivingParams | None = None) -> None:
        if not 2 <= n_robots <= 6:
            raise ValueError(f"n_robots must be between 2 and 6, got {n_robots}")
        self.params = params or DrivingParams()
        self.n_robots = n_robots
        self.map: RoadMap = road_map(self.params.map)
        self.classes = CLASSES
        self.meshes = _catalogue(self.map)
        self.max_objects = self.params.max_vehicles + n_robots
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
                self._episode = episode
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
        self._spawn(episode, 0.0)
        for _ in range(SUBSTEPS):
            episode.road.act()
            for vehicle, control in zip(episode.connected, np.clip(wanted, -1.0, 1.0), strict=True):
                vehicle.act(self._command(vehicle, control))
            episode.road.step(1 / SIMULATION_HZ)
        self._remove_leaving(episode)
        episode.collided = [bool(v.crashed) for v in episode.connected]
        episode.time += self.step_seconds

    def snapshot(self) -> Snapshot:
        """The present instant."""
        episode = self._running()
        vehicles = [*episode.connected, *(v for v in episode.road.vehicles if not isinstance(v, ConnectedVehicle))]
        m, n = len(vehicles), self.n_robots
        planar = to_world(np.array([v.position for v in vehicles]))
        headings = np.array([-v.heading for v in vehicles])
        speeds = np.array([v.speed for v in vehicles])
        sizes = np.array([KINDS[v.kind].size for v in vehicles])
        direction = np.column_stack([np.cos(headings), np.sin(headings), np.zeros(m)])
        velocities = speeds[:, None] * direction
        poses = planar_poses(planar, headings)
        looks = [episode.looks[v.identity] for v in vehicles]
        return Snapshot(
            time=episode.time,
            identity=np.array([v.identity for v in vehicles], dtype=np.int64),
            object_class=np.array([KINDS[v.kind].object_class for v in vehicles], dtype=np.int64),
            positions=np.column_stack([planar, sizes[:, 2] / 2]),
            velocities=velocities,
            headings=headings,
            sizes=sizes,
            body_mesh=np.array([mesh for mesh, _ in looks] + [len(VEHICLE_MESHES)], dtype=np.int64),
            body_poses=np.concatenate([poses, np.eye(4)[None]]),
            body_tints=np.array([tint for _, tint in looks] + [(1.0, 1.0, 1.0)]),
            body_object=np.append(np.arange(m), -1).astype(np.int64),
            T_world_camera=poses[:n] @ self._T_body_camera(),
            robot_object=np.arange(n, dtype=np.int64),
            robot_velocity=velocities[:n].copy(),
            robot_state=np.array([_own_state(v) for v in episode.connected]),
            collided=np.array(episode.collided, dtype=bool),
            light=episode.light,
        )

    def close(self) -> None:
        """Forget the episode."""
        self._episode = None

    # --- beyond the protocol -----------------------------------------------------------------------------------------

    def idm_controls(self) -> Array:
        """Controls (N, 2) that highway-env's IDM driver would give the connected vehicles now (privileged)."""
        episode = self._running()
        episode.road.act()
        advice = np.array([v.advised for v in episode.connected])
        return np.clip(advice * [1.0, -1.0] / [self.params.max_acceleration, self.params.max_steering_rad], -1.0, 1.0)

    def save_state(self) -> Any:
        """An opaque copy of the whole state; `restore_state` continues from it bit-identically."""
        return self._copied(self._running())

    def restore_state(self, state: Any) -> None:
        """Go back to a state of `save_state`, any number of times."""
        if not isinstance(state, _Episode):
            raise ValueError(f"state must come from save_state, got {type(state).__name__}")
        self._episode = self._copied(state)

    # --- inside ------------------------------------------------------------------------------------------------------

    def _running(self) -> _Episode:
        if self._episode is None:
            raise RuntimeError("the world has no scene: call reset(rng) first")
        return self._episode

    def _copied(self, episode: _Episode) -> _Episode:
        network = episode.road.network
        shared = [network, network.table, *network.table.lanes, self.map]
        return copy.deepcopy(episode, {id(item): item for item in shared})

    def _T_body_camera(self) -> Array:
        T = np.zeros((4, 4))
        T[:3, :3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]
        T[:, 3] = self.params.camera_forward_m, 0.0, self.params.camera_height_m, 1.0
        return T

    def _command(self, vehicle: ConnectedVehicle, control: Array) -> dict[str, float]:
        acceleration = float(control[0]) * self.params.max_acceleration
        return {
            # Braking stops at a standstill: no reversing.
            "acceleration": max(acceleration, -vehicle.speed * SIMULATION_HZ),
            "steering": -float(control[1]) * self.params.max_steering_rad,
        }

    def _generate(self, rng: np.random.Generator) -> _Episode | None:
        road = make_road(self.map, rng, connected_lanes=True)
        episode = _Episode(rng, road, [], Light(), 0.0, 0, [False] * self.n_robots, {})
        self._populate(episode)
        for _ in range(int(self.params.prewarm_s * SIMULATION_HZ)):
            road.act()
            road.step(1 / SIMULATION_HZ)
        self._remove_leaving(episode)
        road.vehicles = [v for v in road.vehicles if not v.crashed]
        return episode if self._place_connected(episode) else None

    def _populate(self, episode: _Episode) -> None:
        rng = episode.rng
        lanes = self.map.populated
        weights = np.array([end - begin for _, (begin, end) in lanes])
        for _ in range(6 * self.params.n_vehicles):
            if len(episode.road.vehicles) >= self.params.n_vehicles:
                return
            lane, (begin, end) = lanes[int(rng.choice(len(lanes), p=weights / weights.sum()))]
            self._add_vehicle(episode, lane, float(rng.uniform(begin, end)), gap=13.0)

    def _spawn(self, episode: _Episode, longitudinal: float) -> None:
        rng = episode.rng
        if not self.map.entries or rng.uniform() > self.params.spawn_probability:
            return
        if len(episode.road.vehicles) - len(episode.connected) >= self.params.max_vehicles:
            return
        lane, _ = self.map.entries[int(rng.integers(len(self.map.entries)))]
        self._add_vehicle(episode, lane, longitudinal, gap=20.0)

    def _add_vehicle(self, episode: _Episode, lane: tuple[str, str, int], longitudinal: float, gap: float) -> None:
        rng = episode.rng
        where = self.map.network.get_lane(lane)
        limit = where.speed_limit or 10.0
        speed = float(limit * rng.uniform(0.6, 0.9))
        kind = int(rng.choice(len(KINDS), p=[k.share for k in KINDS]))
        position = where.position(longitudinal, 0)
        if any(np.hypot(*(v.position - position)) < gap for v in episode.road.vehicles):
            return
        vehicle = TrafficVehicle.make_on_lane(episode.road, lane, longitudinal, speed)
        self._enroll(episode, vehicle, kind)
        vehicle.randomize_behavior()
        goals = dict(self.map.entries).get(lane) or _onward(self.map, lane)
        if goals:
            vehicle.plan_route_to(str(rng.choice(goals)))
        episode.road.vehicles.append(vehicle)

    def _enroll(self, episode: _Episode, vehicle: TrafficVehicle, kind: int) -> None:
        """Give a new vehicle its identity, size, look and driving style."""
        rng = episode.rng
        vehicle.identity, vehicle.kind = episode.next_identity, kind
        episode.next_identity += 1
        length, width, _ = KINDS[kind].size
        vehicle.resize(length, width)
        for name, value in self.map.driving_style.items():
            setattr(vehicle, name, value)
        meshes = KINDS[kind].meshes
        common = rng.uniform() < self.params.look_alike_fraction
        tints = COMMON_TINTS if common else RARE_TINTS
        mesh = meshes[0] if common else int(rng.choice(meshes))
        episode.looks[vehicle.identity] = (mesh, tints[int(rng.integers(len(tints)))])

    def _place_connected(self, episode: _Episode) -> bool:
        """Put the connected vehicles at their starts and clear what is too close; False when there is no room."""
        rng, road = episode.rng, episode.road
        starts: list[Start] = list(self.map.starts)
        if self.map.shuffled:
            starts = [starts[int(k)] for k in rng.permutation(len(starts))]
        for n in range(self.n_robots):
            start = starts[n % len(starts)]
            behind = (n // len(starts)) * self.map.queue_gap_m
            longitudinal = float(rng.uniform(*start.longitudinal)) - behind
            vehicle = ConnectedVehicle.make_on_lane(road, start.lane, longitudinal, float(rng.uniform(*self.map.speed)))
            if any(np.hypot(*(v.position - vehicle.position)) < 7.0 for v in episode.connected):
                return False
            self._enroll(episode, vehicle, 0)
            vehicle.target_speed = vehicle.lane.speed_limit or 10.0
            if start.destinations:
                vehicle.plan_route_to(str(rng.choice(start.destinations)))
            road.vehicles = [
                v for v in road.vehicles if np.hypot(*(v.position - vehicle.position)) >= 11.0 or v in episode.connected
            ]
            road.vehicles.append(vehicle)
            episode.connected.append(vehicle)
        return len(road.vehicles) >= self.n_robots and all(v in road.vehicles for v in episode.connected)

    def _remove_leaving(self, episode: _Episode) -> None:
        graph = self.map.network.graph
        road = episode.road
        road.vehicles = [
            v
            for v in road.vehicles
            if isinstance(v, ConnectedVehicle)
            or v.lane_index[1] in graph
            or v.lane.local_coordinates(v.position)[0] < v.lane.length - 20.0
        ]


def planar_poses(positions: Array, headings: Array) -> Array:
    """T_world_body (n, 4, 4) of bodies standing at positions (n, 2) m with headings (n,) rad."""
    poses = np.zeros((len(positions), 4, 4))
    c, s = np.cos(headings), np.sin(headings)
    poses[:, 0, 0], poses[:, 0, 1], poses[:, 1, 0], poses[:, 1, 1] = c, -s, s, c
    poses[:, 2, 2] = poses[:, 3, 3] = 1.0
    poses[:, :2, 3] = positions
    return poses


def _own_state(vehicle: ConnectedVehicle) -> list[float]:
    longitudinal, lateral = vehicle.lane.local_coordinates(vehicle.position)
    slip = np.arctan(0.5 * np.tan(vehicle.action["steering"]))
    yaw_rate = vehicle.speed * np.sin(slip) / (vehicle.LENGTH / 2)
    return [
        vehicle.speed,
        -float(yaw_rate),
        -float(lateral),
        -float(vehicle.lane.local_angle(vehicle.heading, longitudinal)),
        vehicle.lane.speed_limit or 0.0,
    ]


def _onward(roads: RoadMap, lane: tuple[str, str, int]) -> tuple[str, ...]:
    """Nodes that vehicles starting on a populated lane may go to: all that any entry leads to."""
    return tuple(sorted({goal for _, goals in roads.entries for goal in goals}))


def _catalogue(roads: RoadMap) -> tuple[Mesh, ...]:
    vehicles = (car("sedan"), car("hatchback"), car("estate"), van(), truck(), bus())
    return (*vehicles, _asphalt(roads))


def _asphalt(roads: RoadMap) -> Mesh:
    from ..camera.shapes import merge

    parts = []
    for lane in roads.network.lanes_list():
        s = np.linspace(0, min(float(lane.length), 600.0), 20)
        left = to_world(np.array([lane.position(x, -lane.width_at(x) / 2) for x in s]))
        right = to_world(np.array([lane.position(x, lane.width_at(x) / 2) for x in s]))
        parts.append(strip(left, right, 0.02, (78, 80, 84)))
    return merge(*parts)
