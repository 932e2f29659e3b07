"""Our camera beside TinyRenderer on one scene, for `covis speed envs`: the same meshes, poses, view and size."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ..worlds.world import Array, Light, Mesh, Snapshot
from . import shapes
from .backends import BulletCamera
from .raster import PLAIN, Look, Rasterizer, intrinsics_from_fov, look_at

HORIZONTAL_FOV_RAD = np.radians(70.0)
EYE, TARGET = (-2.0, 0.0, 1.2), (4.0, 0.0, 0.3)


def low_poly_robot() -> Mesh:
    """A box and four cylinders: 268 triangles, Husky-sized."""
    wheels = [
        shapes.cylinder(0.165, 0.115, shapes.RUBBER, sides=17, axis="y", center=(x, y, 0.165))
        for x in (-0.256, 0.256)
        for y in (-0.278, 0.278)
    ]
    return shapes.merge(shapes.box((0.97, 0.4, 0.25), (230, 190, 40), (0, 0, 0.27)), *wheels)


def low_poly_team(robots: int = 15) -> tuple[tuple[Mesh, ...], Snapshot]:
    """Robots standing in rows of four before one camera; every one of them is its own object."""
    n = np.arange(robots)
    yaw: Array = 0.7 * n.astype(np.float64)
    poses = np.tile(np.eye(4), (robots, 1, 1))
    poses[:, 0, 0] = poses[:, 1, 1] = np.cos(yaw)
    poses[:, 1, 0], poses[:, 0, 1] = np.sin(yaw), -np.sin(yaw)
    poses[:, 0, 3] = 1.0 + 2.0 * (n // 4) + 0.3 * (n % 3)
    poses[:, 1, 3] = 1.6 * (n % 4) - 2.4 + 0.25 * (n // 4 % 2)
    zeros = np.zeros((robots, 3))
    snapshot = Snapshot(
        time=0.0,
        identity=n,
        object_class=np.zeros(robots, np.int64),
        positions=poses[:, :3, 3] + (0.0, 0.0, 0.2),
        velocities=zeros,
        headings=yaw,
        sizes=np.ones((robots, 3)),
        body_mesh=np.zeros(robots, np.int64),
        body_poses=poses,
        body_tints=np.ones((robots, 3)),
        body_object=n,
        T_world_camera=look_at(EYE, TARGET)[None],
        robot_object=np.array([-1]),
        robot_velocity=np.zeros((1, 3)),
        robot_state=np.zeros((1, 1)),
        collided=np.zeros(1, bool),
        light=Light(),
    )
    return (low_poly_robot(),), snapshot


def contenders(
    width: int, height: int, *, robots: int = 15, look: Look = PLAIN, ground: bool = True
) -> tuple[Callable[[], object], Callable[[], object], Callable[[], None]]:
    """Functions that take one picture (RGB, depth, ids) of one scene, ours and TinyRenderer's; and a closer.

    Ours does all of its work, fresh arrays included. TinyRenderer's is its `getCameraImage` with shadow=0 alone: bodies
    are already placed and its depth buffer stays as it is. `ground` gives it a square of ground to draw, as ours does.
    """
    meshes, snapshot = low_poly_team(robots)
    K: Array = intrinsics_from_fov(width, height, HORIZONTAL_FOV_RAD)
    raster = Rasterizer(meshes, width, height, look=look)
    tiny = BulletCamera(meshes, width, height, centred=False, ground=ground)
    tiny.place(snapshot)
    T = snapshot.T_world_camera[0]
    return lambda: raster.render(snapshot, 0, K), lambda: tiny.capture(T, K), tiny.close
