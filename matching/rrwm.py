"""Reweighted random walks for graph matching (Cho, Lee and Lee 2010): pairwise, by distances."""

from __future__ import annotations

import numpy as np

from .candidates import MAX_CANDIDATES, assignment, check_size, distance_variance_m2, mean_agreement
from .checks import check_count, check_interval
from .graph import Matching, ObjectGraph, check_comparable
from .pose import Array, RelativePose
from .random_walk import distance_affinity, reweighted_random_walk
from .similarity import attribute_similarity, distances


def rrwm(
    source: ObjectGraph,
    target: ObjectGraph,
    *,
    prior: RelativePose | None = None,
    rng: np.random.Generator | None = None,
    walk_weight: float = 0.2,
    inflation: float = 30.0,
    iterations: int = 300,
    sinkhorn_iterations: int = 1000,
    tolerance: float = 3e-13,
    sinkhorn_tolerance: float = 1e-3,
    distance_width_m2: float | None = None,
    distance_width_factor: float = 2.0,
    attribute_weight: float = 1.0,
) -> Matching:
    """Walk randomly over candidate matches, jumping to those that satisfy the one-to-one constraints, and assign.

    The published parameters are the defaults of the first six options.

    Args:
        source, target: the two robots' graphs, n n' <= `MAX_CANDIDATES`.
        prior, rng: not used.
        walk_weight: share of the walk in each step; the rest jumps (the authors' c).
        inflation: beta, exponent of the reweighting at the most visited candidate.
        iterations: most steps of the walk.
        sinkhorn_iterations: most normalisations of rows and columns per step.
        tolerance: the walk ends when its change (Euclidean norm) falls below; 0 = all iterations.
        sinkhorn_tolerance: normalisation ends when the entries' change falls below; 0 = all iterations.
        distance_width_m2: gamma of Eq. (2). None: `distance_width_factor` times the median variance of a candidate.
        distance_width_factor: see above.
        attribute_weight: exponent of the attribute similarities in the affinity; 0 = distances alone, as in the paper.

    Returns:
        min(n, n') matches (the method has no null match), each scored by its mean affinity with the others.

    Raises:
        ValueError: a parameter out of range, too many objects, different attribute classes.
    """
    check_comparable(source, target, prior)
    check_size("rrwm", source, target, MAX_CANDIDATES)
    check_walk(walk_weight, inflation, iterations, sinkhorn_iterations, tolerance, sinkhorn_tolerance)
    check_interval("attribute_weight", attribute_weight, "[0, inf)")
    if len(source) == 0 or len(target) == 0:
        return Matching.empty()
    s, t = distances(source.positions), distances(target.positions)
    width = distance_width(source, target, s, t, distance_width_m2, distance_width_factor)
    A = attribute_similarity(source.attributes, target.attributes) ** attribute_weight
    visits = reweighted_random_walk(
        distance_affinity(s, t, width, A, A * (attribute_weight > 0)),
        walk_weight,
        inflation,
        iterations,
        sinkhorn_iterations,
        tolerance,
        sinkhorn_tolerance,
    )
    return mean_agreement(assignment(visits), s, t, width, A)


def distance_width(
    source: ObjectGraph, target: ObjectGraph, s: Array, t: Array, width_m2: float | None, factor: float
) -> float:
    """gamma of Eq. (2), m^2: as given, or `factor` times the median variance of a candidate."""
    check_interval("distance_width_factor", factor, "(0, inf)")
    if width_m2 is None:
        width_m2 = factor * distance_variance_m2(source, target, s, t)
    check_interval("distance_width_m2", width_m2, "(0, inf)")
    return float(width_m2)


def check_walk(
    walk_weight: float,
    inflation: float,
    iterations: int,
    sinkhorn_iterations: int,
    tolerance: float,
    sinkhorn_tolerance: float,
) -> None:
    """Raises ValueError naming the value unless the walk's parameters make sense."""
    check_interval("walk_weight", walk_weight, "[0, 1]")
    check_interval("inflation", inflation, "(0, inf)")
    check_count("iterations", iterations)
    check_count("sinkhorn_iterations", sinkhorn_iterations)
    check_interval("tolerance", tolerance, "[0, inf)")
    check_interval("sinkhorn_tolerance", sinkhorn_tolerance, "[0, inf)")
