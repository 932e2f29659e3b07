"""What the methods that rank candidate matches share: sizes, widths, and reading off an assignment.

A candidate match of source object i and target object i' has the number i * n' + i'.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from scipy.optimize import linear_sum_assignment

from .graph import Matching, ObjectGraph
from .pose import Array
from .similarity import attribute_similarity, pair_affinity
from .uncertainty import kronecker_plus, typical

MAX_CANDIDATES = 4900
"""Most candidates (n n') of a method that holds an affinity for every two of them: 70 objects a side, 0.2 GB."""


def check_size(method: str, source: ObjectGraph, target: ObjectGraph, most: int) -> None:
    """Raises ValueError naming the numbers unless n n' is at most `most`."""
    if len(source) * len(target) > most:
        raise ValueError(
            f"{method} accepts at most {most} candidate matches ({int(most**0.5)} objects a side), "
            f"got {len(source)} x {len(target)} = {len(source) * len(target)}"
        )


def extent_floor_m2(*distances: Array) -> float:
    """A variance for graphs that claim to have none: a millionth of the mean squared distance, m^2."""
    return 1e-6 * max(1e-6, *(float((d**2).mean()) if d.size else 0.0 for d in distances))


def distance_variance_m2(
    source: ObjectGraph, target: ObjectGraph, source_distance: Array, target_distance: Array
) -> float:
    """Median of u_i + u'_i' over the candidates, m^2: half the variance of a difference of distances along the rays."""
    U = kronecker_plus(source.position_variance, target.position_variance)
    return max(typical(U), extent_floor_m2(source_distance, target_distance))


def affinity_matrix(
    source: ObjectGraph,
    target: ObjectGraph,
    source_distance: Array,
    target_distance: Array,
    width_m2: float,
    attribute_weight: float,
) -> Array:
    """(n n', n n') D of Eq. (2) scaled by the attribute similarities of both matches; attributes on the diagonal.

    An entry is D_ab (A_a A_b)^attribute_weight; 0 for matches that share an object.
    """
    n, m = len(source), len(target)
    A = attribute_similarity(source.attributes, target.attributes) ** attribute_weight
    K = pair_affinity(source_distance, target_distance, width_m2)
    K = K.reshape(n * m, n * m)
    if attribute_weight > 0:
        weigh(K, A.ravel())
    return K


@njit(cache=True)
def weigh(K: Array, a: Array) -> None:
    """Scale the rows and columns of K (k, k) by a (k,), in place, and put a on its diagonal."""
    for x in range(len(a)):
        for y in range(len(a)):
            K[x, y] *= a[x] * a[y]
        K[x, x] = a[x]


def assignment(support: Array, scores: Array | None = None) -> Matching:
    """The one-to-one matching of largest total `support` (n, n') >= 0; candidates of no support are not matched.

    Scores are `scores` (n, n') in [0, 1], by default the support relative to the largest.
    """
    if support.size == 0 or not support.max() > 0:
        return Matching.empty()
    rows, cols = linear_sum_assignment(support, maximize=True)
    kept = support[rows, cols] > 0
    rows, cols = rows[kept], cols[kept]
    scores = support / support.max() if scores is None else scores
    return Matching(np.stack([rows, cols], axis=1), np.clip(scores[rows, cols], 0.0, 1.0))


def mean_agreement(matching: Matching, s: Array, t: Array, width_m2: float, A: Array) -> Matching:
    """The same matches, each scored by its mean affinity with the others, D_ab A_a A_b; those of one match as they are.

    s (n, n) and t (n', n') m are distances, `width_m2` is gamma of Eq. (2), A (n, n') what candidates are weighted by.
    """
    if len(matching) < 2:
        return matching
    rows, cols = matching.pairs.T
    difference = s[np.ix_(rows, rows)] - t[np.ix_(cols, cols)]
    a = A[rows, cols]
    among = np.exp(-(difference**2) / width_m2) * a[:, None] * a
    np.fill_diagonal(among, 0.0)
    return Matching(matching.pairs, np.clip(among.sum(axis=1) / (len(rows) - 1), 0.0, 1.0))
