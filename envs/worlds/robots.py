"""What the robot scenes share: the state of an episode, stepping and describing it.

A scene is what stays the same over an episode (`Scene`), its state what changes (`State`); both are frozen and hold all
there is, so saving is handing them out and restoring is taking them back.

Objects are ordered observers, team, then (where obstacles count as objects) obstacles; so are their identities.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .bullet import BodyState, BoxDynamics, Dynamics
from .layout import in_disc, observers_around, place_apart, team_layout
from .lighting import sample_light
from .models import ROBOT_CLASSES, Model, models
from .robot_params import RobotSceneParams
from .team import TeamRoutes, advance_waypoints, draw_routes, team_commands
from .wheels import WheelDynamics
from .world import Array, Light, ObjectClass, SceneGenerationError, Snapshot

SCENE_TRIES = 20
MAX_OBSERVERS = 8
FLEET_COLORS = ((240, 196, 32), (226, 120, 40), (196, 60, 48), (84, 140, 76), (64, 112, 176), (208, 208, 204))
UNIQUE_COLORS = ((230, 60, 160), (40, 200, 210), (150, 80, 210), (120, 220, 60), (250, 250, 250))
CRATE_COLORS = ((190, 150, 100), (128, 132, 140), (110, 140, 120), (170, 90, 70))
UNIQUE_MODELS = ("rover", "carrier", "husky")


@dataclass(frozen=True, eq=False)
class Scene:
    """What stays the same over an episode: r robots (N observers first), s bodies that stand still.

    Attributes:
        robot_model: (r,) index into the world's models.
        obstacles: (k, 3) planar poses.
        static_poses: (s, 4, 4) T_world_body; the obstacles first.
        static_model: (s,) index into the world's models.
        static_objects: how many of the static bodies, from the first, are objects.
        tints: (r + s, 3).
        T_robot_camera: (N, 4, 4).
        light: sun and sky.
        routes: the team's.
    """

    robot_model: NDArray[np.int64]
    obstacles: Array
    static_poses: Array
    static_model: NDArray[np.int64]
    static_objects: int
    tints: Array
    T_robot_camera: Array
    light: Light
    routes: TeamRoutes


@dataclass(frozen=True, eq=False)
class State:
    """What changes: time, robots on the ground, waypoints (t,), what collided (N,), flying observers.

    Attributes:
        flight: (f, 10) of each flying observer: x, y, z m, heading rad, their rates in the world frame, then pitch and
            roll in rad.
    """

    time: float
    bodies: BodyState
    target: NDArray[np.int64]
    collided: NDArray[np.bool_]
    flight: Array


@dataclass(frozen=True, eq=False)
class SavedState:
    """All there is of a world's present; picklable. `key` tells which worlds may take it."""

    key: tuple[Any, ...]
    scene: Scene
    state: State


