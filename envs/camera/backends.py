"""pybullet's renderers drawing the same snapshots: the parity oracle, the peer in speed, and an alternative camera.

Bodies come from pybullet; ground and sky, which its renderers lack, from our kernels, so that a `Frame` means the same.
"""

from __future__ import annotations

import contextlib
import importlib.util
import tempfile
import weakref
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ..worlds.bullet import connect, load_pybullet, silence
from ..worlds.world import Array, Mesh, Snapshot
from .frame import Frame
from .raster import NOBODY, Rasterizer

TINY_SAMPLE_OFFSET = (0.0, 1.0)
"""Where TinyRenderer samples a pixel (right, down): its lower left corner, not its centre."""

EGL_SAMPLE_OFFSET = (0.5, 0.5)

NEAR_M, FAR_M = 0.1, 300.0
AWAY_M = 1e5
NONE = np.zeros(0, np.int64)
_EGL_CLIENTS: set[int] = set()


def make_camera(backend: str, meshes: Sequence[Mesh], width: int, height: int, **options: Any) -> Camera:
    """A camera that draws snapshots: backend "raster" (ours), "tiny" or "egl" (pybullet's); options go to its class.

    Raises:
        ValueError: no such backend.
        ImportError: the backend needs pybullet, which is not installed.
        RuntimeError: "egl" where EGL cannot start.
    """
    if backend == "raster":
        return Rasterizer(meshes, width, height, **options)
    if backend in ("tiny", "egl"):
        return BulletCamera(meshes, width, height, renderer=backend, **options)
    raise ValueError(f'backend must be "raster", "tiny" or "egl", got {backend!r}')


class Camera(Protocol):
    """What every backend offers."""

    width: int
    height: int

    def render(self, snapshot: Snapshot, robot: int, intrinsics: Array, *, out: Frame | None = None) -> Frame:
        """The frame of one robot's camera, with intrinsics (3, 3)."""

    def render_view(
        self,
        snapshot: Snapshot,
        T_world_camera: Array,
        intrinsics: Array,
        *,
        hidden_object: int = NOBODY,
        out: Frame | None = None,
    ) -> Frame:
        """The frame of a camera anywhere."""


