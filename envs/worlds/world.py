"""What a world is: simulator state and transition behind one protocol, with no PettingZoo in it.

A world owns its simulator, moves it, and describes the present instant as a `Snapshot`: true objects, what to draw,
and where the robots' cameras are. Everything else (cameras, claims, scoring, spaces) is the same for every world.

World frame: z up, metres. Camera frame: x right, y down, z forward. Angles: radians.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol, cast

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ObjectClass:
    """A kind of object that robots detect.

    Attributes:
        name: what a detector calls it.
        depth_to_centre_m: typical distance from the visible surface to the object's centre, along the viewing ray.
    """

    name: str
    depth_to_centre_m: float


@dataclass(frozen=True, eq=False)
class Mesh:
    """A triangle mesh in its body frame.

    Attributes:
        vertices: (v, 3) m.
        faces: (f, 3) int32 vertex indices, counter-clockwise seen from outside.
        colors: (f, 3) uint8 RGB of each face; multiplied by the body's tint when drawn.
        patterns: optional (f,) uint8, procedural pattern of each face, an index into `camera.shapes.PATTERNS`.
    """

    vertices: Array
    faces: NDArray[np.int32]
    colors: NDArray[np.uint8]
    patterns: NDArray[np.uint8] | None = None


@dataclass(frozen=True, eq=False)
class Light:
    """Sun and sky.

    Attributes:
        sun_direction: (3,) unit vector towards the sun, world frame.
        ambient: share of the light that comes from everywhere, in [0, 1].
        sky_color, horizon_color, ground_color: RGB in [0, 255].
    """

    sun_direction: tuple[float, float, float] = (0.35, 0.25, 0.9)
    ambient: float = 0.45
    sky_color: tuple[int, int, int] = (120, 170, 225)
    horizon_color: tuple[int, int, int] = (205, 220, 235)
    ground_color: tuple[int, int, int] = (120, 122, 118)


@dataclass(frozen=True, eq=False)
class Snapshot:
    """One instant of a world: m objects, b drawn bodies, N robots. Arrays are fresh: the caller may keep them.

    Attributes:
        time: s since the reset.
        identity: (m,) int64, stable over an episode and never reused in it.
        object_class: (m,) int64 index into `World.classes`.
        positions: (m, 3) m, centre of each object's bounding box, world frame.
        velocities: (m, 3) m/s, world frame.
        headings: (m,) rad about world z.
        sizes: (m, 3) m, length, width, height of the bounding box.
        body_mesh: (b,) int64 index into `World.meshes`.
        body_poses: (b, 4, 4) T_world_body.
        body_tints: (b, 3) RGB factors in [0, 1].
        body_object: (b,) int64 index of the object the body belongs to (0..m-1), or -1 for scenery.
        T_world_camera: (N, 4, 4).
        robot_object: (N,) int64 index of the object that robot is itself (its own camera does not draw it), or -1.
        robot_velocity: (N, 3) m/s, world frame.
        robot_state: (N, s) what a robot knows of itself (speed etc.); the world documents the columns.
        collided: (N,) bool, robot in contact with anything but the ground since the last step.
        light: sun and sky.
    """

    time: float
    identity: NDArray[np.int64]
    object_class: NDArray[np.int64]
    positions: Array
    velocities: Array
    headings: Array
    sizes: Array
    body_mesh: NDArray[np.int64]
    body_poses: Array
    body_tints: Array
    body_object: NDArray[np.int64]
    T_world_camera: Array
    robot_object: NDArray[np.int64]
    robot_velocity: Array
    robot_state: Array
    collided: NDArray[np.bool_]
    light: Light


class World(Protocol):
    """Simulator state and transition. The attributes may be plain ones; the protocol only reads them.

    Attributes:
        classes: kinds of objects, in the order of the attribute vector.
        meshes: every mesh a snapshot may refer to; fixed for the life of the world.
        n_robots: N.
        max_objects: upper bound of m in any snapshot.
        control_size: d, controls per robot.
        state_size: s, columns of `robot_state`.
        horizontal_fov_rad: (N,) full horizontal field of view of each robot's camera.
        step_seconds: simulated time per step.
        ends_on_collision: whether a collision of any robot ends the episode.
    """

    @property
    def classes(self) -> tuple[ObjectClass, ...]: ...

    @property
    def meshes(self) -> tuple[Mesh, ...]: ...

    @property
    def n_robots(self) -> int: ...

    @property
    def max_objects(self) -> int: ...

    @property
    def control_size(self) -> int: ...

    @property
    def state_size(self) -> int: ...

    @property
    def horizontal_fov_rad(self) -> Array: ...

    @property
    def step_seconds(self) -> float: ...

    @property
    def ends_on_collision(self) -> bool: ...

    def reset(self, rng: np.random.Generator) -> None:
        """Generate a new scene from `rng` alone. Raises SceneGenerationError if that fails within bounded tries."""

    def step(self, controls: Array) -> None:
        """Advance by `step_seconds` under controls (N, d) in [-1, 1]."""

    def snapshot(self) -> Snapshot:
        """The present instant."""

    def close(self) -> None:
        """Release the simulator; calling it twice is harmless."""


def checked_world(world: Any) -> World:
    """The world. Raises TypeError naming what it lacks of the protocol."""
    missing = [name for name in vars(World) if not name.startswith("_") and not hasattr(world, name)]
    if missing:
        raise TypeError(f"{type(world).__name__} is no World: it has no {', '.join(missing)}")
    return cast(World, world)


class SceneGenerationError(RuntimeError):
    """No scene satisfying the parameters was found within the bounded number of tries; the message says why."""
