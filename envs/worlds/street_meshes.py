"""Meshes of connected driving: vehicles, people, signs, signals, scenery.

Origin on the ground, x forward, z up, metres.

What takes the body's tint is painted white; glass, tyres, lamps keep colours of their own.
"""

from __future__ import annotations

import numpy as np

from ..camera.shapes import Color, box, merge, paint, side_profile, translate, wheel
from .world import Array, Mesh

WHITE: Color = (250, 250, 250)
GLASS: Color = (46, 58, 72)
DARK: Color = (44, 46, 50)
HEADLAMP: Color = (255, 250, 215)
TAILLAMP: Color = (200, 34, 30)


def _wheels(xs: tuple[float, ...], half_track: float, radius: float) -> list[Mesh]:
    return [wheel(radius, 0.22, (x, y, radius), sides=8) for x in xs for y in (-half_track, half_track)]


def _lamps(front: float, back: float, half_width: float, height: float) -> list[Mesh]:
    y = half_width - 0.28
    return [box((0.06, 0.36, 0.16), HEADLAMP, (front, side * y, height)) for side in (-1, 1)] + [
        box((0.06, 0.3, 0.18), TAILLAMP, (back, side * y, height + 0.06)) for side in (-1, 1)
    ]


def _cabin(outline: list[tuple[float, float]], width: float, roof_z: float) -> Mesh:
    """A greenhouse: glass all round, painted roof."""
    return paint(side_profile(outline, width, GLASS), WHITE, lambda centre, normal: normal[:, 2] > 0.9)


def car(kind: str = "sedan") -> Mesh:
    """A passenger car 4.5 m long: "sedan", "hatchback" or "estate"."""
    body = side_profile([(-2.25, 0.32), (2.25, 0.32), (2.25, 0.62), (2.1, 0.78), (0.9, 0.92), (-2.2, 0.95)], 1.8, WHITE)
    cabins = {
        "sedan": [(-1.75, 0.92), (1.05, 0.9), (0.35, 1.42), (-1.1, 1.45)],
        "hatchback": [(-2.15, 0.93), (1.0, 0.9), (0.35, 1.48), (-1.6, 1.5)],
        "estate": [(-2.2, 0.93), (1.05, 0.9), (0.4, 1.45), (-2.0, 1.5)],
    }
    skirt = box((4.3, 1.7, 0.18), DARK, (0, 0, 0.27))
    return merge(
        body, _cabin(cabins[kind], 1.6, 1.4), skirt, *_lamps(2.24, -2.24, 0.9, 0.66), *_wheels((-1.4, 1.4), 0.82, 0.33)
    )


def van() -> Mesh:
    """A delivery van 5.3 m long, 2.3 m high."""
    body = side_profile(
        [(-2.65, 0.35), (2.65, 0.35), (2.65, 0.95), (2.3, 1.15), (1.5, 2.25), (-2.65, 2.25)], 1.95, WHITE
    )
    windscreen = side_profile([(1.62, 1.3), (2.25, 1.2), (1.6, 2.1), (1.5, 2.12)], 1.97, GLASS)
    side_windows = box((0.8, 1.98, 0.55), GLASS, (1.05, 0, 1.65))
    skirt = box((5.1, 1.85, 0.2), DARK, (0, 0, 0.3))
    rear = box((0.04, 1.5, 0.5), GLASS, (-2.66, 0, 1.7))
    return merge(
        body,
        windscreen,
        side_windows,
        rear,
        skirt,
        *_lamps(2.64, -2.66, 0.97, 0.78),
        *_wheels((-1.7, 1.75), 0.88, 0.36),
    )


def truck() -> Mesh:
    """A box lorry 7.6 m long, 3.1 m high: tinted cab, pale box."""
    cab = side_profile([(2.1, 0.5), (3.8, 0.5), (3.8, 1.6), (3.5, 2.4), (2.1, 2.4)], 2.15, WHITE)
    glass = merge(box((0.06, 1.9, 0.66), GLASS, (3.72, 0, 1.92)), box((0.8, 2.17, 0.55), GLASS, (2.95, 0, 1.9)))
    cargo = box((5.7, 2.3, 2.35), (224, 224, 218), (-0.95, 0, 1.95))
    chassis = box((7.3, 1.5, 0.3), DARK, (-0.1, 0, 0.62))
    return merge(cab, glass, cargo, chassis, *_lamps(3.8, -3.82, 1.05, 0.75), *_wheels((-2.6, -1.6, 2.7), 0.95, 0.46))


def bus() -> Mesh:
    """A city bus 8.6 m long, 3 m high, with a window band."""
    body = box((8.6, 2.35, 2.6), WHITE, (0, 0, 1.68))
    band = box((8.2, 2.38, 0.95), GLASS, (0, 0, 1.95))
    front = box((8.64, 2.1, 1.2), GLASS, (0, 0, 1.95))
    roof = box((3.0, 1.6, 0.2), (205, 207, 210), (-1.5, 0, 3.05))
    skirt = box((8.4, 2.25, 0.3), DARK, (0, 0, 0.4))
    pillars = [box((0.14, 2.4, 0.97), WHITE, (x, 0, 1.95)) for x in (-2.6, -0.9, 0.8, 2.5)]
    return merge(
        body, band, front, roof, skirt, *pillars, *_lamps(4.32, -4.32, 1.15, 0.8), *_wheels((-2.5, 2.7), 1.05, 0.48)
    )


def strip(left: Array, right: Array, z: float, color: Color) -> Mesh:
    """A flat ribbon between two borders (n, 2) m at height z, facing up; `left` is left of `right` looking along."""
    n = len(left)
    vertices = np.column_stack([np.vstack([left, right]), np.full(2 * n, z)])
    a = np.arange(n - 1)
    faces = np.vstack([np.column_stack([a, a + n, a + n + 1]), np.column_stack([a, a + n + 1, a + 1])])
    return Mesh(vertices, faces.astype(np.int32), np.tile(np.array(color, dtype=np.uint8), (len(faces), 1)))


def lift(body: Mesh, z: float) -> Mesh:
    """The mesh raised by z m."""
    return translate(body, (0, 0, z))
