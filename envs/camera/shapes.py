"""Low-poly meshes: builders, and functions that move, paint and merge them.

Every builder returns a closed `Mesh` in its body frame (z up, metres), faces counter-clockwise seen from outside.
Colours are RGB in [0, 255]; a body's tint multiplies them when it is drawn, so paint what should take the tint white.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from ...matching.pose import rotation_from_vector
from ..worlds.world import Array, Mesh
from ._foreground import PATTERNS

Color = tuple[int, int, int]

WHITE: Color = (255, 255, 255)
RUBBER: Color = (38, 38, 42)
STEEL: Color = (150, 152, 158)

CREASE_RAD = np.radians(46.0)
"""Edges sharper than this stay edges when a mesh is shaded smoothly."""


def mesh(vertices: ArrayLike, faces: ArrayLike, color: ArrayLike = WHITE) -> Mesh:
    """A mesh from vertices (v, 3) m, faces (f, 3) and one colour or colours (f, 3).

    Raises:
        ValueError: wrong shapes, an index out of range, a colour outside [0, 255].
    """
    points = np.asarray(vertices, dtype=np.float64).reshape(-1, 3)
    triangles = np.asarray(faces, dtype=np.int32).reshape(-1, 3)
    if len(triangles) and (triangles.min() < 0 or triangles.max() >= len(points)):
        raise ValueError(f"faces refer to vertex {triangles.min()}..{triangles.max()}, there are {len(points)}")
    return Mesh(points, triangles, _face_colors(color, len(triangles)))


def box(size: ArrayLike, color: ArrayLike = WHITE, center: ArrayLike = (0.0, 0.0, 0.0)) -> Mesh:
    """A cuboid of `size` (3,) m = (length x, width y, height z) about `center`; 12 triangles."""
    lengths = _positive(size, "size", 3)
    corners = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return mesh(corners * lengths + np.asarray(center, dtype=np.float64), _split_quads(quads), color)


def prism(
    outline: ArrayLike,
    height: float,
    color: ArrayLike = WHITE,
    *,
    top_scale: float = 1.0,
    top_shift: ArrayLike = (0, 0),
) -> Mesh:
    """A convex outline (n, 2) m in the x-y plane, counter-clockwise, extruded from z = 0 to `height`.

    The top outline may be scaled by `top_scale` > 0 and moved by `top_shift` (2,) m: frusta, roofs and car cabins.
    """
    flat = np.asarray(outline, dtype=np.float64)
    if flat.ndim != 2 or flat.shape[1] != 2 or len(flat) < 3:
        raise ValueError(f"outline must have shape (n, 2) with n >= 3, got {flat.shape}")
    if _signed_area(flat) <= 0:
        raise ValueError("outline must run counter-clockwise seen from above")
    n = len(flat)
    top = flat * float(_positive(top_scale, "top_scale", 1)[0]) + np.asarray(top_shift, dtype=np.float64)
    vertices = np.vstack(
        [np.column_stack([flat, np.zeros(n)]), np.column_stack([top, np.full(n, _positive(height, "height", 1)[0])])]
    )
    sides = [(i, (i + 1) % n, n + (i + 1) % n, n + i) for i in range(n)]
    caps = [(0, i + 1, i) for i in range(1, n - 1)] + [(n, n + i, n + i + 1) for i in range(1, n - 1)]
    return mesh(vertices, np.vstack([_split_quads(sides), np.array(caps)]), color)


def side_profile(outline: ArrayLike, width: float, color: ArrayLike = WHITE) -> Mesh:
    """A convex outline (n, 2) m of (x, z), counter-clockwise seen from -y, extruded to `width` m about y = 0."""
    upright = prism(outline, width, color)
    return translate(rotate(upright, (1, 0, 0), np.pi / 2), (0, width / 2, 0))


def cylinder(
    radius: float,
    height: float,
    color: ArrayLike = WHITE,
    *,
    sides: int = 12,
    axis: str = "z",
    center: ArrayLike = (0.0, 0.0, 0.0),
    top_scale: float = 1.0,
) -> Mesh:
    """A cylinder (a truncated cone if `top_scale` != 1) about `center` along `axis` "x", "y" or "z"."""
    upright = prism(_circle(radius, sides), height, color, top_scale=top_scale)
    centred = translate(upright, (0, 0, -height / 2))
    return translate(_align(centred, axis), center)


def cone(
    radius: float, height: float, color: ArrayLike = WHITE, *, sides: int = 10, center: ArrayLike = (0.0, 0.0, 0.0)
) -> Mesh:
    """A cone with its base at `center` and its tip `height` above; 2 sides - 2 triangles."""
    rim = np.column_stack([_circle(radius, sides), np.zeros(sides)])
    vertices = np.vstack([rim, [[0.0, 0.0, _positive(height, "height", 1)[0]]]]) + np.asarray(center, dtype=np.float64)
    slopes = [(i, (i + 1) % sides, sides) for i in range(sides)]
    base = [(0, i + 1, i) for i in range(1, sides - 1)]
    return mesh(vertices, np.array(slopes + base), color)


def sphere(
    radius: float | ArrayLike,
    color: ArrayLike = WHITE,
    *,
    rings: int = 5,
    sides: int = 8,
    center: ArrayLike = (0.0, 0.0, 0.0),
) -> Mesh:
    """A sphere, or an ellipsoid for radii (3,) m, with `rings` bands of latitude; 2 sides (rings - 1) triangles."""
    radii = np.broadcast_to(np.asarray(radius, dtype=np.float64), (3,))
    if rings < 2 or sides < 3 or not (radii > 0).all():
        raise ValueError(f"a sphere needs rings >= 2, sides >= 3, radius > 0, got {rings}, {sides}, {radius!r}")
    latitude = np.linspace(-np.pi / 2, np.pi / 2, rings + 1)[1:-1]
    circle = _circle(1.0, sides)
    bands = [np.column_stack([np.cos(a) * circle, np.full(sides, np.sin(a))]) for a in latitude]
    vertices = np.vstack([*bands, [[0, 0, -1]], [[0, 0, 1]]]) * radii + np.asarray(center, dtype=np.float64)
    south, north = len(vertices) - 2, len(vertices) - 1
    faces: list[tuple[int, ...]] = []
    for i in range(sides):
        j = (i + 1) % sides
        faces.append((south, j, i))
        faces.append((north, (rings - 2) * sides + i, (rings - 2) * sides + j))
    quads = [
        (r * sides + i, r * sides + (i + 1) % sides, (r + 1) * sides + (i + 1) % sides, (r + 1) * sides + i)
        for r in range(rings - 2)
        for i in range(sides)
    ]
    return mesh(vertices, np.vstack([np.array(faces), _split_quads(quads)]), color)


def wheel(
    radius: float,
    width: float,
    center: ArrayLike = (0.0, 0.0, 0.0),
    *,
    tire: Color = RUBBER,
    hub: Color = STEEL,
    sides: int = 12,
) -> Mesh:
    """A wheel turning about y: a tyre with a hub disc on either side; 8 sides - 8 triangles."""
    body = cylinder(radius, width, tire, sides=sides, axis="y")
    disc = cylinder(0.55 * radius, 1.06 * width, hub, sides=sides, axis="y")
    return translate(merge(body, disc), center)


def husky(body: Color = WHITE, *, sides: int = 12) -> Mesh:
    """A Husky-like robot, 0.97 m long (x is forward), 0.67 m wide, 0.62 m high with its mast; origin on the ground.

    Deck, bumpers and wheels have colours of their own; the hull is `body` and takes the tint.
    """
    yellow, dark, grey, lens = body, (48, 49, 53), (112, 114, 120), (30, 34, 48)
    hull = prism([(-0.42, -0.2), (0.42, -0.2), (0.42, 0.2), (-0.42, 0.2)], 0.13, yellow, top_scale=0.94)
    parts = [
        translate(hull, (0, 0, 0.235)),
        box((0.84, 0.38, 0.12), dark, (0, 0, 0.18)),
        box((0.72, 0.3, 0.025), dark, (0, 0, 0.378)),
        box((0.05, 0.44, 0.06), grey, (0.46, 0, 0.2)),
        box((0.05, 0.44, 0.06), grey, (-0.46, 0, 0.2)),
        box((0.06, 0.06, 0.16), grey, (-0.16, 0, 0.46)),
        box((0.1, 0.2, 0.08), dark, (-0.14, 0, 0.58)),
        box((0.02, 0.16, 0.04), lens, (-0.085, 0, 0.58)),
    ]
    wheels = [wheel(0.165, 0.115, (x, y, 0.165), sides=sides) for x in (-0.256, 0.256) for y in (-0.278, 0.278)]
    return merge(*parts, *wheels)


def merge(*meshes: Mesh) -> Mesh:
    """One mesh of all the given ones, in the same body frame."""
    if not meshes:
        raise ValueError("merge needs at least one mesh")
    offsets = np.cumsum([0] + [len(m.vertices) for m in meshes[:-1]])
    faces = [m.faces + np.int32(o) for m, o in zip(meshes, offsets, strict=True)]
    patterns = None
    if any(m.patterns is not None for m in meshes):
        patterns = np.concatenate(
            [np.zeros(len(m.faces), np.uint8) if m.patterns is None else m.patterns for m in meshes]
        )
    colors = np.vstack([m.colors for m in meshes])
    return Mesh(np.vstack([m.vertices for m in meshes]), np.vstack(faces), colors, patterns)


def translate(body: Mesh, offset: ArrayLike) -> Mesh:
    """The mesh moved by `offset` (3,) m."""
    return Mesh(body.vertices + np.asarray(offset, dtype=np.float64), body.faces, body.colors, body.patterns)


def rotate(body: Mesh, axis: ArrayLike, angle: float) -> Mesh:
    """The mesh turned about `axis` (3,) through the origin by `angle` rad, right-handed."""
    direction = np.asarray(axis, dtype=np.float64)
    R = rotation_from_vector(direction / np.linalg.norm(direction) * angle)
    return Mesh(body.vertices @ R.T, body.faces, body.colors, body.patterns)


def scale(body: Mesh, factor: ArrayLike) -> Mesh:
    """The mesh scaled by `factor` > 0, one number or (3,)."""
    factors = np.broadcast_to(np.asarray(factor, dtype=np.float64), (3,))
    if not (factors > 0).all():
        raise ValueError(f"factor must be positive, got {factor!r}")
    return Mesh(body.vertices * factors, body.faces, body.colors, body.patterns)


def paint(body: Mesh, color: ArrayLike, where: Callable[[Array, Array], NDArray[np.bool_]] | None = None) -> Mesh:
    """The mesh with its faces recoloured: all, or those where `where(centres (f, 3), normals (f, 3))` is true."""
    colors = body.colors.copy()
    colors[_chosen(body, where)] = _face_colors(color, 1)[0]
    return Mesh(body.vertices, body.faces, colors, body.patterns)


def texture(body: Mesh, pattern: str, where: Callable[[Array, Array], NDArray[np.bool_]] | None = None) -> Mesh:
    """The mesh with a procedural pattern, one of `PATTERNS`, on all faces or those that `where` chooses as in `paint`.

    A pattern varies the brightness of a face's colour and is measured in metres along the face.
    """
    if pattern not in PATTERNS:
        raise ValueError(f"pattern must be one of {', '.join(PATTERNS)}, got {pattern!r}")
    patterns = np.zeros(len(body.faces), np.uint8) if body.patterns is None else body.patterns.copy()
    patterns[_chosen(body, where)] = PATTERNS.index(pattern)
    return Mesh(body.vertices, body.faces, body.colors, patterns)


def normals(body: Mesh) -> Array:
    """Outward unit normal (f, 3) of each face."""
    a, b, c = (body.vertices[body.faces[:, k]] for k in range(3))
    cross = np.cross(b - a, c - a)
    return cross / np.maximum(np.linalg.norm(cross, axis=1, keepdims=True), 1e-12)


def corner_normals(body: Mesh, crease_rad: float = CREASE_RAD) -> Array:
    """Unit normals (f, 3, 3) at each face's corners: the mean of the faces there that differ by less than a crease."""
    flat = normals(body)
    corners = np.repeat(flat[:, None], 3, axis=1)
    if not len(flat):
        return corners
    _, place = np.unique(np.round(body.vertices, 6), axis=0, return_inverse=True)
    at = place.reshape(-1)[body.faces.ravel()]
    _average_near(np.argsort(at, kind="stable"), at, flat, _corner_angles(body), np.cos(crease_rad), corners)
    return corners


