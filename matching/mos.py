"""Multi-order similarities (Chang, Fischer, Petit, Zambelli and Demiris 2017): attributes, distances and angles.

One hypergraph walk follows the similarities of all three orders: of the objects' appearance (first), of the distances
of pairs (second), of the angles of triples (third). Each order is normalised by its largest degree and weighted.
"""

from __future__ import annotations

import numpy as np

from .candidates import affinity_matrix, assignment, check_size
from .checks import check_interval
from .graph import Matching, ObjectGraph, check_comparable
from .pose import Array, RelativePose
from .rrwhm import MAX_CANDIDATES, hypergraph_walk, triples
from .rrwm import check_walk, distance_width
from .similarity import attribute_similarity, contract, distances


def mos(
    source: ObjectGraph,
    target: ObjectGraph,
    *,
    prior: RelativePose | None = None,
    rng: np.random.Generator | None = None,
    order_weights: tuple[float, float, float] = (1.0, 1.0, 0.3),
    walk_weight: float = 0.2,
    inflation: float = 30.0,
    iterations: int = 300,
    sinkhorn_iterations: int = 1000,
    tolerance: float = 1e-6,
    sinkhorn_tolerance: float = 1e-3,
    distance_width_m2: float | None = None,
    distance_width_factor: float = 1.0,
    angle_width: float | None = None,
    neighbours_factor: float = 1.0,
    attribute_exponent: float = 1.0,
) -> Matching:
    """Match by attributes, distances and angles together with reweighted random walks on a hypergraph.

    Args:
        source, target: the two robots' graphs, n n' <= 1024.
        prior, rng: not used.
        order_weights: weights of the first, second and third order.
        walk_weight, inflation, iterations, sinkhorn_iterations, tolerance, sinkhorn_tolerance: as in `rrwhm`.
        neighbours_factor, angle_width: as in `rrwhm`.
        distance_width_m2, distance_width_factor: as in `rrwm`.
        attribute_exponent: power of the attribute similarity in the first order; larger trusts classes more.

    Returns:
        min(n, n') matches; scores are visits relative to the most visited candidate.

    Raises:
        ValueError: a parameter out of range, too many objects, different attribute classes.
    """
    check_comparable(source, target, prior)
    check_size("mos", source, target, MAX_CANDIDATES)
    check_walk(walk_weight, inflation, iterations, sinkhorn_iterations, tolerance, sinkhorn_tolerance)
    weights = np.asarray(order_weights)
    if weights.shape != (3,) or not (weights >= 0).all() or not 0 < weights.sum() < np.inf:
        raise ValueError(f"order_weights must be three non-negative numbers, not all zero, got {order_weights!r}")
    check_interval("attribute_exponent", attribute_exponent, "[0, inf)")
    n, m = len(source), len(target)
    if n == 0 or m == 0:
        return Matching.empty()
    s, t = distances(source.positions), distances(target.positions)
    width = distance_width(source, target, s, t, distance_width_m2, distance_width_factor)
    unary = attribute_similarity(source.attributes, target.attributes).ravel() ** attribute_exponent
    pairwise = affinity_matrix(source, target, s, t, width, 0.0)
    index, values = np.zeros((0, 3), dtype=np.int32), np.zeros(0)
    if min(n, m) >= 3:
        index, values = triples(source, target, neighbours_factor, angle_width)
    uniform = np.full(n * m, 1.0 / (n * m))
    visits = hypergraph_walk(
        _normalised(unary, order_weights[0], unary),
        _normalised(pairwise, order_weights[1], pairwise @ uniform),
        index,
        _normalised(values, order_weights[2], contract(index, values, uniform, uniform)),
        n,
        m,
        walk_weight,
        inflation,
        iterations,
        sinkhorn_iterations,
        tolerance,
        sinkhorn_tolerance,
    )
    return assignment(visits)


def _normalised(similarity: Array, weight: float, degree: Array) -> Array:
    """The similarities scaled so that their largest degree, what uniform visits of total 1 collect, is `weight`."""
    largest = float(degree.max(initial=0.0))
    return similarity * (weight / largest) if largest > 0 else similarity
