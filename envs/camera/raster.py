"""Our own software camera: triangles in; RGB, depth in metres and instance ids out, in Numba.

Three passes: transform, cull and clip each body and fill its triangles into a buffer of inverse depths and one of
triangle numbers; draw the ground plane z = 0 and the sky; put the bodies' pixels, each shaded once, before them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import isfinite
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..worlds.world import Array, Light, Mesh, Snapshot
from ._background import NOISE_SIZE, draw_background
from ._foreground import draw_foreground, mean_colors
from ._triangles import (
    BAD_POSE,
    NO_MESH,
    PATTERNED,
    SMOOTH,
    TABLE_FULL,
    TRIANGLE_FIELDS,
    draw_bodies,
    draw_shadows,
)
from .frame import Frame, FrameMemory
from .shapes import PATTERNS, corner_normals, extent, normals, pattern_axes

NEAR_M = 0.05
"""Nothing nearer than this along the optical axis is drawn."""

NOBODY = -1


@dataclass(frozen=True)
class Look:
    """What is drawn beyond shape and colour; nothing here changes depth or instances.

    Attributes:
        smooth: round what is round (brightness runs smoothly over edges of less than 46 degrees) and smooth the ground.
        patterns: draw the meshes' patterns.
        shadows: shadows that the sun casts on the ground, and on bodies that lie flat on it.
        contact: darkness of the ground about the feet of bodies, in [0, 1].
        clouds: strength of clouds, in [0, 1].
        haze_m: distance at which half of the colour is the horizon's.
        samples: colours are the mean of samples x samples points of each pixel, against jagged edges; 1 is off.

    Raises:
        ValueError: a value out of its range.
    """

    smooth: bool = True
    patterns: bool = True
    shadows: bool = True
    contact: float = 0.6
    clouds: float = 0.6
    haze_m: float = 350.0
    samples: int = 1

    def __post_init__(self) -> None:
        for name in ("contact", "clouds", "haze_m"):
            if not isinstance(getattr(self, name), int | float | np.number):
                raise ValueError(f"{name} must be a number, got {getattr(self, name)!r}")
        for name in ("contact", "clouds"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"{name} must be in [0, 1], got {getattr(self, name)}")
        if not self.haze_m > 0:
            raise ValueError(f"haze_m must be positive, got {self.haze_m}")
        if self.samples not in (1, 2, 3, 4):
            raise ValueError(f"samples must be 1, 2, 3 or 4, got {self.samples}")


PLAIN = Look(smooth=False, patterns=False, shadows=False, contact=0.0, clouds=0.0)
"""Flat faces, ground and sky: the fastest."""


class Rasterizer:
    """Draws snapshots of one world; owns its scratch memory, so use one per thread.

    Args:
        meshes: every mesh a snapshot may refer to.
        width, height: pixels.
        look: shading, patterns, shadows, anti-aliasing.
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
        look: Look = Look(),
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
        self.look = look
        # With several samples the colours come from the finer picture: this one gives depth and instances.
        own = PLAIN if look.samples > 1 else look
        self._geometry = _pack(meshes, own)
        self._inverse_depth = np.zeros((height, width), np.float32)
        self._triangle_at = np.zeros((height, width), np.int32)
        self._spans = np.tile(np.array([[width, 0]], np.int32), (height, 1))
        self._shadow = np.zeros((height, width), np.uint8)
        self._contact = np.zeros((height, width), np.uint8)
        self._shadow_spans = self._spans.copy()
        self._shaded = own.shadows or own.contact > 0
        self._look = np.array([own.contact, own.shadows, own.clouds, own.smooth])
        self._projected = np.empty((5, max(4, *(len(m.vertices) for m in meshes), 4)))
        self._triangles = np.empty((1024, TRIANGLE_FIELDS), np.float32)
        self._noise = _noise_tile().ravel()
        self._frames = FrameMemory(self.width, self.height)
        self._light = Light()
        self._light_row = light_row(self._light, look.haze_m)
        self._fine: Rasterizer | None = None
        if look.samples > 1:
            self._fine = Rasterizer(
                meshes,
                width * look.samples,
                height * look.samples,
                look=replace(look, samples=1),
                near_m=near_m,
                own_body=own_body,
            )
            self._fine_frame = Frame.empty(self._fine.width, self._fine.height)

    def resized(self, width: int, height: int) -> Rasterizer:
        """A rasteriser of the same meshes and look at another size; it shares their preparation."""
        other = Rasterizer((), width, height, look=self.look, near_m=self.near_m, own_body=self.own_body)
        other.sample_offset, other._geometry, other._projected = self.sample_offset, self._geometry, self._projected
        if other._fine is not None and self._fine is not None:
            other._fine._geometry, other._fine._projected = self._fine._geometry, self._fine._projected
        return other

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
        frame = self._frames.frame() if out is None else self._checked(out)
        meshes = _contiguous(body_mesh, np.int64)
        poses = _contiguous(body_poses, np.float64)
        objects = _contiguous(body_object, np.int64)
        if not len(meshes) == len(poses) == len(body_tints) == len(objects):
            counts = (len(meshes), len(poses), len(body_tints), len(objects))
            raise ValueError(f"there are {counts} body meshes, poses, tints and objects; the counts must agree")
        camera = _camera_row(T_world_camera, intrinsics, self.sample_offset, self.near_m)
        if light is not self._light:
            self._light, self._light_row = light, light_row(light, self.look.haze_m)
        lights = self._light_row
        status, number = TABLE_FULL, len(self._triangles)
        while status == TABLE_FULL:
            status, number = draw_bodies(
                self._geometry,
                meshes,
                poses,
                _contiguous(body_tints, np.float64),
                objects,
                hidden_object,
                self._shaded,
                camera,
                lights,
                self._projected,
                self._triangles,
                self._inverse_depth,
                self._triangle_at,
                self._spans,
            )
            if status == TABLE_FULL:
                self._triangles = np.empty((2 * number, TRIANGLE_FIELDS), np.float32)
        if status == NO_MESH:
            raise ValueError(f"body_mesh[{number}] is {meshes[number]}, there are {len(self._geometry[0]) - 1} meshes")
        if status == BAD_POSE:
            raise ValueError(f"body_poses[{number}] is not finite:\n{poses[number]}")
        if self._shaded:
            draw_shadows(
                self._geometry,
                meshes,
                poses,
                self._look,
                camera,
                lights,
                self._projected,
                self._shadow,
                self._contact,
                self._shadow_spans,
            )
        colors = frame.rgb.reshape(self.height, 3 * self.width)
        draw_background(
            camera,
            lights,
            self._look,
            self._noise,
            self._inverse_depth,
            self._spans,
            self._shadow,
            self._contact,
            self._shadow_spans,
            colors,
            frame.depth,
            frame.instances,
        )
        draw_foreground(
            camera[12],
            lights,
            self._noise,
            self._triangles,
            self._inverse_depth,
            self._triangle_at,
            self._spans,
            self._shadow,
            self._contact,
            self._shadow_spans,
            colors,
            frame.depth,
            frame.instances,
        )
        if self._fine is not None:
            scaled = np.array(intrinsics, dtype=np.float64)
            scaled[:2] *= self.look.samples
            fine = self._fine.render_bodies(
                meshes,
                poses,
                body_tints,
                objects,
                light,
                T_world_camera,
                scaled,
                hidden_object=hidden_object,
                out=self._fine_frame,
            )
            mean_colors(fine.rgb, frame.rgb)
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