@njit(cache=True)
def _average_near(
    order: NDArray[np.int64],
    place: NDArray[np.int64],
    flat: Array,
    angles: Array,
    least_cosine: float,
    corners: Array,
) -> None:
    """Average normals over corners at one place, weighted by their angles; `order` (3 f,) sorts corners by `place`."""
    first = 0
    while first < len(order):
        last = first
        while last < len(order) and place[order[last]] == place[order[first]]:
            last += 1
        for a in range(first, last):
            i = order[a] // 3
            x, y, z = 0.0, 0.0, 0.0
            for b in range(first, last):
                j = order[b] // 3
                if flat[i, 0] * flat[j, 0] + flat[i, 1] * flat[j, 1] + flat[i, 2] * flat[j, 2] > least_cosine:
                    w = angles[j, order[b] % 3]
                    x, y, z = x + w * flat[j, 0], y + w * flat[j, 1], z + w * flat[j, 2]
            length = max(np.sqrt(x * x + y * y + z * z), 1e-12)
            k = order[a] % 3
            corners[i, k, 0], corners[i, k, 1], corners[i, k, 2] = x / length, y / length, z / length
        first = last


def _corner_angles(body: Mesh) -> Array:
    """Angle (f, 3) rad of each face at each of its corners."""
    corners = body.vertices[body.faces]
    to_next, to_last = np.roll(corners, -1, axis=1) - corners, np.roll(corners, 1, axis=1) - corners
    lengths = np.linalg.norm(to_next, axis=2) * np.linalg.norm(to_last, axis=2)
    cosine = np.einsum("fki,fki->fk", to_next, to_last) / np.maximum(lengths, 1e-18)
    return np.arccos(np.clip(cosine, -1.0, 1.0))


