"""Our own software camera: triangles in; RGB, depth in metres and instance ids out, in Numba.

Three passes: transform, cull and clip each body and fill its triangles into a buffer of inverse depths and one of
triangle numbers; draw the ground plane z = 0 and the sky; put the bodies' pixels, each shaded once, before them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..worlds.world import Array, Light, Mesh, Snapshot
from ._kernels import NOISE_SIZE, TRIANGLE_FIELDS, render_kernel
from .shapes import normals

NEAR_M = 0.05
"""Nothing nearer than this along the optical axis is drawn."""

HAZE_M = 350.0
"""Distance at which half of the colour is the horizon's."""

NOBODY = -1


@dataclass(frozen=True, eq=False)
class Frame:
    """What one camera sees.

    Attributes:
        rgb: (H, W, 3) uint8.
        depth: (H, W) float32, m along the optical axis; inf where there is only sky.
        instances: (H, W) int32, index of the object in the snapshot; -1 for scenery, ground and sky.
    """

    rgb: NDArray[np.uint8]
    depth: NDArray[np.float32]
    instances: NDArray[np.int32]

    @classmethod
    def empty(cls, width: int, height: int) -> Frame:
        """Arrays to render into, contents undefined."""
        return cls(
            np.empty((height, width, 3), np.uint8),
            np.empty((height, width), np.float32),
            np.empty((height, width), np.int32),
        )

    def copy(self) -> Frame:
        """A frame that shares no memory with this one."""
        return Frame(self.rgb.copy(), self.depth.copy(), self.instances.copy())


class Rasterizer:
    """Draws snapshots of one world; owns its scratch memory, so use one per thread.

    Args:
        meshes: every mesh a snapshot may refer to.
        width, height: pixels.
        sample_offset: where in a pixel it is sampled, (right, down); (0.5, 0.5) is its centre.
        near_m: distance of the near plane, m.
        own_body: whether a robot's camera sees the robot itself.

    Raises:
        ValueError: a size below one pixel, a bad near plane or mesh.
    """

    def __init__(
        self,
        meshes: Sequence[Mesh],
        width: int,
        height: int,
        *,
        sample_offset: tuple[float, float] = (0.5, 0.5),
        near_m: float = NEAR_M,
        own_body: bool = False,
    ) -> None:
        if width < 1 or height < 1:
            raise ValueError(f"width and height must be at least 1 pixel, got {width}x{height}")
        if not near_m > 0:
            raise ValueError(f"near_m must be positive, got {near_m}")
        self.width, self.height = int(width), int(height)
        self.sample_offset = (float(sample_offset[0]), float(sample_offset[1]))
        self.near_m, self.own_body = float(near_m), bool(own_body)
        self._geometry = _pack(meshes)
        self._inverse_depth = np.zeros((height, width), np.float32)
        self._triangle_at = np.zeros((height, width), np.int32)
        self._spans = np.tile(np.array([[width, 0]], np.int32), (height, 1))
        self._projected = np.empty((max((len(m.vertices) for m in meshes), default=1), 6))
        self._triangles = np.empty((1024, TRIANGLE_FIELDS), np.float32)
        self._noise = _noise_tile().ravel()

    def render(self, snapshot: Snapshot, robot: int, intrinsics: Array, *, out: Frame | None = None) -> Frame:
        """The frame of one robot's camera, with intrinsics (3, 3); into fresh arrays, or into those of `out`.

        Raises:
            ValueError: no such robot, bad intrinsics, or `out` of another size.
        """
        if not 0 <= robot < len(snapshot.T_world_camera):
            raise ValueError(f"robot must be in 0..{len(snapshot.T_world_camera) - 1}, got {robot}")
        hidden = NOBODY if self.own_body else int(snapshot.robot_object[robot])
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
        return self.render_bodies(
            snapshot.body_mesh,
            snapshot.body_poses,
            snapshot.body_tints,
            snapshot.body_object,
            snapshot.light,
            T_world_camera,
            intrinsics,
            hidden_object=hidden_object,
            out=out,
        )

    def render_bodies(
        self,
        body_mesh: NDArray[np.int64],
        body_poses: Array,
        body_tints: Array,
        body_object: NDArray[np.int64],
        light: Light,
        T_world_camera: Array,
        intrinsics: Array,
        *,
        hidden_object: int = NOBODY,
        out: Frame | None = None,
    ) -> Frame:
        """Like `render_view`, from the arrays of a snapshot."""
        frame = Frame.empty(self.width, self.height) if out is None else self._checked(out)
        needed = render_kernel(
            *self._geometry,
            _contiguous(body_mesh, np.int64),
            _contiguous(body_poses, np.float64),
            _contiguous(body_tints, np.float64),
            _contiguous(body_object, np.int64),
            hidden_object,
            _camera_row(T_world_camera, intrinsics, self.sample_offset, self.near_m),
            light_row(light),
            self._noise,
            self._projected,
            self._triangles,
            self._inverse_depth,
            self._triangle_at,
            self._spans,
            frame.rgb,
            frame.depth,
            frame.instances,
        )
        if needed > 0:
            self._triangles = np.empty((2 * needed, TRIANGLE_FIELDS), np.float32)
            return self.render_bodies(
                body_mesh,
                body_poses,
                body_tints,
                body_object,
                light,
                T_world_camera,
                intrinsics,
                hidden_object=hidden_object,
                out=frame,
            )
        if needed < 0:
            raise ValueError(f"body_mesh refers to mesh {-needed - 1}, there are {len(self._geometry[0]) - 1}")
        return frame

    def _checked(self, out: Frame) -> Frame:
        expected = Frame.empty(0, 0)
        shapes = ((self.height, self.width, 3), (self.height, self.width), (self.height, self.width))
        for name, shape in zip(("rgb", "depth", "instances"), shapes, strict=True):
            array = getattr(out, name)
            dtype = getattr(expected, name).dtype
            if array.shape != shape or array.dtype != dtype or not array.flags.c_contiguous:
                raise ValueError(f"out.{name} must be contiguous {shape} {dtype}, got {array.shape} {array.dtype}")
        return out


