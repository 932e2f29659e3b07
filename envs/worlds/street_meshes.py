"""Meshes of connected driving: vehicles, people, signs, signals, scenery.

Origin on the ground, x forward, z up, metres.

What takes the body's tint is painted white; glass, tyres, lamps keep colours of their own.
"""

from __future__ import annotations

import numpy as np

from ..camera.shapes import (
    RUBBER,
    Color,
    box,
    cone,
    cylinder,
    merge,
    mesh,
    paint,
    prism,
    rotate,
    side_profile,
    sphere,
    translate,
)
from .world import Array, Mesh

WHITE: Color = (250, 250, 250)
GLASS: Color = (46, 58, 72)
DARK: Color = (44, 46, 50)
HEADLAMP: Color = (255, 250, 215)
TAILLAMP: Color = (200, 34, 30)


def _wheels(xs: tuple[float, ...], half_track: float, radius: float) -> list[Mesh]:
    """Tyres with rims painted on, 20 triangles each."""
    tyre = rotate(cylinder(radius, 0.24, RUBBER, sides=6, axis="y"), (0, 1, 0), np.pi / 6)
    tyre = paint(tyre, (88, 90, 94), lambda centre, normal: np.abs(normal[:, 1]) > 0.9)
    return [translate(tyre, (x, y, radius)) for x in xs for y in (-half_track, half_track)]


def _lamps(front: float, back: float, half_width: float, height: float) -> list[Mesh]:
    """Two headlamps and two tail lamps as flat panes, 2 triangles each."""
    y = half_width - 0.28
    head = [
        rotate(_pane(side * y, -front - 0.01, height, 0.36, 0.16, HEADLAMP), (0, 0, 1), np.pi / 2) for side in (-1, 1)
    ]
    tail = [
        rotate(_pane(side * y, back - 0.01, height + 0.06, 0.3, 0.18, TAILLAMP), (0, 0, 1), -np.pi / 2)
        for side in (-1, 1)
    ]
    return head + tail


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


def person() -> Mesh:
    """A pedestrian 1.75 m tall in mid-stride; coat takes the tint."""
    trousers, skin, hair = (52, 56, 70), (214, 168, 138), (70, 50, 38)
    legs = [
        translate(rotate(box((0.16, 0.15, 0.86), trousers, (0, 0, -0.43)), (0, 1, 0), swing), (0, side * 0.1, 0.86))
        for side, swing in ((-1, 0.3), (1, -0.3))
    ]
    arms = [
        translate(rotate(box((0.11, 0.1, 0.6), WHITE, (0, 0, -0.3)), (0, 1, 0), -swing), (0, side * 0.28, 1.38))
        for side, swing in ((-1, 0.35), (1, -0.35))
    ]
    torso = prism([(-0.12, -0.17), (0.12, -0.17), (0.12, 0.17), (-0.12, 0.17)], 0.6, WHITE, top_scale=1.25)
    head = sphere((0.12, 0.11, 0.15), skin, rings=3, sides=5, center=(0, 0, 1.61))
    head = paint(head, hair, lambda centre, normal: (centre[:, 2] > 1.65) | (centre[:, 0] < -0.04))
    return merge(*legs, *arms, translate(torso, (0, 0, 0.82)), head)


def post(radius: float, height: float) -> Mesh:
    """What a signal or a sign hangs on."""
    return cylinder(radius, height, (118, 121, 126), sides=6, center=(0, 0, height / 2))


def signal(lit: str) -> Mesh:
    """A traffic light, 2.3 to 3.4 m above the ground, whose lamps face +x; `lit` is "red", "amber" or "green"."""
    colors = {"red": ((255, 46, 36), (58, 22, 20)), "amber": ((255, 190, 40), (60, 48, 18))}
    colors["green"] = ((60, 255, 120), (16, 56, 32))
    lamps = [
        box((0.06, 0.24, 0.24), colors[name][0] if name == lit else colors[name][1], (0.18, 0, z))
        for name, z in (("red", 3.15), ("amber", 2.85), ("green", 2.55))
    ]
    return merge(
        box((0.3, 0.42, 1.0), (34, 36, 40), (0, 0, 2.85)),
        box((0.04, 0.6, 1.18), (20, 21, 24), (-0.02, 0, 2.85)),
        *lamps,
    )