def pattern_axes(flat: Array) -> Array:
    """Directions (f, 6) in which a face with normal (f, 3) measures its pattern: level, and up its slope."""
    level = np.column_stack([-flat[:, 1], flat[:, 0], np.zeros(len(flat))])
    lying = np.abs(flat[:, 2]) > 0.99
    level[lying] = (1.0, 0.0, 0.0)
    level /= np.linalg.norm(level, axis=1, keepdims=True)
    return np.column_stack([level, np.cross(flat, level)])


def extent(body: Mesh) -> tuple[Array, Array]:
    """Lowest and highest corner (3,), (3,) m of the mesh's bounding box in its body frame."""
    return body.vertices.min(0), body.vertices.max(0)


def volume(body: Mesh) -> float:
    """Enclosed volume in m^3; positive exactly when a closed mesh's faces run counter-clockwise seen from outside."""
    a, b, c = (body.vertices[body.faces[:, k]] for k in range(3))
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6.0)


def _chosen(body: Mesh, where: Callable[[Array, Array], NDArray[np.bool_]] | None) -> slice | NDArray[np.bool_]:
    return slice(None) if where is None else where(body.vertices[body.faces].mean(1), normals(body))


def _face_colors(color: ArrayLike, n: int) -> NDArray[np.uint8]:
    values = np.asarray(color)
    if values.shape not in ((3,), (n, 3)) or (values.size and (values.min() < 0 or values.max() > 255)):
        raise ValueError(f"color must be RGB in [0, 255], one or {n} of them, got {color!r}")
    return np.broadcast_to(values, (n, 3)).astype(np.uint8)