class RobotWorld:
    """The common part of the robot scenes; see `covis.envs.worlds.world.World` for the protocol.

    Columns of `robot_state`: m/s forward, rad/s to the left.
    """

    control_size = 2
    state_size = 2
    ends_on_collision = False
    n_flyers = 0
    """Observers that fly: the first ones."""

    def __init__(self, n_robots: int, params: RobotSceneParams) -> None:
        """Raises ValueError for a number of observers that does not fit, TypeError for parameters of something else."""
        if not isinstance(params, RobotSceneParams):
            raise TypeError(f"params must be those of a robot scene, got {type(params).__name__}")
        self.params = params
        self.n_robots = _checked_observers(n_robots, params)
        self.models: tuple[Model, ...] = models(
            params.scale, params.mesh_detail_m if params.meshes == "stock" else None
        )
        self.classes = tuple(ObjectClass(c.name, params.scale * c.depth_to_centre_m) for c in ROBOT_CLASSES)
        self.meshes = tuple(model.mesh for model in self.models)
        self.step_seconds = params.step_seconds
        self.horizontal_fov_rad = np.full(self.n_robots, math.radians(params.horizontal_fov_deg))
        self._n_objects = self.n_robots + params.n_team
        self.max_objects = self._n_objects + (params.n_obstacles[1] if params.obstacles != "scenery" else 0)
        self._dynamics = self._make_dynamics()
        self._scene: Scene | None = None
        self._state: State | None = None

    # ------------------------------------------------------------------ the protocol

    def reset(self, rng: np.random.Generator) -> None:
        """Generate a new scene from `rng` alone. Raises SceneGenerationError when none was found in bounded tries."""
        for attempt in range(SCENE_TRIES):
            try:
                scene, planar, flight = self._generate(rng)
                break
            except SceneGenerationError as error:
                if attempt == SCENE_TRIES - 1:
                    raise SceneGenerationError(
                        f"no scene in {SCENE_TRIES} tries; the last failed with: {error}"
                    ) from error
        state = State(
            time=0.0,
            bodies=self._dynamics.rest(planar),
            target=np.zeros(len(scene.routes.speed), dtype=np.int64),
            collided=np.zeros(self.n_robots, dtype=bool),
            flight=flight,
        )
        self._take(scene, state)

    def step(self, controls: Array) -> None:
        """Advance by `step_seconds` under controls (N, d) in [-1, 1]: shares of greatest forward speed and turn rate.

        Raises:
            ValueError: wrong shape, a value that is not finite or outside [-1, 1].
        """
        scene, state = self._present()
        controls = check_controls(controls, self.n_robots, self.control_size)
        f = self.n_flyers
        limits = np.array([self.params.max_speed_mps, self.params.max_turn_radps])
        target, scripted = self._team_commands(scene, state)
        bodies, touched = self._dynamics.advance(state.bodies, np.vstack([controls[f:, :2] * limits, scripted]))
        collided = np.zeros(self.n_robots, dtype=bool)
        collided[f:] = touched[: self.n_robots - f]
        flight = self._fly(state.flight, controls[:f])
        self._state = State(state.time + self.step_seconds, bodies, target, collided, flight)

    def snapshot(self) -> Snapshot:
        """The present instant."""
        scene, state = self._present()
        n, r, f = self.n_robots, len(scene.robot_model), self.n_flyers
        m = r + scene.static_objects
        body_model = np.concatenate([scene.robot_model, scene.static_model])
        body_poses = np.concatenate([self._robot_poses(state), scene.static_poses])
        centres = self._centres[body_model[:m]]
        velocities = np.zeros((m, 3))
        velocities[f:r, :2] = state.bodies.velocity[:, :2]
        velocities[:f] = state.flight[:, 4:7]
        poses = body_poses[:m]
        body_object = np.full(len(body_model), -1, dtype=np.int64)
        body_object[:m] = np.arange(m)
        return Snapshot(
            time=state.time,
            identity=np.arange(m, dtype=np.int64),
            object_class=self._object_classes[body_model[:m]],
            positions=(poses[:, :3, :3] @ centres[..., None])[..., 0] + poses[:, :3, 3],
            velocities=velocities,
            headings=np.arctan2(poses[:, 1, 0], poses[:, 0, 0]),
            sizes=self._sizes[body_model[:m]],
            body_mesh=body_model,
            body_poses=body_poses,
            body_tints=scene.tints.copy(),
            body_object=body_object,
            T_world_camera=self._camera_poses(scene, state, body_poses[:n]),
            robot_object=np.arange(n, dtype=np.int64),
            robot_velocity=velocities[:n].copy(),
            robot_state=self._robot_state(state),
            collided=state.collided.copy(),
            light=scene.light,
        )

    def close(self) -> None:
        """Release the simulator; calling it twice is harmless."""
        self._dynamics.close()

    # ------------------------------------------------------------------ beyond the protocol

    def save_state(self) -> SavedState:
        """The whole present: a world of the same kind and parameters that takes it continues bit-identically."""
        scene, state = self._present()
        return SavedState(self._key(), scene, state)

    def restore_state(self, saved: SavedState) -> None:
        """Continue from `saved`. Raises ValueError when it comes from a world of another kind, size or parameters."""
        if not isinstance(saved, SavedState) or saved.key != self._key():
            of = saved.key if isinstance(saved, SavedState) else type(saved).__name__
            raise ValueError(f"this state is not one of {self._key()}, but of {of}")
        self._take(saved.scene, saved.state)

    def obstacle_sizes(self) -> Array:
        """Length and width (k, 2) m of as many obstacles as a scene can have."""
        name = "container" if self.params.obstacles == "scenery" else self.params.obstacles
        return np.tile(self._sizes[self._index(name), :2], (self.params.n_obstacles[1], 1))

    def use_dynamics(self, dynamics: Dynamics) -> None:
        """Move the robots by other dynamics from the next reset on."""
        self.close()
        self._dynamics, self._scene, self._state = dynamics, None, None

    # ------------------------------------------------------------------ generation

    def _generate(self, rng: np.random.Generator) -> tuple[Scene, Array, Array]:
        """A scene, planar poses (r - f, 3) of the robots on the ground and (f, 10) of those in the air."""
        p = self.params
        radius = rng.uniform(*p.team_radius_m)
        team = self._place_team(rng, radius)
        grounded = self._place_observers(rng, team)
        flight = self._place_flyers(rng)
        planar = np.vstack([grounded, team])
        obstacles = self._place_obstacles(rng, radius, planar)
        backdrop_poses, backdrop_model, backdrop_tints = self._backdrop(rng)
        routes = draw_routes(
            rng,
            team[:, :2],
            radius,
            moving_share=p.moving_share,
            speed_mps=p.team_speed_mps,
            max_turn=p.max_turn_radps,
            keep_away_m=1.3 * p.separation_m,
            arrived_m=0.6 * p.scale,
        )
        model, tints = self._looks(rng)
        obstacle_model = self._index(self._obstacle_model(rng))
        fleet = tints[-1] if p.n_team else np.array(FLEET_COLORS[0]) / 255.0
        color = fleet if p.obstacles == "husky" else np.array(CRATE_COLORS[int(rng.integers(len(CRATE_COLORS)))]) / 255
        k = len(obstacles)
        scene = Scene(
            robot_model=model,
            obstacles=obstacles,
            static_poses=np.concatenate([planar_poses(obstacles), backdrop_poses]),
            static_model=np.concatenate([np.full(k, obstacle_model, dtype=np.int64), backdrop_model]),
            static_objects=0 if p.obstacles == "scenery" else k,
            tints=np.vstack([tints, np.tile(color, (k, 1)), backdrop_tints]),
            T_robot_camera=self._mounts(rng),
            light=sample_light(rng, p.times_of_day),
            routes=routes,
        )
        return scene, planar, flight

    def _place_team(self, rng: np.random.Generator, radius: float) -> Array:
        p = self.params
        layout = p.layouts[int(rng.integers(len(p.layouts)))]
        proposal = team_layout(rng, layout, radius, p.n_team)
        spots = place_apart(proposal, p.n_team, p.separation_m, "robot")
        spots = spots[rng.permutation(p.n_team)]
        return np.column_stack([spots, rng.uniform(-np.pi, np.pi, p.n_team)])

    def _place_observers(self, rng: np.random.Generator, team: Array) -> Array:
        p = self.params
        low, high = p.observer_angle_deg
        return observers_around(
            rng,
            self.n_robots - self.n_flyers,
            p.observer_distance_m,
            (math.radians(low), math.radians(high)),
            p.observer_gaze_m,
            p.separation_m,
            team[:, :2],
        )

    def _place_flyers(self, rng: np.random.Generator) -> Array:
        return np.zeros((0, 10))

    def _place_obstacles(self, rng: np.random.Generator, radius: float, robots: Array) -> Array:
        p = self.params
        k = int(rng.integers(p.n_obstacles[0], p.n_obstacles[1] + 1))
        name = "husky" if p.obstacles == "husky" else "crate" if p.obstacles == "crate" else "container"
        half = 0.5 * float(np.hypot(*self.models[self._index(name)].size[:2]))
        clearance = max(p.separation_m, half + 0.6 * p.scale)
        observers = robots[: self.n_robots - self.n_flyers, :2]

        def draw(i: int) -> Array:
            for _ in range(20):  # right before a camera, an obstacle would hide everything
                spot = in_disc(rng, radius)
                if (np.hypot(*(observers - spot).T) > p.obstacle_distance_m).all():
                    break
            return spot

        apart = max(p.separation_m, 2.0 * half)
        spots = place_apart(draw, k, apart, "obstacle", taken=robots[:, :2], clearance_m=clearance)
        return np.column_stack([spots, rng.uniform(-np.pi, np.pi, k)])

    def _backdrop(self, rng: np.random.Generator) -> tuple[Array, NDArray[np.int64], Array]:
        """Trees and sheds beyond the arena: poses, models, tints."""
        p = self.params
        if p.backdrop == "lab":
            return self._walls(rng)
        k = int(rng.integers(p.n_backdrop[0], p.n_backdrop[1] + 1))
        angle = rng.uniform(-np.pi, np.pi, k)
        edge = max(p.team_radius_m[1], p.observer_distance_m[1]) + 8.0
        distance = edge + rng.uniform(0.0, 25.0, k)
        heading = rng.uniform(-np.pi, np.pi, k)
        names = np.where(rng.uniform(size=k) < 0.7, self._index("tree"), self._index("shed"))
        tints = np.where(names[:, None] == self._index("tree"), 1.0, rng.uniform(0.55, 0.95, (k, 3)))
        planar = np.column_stack([distance * np.cos(angle), distance * np.sin(angle), heading])
        return planar_poses(planar), names.astype(np.int64), tints

    def _walls(self, rng: np.random.Generator) -> tuple[Array, NDArray[np.int64], Array]:
        """A square room about the arena, of panels 2.5 m long."""
        half = 1.25 * math.ceil((max(self.params.team_radius_m[1], self.params.observer_distance_m[1]) + 1.0) / 1.25)
        along = np.arange(-half + 1.25, half, 2.5)
        sides = [np.column_stack([along, np.full_like(along, half), np.zeros_like(along)])]
        for _ in range(3):
            x, y, heading = sides[-1].T
            sides.append(np.column_stack([-y, x, heading + np.pi / 2]))
        planar = np.vstack(sides)
        tint = np.tile(rng.uniform(0.6, 0.95, 3), (len(planar), 1))
        return planar_poses(planar), np.full(len(planar), self._index("wall"), dtype=np.int64), tint

    def _looks(self, rng: np.random.Generator) -> tuple[NDArray[np.int64], Array]:
        """Model (r,) and tint (r, 3) of each robot: one look for all but the unique ones."""
        p = self.params
        model = np.full(self._n_objects, self._index("husky"), dtype=np.int64)
        model[: self.n_flyers] = self._index("drone")
        fleet = np.array(FLEET_COLORS[int(rng.integers(len(FLEET_COLORS)))], dtype=np.float64)
        tints = np.tile(np.clip(fleet + rng.uniform(-12, 12, 3), 0, 255) / 255.0, (self._n_objects, 1))
        unique = round(p.unique_share * p.n_team)
        for i, color in enumerate(np.resize(rng.permutation(len(UNIQUE_COLORS)), unique)):
            at = self.n_robots + i
            model[at] = self._index(UNIQUE_MODELS[int(rng.integers(len(UNIQUE_MODELS)))])
            tints[at] = np.clip(np.array(UNIQUE_COLORS[int(color)]) + rng.uniform(-12, 12, 3), 0, 255) / 255.0
        return model, tints

    def _obstacle_model(self, rng: np.random.Generator) -> str:
        if self.params.obstacles != "scenery":
            return self.params.obstacles
        return ("container", "barrier")[int(rng.integers(2))]

    def _mounts(self, rng: np.random.Generator) -> Array:
        """T_robot_camera (N, 4, 4) of each observer."""
        p = self.params
        heights = rng.uniform(*p.camera_height_m, size=self.n_robots)
        tilts = np.radians(rng.uniform(*p.camera_tilt_deg, size=self.n_robots))
        return np.stack([camera_mount((0.1 * p.scale, 0.0, h), t) for h, t in zip(heights, tilts, strict=True)])

    # ------------------------------------------------------------------ stepping

    def _team_commands(self, scene: Scene, state: State) -> tuple[NDArray[np.int64], Array]:
        grounded = self.n_robots - self.n_flyers
        planar = state.bodies.planar
        routes, team = scene.routes, planar[grounded:]
        target = advance_waypoints(routes.waypoints, routes.speed, state.target, team, routes.arrived_m)
        others = np.vstack([planar[:grounded, :2], scene.obstacles[:, :2]])
        commands = team_commands(
            routes.waypoints, routes.speed, routes.max_turn, routes.keep_away_m, target, team, others
        )
        return target, commands

    def _fly(self, flight: Array, controls: Array) -> Array:
        return flight

    # ------------------------------------------------------------------ description

    def _robot_poses(self, state: State) -> Array:
        """T_world_body (r, 4, 4) of observers and team."""
        return planar_poses(state.bodies.planar)

    def _camera_poses(self, scene: Scene, state: State, robot_poses: Array) -> Array:
        return robot_poses @ scene.T_robot_camera

    def _robot_state(self, state: State) -> Array:
        """(N - f, 2) of the observers on the ground: speed along the heading, turn rate."""
        n = self.n_robots - self.n_flyers
        planar, velocity = state.bodies.planar[:n], state.bodies.velocity[:n]
        forward = velocity[:, 0] * np.cos(planar[:, 2]) + velocity[:, 1] * np.sin(planar[:, 2])
        return np.column_stack([forward, velocity[:, 2]])

    # ------------------------------------------------------------------ housekeeping

    def _make_dynamics(self) -> Dynamics:
        p = self.params
        grounded = self._n_objects - self.n_flyers
        self._sizes = np.stack([model.size for model in self.models])
        self._centres = np.stack([model.centre for model in self.models])
        self._object_classes = np.array([model.object_class for model in self.models], dtype=np.int64)
        robots = np.tile(self._sizes[self._index("husky"), :2], (grounded, 1))
        unique = round(p.unique_share * p.n_team)
        first = self.n_robots - self.n_flyers
        robots[first : first + unique] = self._sizes[[self._index(name) for name in UNIQUE_MODELS], :2].max(0)
        obstacles = self.obstacle_sizes()
        if p.dynamics == "wheels":
            return WheelDynamics(grounded, obstacles, scale=p.scale, step_seconds=p.step_seconds)
        return BoxDynamics(robots, obstacles, step_seconds=p.step_seconds)

    def _index(self, name: str) -> int:
        return [model.name for model in self.models].index(name)

    def _key(self) -> tuple[Any, ...]:
        return (type(self).__name__, self.n_robots, self.params)

    def _present(self) -> tuple[Scene, State]:
        if self._scene is None or self._state is None:
            raise RuntimeError(f"{type(self).__name__} has no scene yet: call reset(rng) first")
        return self._scene, self._state

    def _take(self, scene: Scene, state: State) -> None:
        self._dynamics.set_obstacles(scene.obstacles)
        self._scene, self._state = scene, state


