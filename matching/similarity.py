"""Attribute, distance and angular similarity of two graphs (section 3.2).

D (nn' x nn') and T (nn' x nn' x nn') are functions of two small tables each (distances; cosines of triangle angles), so
nothing of their size is stored: kernels evaluate the entries they need. T is made sparse as section 3.4 says, by
nearest neighbours among triangles: an entry counts only if the target triangle is one of the k that are nearest to the
source triangle. `triangle_radius` holds the distance of that k-th neighbour, which is all it takes to decide.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from .pose import Array


def attribute_similarity(a: Array, b: Array) -> Array:
    """A (n, n'): cosine of attribute vectors a (n, c) and b (n', c); a zero vector is similar to nothing. Eq. (1)."""
    norm_a = np.linalg.norm(a, axis=1)
    norm_b = np.linalg.norm(b, axis=1)
    scale = norm_a[:, None] * norm_b[None]
    return np.divide(a @ b.T, scale, out=np.zeros((len(a), len(b))), where=scale > 0)


def distances(positions: Array) -> Array:
    """s^d (n, n) m: distance of every pair of positions (n, 3) m."""
    difference = positions[:, None] - positions[None]
    return np.sqrt((difference**2).sum(axis=2))


@njit(cache=True)
def pair_affinity(source_distance: Array, target_distance: Array, width_m2: float) -> Array:
    """D (n, n', n, n') of Eq. (2); 0 where two matches share an object, as they exclude each other."""
    n, m = len(source_distance), len(target_distance)
    D = np.zeros((n, m, n, m))
    for i in range(n):
        for j in range(i):
            for ii in range(m):
                for jj in range(m):
                    if ii != jj:
                        difference = source_distance[i, j] - target_distance[ii, jj]
                        exponent = difference * difference / width_m2
                        if exponent < 100.0:  # below that, exp() is zero for every purpose
                            D[i, ii, j, jj] = D[j, jj, i, ii] = np.exp(-exponent)
    return D


@njit(cache=True)
def vertex_cosines(positions: Array) -> Array:
    """cos(theta) (n, n, n): [i, j, k] is the cosine of the angle at i in the triangle i, j, k of positions (n, 3) m.

    0 where two of the three coincide, as indices or in space: such an angle says nothing.
    """
    n = len(positions)
    out = np.zeros((n, n, n))
    edge = np.zeros((n, 3))
    for i in range(n):
        for j in range(n):
            length = 0.0
            for axis in range(3):
                edge[j, axis] = positions[j, axis] - positions[i, axis]
                length += edge[j, axis] ** 2
            length = np.sqrt(length)
            for axis in range(3):
                edge[j, axis] = edge[j, axis] / length if length > 1e-12 else 0.0
        for j in range(n):
            for k in range(j):
                if j != i and k != i:
                    c = edge[j, 0] * edge[k, 0] + edge[j, 1] * edge[k, 1] + edge[j, 2] * edge[k, 2]
                    out[i, j, k] = out[i, k, j] = min(1.0, max(-1.0, c))
    return out


def triangle_sides(positions: Array, up: Array | None) -> NDArray[np.int8]:
    """(n, n, n) in {-1, 0, 1}: whether i, j, k turn left or right seen from above (`up`, unit vector); 0 = cannot tell.

    Distances and angles are the same in a scene and in its mirror image; these signs are not.
    """
    n = len(positions)
    if up is None:
        return np.zeros((n, n, n), dtype=np.int8)
    edge = positions[None] - positions[:, None]
    area = np.einsum("ijx,ikx->ijk", np.cross(edge, up), edge)
    return -np.sign(np.where(np.abs(area) > 1e-9, area, 0.0)).astype(np.int8)


@njit(cache=True)
def triangle_distance(c: Array, i: int, j: int, k: int, d: Array, a: int, b: int, e: int, nine_terms: bool) -> float:
    """Exponent of Eq. (3) times -gamma, for triangle i, j, k with cosines c and triangle a, b, e with cosines d.

    Matched vertices are compared, three terms; `nine_terms` takes the sum over all p, q as the equation is printed.
    """
    p, q, r = c[i, j, k], c[j, i, k], c[k, i, j]
    s, t, u = d[a, b, e], d[b, a, e], d[e, a, b]
    if not nine_terms:
        return abs(p - s) + abs(q - t) + abs(r - u)
    total = 0.0
    for x in (p, q, r):
        total += abs(x - s) + abs(x - t) + abs(x - u)
    return total


@njit(cache=True)
def triangle_radius(c: Array, d: Array, neighbours: int, nine_terms: bool) -> Array:
    """(n, n, n): distance from each source triangle to its `neighbours`-th nearest target triangle (section 3.4).

    c (n, n, n) and d (n', n', n') are `vertex_cosines`. A target triangle counts once for each order of its corners.
    Infinite where there are no more than `neighbours` target triangles.
    """
    n, m = len(c), len(d)
    total = m * (m - 1) * (m - 2)
    out = np.full((n, n, n), np.inf)
    if neighbours >= total or n < 3:
        return out
    s, t, u = np.empty(total), np.empty(total), np.empty(total)
    at = 0
    for a in range(m):
        for b in range(m):
            for e in range(m):
                if a != b and b != e and a != e:
                    s[at], t[at], u[at] = d[a, b, e], d[b, a, e], d[e, a, b]
                    at += 1
    distance = np.empty(total)
    for i in range(n):
        for j in range(i):
            for k in range(j):
                p, q, r = c[i, j, k], c[j, i, k], c[k, i, j]
                if nine_terms:
                    for x in range(total):
                        near = 0.0
                        for corner in (p, q, r):
                            near += abs(corner - s[x]) + abs(corner - t[x]) + abs(corner - u[x])
                        distance[x] = near
                else:
                    for x in range(total):
                        distance[x] = abs(p - s[x]) + abs(q - t[x]) + abs(r - u[x])
                # The three terms are summed in any order later: leave room for their rounding.
                radius = _kth_smallest(distance, neighbours) + 1e-12
                out[i, j, k] = out[i, k, j] = out[j, i, k] = radius
                out[j, k, i] = out[k, i, j] = out[k, j, i] = radius
    return out


@njit(cache=True)
def _kth_smallest(values: Array, k: int) -> float:
    """The k-th smallest of values in [0, 18] (k from 1): a histogram finds its bin, the bin is sorted."""
    bins = 1024
    scale = bins / 18.0001  # the largest sum of nine differences of cosines; three are at most 6
    histogram = np.zeros(bins, dtype=np.int32)
    for value in values:
        histogram[int(value * scale)] += 1
    before = 0
    chosen = 0
    while before + histogram[chosen] < k:
        before += histogram[chosen]
        chosen += 1
    inside = np.empty(len(values))
    found = 0
    for value in values:
        inside[found] = value
        found += int(value * scale) == chosen
    inside = inside[:found]
    inside.sort()
    return inside[k - before - 1]


@njit(cache=True)
def nearest_triples(c: Array, d: Array, neighbours: int, nine_terms: bool) -> tuple[NDArray[np.int32], Array]:
    """T of Eq. (3) as a sparse list: candidates (t, 3), each i * n' + i', and distances (t,) of the two triangles.

    Every source triangle is listed with its `neighbours` nearest target triangles (section 3.4), once for i < j < k;
    the other orders follow by symmetry. c and d are `vertex_cosines`.
    """
    n, m = len(c), len(d)
    radius = triangle_radius(c, d, neighbours, nine_terms)
    total = 0
    for emit in range(2):  # count, then write
        if emit == 1:
            index = np.empty((total, 3), dtype=np.int32)
            distance = np.empty(total)
        at = 0
        for i in range(n):
            for j in range(i + 1, n):
                for k in range(j + 1, n):
                    for a in range(m):
                        for b in range(m):
                            for e in range(m):
                                if a in (b, e) or b == e:
                                    continue
                                far = triangle_distance(c, i, j, k, d, a, b, e, nine_terms)
                                if far <= radius[i, j, k]:
                                    if emit == 1:
                                        index[at, 0], index[at, 1], index[at, 2] = i * m + a, j * m + b, k * m + e
                                        distance[at] = far
                                    at += 1
        total = at
    return index, distance


@njit(cache=True)
def contract(index: NDArray[np.int32], values: Array, x: Array, y: Array) -> Array:
    """T contracted with x and y (n n',): the gradient of T(x, y, z) by z, for a symmetric T given once per triple."""
    out = np.zeros(len(x))
    for t in range(len(values)):
        a, b, c, v = index[t, 0], index[t, 1], index[t, 2], values[t]
        out[a] += v * (x[b] * y[c] + x[c] * y[b])
        out[b] += v * (x[a] * y[c] + x[c] * y[a])
        out[c] += v * (x[a] * y[b] + x[b] * y[a])
    return out
