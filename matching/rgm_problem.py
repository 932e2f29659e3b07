"""The optimisation problem of the paper's method for one pair of graphs: Eq. (15) with its widths and units."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from .candidates import extent_floor_m2
from .checks import check_count, check_interval
from .graph import ObjectGraph
from .objective import Terms
from .pose import Array
from .random_walk import distance_affinity, reweighted_random_walk
from .similarity import attribute_similarity, distances, pair_affinity, triangle_radius, triangle_sides, vertex_cosines
from .uncertainty import certainty, kronecker_plus, typical

UNIT_MEDIANS = 6.0
"""Unit of V and of U in the uncertainty regulariser, in medians over the candidates."""
LEAST_WEIGHT = 1e-300
"""Of Eq. (18): a weight of 0 would leave nothing to choose from once only hopeless objects are left."""


@dataclass(frozen=True)
class Similarity:
    """Widths, units and options of the similarities and their weights; None = from the pair's median variances.

    Attributes:
        distance_width_m2: gamma of Eq. (2), m^2. None: `distance_width_factor` times the median of U.
        distance_width_factor: see above.
        angle_width: gamma of Eq. (3), dimensionless (a sum of differences of cosines).
        attribute_uncertainty_width: sigma of Eq. (8), probability^2. None: `uncertainty_width_factor` medians of V.
        distance_uncertainty_width_m2: sigma of Eq. (10), m^2. None: `uncertainty_width_factor` medians of U.
        angle_uncertainty_width_m2: sigma of Eq. (11), m^2. None: `uncertainty_width_factor` medians of U.
        uncertainty_width_factor: see above. Infinite widths give all similarities the weight 1, which is Eq. (4).
        attribute_unit: unit of V in Eq. (13) and of v in Eq. (18), probability^2. None: `UNIT_MEDIANS` medians of V.
        position_unit_m2: unit of U and u there, m^2. None: `UNIT_MEDIANS` medians of U.
        neighbours: k of section 3.4, nearest target triangles of each source triangle. None: n n'.
        nine_terms: Eq. (3) as printed.
        reject_mirrored: T = 0 for triangles that turn opposite ways seen from above.
    """

    distance_width_m2: float | None = None
    distance_width_factor: float = 2.0
    angle_width: float = 0.25
    attribute_uncertainty_width: float | None = None
    distance_uncertainty_width_m2: float | None = None
    angle_uncertainty_width_m2: float | None = None
    uncertainty_width_factor: float = 60.0
    attribute_unit: float | None = None
    position_unit_m2: float | None = None
    neighbours: int | None = None
    nine_terms: bool = False
    reject_mirrored: bool = False

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, bool) or value is None:
                continue
            if field.name == "neighbours":
                check_count(field.name, value)
            else:
                check_interval(field.name, value, "(0, inf]")


@dataclass(frozen=True)
class Scales:
    """The numbers that `Similarity` leaves open, for one pair: widths in the units of the same fields there."""

    distance_width_m2: float
    attribute_uncertainty_width: float
    distance_uncertainty_width_m2: float
    angle_uncertainty_width_m2: float
    attribute_unit: float
    position_unit_m2: float


def scales(similarity: Similarity, V: Array, U: Array, floor_m2: float) -> Scales:
    """What is not given follows the medians of V and U (n, n'), which count as at least 1e-6 and `floor_m2`."""
    median_V, median_U = max(typical(V), 1e-6), max(typical(U), floor_m2)
    factor = similarity.uncertainty_width_factor
    return Scales(
        _or(similarity.distance_width_m2, similarity.distance_width_factor * median_U),
        _or(similarity.attribute_uncertainty_width, factor * median_V),
        _or(similarity.distance_uncertainty_width_m2, factor * median_U),
        _or(similarity.angle_uncertainty_width_m2, factor * median_U),
        _or(similarity.attribute_unit, UNIT_MEDIANS * median_V),
        _or(similarity.position_unit_m2, UNIT_MEDIANS * median_U),
    )


@dataclass(frozen=True)
class Problem:
    """Eq. (15) for one pair of graphs.

    Attributes:
        terms: similarities and weights.
        table: `coefficients` with both regularisers; `table_pi` without, for Eq. (17).
        support: (n, n') score of every candidate match by the reweighted random walk.
        proposal_weight: (n,) exp(-(v + u) / gamma) of Eq. (18).
    """

    terms: Terms
    table: Array
    table_pi: Array
    support: Array
    proposal_weight: Array


def build(
    source: ObjectGraph,
    target: ObjectGraph,
    similarity: Similarity,
    table: Array,
    table_pi: Array,
    proposal_width: float = 2.0,
) -> Problem:
    """The problem of two graphs whose variances are finite. Eq. (1)-(3), (7)-(11).

    `table` and `table_pi` are `coefficients` with and without regularisers, `proposal_width` is gamma of Eq. (18).
    """
    V = kronecker_plus(source.attribute_variance, target.attribute_variance)  # Eq. (7)
    U = kronecker_plus(source.position_variance, target.position_variance)  # Eq. (9)
    s, t = distances(source.positions), distances(target.positions)
    # Graphs that claim no error at all still need a width: a thousandth of their extent.
    width = scales(similarity, V, U, extent_floor_m2(s, t))
    w_a = certainty(V, width.attribute_uncertainty_width)  # Eq. (8)
    w_d = certainty(U, width.distance_uncertainty_width_m2)  # Eq. (10)
    w_t = certainty(U, width.angle_uncertainty_width_m2)  # Eq. (11)
    pair = pair_affinity(s, t, width.distance_width_m2)
    pair *= w_d[:, :, None, None]
    pair *= w_d[None, None]
    c, d = vertex_cosines(source.positions), vertex_cosines(target.positions)
    neighbours = len(source) * len(target) if similarity.neighbours is None else similarity.neighbours
    mirrored = similarity.reject_mirrored
    terms = Terms(
        attribute=attribute_similarity(source.attributes, target.attributes) * w_a,
        pair=pair,
        source_cosine=c,
        target_cosine=d,
        source_apex=np.ascontiguousarray(c.transpose(1, 2, 0)),
        target_apex=np.ascontiguousarray(d.transpose(1, 2, 0)),
        source_side=triangle_sides(source.positions, source.up if mirrored else None),
        target_side=triangle_sides(target.positions, target.up if mirrored else None),
        radius=triangle_radius(c, d, neighbours, similarity.nine_terms),
        angle_width=float(similarity.angle_width),
        angle_weight=w_t,
        nine_terms=similarity.nine_terms,
        penalty=(V / width.attribute_unit + U / width.position_unit_m2) ** 2,
    )
    uncertainty = source.attribute_variance / width.attribute_unit + source.position_variance / width.position_unit_m2
    # What the objects have in common, Eq. (18) loses when it is normalised over them.
    weight = np.maximum(np.exp(-(uncertainty - uncertainty.min()) / proposal_width), LEAST_WEIGHT)
    affinity = distance_affinity(s, t, width.distance_width_m2, w_d, terms.attribute)
    support = reweighted_random_walk(affinity, iterations=30, sinkhorn_iterations=10)
    return Problem(terms, table, table_pi, support, weight)


def _or(given: float | None, default: float) -> float:
    return default if given is None else given