def intrinsics_from_fov(width: int, height: int, horizontal_fov_rad: float) -> Array:
    """Pinhole matrix (3, 3) with square pixels and the optical axis through the image's centre.

    (0, 0) is the outer corner of the first pixel, so pixel centres lie at +0.5.

    Raises:
        ValueError: a field of view outside (0, pi).
    """
    if not 0 < horizontal_fov_rad < np.pi:
        raise ValueError(f"horizontal_fov_rad must be in (0, pi), got {horizontal_fov_rad}")
    focal = 0.5 * width / np.tan(0.5 * horizontal_fov_rad)
    return np.array([[focal, 0.0, 0.5 * width], [0.0, focal, 0.5 * height], [0.0, 0.0, 1.0]])


def look_at(eye: ArrayLike, target: ArrayLike, up: ArrayLike = (0.0, 0.0, 1.0)) -> Array:
    """T_world_camera (4, 4) of a camera at `eye` that looks at `target`, both (3,) m, with `up` upwards in its image.

    Raises:
        ValueError: `up` is along the line of sight, or `eye` is `target`.
    """
    origin = np.asarray(eye, dtype=np.float64)
    forward = np.asarray(target, dtype=np.float64) - origin
    right = np.cross(forward, np.asarray(up, dtype=np.float64))
    if not np.linalg.norm(forward) > 0 or np.linalg.norm(right) < 1e-9 * np.linalg.norm(forward):
        raise ValueError(f"cannot look from {eye!r} at {target!r} with up {up!r}")
    T = np.eye(4)
    T[:3, 2] = forward / np.linalg.norm(forward)
    T[:3, 0] = right / np.linalg.norm(right)
    T[:3, 1] = np.cross(T[:3, 2], T[:3, 0])
    T[:3, 3] = origin
    return T


