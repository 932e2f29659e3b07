"""What the robot scenes share: the state of an episode, stepping and describing it; `robot_generation` draws them.

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
from .models import ROBOT_CLASSES
from .robot_generation import UNIQUE_MODELS, RobotSceneGenerator, Scene, planar_poses
from .robot_params import RobotSceneParams
from .team import advance_waypoints, team_commands
from .wheels import WheelDynamics
from .world import Array, ObjectClass, SceneGenerationError, Snapshot

SCENE_TRIES = 20
"""How often a scene is drawn anew when robots or obstacles find no place."""


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


class RobotWorld(RobotSceneGenerator):
    """The common part of the robot scenes; see `covis.envs.worlds.world.World` for the protocol.

    Columns of `robot_state`: m/s forward, rad/s to the left.
    """

    control_size = 2
    state_size = 2
    ends_on_collision = False

    def __init__(self, n_robots: int, params: RobotSceneParams) -> None:
        """Raises ValueError for a number of observers that does not fit, TypeError for parameters of something else."""
        super().__init__(n_robots, params)
        self.classes = tuple(ObjectClass(c.name, params.scale * c.depth_to_centre_m) for c in ROBOT_CLASSES)
        self.meshes = tuple(model.mesh for model in self.models)
        self.step_seconds = params.step_seconds
        self.horizontal_fov_rad = np.full(self.n_robots, math.radians(params.horizontal_fov_deg))
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

    def use_dynamics(self, dynamics: Dynamics) -> None:
        """Move the robots by other dynamics from the next reset on."""
        self.close()
        self._dynamics, self._scene, self._state = dynamics, None, None

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

    def _key(self) -> tuple[Any, ...]:
        return (type(self).__name__, self.n_robots, self.params)

    def _present(self) -> tuple[Scene, State]:
        if self._scene is None or self._state is None:
            raise RuntimeError(f"{type(self).__name__} has no scene yet: call reset(rng) first")
        return self._scene, self._state

    def _take(self, scene: Scene, state: State) -> None:
        self._dynamics.set_obstacles(scene.obstacles)
        self._scene, self._state = scene, state


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
