"""The S-MRC scene as plain pybullet users build it: what `covis speed envs` measures ours against.

`stock=True`: pybullet's own Husky URDF with its meshes, wheel motors, 24 engine steps of 1/120 s per 0.2 s.
`stock=False`: our box bodies and low-poly meshes, so that only the renderer differs.
Either way TinyRenderer draws, without shadows, and gives RGB, depth buffer and ids of every observer's camera.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from types import ModuleType

import numpy as np
from numpy.typing import NDArray

from .bullet import BodyState, BoxDynamics
from .multi_robot import MultiRobotParams, MultiRobotWorld
from .robots import RobotWorld
from .wheels import WheelDynamics
from .world import Array, Mesh

NEAR_M, FAR_M = 0.1, 100.0


@dataclass(frozen=True, eq=False)
class TinyImages:
    """What TinyRenderer gives: rgb (H, W, 4) uint8, depth buffer (H, W) float32, body ids (H, W) int32."""

    rgb: NDArray[np.uint8]
    depth: NDArray[np.float32]
    ids: NDArray[np.int32]


def speed_params(n_team: int = 15) -> MultiRobotParams:
    """The scene both sides run: `n_team` robots, four obstacles, nothing around."""
    return MultiRobotParams(n_team=n_team, n_obstacles=(4, 4), n_backdrop=(0, 0), moving_share=1.0)


class TinyPeer:
    """A multi_robot scene moved and drawn by pybullet alone.

    Args:
        n_observers: N.
        params: of the scene; the backdrop is not drawn.
        width, height: pixels.
        stock: stock Husky on wheels rather than our box bodies and meshes.
        shadow: TinyRenderer's shadows, which cost it as much again.
    """

    def __init__(
        self,
        n_observers: int = 2,
        params: MultiRobotParams | None = None,
        *,
        width: int = 160,
        height: int = 120,
        stock: bool = True,
        shadow: bool = False,
    ) -> None:
        params = speed_params() if params is None else params
        self.world = MultiRobotWorld(n_observers, params)
        self.width, self.height, self._shadow = width, height, int(shadow)
        sizes = self.world.obstacle_sizes()
        self._dynamics: PlainWheels | VisibleBoxes
        if stock:
            self._dynamics = PlainWheels(n_observers + params.n_team, sizes, step_seconds=params.step_seconds)
        else:
            husky, obstacle = self.world.meshes[0], self.world.meshes[5]
            robots = np.tile(np.ptp(husky.vertices, axis=0)[:2], (n_observers + params.n_team, 1))
            shapes = [husky] * len(robots) + [obstacle] * len(sizes)
            self._dynamics = VisibleBoxes(shapes, robots, sizes, step_seconds=params.step_seconds)
        self.world.use_dynamics(self._dynamics)

    def reset(self, rng: np.random.Generator) -> list[TinyImages]:
        """A new scene, and what its cameras see."""
        self.world.reset(rng)
        self._dynamics.show(self.world.save_state().state.bodies)
        return self.images()

    def follow(self, world: RobotWorld) -> list[TinyImages]:
        """The present scene of another multi_robot world of the same parameters, its robots standing still."""
        saved = world.save_state()
        bodies = self._dynamics.rest(saved.state.bodies.planar)
        self.world.restore_state(replace(saved, state=replace(saved.state, bodies=bodies)))
        self._dynamics.show(bodies)
        return self.images()

    def step(self, controls: Array) -> list[TinyImages]:
        """Move all robots for one step under the observers' controls (N, 2), and see what their cameras see."""
        self.world.step(controls)
        return self.images()

    def images(self) -> list[TinyImages]:
        """One camera image per observer."""
        client, p = self._dynamics.client, self._dynamics.pybullet
        out = []
        for T, fov in zip(self.world.snapshot().T_world_camera, self.world.horizontal_fov_rad, strict=True):
            view, projection = gl_matrices(T, float(fov), self.height / self.width)
            _, _, rgb, depth, ids = p.getCameraImage(
                self.width,
                self.height,
                view,
                projection,
                shadow=self._shadow,
                renderer=p.ER_TINY_RENDERER,
                physicsClientId=client,
            )
            shape = (self.height, self.width)
            out.append(
                TinyImages(
                    np.asarray(rgb, np.uint8).reshape(*shape, 4),
                    np.asarray(depth, np.float32).reshape(shape),
                    np.asarray(ids, np.int32).reshape(shape),
                )
            )
        return out

    def close(self) -> None:
        """End the engine; calling it twice is harmless."""
        self.world.close()


class PlainWheels(WheelDynamics):
    """Wheel dynamics as everybody runs them: the engine keeps its state from step to step."""

    _last: BodyState | None = None
    _keep = False

    def show(self, state: BodyState) -> None:
        """Put the bodies where a new scene begins."""
        self._keep = False
        self._set(self.pybullet, self.client, state.inner)
        self._last = state

    def advance(self, state: BodyState, commands: Array) -> tuple[BodyState, NDArray[np.bool_]]:
        """See `Dynamics.advance`."""
        self._keep = state is self._last
        self._last, touched = super().advance(state, commands)
        return self._last, touched

    def _set(self, p: ModuleType, client: int, inner: Array) -> None:
        if not self._keep:
            super()._set(p, client, inner)


class VisibleBoxes(BoxDynamics):
    """Box bodies that TinyRenderer draws as the given meshes, one per body."""

    def __init__(
        self, meshes: Sequence[Mesh], robot_sizes: Array, obstacle_sizes: Array, *, step_seconds: float
    ) -> None:
        super().__init__(robot_sizes, obstacle_sizes, step_seconds=step_seconds)
        self._meshes = list(meshes)

    def show(self, state: BodyState) -> None:
        """Put the bodies where a new scene begins."""
        self._set_poses(self.pybullet, self.client, state.planar)

    def visual_shape(self, p: ModuleType, client: int, body: int) -> int:
        """The mesh of that body."""
        mesh = self._meshes[body]
        return int(
            p.createVisualShape(
                p.GEOM_MESH,
                vertices=mesh.vertices.tolist(),
                indices=mesh.faces.ravel().tolist(),
                rgbaColor=[0.8, 0.6, 0.2, 1.0],
                physicsClientId=client,
            )
        )


def gl_matrices(T_world_camera: Array, horizontal_fov_rad: float, aspect: float) -> tuple[list[float], list[float]]:
    """OpenGL's view and projection matrix, column-major, of a camera (4, 4); `aspect` is height / width."""
    to_gl = np.diag([1.0, -1.0, -1.0, 1.0])  # OpenGL's camera: y up, looking along -z
    view = np.linalg.inv(T_world_camera @ to_gl)
    x = 1.0 / np.tan(0.5 * horizontal_fov_rad)
    projection = np.zeros((4, 4))
    projection[0, 0], projection[1, 1] = x, x / aspect
    projection[2, 2] = -(FAR_M + NEAR_M) / (FAR_M - NEAR_M)
    projection[2, 3] = -2 * FAR_M * NEAR_M / (FAR_M - NEAR_M)
    projection[3, 2] = -1.0
    return view.T.ravel().tolist(), projection.T.ravel().tolist()