def light_row(light: Light, haze_m: float) -> Array:
    """The light as the kernels take it (14,): sun, ambient, haze 1/m, sky, horizon and ground colours.

    Raises:
        ValueError: a value that is not finite, or out of its range.
    """
    sun = np.asarray(light.sun_direction, dtype=np.float64)
    sun = sun / max(float(np.linalg.norm(sun)), 1e-12)
    colors = (*light.sky_color, *light.horizon_color, *light.ground_color)
    row = np.array((*sun, light.ambient, 1.0 / haze_m, *colors), dtype=np.float64)
    if not np.isfinite(row).all() or not 0 <= light.ambient <= 1 or row[5:].min() < 0 or row[5:].max() > 255:
        raise ValueError(f"the light must be finite, ambient in [0, 1], colours in [0, 255], got {light}")
    return row


def _camera_row(T_world_camera: Array, intrinsics: Array, sample_offset: tuple[float, float], near_m: float) -> Array:
    """The camera as the kernels take it (19,): rotation, position, focal lengths and centre, offset, near plane."""
    T = np.asarray(T_world_camera, dtype=np.float64)
    K = np.asarray(intrinsics, dtype=np.float64)
    if T.shape != (4, 4):
        raise ValueError(f"T_world_camera must have shape (4, 4), got {T.shape}")
    ok = K.shape == (3, 3)
    if ok:
        (fx, skew, cx), (zero, fy, cy), (_, _, one) = K.tolist()
        ok = fx > 0 and fy > 0 and skew == zero == 0 and one == 1
    if not ok:
        raise ValueError(f"intrinsics must be a pinhole matrix (3, 3) without skew, got\n{K}")
    row = np.empty(19)
    row[:9] = T[:3, :3].ravel()
    row[9:12] = T[:3, 3]
    row[12:] = fx, fy, cx, cy, *sample_offset, near_m
    if not isfinite(row.sum()):
        raise ValueError(f"T_world_camera and intrinsics must be finite, got\n{T}\n{K}")
    return row