class BulletCamera:
    """pybullet's TinyRenderer, or its EGL plugin (OpenGL without a display), as a camera of snapshots.

    One visual shape per mesh, in the mesh's mean colour times the tint: pybullet has no colours per face.

    Args:
        meshes: every mesh a snapshot may refer to.
        width, height: pixels.
        renderer: "tiny" or "egl".
        centred: shift the picture so that pixels are sampled at their centres; False keeps TinyRenderer's way.
        shadows: pybullet's shadows, 1.7 to 3 times slower.
        ground: also draw a square of ground in pybullet, so that it does the work our camera does; for comparing speed.

    Raises:
        ImportError: pybullet is not installed.
        RuntimeError: EGL cannot start on this machine.
    """

    def __init__(
        self,
        meshes: Sequence[Mesh],
        width: int,
        height: int,
        *,
        renderer: str = "tiny",
        centred: bool = True,
        shadows: bool = False,
        ground: bool = False,
    ) -> None:
        self._pybullet = load_pybullet()
        self.width, self.height = int(width), int(height)
        self.centred, self.shadows = bool(centred), bool(shadows)
        self._client = connect()
        self._quit = weakref.finalize(self, _disconnect, self._client)
        self._renderer = self._pybullet.ER_TINY_RENDERER
        self._sample_offset = TINY_SAMPLE_OFFSET
        if renderer == "egl":
            self._renderer = self._pybullet.ER_BULLET_HARDWARE_OPENGL
            self._sample_offset = EGL_SAMPLE_OFFSET
            _load_egl(self._client)
        elif renderer != "tiny":
            raise ValueError(f'renderer must be "tiny" or "egl", got {renderer!r}')
        self._meshes = tuple(meshes)
        self._drawn = False
        self._shapes: dict[int, int] = {}
        self._bodies: list[tuple[int, int]] = []  # (mesh, pybullet's id) in drawing order
        self._tints: Array = np.zeros((0, 3))
        self._background = Rasterizer((), width, height)
        if ground:
            corners = [[-200.0, -200.0, 0.0], [200.0, -200.0, 0.0], [200.0, 200.0, 0.0], [-200.0, 200.0, 0.0]]
            self._body(self._shape_of(np.array(corners), np.array([0, 1, 2, 0, 2, 3])))

    def render(self, snapshot: Snapshot, robot: int, intrinsics: Array, *, out: Frame | None = None) -> Frame:
        """The frame of one robot's camera; the robot itself is not drawn."""
        hidden = int(snapshot.robot_object[robot])
        return self.render_view(snapshot, snapshot.T_world_camera[robot], intrinsics, hidden_object=hidden, out=out)

    def render_view(
        self,
        snapshot: Snapshot,
        T_world_camera: Array,
        intrinsics: Array,
        *,
        hidden_object: int = NOBODY,
        out: Frame | None = None,
    ) -> Frame:
        """The frame of a camera anywhere, without the bodies of the object `hidden_object`."""
        self.place(snapshot, hidden_object)
        colors, depth, ids = self.draw(T_world_camera, intrinsics)
        frame = self._background.render_bodies(
            NONE, np.zeros((0, 4, 4)), np.zeros((0, 3)), NONE, snapshot.light, T_world_camera, intrinsics,
            out=out,
        )  # fmt: skip
        objects = np.full(max((i for _, i in self._bodies), default=0) + 2, -1, np.int32)
        objects[[i for _, i in self._bodies]] = snapshot.body_object
        front = (ids >= 0) & (depth < frame.depth)
        frame.rgb[front] = colors[front]
        frame.depth[front] = depth[front]
        frame.instances[front] = objects[ids[front]]
        return frame

    def place(self, snapshot: Snapshot, hidden_object: int = NOBODY) -> None:
        """Move pybullet's bodies to where the snapshot has them; the bodies of `hidden_object` out of sight."""
        p = self._pybullet
        kinds = [int(m) for m in snapshot.body_mesh]
        if kinds != [m for m, _ in self._bodies]:
            for _, body in self._bodies:
                p.removeBody(body, physicsClientId=self._client)
            self._bodies = [(m, self._body(self._shape(m))) for m in kinds]
            self._tints = np.full((len(kinds), 3), np.nan)
        for i, (m, body) in enumerate(self._bodies):
            T = snapshot.body_poses[i]
            hidden = hidden_object >= 0 and snapshot.body_object[i] == hidden_object
            where = (0.0, 0.0, -AWAY_M) if hidden else T[:3, 3].tolist()
            p.resetBasePositionAndOrientation(body, where, _quaternion(T[:3, :3]), physicsClientId=self._client)
            if not np.array_equal(self._tints[i], snapshot.body_tints[i]):
                color = self._meshes[m].colors.mean(0) / 255.0 * snapshot.body_tints[i]
                p.changeVisualShape(body, -1, rgbaColor=[*color.tolist(), 1.0], physicsClientId=self._client)
                self._tints[i] = snapshot.body_tints[i]

    def draw(
        self, T_world_camera: Array, intrinsics: Array
    ) -> tuple[NDArray[np.uint8], NDArray[np.float32], NDArray[np.int64]]:
        """What was placed: RGB (H, W, 3), depth (H, W) m, pybullet's body ids (H, W)."""
        _, _, colors, buffer, ids = self.capture(T_world_camera, intrinsics)
        # pybullet returns tuples instead of arrays when it was built without NumPy.
        shape = (self.height, self.width)
        depth = np.reshape(np.asarray(buffer, np.float32), shape)
        depth = (FAR_M * NEAR_M / (FAR_M - (FAR_M - NEAR_M) * depth.astype(np.float64))).astype(np.float32)
        rgb = np.reshape(np.asarray(colors, np.uint8), (*shape, 4))[..., :3]
        return rgb, depth, np.reshape(np.asarray(ids, np.int64), shape)

    def capture(self, T_world_camera: Array, intrinsics: Array) -> tuple[Any, ...]:
        """Only pybullet's own work on what was placed: what its `getCameraImage` returns."""
        K = np.array(intrinsics, dtype=np.float64)
        if self.centred:
            K[0, 2] += self._sample_offset[0] - 0.5
            K[1, 2] += self._sample_offset[1] - 0.5
        with contextlib.nullcontext() if self._drawn else silence():
            picture = self._pybullet.getCameraImage(
                self.width,
                self.height,
                view_matrix(T_world_camera),
                projection_matrix(K, self.width, self.height),
                shadow=int(self.shadows),
                renderer=self._renderer,
                physicsClientId=self._client,
            )
        self._drawn = True
        return tuple(picture)

    def close(self) -> None:
        """Disconnect from pybullet; calling it twice is harmless."""
        self._quit()

    def _shape(self, mesh: int) -> int:
        if mesh not in self._shapes:
            m = self._meshes[mesh]
            self._shapes[mesh] = self._shape_of(m.vertices, m.faces.ravel())
        return self._shapes[mesh]

    def _shape_of(self, vertices: Array, indices: NDArray[Any]) -> int:
        p = self._pybullet
        with silence():
            if self._renderer == p.ER_TINY_RENDERER:
                return int(
                    p.createVisualShape(
                        p.GEOM_MESH, vertices=vertices.tolist(), indices=indices.tolist(), physicsClientId=self._client
                    )
                )
            # The EGL plugin crashes on meshes from memory; from a file it takes them.
            with tempfile.TemporaryDirectory() as folder:
                path = Path(folder) / "mesh.obj"
                path.write_text(_wavefront(vertices, indices))
                return int(p.createVisualShape(p.GEOM_MESH, fileName=str(path), physicsClientId=self._client))

    def _body(self, shape: int) -> int:
        return int(self._pybullet.createMultiBody(0, -1, shape, physicsClientId=self._client))


