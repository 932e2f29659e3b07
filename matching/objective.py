"""The regularised graph matching objective (Eq. 4, 12-15), from scratch; `objective_state` keeps it up to date.

With m matches, a value is a fixed combination of four sums over them,

    S_A = sum_a A_a W^a_a              S_D = sum_{a != b} D_ab W^d_ab
    S_T = sum_{a, b, c distinct} T_abc W^t_abc      S_U = sum_a (V + U)_a^2

    E = c_A(m) S_A + c_D(m) S_D + c_T(m) S_T - c_U(m) S_U - c_0(m),

and a table of `coefficients` holds c_A ... c_0 for every m. The equations as printed are c_A = c_D = c_T = 1,
c_U = lambda_1 and c_0 = lambda_2 m. See `coefficients` for the scaling that makes the published lambdas mean something.

`vec` and `unvec` are the only place where matrices are flattened; they go by columns, like the paper.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from .checks import check_interval
from .pose import Array
from .similarity import triangle_distance

SCALINGS = ("mean", "sum")
COUNT_PENALTIES = ("squared", "frobenius")


def vec(X: Array) -> Array:
    """The columns of X (n, n') one below the other, (n n',)."""
    return np.asarray(X).reshape(-1, order="F")


def unvec(x: Array, n: int, n_target: int) -> Array:
    """The matrix (n, n') whose columns `x` (n n',) holds."""
    return np.asarray(x).reshape((n, n_target), order="F")


class Terms(NamedTuple):
    """Everything the objective of one pair of graphs needs; T is evaluated on the fly.

    Attributes:
        attribute: (n, n') A weighted by W^a. Eq. (1), (8).
        pair: (n, n', n, n') D weighted by W^d, 0 for matches that share an object. Eq. (2), (10).
        source_cosine, target_cosine: (n, n, n), (n', n', n').
        source_apex, target_apex: the same arranged by the other corners: [a, b, j] is the cosine of the angle at j.
        source_side, target_side: (n, n, n), (n', n', n') in {-1, 0, 1}; triangles of opposite sides have T = 0.
        radius: (n, n, n), a target triangle farther than this from a source triangle has T = 0.
        angle_width: gamma of Eq. (3).
        angle_weight: (n, n') factor w of W^t. Eq. (11).
        nine_terms: whether Eq. (3) is summed over all nine pairs of corners.
        penalty: (n, n') (V + U)^2. Eq. (13).
    """

    attribute: Array
    pair: Array
    source_cosine: Array
    target_cosine: Array
    source_apex: Array
    target_apex: Array
    source_side: NDArray[np.int8]
    target_side: NDArray[np.int8]
    radius: Array
    angle_width: float
    angle_weight: Array
    nine_terms: bool
    penalty: Array


def coefficients(
    largest: int, uncertainty_weight: float, noncovisibility_weight: float, scaling: str, count_penalty: str
) -> Array:
    """Coefficients (largest + 1, 5) of S_A, S_D, S_T, S_U and 1, row m for m matches.

    scaling "sum" is Eq. (15) as printed. S_A, S_D, S_T then grow like m, m^2, m^3: at 10 matches the angular term is a
    hundred times the attributes and lambda_2 = 0.4 rejects nothing.
    scaling "mean" gives every term the size m^2 of the count penalty: m^2 times the mean attribute, pair and triple
    similarity, averaged over the kinds there are (one match has no pairs). A group of matches then pays exactly if its
    mean similarity, less lambda_1 times its mean squared uncertainty, exceeds lambda_2.
    count_penalty "squared" is ||X||^2 = m^2, as in Suh 2015 on which the solver builds; "frobenius" is m.
    """
    if scaling not in SCALINGS:
        raise ValueError(f"scaling must be one of {SCALINGS}, got {scaling!r}")
    if count_penalty not in COUNT_PENALTIES:
        raise ValueError(f"count_penalty must be one of {COUNT_PENALTIES}, got {count_penalty!r}")
    check_interval("uncertainty_weight", uncertainty_weight, "[0, inf)")
    check_interval("noncovisibility_weight", noncovisibility_weight, "[0, inf)")
    m = np.arange(largest + 1, dtype=np.float64)
    out = np.zeros((largest + 1, 5))
    if scaling == "sum":
        out[:, :3] = 1.0
        out[:, 3] = uncertainty_weight
    else:
        kinds = np.minimum(np.maximum(m, 1), 3)
        out[:, 0] = m / kinds
        out[2:, 1] = (m / np.maximum(m - 1, 1) / kinds)[2:]
        out[3:, 2] = (m / np.maximum((m - 1) * (m - 2), 1) / kinds)[3:]
        out[:, 3] = uncertainty_weight * m
    out[:, 4] = noncovisibility_weight * (m**2 if count_penalty == "squared" else m)
    return out


@njit(cache=True)
def triple_similarity(terms: Terms, i: int, ii: int, j: int, jj: int, k: int, kk: int) -> float:
    """T of the matches (i, ii), (j, jj), (k, kk), without W^t; 0 where they share an object. Eq. (3)."""
    if i in (j, k) or j == k or ii in (jj, kk) or jj == kk:
        return 0.0
    if terms.source_side[i, j, k] * terms.target_side[ii, jj, kk] < 0:
        return 0.0
    distance = triangle_distance(terms.source_cosine, i, j, k, terms.target_cosine, ii, jj, kk, terms.nine_terms)
    if distance > terms.radius[i, j, k]:
        return 0.0
    return np.exp(-distance / terms.angle_width)


@njit(cache=True)
def full_sums(terms: Terms, match: NDArray[np.int64]) -> Array:
    """S_A, S_D, S_T, S_U (4,) of `match` (n,): the target of each source object, -1 = none. From scratch, O(m^3)."""
    out = np.zeros(4)
    for i in range(len(match)):
        ii = match[i]
        if ii < 0:
            continue
        out[0] += terms.attribute[i, ii]
        out[3] += terms.penalty[i, ii]
        for j in range(i):
            jj = match[j]
            if jj < 0:
                continue
            out[1] += 2.0 * terms.pair[i, ii, j, jj]
            for k in range(j):
                kk = match[k]
                if kk >= 0:
                    w = terms.angle_weight[i, ii] * terms.angle_weight[j, jj] * terms.angle_weight[k, kk]
                    out[2] += 6.0 * w * triple_similarity(terms, i, ii, j, jj, k, kk)
    return out


@njit(cache=True)
def value(sums: Array, m: int, table: Array) -> float:
    """E of m matches with the given sums (4,) and `coefficients` table."""
    row = table[m]
    return row[0] * sums[0] + row[1] * sums[1] + row[2] * sums[2] - row[3] * sums[3] - row[4]


def objective(terms: Terms, match: NDArray[np.int64], table: Array) -> float:
    """E of `match` (n,), target of each source object or -1, computed from scratch. Eq. (15)."""
    match = np.asarray(match, dtype=np.int64)
    return float(value(full_sums(terms, match), int((match >= 0).sum()), table))