def sign(kind: str) -> Mesh:
    """A road sign, 1.8 to 2.7 m above the ground, facing +x: "limit", "stop", "yield" or "info"."""
    face = {"limit": (10, 0.0), "stop": (8, np.pi / 8), "yield": (3, np.pi + np.pi / 3), "info": (4, np.pi / 4)}
    sides, turn = face[kind]
    rim = {"limit": (205, 30, 34), "stop": (200, 28, 30), "yield": (205, 30, 34), "info": (36, 84, 170)}[kind]
    inner = {"limit": (245, 245, 245), "stop": (214, 40, 40), "yield": (245, 245, 245), "info": (52, 108, 200)}[kind]
    disc = rotate(cylinder(0.46, 0.04, rim, sides=sides, axis="x"), (1, 0, 0), turn)
    middle = rotate(cylinder(0.34, 0.06, inner, sides=sides, axis="x"), (1, 0, 0), turn)
    mark = {
        "limit": box((0.08, 0.26, 0.2), (40, 40, 44)),
        "stop": box((0.08, 0.5, 0.12), WHITE),
        "yield": box((0.065, 0.02, 0.02), WHITE),
        "info": box((0.08, 0.1, 0.36), WHITE),
    }[kind]
    return merge(*(translate(part, (0.06, 0, 2.24)) for part in (disc, middle, mark)))


def tree(kind: str = "round") -> Mesh:
    """A street tree: "round" (5.5 m) or "tall" (7.5 m); the crown takes the tint."""
    bark = (96, 74, 54)
    if kind == "tall":
        crown = [
            cone(1.5, 3.2, (96, 140, 84), sides=8, center=(0, 0, 2.0)),
            cone(1.15, 3.0, (110, 152, 92), sides=8, center=(0, 0, 4.2)),
        ]
        return merge(cylinder(0.16, 2.2, bark, sides=6, center=(0, 0, 1.1)), *crown)
    crown = [
        sphere((1.7, 1.7, 1.4), (104, 148, 84), rings=4, sides=8, center=(0, 0, 3.7)),
        sphere((1.1, 1.1, 1.0), (122, 164, 96), rings=4, sides=7, center=(0.4, 0.3, 4.7)),
    ]
    return merge(cylinder(0.18, 2.7, bark, sides=6, center=(0, 0, 1.35)), *crown)


def building(length: float, depth: float, floors: int, *, shop: bool = True) -> Mesh:
    """A house `length` x `depth` m, facade to -y side at y = -depth / 2; windows all round, walls take the tint."""
    height = 3.2 * floors + 0.6
    walls = box((length, depth, height), (235, 232, 226), (0, 0, height / 2))
    roof = box((length + 0.5, depth + 0.5, 0.35), (120, 112, 106), (0, 0, height + 0.17))
    panes = []
    for floor in range(floors):
        z = 3.2 * floor + 1.9
        base = shop and floor == 0
        glass = (70, 86, 100) if base else (84, 100, 118)
        for span, reach, turn in ((length, depth, 0.0), (depth, length, np.pi / 2)):
            count = max(int(span // 3.0), 1)
            for side in (0.0, np.pi):
                for k in range(count):
                    x = (k + 0.5) * span / count - span / 2
                    width = span / count * (0.8 if base else 0.45)
                    panes.append(
                        rotate(
                            _pane(x, -reach / 2 - 0.03, z - 0.2 * base, width, 2.2 if base else 1.6, glass),
                            (0, 0, 1),
                            turn + side,
                        )
                    )
    return merge(walls, roof, *panes)


def _pane(x: float, y: float, z: float, width: float, height: float, color: Color) -> Mesh:
    """An upright rectangle facing -y."""
    w, h = width / 2, height / 2
    corners = [(x - w, y, z - h), (x + w, y, z - h), (x + w, y, z + h), (x - w, y, z + h)]
    return mesh(corners, [(0, 1, 2), (0, 2, 3)], color)


def barrier() -> Mesh:
    """A striped barrier 2 m wide, where a lane ends."""
    red = (210, 50, 44)
    stripes = [box((0.26, 0.34, 0.5), red if k % 2 else WHITE, (0, -0.85 + 0.34 * k, 0.75)) for k in range(6)]
    return merge(box((2.0, 2.0, 0.5), (190, 188, 180), (0, 0, 0.25)), *stripes)
