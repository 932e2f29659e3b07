"""Collisions of vehicles and obstacles in a table (columns V_* of `lane_kernels`): kernels.

Each function names the one of highway-env that it stands for, and all are in its frame (x right, y down on its screen).
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from .lane_kernels import V_COS, V_HEADING, V_LENGTH, V_SIN, V_SPEED, V_WIDTH, V_X, V_Y

Array = NDArray[np.float64]
Ints = NDArray[np.int64]


@njit(cache=True)
def corners(x: float, y: float, heading: float, length: float, width: float) -> Array:
    """(4, 2) m corners of a rectangle in order around it: `RoadObject.polygon` without its closing point."""
    c, s = math.cos(heading), math.sin(heading)
    out = np.empty((4, 2))
    for k in range(4):
        dx = -length / 2 if k < 2 else length / 2
        dy = width / 2 if k == 1 or k == 2 else -width / 2
        out[k, 0] = x + c * dx - s * dy
        out[k, 1] = y + s * dx + c * dy
    return out


@njit(cache=True)
def rectangles_intersect(a: Array, b: Array, ax: float, ay: float, bx: float, by: float) -> tuple[bool, bool]:
    """Whether two rectangles (4, 2) intersect now, and after moving by (ax, ay) and (bx, by).

    The yes or no of `utils.are_polygons_intersecting`.
    """
    intersecting, will_intersect = True, True
    for polygon in (a, b):
        for k in range(4):
            nx = -(polygon[(k + 1) % 4, 1] - polygon[k, 1])
            ny = polygon[(k + 1) % 4, 0] - polygon[k, 0]
            norm = math.sqrt(nx * nx + ny * ny)
            nx, ny = nx / norm, ny / norm
            a_projected, b_projected = a[:, 0] * nx + a[:, 1] * ny, b[:, 0] * nx + b[:, 1] * ny
            min_a, max_a = a_projected.min(), a_projected.max()
            min_b, max_b = b_projected.min(), b_projected.max()
            if (min_b - max_a if min_a < min_b else min_a - max_b) > 0:
                intersecting = False
            moved = nx * (ax - bx) + ny * (ay - by)
            if moved < 0:
                min_a += moved
            else:
                max_a += moved
            if (min_b - max_a if min_a < min_b else min_a - max_b) > 0:
                will_intersect = False
            if not intersecting and not will_intersect:
                return False, False
    return intersecting, will_intersect


@njit(cache=True)
def translation(a: Array, b: Array, moved_a: Array, moved_b: Array) -> Array:
    """(2,) m by which highway-env moves colliding rectangles apart; a, b (5, 2) are its closed polygons.

    The translation of `utils.are_polygons_intersecting`.
    """
    shortest, axis = np.inf, np.zeros(2)
    toward_x, toward_y = a[:4, 0].mean() - b[:4, 0].mean(), a[:4, 1].mean() - b[:4, 1].mean()
    for polygon in (a, b):
        for k in range(4):
            nx, ny = -polygon[k + 1, 1] + polygon[k, 1], polygon[k + 1, 0] - polygon[k, 0]
            norm = math.sqrt(nx * nx + ny * ny)
            nx, ny = nx / norm, ny / norm
            a_projected, b_projected = a[:, 0] * nx + a[:, 1] * ny, b[:, 0] * nx + b[:, 1] * ny
            min_a, max_a = a_projected.min(), a_projected.max()
            min_b, max_b = b_projected.min(), b_projected.max()
            moved = nx * (moved_a[0] - moved_b[0]) + ny * (moved_a[1] - moved_b[1])
            if moved < 0:
                min_a += moved
            else:
                max_a += moved
            distance = min_b - max_a if min_a < min_b else min_a - max_b
            if abs(distance) < shortest:
                shortest = abs(distance)
                sign = 1.0 if toward_x * nx + toward_y * ny > 0 else -1.0
                axis[0], axis[1] = sign * nx, sign * ny
    return shortest * axis


@njit(cache=True)
def diagonal(body: Array) -> float:
    """Length (m) of a body's diagonal."""
    return math.sqrt(body[V_LENGTH] ** 2 + body[V_WIDTH] ** 2)


@njit(cache=True)
def outline(body: Array) -> Array:
    """(4, 2) m corners of a body."""
    return corners(body[V_X], body[V_Y], body[V_HEADING], body[V_LENGTH], body[V_WIDTH])


@njit(cache=True)
def collisions(bodies: Array, n: int, dt: float) -> Ints:
    """Pairs of bodies, the first of them one of the first n, that touch or will within `dt` s.

    Rows [i, j, intersecting, will intersect], in the order of `Road.step`: for every vehicle the
    later vehicles, then all obstacles.
    """
    found = [(0, 0, 0, 0)]
    for i in range(n):
        a = bodies[i]
        for j in range(i + 1, len(bodies)):
            b = bodies[j]
            reach = (diagonal(a) + diagonal(b)) / 2 + a[V_SPEED] * dt
            if math.sqrt((b[V_X] - a[V_X]) ** 2 + (b[V_Y] - a[V_Y]) ** 2) > reach:
                continue
            hits, will_hit = rectangles_intersect(
                outline(a),
                outline(b),
                a[V_SPEED] * a[V_COS] * dt,
                a[V_SPEED] * a[V_SIN] * dt,
                b[V_SPEED] * b[V_COS] * dt,
                b[V_SPEED] * b[V_SIN] * dt,
            )
            if hits or will_hit:
                found.append((i, j, 1 if hits else 0, 1 if will_hit else 0))
    out = np.empty((len(found) - 1, 4), dtype=np.int64)
    for k in range(1, len(found)):
        out[k - 1, 0], out[k - 1, 1], out[k - 1, 2], out[k - 1, 3] = found[k]
    return out


@njit(cache=True)
def touching(cars: Array, bodies: Array) -> NDArray[np.bool_]:
    """(n,) whether each rectangle of cars (n, 5) x, y, heading, length, width overlaps any of bodies (k, 5)."""
    out = np.zeros(len(cars), dtype=np.bool_)
    for i in range(len(cars)):
        x, y, heading, length, width = cars[i]
        for j in range(len(bodies)):
            u, v, turn, long, wide = bodies[j]
            if math.hypot(u - x, v - y) > (math.hypot(length, width) + math.hypot(long, wide)) / 2:
                continue
            now, _ = rectangles_intersect(
                corners(x, y, heading, length, width), corners(u, v, turn, long, wide), 0.0, 0.0, 0.0, 0.0
            )
            out[i] |= now
    return out