def _positive(value: ArrayLike, name: str, size: int) -> Array:
    values = np.asarray(value, dtype=np.float64).reshape(-1)
    if values.shape != (size,) or not (values > 0).all() or not np.isfinite(values).all():
        raise ValueError(f"{name} must be {size} positive number(s), got {value!r}")
    return values


def _circle(radius: float, sides: int) -> Array:
    if sides < 3:
        raise ValueError(f"sides must be at least 3, got {sides}")
    angle = 2 * np.pi * np.arange(sides) / sides
    return _positive(radius, "radius", 1)[0] * np.column_stack([np.cos(angle), np.sin(angle)])


def _split_quads(quads: Sequence[Sequence[int]]) -> NDArray[np.int32]:
    q = np.array(quads, dtype=np.int32).reshape(-1, 4)
    return np.vstack([q[:, [0, 1, 2]], q[:, [0, 2, 3]]])


def _signed_area(outline: Array) -> float:
    x, y = outline.T
    return 0.5 * float(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y))


def _align(upright: Mesh, axis: str) -> Mesh:
    if axis == "z":
        return upright
    if axis == "y":
        return rotate(upright, (1, 0, 0), -np.pi / 2)
    if axis == "x":
        return rotate(upright, (0, 1, 0), np.pi / 2)
    raise ValueError(f'axis must be "x", "y" or "z", got {axis!r}')
