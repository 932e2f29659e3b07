"""Reweighted random walks for hypergraph matching (Lee, Cho and Lee 2011): third order, by the angles of triangles.

The tensor is built as Duchenne et al. 2011 do: every source triangle with its n n' nearest target triangles, weighted
by exp(-distance / mean distance). Triangles are compared by the cosines of their angles, as in Eq. (3); all source
triangles are used, since a random sample of them loses the true triples.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from .candidates import assignment, check_size
from .checks import check_interval
from .graph import Matching, ObjectGraph, check_comparable
from .pose import Array, RelativePose
from .random_walk import reweighted
from .rrwm import check_walk
from .similarity import contract, nearest_triples, vertex_cosines

MAX_CANDIDATES = 1024
"""Most candidates n n' of the methods that list triples: at 32 objects a side the list takes 100 MB."""


def rrwhm(
    source: ObjectGraph,
    target: ObjectGraph,
    *,
    prior: RelativePose | None = None,
    rng: np.random.Generator | None = None,
    walk_weight: float = 0.2,
    inflation: float = 30.0,
    iterations: int = 300,
    sinkhorn_iterations: int = 1000,
    tolerance: float = 1e-6,
    sinkhorn_tolerance: float = 1e-3,
    neighbours_factor: float = 0.3,
    angle_width: float | None = 0.3,
) -> Matching:
    """Walk randomly over candidate matches along triples of them, with reweighted jumps, and assign.

    Args:
        source, target: the two robots' graphs, n n' <= 1024.
        prior, rng: not used.
        walk_weight, inflation, iterations, sinkhorn_iterations, sinkhorn_tolerance: as in `rrwm`; published values.
        tolerance: the walk ends when its change (Euclidean norm) falls below.
        neighbours_factor: target triangles kept for each source triangle, in multiples of the published n n'.
        angle_width: gamma of Eq. (3). None: the mean distance of the triangles kept.

    Returns:
        min(n, n') matches, none with fewer than 3 objects a side; scores are visits relative to the most visited.

    Raises:
        ValueError: a parameter out of range, too many objects, different attribute classes.
    """
    check_comparable(source, target, prior)
    check_size("rrwhm", source, target, MAX_CANDIDATES)
    check_walk(walk_weight, inflation, iterations, sinkhorn_iterations, tolerance, sinkhorn_tolerance)
    if min(len(source), len(target)) < 3:
        return Matching.empty()
    index, values = triples(source, target, neighbours_factor, angle_width)
    visits = hypergraph_walk(
        np.zeros(len(source) * len(target)),
        np.zeros((0, 0)),
        index,
        values,
        len(source),
        len(target),
        walk_weight,
        inflation,
        iterations,
        sinkhorn_iterations,
        tolerance,
        sinkhorn_tolerance,
    )
    return assignment(visits)


def triples(
    source: ObjectGraph, target: ObjectGraph, neighbours_factor: float, angle_width: float | None
) -> tuple[NDArray[np.int32], Array]:
    """Sparse T: candidates (t, 3) and values (t,) in (0, 1], once per triple."""
    check_interval("neighbours_factor", neighbours_factor, "(0, inf)")
    if angle_width is not None:
        check_interval("angle_width", angle_width, "(0, inf)")
    neighbours = max(1, round(neighbours_factor * len(source) * len(target)))
    index, distance = nearest_triples(
        vertex_cosines(source.positions), vertex_cosines(target.positions), neighbours, False
    )
    width = max(float(distance.mean()), 1e-9) if angle_width is None else angle_width
    return index, np.exp(-distance / width)


@njit(cache=True)
def hypergraph_walk(
    unary: Array,
    pairwise: Array,
    index: NDArray[np.int32],
    values: Array,
    n: int,
    m: int,
    walk_weight: float,
    inflation: float,
    iterations: int,
    sinkhorn_iterations: int,
    tolerance: float,
    sinkhorn_tolerance: float,
) -> Array:
    """Visits (n, m), summing to 1, of a walk along similarities of first, second and third order.

    unary (n m,) and pairwise (n m, n m) may be zero, or of size 0, for a walk along triples alone. Each order comes
    normalised by its largest degree.
    """
    size = n * m
    x = np.full(size, 1.0 / size)
    for _ in range(iterations):
        walk = contract(index, values, x, x) + unary * x.sum() ** 2
        if len(pairwise) > 0:
            walk += (pairwise @ x) * x.sum()
        total = walk.sum()
        if total <= 0.0:
            return np.zeros((n, m))
        walk /= total
        jump = reweighted(walk.reshape(n, m), inflation, sinkhorn_iterations, sinkhorn_tolerance).ravel()
        new = walk_weight * walk + (1.0 - walk_weight) * jump
        change = np.sqrt(((new - x) ** 2).sum())
        x = new
        if change < tolerance:
            break
    return x.reshape(n, m)