def camera_mount(position: tuple[float, float, float], tilt_rad: float) -> Array:
    """T_robot_camera (4, 4) of a camera that looks along x of its robot, tilted down by `tilt_rad`."""
    c, s = math.cos(tilt_rad), math.sin(tilt_rad)
    T = np.eye(4)
    T[:3, 0] = (0.0, -1.0, 0.0)  # right
    T[:3, 1] = (-s, 0.0, -c)  # down
    T[:3, 2] = (c, 0.0, -s)  # forward
    T[:3, 3] = position
    return T


def planar_poses(planar: Array) -> Array:
    """T_world_body (n, 4, 4) of bodies on the ground at planar poses (n, 3)."""
    out = np.zeros((len(planar), 4, 4))
    c, s = np.cos(planar[:, 2]), np.sin(planar[:, 2])
    out[:, 0, 0] = out[:, 1, 1] = c
    out[:, 1, 0], out[:, 0, 1] = s, -s
    out[:, :2, 3] = planar[:, :2]
    out[:, 2, 2] = out[:, 3, 3] = 1.0
    return out


def check_controls(controls: Array, n: int, d: int) -> Array:
    """The controls as float64 (n, d). Raises ValueError unless of that shape, finite and in [-1, 1]."""
    checked = np.asarray(controls, dtype=np.float64)
    if checked.shape != (n, d):
        raise ValueError(f"controls must have shape {(n, d)}, got {checked.shape}")
    if not np.isfinite(checked).all():
        raise ValueError(f"controls must be finite, got {checked.tolist()}")
    if np.abs(checked).max(initial=0.0) > 1.0:
        raise ValueError(f"controls must lie in [-1, 1], got {checked.tolist()}")
    return checked


def _checked_observers(n_robots: int, params: RobotSceneParams) -> int:
    if isinstance(n_robots, bool) or not isinstance(n_robots, int | np.integer):
        raise ValueError(f"n_robots must be a whole number, got {n_robots!r}")
    if not 2 <= n_robots <= MAX_OBSERVERS:
        raise ValueError(f"n_robots must be between 2 and {MAX_OBSERVERS}, got {n_robots}")
    around = 2 * math.pi * params.observer_distance_m[1]
    if n_robots * params.separation_m > around:
        raise ValueError(
            f"n_robots = {n_robots} observers do not fit on a circle of {params.observer_distance_m[1]} m with "
            f"separation_m = {params.separation_m}"
        )
    return int(n_robots)