def light_row(light: Light) -> Array:
    """The light as the kernels take it (14,): sun, ambient, haze 1/m, sky, horizon and ground colours."""
    sun = np.asarray(light.sun_direction, dtype=np.float64)
    sun = sun / max(float(np.linalg.norm(sun)), 1e-12)
    colors = (*light.sky_color, *light.horizon_color, *light.ground_color)
    return np.array((*sun, light.ambient, 1.0 / HAZE_M, *colors), dtype=np.float64)


def _camera_row(T_world_camera: Array, intrinsics: Array, sample_offset: tuple[float, float], near_m: float) -> Array:
    """The camera as the kernels take it (19,): rotation, position, focal lengths and centre, offset, near plane."""
    T = np.asarray(T_world_camera, dtype=np.float64)
    K = np.asarray(intrinsics, dtype=np.float64)
    if T.shape != (4, 4):
        raise ValueError(f"T_world_camera must have shape (4, 4), got {T.shape}")
    if K.shape != (3, 3) or not (K[0, 0] > 0 and K[1, 1] > 0 and K[0, 1] == K[1, 0] == 0 and K[2, 2] == 1):
        raise ValueError(f"intrinsics must be a pinhole matrix (3, 3) without skew, got\n{K}")
    row = np.empty(19)
    row[:9] = T[:3, :3].ravel()
    row[9:12] = T[:3, 3]
    row[12:] = K[0, 0], K[1, 1], K[0, 2], K[1, 2], *sample_offset, near_m
    return row


def _contiguous(array: ArrayLike, dtype: type) -> NDArray[Any]:
    return np.ascontiguousarray(array, dtype=dtype)


def _pack(meshes: Sequence[Mesh]) -> tuple[NDArray[Any], ...]:
    """All meshes end to end: first vertex and face of each, bounding spheres, vertices, faces, planes, colours."""
    for i, m in enumerate(meshes):
        if not np.isfinite(m.vertices).all() or len(m.colors) != len(m.faces):
            raise ValueError(f"mesh {i} has a vertex that is not finite, or not one colour per face")
    first_vertex = np.cumsum([0, *(len(m.vertices) for m in meshes)]).astype(np.int64)
    first_face = np.cumsum([0, *(len(m.faces) for m in meshes)]).astype(np.int64)
    spheres = np.array([_bounding_sphere(m.vertices) for m in meshes]).reshape(-1, 4)
    planes = [np.column_stack([n := normals(m), np.einsum("ij,ij->i", n, m.vertices[m.faces[:, 0]])]) for m in meshes]
    return (
        first_vertex,
        first_face,
        spheres,
        np.vstack([np.zeros((0, 3)), *(m.vertices for m in meshes)]),
        np.vstack([np.zeros((0, 3), np.int32), *(m.faces for m in meshes)]).astype(np.int32),
        np.vstack([np.zeros((0, 4)), *planes]),
        np.vstack([np.zeros((0, 3), np.uint8), *(m.colors for m in meshes)]).astype(np.float64),
    )


def _bounding_sphere(vertices: Array) -> Array:
    centre = 0.5 * (vertices.min(0) + vertices.max(0))
    return np.array([*centre, np.linalg.norm(vertices - centre, axis=1).max()])


def _noise_tile() -> NDArray[np.float32]:
    """Smooth noise (s, s) in [-1, 1] that tiles; the same one in every process."""
    size = NOISE_SIZE
    rng = np.random.Generator(np.random.PCG64(20211))
    frequency = np.hypot(*np.meshgrid(np.fft.fftfreq(size), np.fft.rfftfreq(size), indexing="ij")) * size
    spectrum = np.fft.rfft2(rng.standard_normal((size, size))) / (1.0 + frequency / 6.0) ** 1.4
    spectrum[0, 0] = 0.0
    tile = np.fft.irfft2(spectrum, (size, size))
    return (np.clip(tile / (2.5 * tile.std()), -1, 1)).astype(np.float32)