def _wavefront(vertices: Array, indices: NDArray[Any]) -> str:
    """The mesh as an OBJ file, with corners and normals of their own for each face, so that it is shaded flat."""
    lines = []
    for n, face in enumerate(indices.reshape(-1, 3)):
        a, b, c = vertices[face]
        normal = np.cross(b - a, c - a)
        normal = normal / max(float(np.linalg.norm(normal)), 1e-12)
        lines += [f"v {x} {y} {z}" for x, y, z in (a, b, c)]
        lines.append("vn {} {} {}".format(*normal))
        lines.append("f " + " ".join(f"{3 * n + k}//{n + 1}" for k in (1, 2, 3)))
    return "\n".join([*lines, ""])


def _disconnect(client: int) -> None:
    with silence():
        load_pybullet().disconnect(client)
    _EGL_CLIENTS.discard(client)


def _load_egl(client: int) -> None:
    if _EGL_CLIENTS:
        raise RuntimeError("pybullet can have one EGL camera open in a process: close the other one first")
    library = importlib.util.find_spec("eglRenderer")
    if library is None or library.origin is None:
        raise RuntimeError("this build of pybullet has no EGL plugin")
    with silence():
        plugin = load_pybullet().loadPlugin(library.origin, "_eglRendererPlugin", physicsClientId=client)
    if plugin < 0:
        raise RuntimeError("pybullet's EGL plugin did not start: it needs EGL and OpenGL 3.3, for example Mesa's")
    _EGL_CLIENTS.add(client)


def view_matrix(T_world_camera: Array) -> list[float]:
    """OpenGL's view matrix, column-major (16), of a camera with x right, y down, z forward."""
    T = np.linalg.inv(np.asarray(T_world_camera, dtype=np.float64))
    return [float(x) for x in (np.diag([1.0, -1.0, -1.0, 1.0]) @ T).T.ravel()]


def projection_matrix(
    intrinsics: Array, width: int, height: int, near_m: float = NEAR_M, far_m: float = FAR_M
) -> list[float]:
    """OpenGL's projection matrix, column-major (16), of a pinhole camera (3, 3) without skew."""
    K = intrinsics
    P = np.zeros((4, 4))
    P[0, 0], P[0, 2] = 2 * K[0, 0] / width, 1 - 2 * K[0, 2] / width
    P[1, 1], P[1, 2] = 2 * K[1, 1] / height, 2 * K[1, 2] / height - 1
    P[2, 2], P[2, 3] = -(far_m + near_m) / (far_m - near_m), -2 * far_m * near_m / (far_m - near_m)
    P[3, 2] = -1.0
    return [float(x) for x in P.T.ravel()]


def _quaternion(R: Array) -> list[float]:
    from scipy.spatial.transform import Rotation

    return [float(x) for x in Rotation.from_matrix(R).as_quat()]