def _contiguous(array: ArrayLike, dtype: type) -> NDArray[Any]:
    return np.ascontiguousarray(array, dtype=dtype)


def _pack(meshes: Sequence[Mesh], look: Look) -> tuple[NDArray[Any], ...]:
    """All meshes end to end, as the kernels take them.

    First vertex and face of each mesh, bounding spheres, boxes; vertices (3, v); faces, their planes, colours, kinds,
    corner normals (9), gradients of their second and third corner's weight (6), directions of their pattern (6).
    """
    for i, m in enumerate(meshes):
        if not np.isfinite(m.vertices).all() or len(m.colors) != len(m.faces):
            raise ValueError(f"mesh {i} has a vertex that is not finite, or not one colour per face")
        if m.patterns is not None and (len(m.patterns) != len(m.faces) or max(m.patterns, default=0) >= len(PATTERNS)):
            raise ValueError(f"mesh {i} must have one pattern per face, each below {len(PATTERNS)}")
    surfaces = [_surface(m, look) for m in meshes]
    return (
        np.cumsum([0, *(len(m.vertices) for m in meshes)]).astype(np.int64),
        np.cumsum([0, *(len(m.faces) for m in meshes)]).astype(np.int64),
        np.array([_bounding_sphere(m.vertices) for m in meshes]).reshape(-1, 4),
        np.array([np.concatenate(extent(m)) for m in meshes]).reshape(-1, 6),
        np.ascontiguousarray(np.vstack([np.zeros((0, 3)), *(m.vertices for m in meshes)]).T),
        np.vstack([np.zeros((0, 3), np.int32), *(m.faces for m in meshes)]).astype(np.int32),
        *(np.vstack([np.zeros((0, k)), *(s[i] for s in surfaces)]) for i, k in enumerate((4, 3))),
        np.concatenate([np.zeros(0, np.uint8), *(s[2] for s in surfaces)]),
        *(np.vstack([np.zeros((0, k)), *(s[i] for s in surfaces)]) for i, k in ((3, 9), (4, 6), (5, 6))),
    )


def _surface(m: Mesh, look: Look) -> tuple[NDArray[Any], ...]:
    """Planes (f, 4), colours (f, 3), kinds (f,), corner normals (f, 9), gradients (f, 6), pattern axes (f, 6)."""
    flat, corners = normals(m), corner_normals(m)
    planes = np.column_stack([flat, np.einsum("ij,ij->i", flat, m.vertices[m.faces[:, 0]])])
    round_ = (np.abs(corners - flat[:, None]).max((1, 2)) > 1e-3) & look.smooth
    patterns = m.patterns if m.patterns is not None and look.patterns else np.zeros(len(m.faces), np.uint8)
    kinds = (SMOOTH * round_ + PATTERNED * (patterns > 0) + (patterns.astype(np.int64) << 4)).astype(np.uint8)
    e1, e2 = (m.vertices[m.faces[:, k]] - m.vertices[m.faces[:, 0]] for k in (1, 2))
    d11, d12, d22 = (np.einsum("ij,ij->i", a, b)[:, None] for a, b in ((e1, e1), (e1, e2), (e2, e2)))
    area = np.maximum(d11 * d22 - d12**2, 1e-18)
    duals = np.column_stack([(d22 * e1 - d12 * e2) / area, (d11 * e2 - d12 * e1) / area])
    return planes, m.colors.astype(np.float64), kinds, corners.reshape(-1, 9), duals, pattern_axes(flat)


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
