"""What the overlap of two views says of a relative pose: objects left alone inside it, its size, the robots' distance.

A robot's view is its sector: the azimuths and ranges that its detections fill. Gravity is known, frames are levelled.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from .pose import Array

MARGIN_RAD = 0.05
REACH = 1.05
RINGS, RAYS = 10, 12
"""Grid of places of equal area that stand for a sector."""

LEAST_SHARE = 0.02
LEAST_DISTANCE = 0.2

N_FEATURES = 8


@njit(cache=True)
def seen_sector(p: Array) -> Array:
    """Where a robot evidently looks: unit vector of the middle, cosine of the half width, reach m, half width rad.

    Positions (n + 1, 3) m, levelled, the robot itself last.
    """
    n = len(p) - 1
    x = y = reach = 0.0
    for i in range(n):
        r = np.sqrt(p[i, 0] ** 2 + p[i, 1] ** 2) + 1e-12
        x += p[i, 0] / r
        y += p[i, 1] / r
        reach = max(reach, r)
    size = np.sqrt(x * x + y * y) + 1e-12
    x, y = x / size, y / size
    half = 0.0
    for i in range(n):
        half = max(half, abs(np.arctan2(x * p[i, 1] - y * p[i, 0], x * p[i, 0] + y * p[i, 1])))
    half = min(half + MARGIN_RAD, np.pi)
    return np.array([x, y, np.cos(half), REACH * reach, half])


@njit(cache=True)
def inside(x: float, y: float, sector: Array) -> bool:
    """Whether (x, y) m in a robot's frame lies in its sector."""
    square = x * x + y * y
    return square < sector[3] ** 2 and x * sector[0] + y * sector[1] >= np.sqrt(square) * sector[2]


@njit(cache=True)
def sector_grid(sector: Array) -> Array:
    """Places (k, 2) m that stand for equal areas of a sector."""
    out = np.empty((RINGS * RAYS, 2))
    for a in range(RINGS):
        r = sector[3] * np.sqrt((a + 0.5) / RINGS)
        for b in range(RAYS):
            angle = sector[4] * (2.0 * (b + 0.5) / RAYS - 1.0)
            c, s = np.cos(angle), np.sin(angle)
            out[a * RAYS + b, 0] = r * (c * sector[0] - s * sector[1])
            out[a * RAYS + b, 1] = r * (s * sector[0] + c * sector[1])
    return out


@njit(cache=True)
def overlap_features(
    p_a: Array,
    p_b: Array,
    likely: Array,
    median_range: float,
    R: Array,
    t: Array,
    marginals: Array,
    log_evidence: Array,
) -> Array:
    """What is weighed of every mode, (k, 8).

    In order: log evidence; class evidence of the matches; objects alone in the other robot's sector; objects expected
    there; matches times log(1 / share of the sectors that overlap); log of that share; log distance of the robots;
    distance (both in median ranges).

    Positions (n + 1, 3), (m + 1, 3) m, levelled, the robots themselves last; class evidence `likely`; poses (k, 3, 3),
    (k, 3) of target to source; match probabilities (k, n, m); log evidence (k,).
    """
    n, m, count = len(p_a) - 1, len(p_b) - 1, len(R)
    sector_a, sector_b = seen_sector(p_a), seen_sector(p_b)
    grid_a, grid_b = sector_grid(sector_a), sector_grid(sector_b)
    out = np.zeros((count, N_FEATURES))
    alone_b = np.empty(m)
    for k in range(count):
        c, s, tx, ty = R[k, 0, 0], R[k, 1, 0], t[k, 0], t[k, 1]
        share_a = share_b = matches = classes = alone = 0.0
        for g in range(len(grid_a)):
            x, y = grid_a[g, 0] - tx, grid_a[g, 1] - ty
            share_a += inside(c * x + s * y, c * y - s * x, sector_b)
            x, y = grid_b[g]
            share_b += inside(c * x - s * y + tx, s * x + c * y + ty, sector_a)
        share_a = max(share_a / len(grid_a), LEAST_SHARE)
        share_b = max(share_b / len(grid_b), LEAST_SHARE)
        alone_b[:] = 1.0
        for i in range(n):
            alone_a = 1.0
            for j in range(m):
                P = marginals[k, i, j]
                if P > 0.0:
                    alone_a -= P
                    alone_b[j] -= P
                    matches += P
                    classes += P * likely[i, j]
            x, y = p_a[i, 0] - tx, p_a[i, 1] - ty
            if inside(c * x + s * y, c * y - s * x, sector_b):
                alone += alone_a
        for j in range(m):
            x, y = p_b[j, 0], p_b[j, 1]
            if inside(c * x - s * y + tx, s * x + c * y + ty, sector_a):
                alone += alone_b[j]
        distance = np.sqrt(tx * tx + ty * ty) / median_range
        out[k, 0] = log_evidence[k]
        out[k, 1] = classes
        out[k, 2] = alone
        out[k, 3] = n * share_a + m * share_b
        out[k, 4] = -0.5 * matches * np.log(share_a * share_b)
        out[k, 5] = np.log(0.5 * (share_a + share_b))
        out[k, 6] = np.log(distance + LEAST_DISTANCE)
        out[k, 7] = distance
    return out
