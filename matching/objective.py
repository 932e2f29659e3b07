"""The regularised graph matching objective (Eq. 4, 12-15), in full and incrementally.

With m matches, a value is a fixed combination of four sums over them,

    S_A = sum_a A_a W^a_a              S_D = sum_{a != b} D_ab W^d_ab
    S_T = sum_{a, b, c distinct} T_abc W^t_abc      S_U = sum_a (V + U)_a^2

    E = c_A(m) S_A + c_D(m) S_D + c_T(m) S_T - c_U(m) S_U - c_0(m),

and `Coefficients` holds c_A ... c_0 for every m. The equations as printed are c_A = c_D = c_T = 1, c_U = lambda_1 and
c_0 = lambda_2 m. See `coefficients` for the scaling that makes the published lambdas mean something.

`vec` and `unvec` are the only place where matrices are flattened; they go by columns, like the paper.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

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
    for name, value in (
        ("uncertainty_weight", uncertainty_weight),
        ("noncovisibility_weight", noncovisibility_weight),
    ):
        if not (np.isfinite(value) and value >= 0):
            raise ValueError(f"{name} must be finite and non-negative, got {value}")
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


class State(NamedTuple):
    """A matching and what every single change to it would do.

    Attributes:
        match: (n,) target of each source object, -1 = none.
        holder: (n',) source of each target object, -1 = none.
        sums: (4,) S_A, S_D, S_T, S_U.
        pair_gain: (n, n') what the match (i, i') has in S_D with all matches that do not conflict with it.
        triple_gain: (n, n') likewise in S_T.
        size: (1,) number of matches.
        list_start, list_index, list_value, list_used: entries of T met so far, kept because the same pairs of matches
            come and go again and again. Row a of the candidates (counted i n' + i'), column b > a: where in
            `list_index` (third candidates) and `list_value` (T times their weight) the entries T_ab. begin, -1 = not
            yet computed; the first index there is their number.
    """

    match: NDArray[np.int64]
    holder: NDArray[np.int64]
    sums: Array
    pair_gain: Array
    triple_gain: Array
    size: NDArray[np.int64]
    list_start: NDArray[np.int32]
    list_index: NDArray[np.int32]
    list_value: Array
    list_used: NDArray[np.int64]


LIST_CAPACITY = 1 << 18
"""Entries of T a state remembers; when they are full it starts anew."""


@njit(cache=True)
def empty_state(n: int, n_target: int) -> State:
    size = n * n_target
    return State(
        np.full(n, -1),
        np.full(n_target, -1),
        np.zeros(4),
        np.zeros((n, n_target)),
        np.zeros((n, n_target)),
        np.zeros(1, dtype=np.int64),
        np.full((size, size), np.int32(-1)),
        np.empty(LIST_CAPACITY + size + 1, dtype=np.int32),
        np.empty(LIST_CAPACITY + size + 1),
        np.zeros(1, dtype=np.int64),
    )


@njit(cache=True)
def add(terms: Terms, state: State, i: int, ii: int) -> None:
    """Add the match (i, ii) of two free objects."""
    _account(terms, state, i, ii, 1.0)
    state.match[i] = ii
    state.holder[ii] = i
    state.size[0] += 1
    _spread(terms, state, i, ii, 1.0)


@njit(cache=True)
def remove(terms: Terms, state: State, i: int) -> None:
    """Remove the match of source object i."""
    ii = state.match[i]
    _account(terms, state, i, ii, -1.0)
    state.match[i] = -1
    state.holder[ii] = -1
    state.size[0] -= 1
    _spread(terms, state, i, ii, -1.0)


@njit(cache=True)
def _account(terms: Terms, state: State, i: int, ii: int, sign: float) -> None:
    state.sums[0] += sign * terms.attribute[i, ii]
    state.sums[1] += sign * state.pair_gain[i, ii]
    state.sums[2] += sign * state.triple_gain[i, ii]
    state.sums[3] += sign * terms.penalty[i, ii]


@njit(cache=True)
def _spread(terms: Terms, state: State, a: int, aa: int, sign: float) -> None:
    """Bring the gains of all candidate matches up to date after (a, aa) came (sign 1) or went (sign -1)."""
    n, n_target = state.pair_gain.shape
    pair = terms.pair[a, aa]
    for j in range(n):
        for jj in range(n_target):
            state.pair_gain[j, jj] += sign * 2.0 * pair[j, jj]
    gain, index, similar = state.triple_gain.reshape(n * n_target), state.list_index, state.list_value
    for b in range(n):
        bb = state.match[b]
        if bb < 0 or b == a:
            continue
        one, other = min(a * n_target + aa, b * n_target + bb), max(a * n_target + aa, b * n_target + bb)
        start = state.list_start[one, other]
        if start < 0:
            start = _list_triples(terms, state, a, aa, b, bb)
            state.list_start[one, other] = start
        w = sign * 6.0 * terms.angle_weight[a, aa] * terms.angle_weight[b, bb]
        for x in range(start + 1, start + 1 + index[start]):
            gain[index[x]] += w * similar[x]


@njit(cache=True)
def _list_triples(terms: Terms, state: State, a: int, aa: int, b: int, bb: int) -> int:
    """Write the entries of T with the matches (a, aa) and (b, bb) into the state's lists; returns where; O(n n')."""
    n, n_target = state.pair_gain.shape
    index, value = state.list_index, state.list_value
    if state.list_used[0] > LIST_CAPACITY:
        state.list_used[0] = 0
        state.list_start[:] = -1
    start = state.list_used[0]
    at = start + 1
    # Of the third corner: what it makes of the angles at aa and bb, and its own angle.
    s, t, u = terms.target_cosine[aa, bb], terms.target_cosine[bb, aa], terms.target_apex[aa, bb]
    for j in range(n):
        if j in (a, b):
            continue
        q, r, p = terms.source_cosine[a, b, j], terms.source_cosine[b, a, j], terms.source_apex[a, b, j]
        radius = terms.radius[a, b, j]
        side = terms.source_side[a, b, j]
        first = at
        for jj in range(n_target):
            if terms.nine_terms:
                d = abs(p - u[jj]) + abs(p - s[jj]) + abs(p - t[jj]) + abs(q - u[jj]) + abs(q - s[jj])
                d += abs(q - t[jj]) + abs(r - u[jj]) + abs(r - s[jj]) + abs(r - t[jj])
            else:
                d = abs(p - u[jj]) + abs(q - s[jj]) + abs(r - t[jj])
            value[at], index[at] = d, j * n_target + jj
            at += d <= radius and jj != aa and jj != bb and side * terms.target_side[aa, bb, jj] >= 0
        for x in range(first, at):
            value[x] = terms.angle_weight[j, index[x] - j * n_target] * np.exp(-value[x] / terms.angle_width)
    index[start] = at - start - 1
    state.list_used[0] = at
    return start


@njit(cache=True)
def value_after(terms: Terms, state: State, table: Array, i: int, ii: int) -> float:
    """E if source object i were matched to the free target ii (instead of its present one, if any); O(1)."""
    old = state.match[i]
    row = table[state.size[0] + (1 if old < 0 else 0)]
    change_a, change_u = terms.attribute[i, ii], terms.penalty[i, ii]
    change_d, change_t = state.pair_gain[i, ii], state.triple_gain[i, ii]
    if old >= 0:
        change_a -= terms.attribute[i, old]
        change_u -= terms.penalty[i, old]
        change_d -= state.pair_gain[i, old]
        change_t -= state.triple_gain[i, old]
    s = state.sums
    total = row[0] * (s[0] + change_a) + row[1] * (s[1] + change_d) + row[2] * (s[2] + change_t)
    return total - row[3] * (s[3] + change_u) - row[4]


@njit(cache=True)
def value_without(terms: Terms, state: State, table: Array, i: int) -> float:
    """E if the match of source object i were removed; O(1)."""
    ii = state.match[i]
    row = table[state.size[0] - 1]
    s = state.sums
    total = row[0] * (s[0] - terms.attribute[i, ii]) + row[1] * (s[1] - state.pair_gain[i, ii])
    total += row[2] * (s[2] - state.triple_gain[i, ii])
    return total - row[3] * (s[3] - terms.penalty[i, ii]) - row[4]


@njit(cache=True)
def value_stolen(terms: Terms, state: State, table: Array, i: int, j: int) -> float:
    """E if the free source object i took the target of j, leaving j unmatched; O(1)."""
    jj = state.match[j]
    row = table[state.size[0]]
    s = state.sums
    total = row[0] * (s[0] + terms.attribute[i, jj] - terms.attribute[j, jj])
    total += row[1] * (s[1] + state.pair_gain[i, jj] - state.pair_gain[j, jj])
    total += row[2] * (s[2] + state.triple_gain[i, jj] - state.triple_gain[j, jj])
    return total - row[3] * (s[3] + terms.penalty[i, jj] - terms.penalty[j, jj]) - row[4]


@njit(cache=True)
def best_reassignment(terms: Terms, state: State, table: Array, worth: float) -> tuple[float, int, int]:
    """The best E above `worth` from matching one matched object to a free target instead, and which; -1 if none."""
    best, first, second = worth, -1, -1
    for i in range(len(state.match)):
        if state.match[i] >= 0:
            for ii in range(len(state.holder)):
                if state.holder[ii] < 0:
                    after = value_after(terms, state, table, i, ii)
                    if after > best:
                        best, first, second = after, i, ii
    return best, first, second


@njit(cache=True)
def best_exchange(terms: Terms, state: State, table: Array, worth: float) -> tuple[float, int, int]:
    """The best E above `worth` from two matched source objects exchanging their targets, and which; -1 if none.

    O(m) for each two. Those whose sums known in O(1) leave no room for `worth` are passed over.
    """
    best, first, second = worth, -1, -1
    match, P, Q, R, A = state.match, terms.penalty, state.pair_gain, state.triple_gain, terms.attribute
    pair, wt = terms.pair, terms.angle_weight
    c, c_apex, c_radius, c_side = terms.source_cosine, terms.source_apex, terms.radius, terms.source_side
    d, d_apex, d_side = terms.target_cosine, terms.target_apex, terms.target_side
    nine_terms, angle_width = terms.nine_terms, terms.angle_width
    r_a, r_d, r_t, r_u = (
        table[state.size[0], 0],
        table[state.size[0], 1],
        table[state.size[0], 2],
        table[state.size[0], 3],
    )
    now = value(state.sums, state.size[0], table)
    others = max(state.size[0] - 2, 0)
    for i in range(len(match)):
        ii = match[i]
        for j in range(i):
            jj = match[j]
            if ii < 0 or jj < 0:
                continue
            change_a = A[i, jj] + A[j, ii] - A[i, ii] - A[j, jj]
            change_u = P[i, jj] + P[j, ii] - P[i, ii] - P[j, jj]
            # The gains leave out what two matches share when both are new, and count it twice when both are old.
            change_d = Q[i, jj] + Q[j, ii] - Q[i, ii] - Q[j, jj] + 2.0 * (pair[i, jj, j, ii] + pair[i, ii, j, jj])
            change_t = R[i, jj] + R[j, ii] - R[i, ii] - R[j, jj]
            known = now + r_a * change_a + r_d * change_d + r_t * change_t - r_u * change_u
            w_new, w_old = 6.0 * wt[i, jj] * wt[j, ii], 6.0 * wt[i, ii] * wt[j, jj]
            # T is at most 1, and two old matches share no more than either has in all.
            at_most = w_new * others + max(min(R[i, ii], R[j, jj]), 0.0)
            if known + r_t * at_most < best - 1e-6:
                continue
            new = old = 0.0
            for k in range(len(match)):
                kk = match[k]
                if kk < 0 or k in (i, j):
                    continue
                p, q, r = c[i, j, k], c[j, i, k], c_apex[i, j, k]
                s, t, u = d[ii, jj, kk], d[jj, ii, kk], d_apex[ii, jj, kk]
                if nine_terms:
                    straight = abs(p - s) + abs(q - t) + abs(r - u) + abs(p - t) + abs(q - s)
                    straight += abs(p - u) + abs(q - u) + abs(r - s) + abs(r - t)
                    crossed = straight
                else:
                    straight = abs(p - s) + abs(q - t) + abs(r - u)
                    crossed = abs(p - t) + abs(q - s) + abs(r - u)
                side = c_side[i, j, k] * d_side[ii, jj, kk]
                if straight <= c_radius[i, j, k] and side >= 0:
                    old += wt[k, kk] * np.exp(-straight / angle_width)
                if crossed <= c_radius[i, j, k] and side <= 0:
                    new += wt[k, kk] * np.exp(-crossed / angle_width)
            after = known + r_t * (w_new * new + w_old * old)
            if after > best:
                best, first, second = after, i, j
    return best, first, second


@njit(cache=True)
def load_match(terms: Terms, state: State, match: NDArray[np.int64]) -> None:
    """Change the state to `match` (n,)."""
    for i in range(len(match)):
        if state.match[i] >= 0 and state.match[i] != match[i]:
            remove(terms, state, i)
    for i in range(len(match)):
        if match[i] >= 0 and state.match[i] < 0:
            add(terms, state, i, match[i])
