"""The objective kept up to date: a matching with what every single change to it would do to Eq. (15)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from .objective import Terms, value
from .pose import Array


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
    """The state of no match at all."""
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
