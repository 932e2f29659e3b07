"""Pairwise matchings of N robots made consistent: what a matches with b, and b with c, a matches with c.

`joint`, the default, optimises all groups together under every robot's one-to-one constraint: a combinatorial ascent,
robot by robot. `convex` maximises the same sum of log odds over the convex relaxation of Huang and Guibas 2013, which
Hu, Huang, Thibert and Guibas 2018 distribute (see `multiway_convex`). `spectral` is the reference (after Pachauri,
Kondor and Singh 2013, and Maset, Arrigoni and Fusiello 2017): leading eigenvectors of the joint match matrix, grouped.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from .checks import check_count, check_interval
from .graph import Matching
from .multiway_convex import ROUND_AT, relaxed
from .pose import Array

Method = Literal["joint", "convex", "spectral"]
Pair = tuple[int, int]
Indices = NDArray[np.int64]

ABSENT_LOG_ODDS = -0.5
CLOSE_ROWS = 0.2


def consistent(
    matchings: Mapping[Pair, Matching],
    sizes: Sequence[int],
    *,
    method: Method = "joint",
    match_prior: float = 0.4,
    min_score: float = 0.0,
) -> dict[Pair, Matching]:
    """Cycle-consistent matchings of the same pairs of robots.

    Args:
        matchings: per pair of robots (i, j), i != j, what a matcher found; scores are match probabilities.
        sizes: number of detections of every robot.
        method: "joint" (default), "convex" or "spectral".
        match_prior: score that speaks neither for nor against a match. Where two robots were compared and no match was
            made, that speaks mildly against one.
        min_score: matches whose combined score is lower are left out. Above 0 this may open cycles again.

    Returns:
        For every given pair the matches of detections in one group. The score of a match is its own, where the pair of
        robots found it, combined with the support over every third robot: 1 - (1 - s) prod(1 - s_ik s_kj).

    Raises:
        ValueError: a robot or detection out of range, an unknown method, a prior outside (0, 1), or for "convex" more
            detections in one chain of likely matches than `multiway_convex.MAX_CONNECTED`.
    """
    check_interval("min_score", min_score, "[0, 1]")
    labels = groups(matchings, sizes, method=method, match_prior=match_prior)
    scores = _joint_scores(matchings, sizes)
    start = _starts(sizes)
    out = {}
    for i, j in matchings:
        rows, cols = np.nonzero(labels[i][:, None] == labels[j][None])
        support = _combined(scores, start[i] + rows, start[j] + cols, start, (i, j))
        keep = support >= min_score
        out[i, j] = Matching(np.stack([rows[keep], cols[keep]], axis=1), support[keep])
    return out


def groups(
    matchings: Mapping[Pair, Matching],
    sizes: Sequence[int],
    *,
    method: Method = "joint",
    match_prior: float = 0.4,
) -> list[Indices]:
    """Label of every detection, one array (n_i,) a robot; equal labels are one object, at most one a robot.

    Labels count from 0 in the order of first appearance; a detection without partner has a label of its own.
    """
    _check(matchings, sizes, match_prior)
    if method == "joint":
        labels = _joint_groups(_affinity(matchings, sizes, match_prior), sizes)
    elif method == "convex":
        labels = _convex_groups(_affinity(matchings, sizes, match_prior), sizes)
    elif method == "spectral":
        labels = _spectral_groups(_joint_scores(matchings, sizes), sizes)
    else:
        raise ValueError(f"method must be 'joint', 'convex' or 'spectral', got {method!r}")
    _, first, inverse = np.unique(labels, return_index=True, return_inverse=True)
    rank = np.empty(len(first), dtype=np.int64)
    rank[np.argsort(first)] = np.arange(len(first))
    return [np.asarray(x) for x in np.split(rank[inverse], np.cumsum(sizes)[:-1])] if len(sizes) else []


def is_consistent(matchings: Mapping[Pair, Matching], sizes: Sequence[int]) -> bool:
    """Whether no chain of matches leads from a detection to another one of the same robot, or skips a given pair."""
    scores = _joint_matches(matchings, sizes)
    start = _starts(sizes)
    reach = scores | np.eye(len(scores), dtype=bool)
    for _ in range(max(1, len(sizes))):
        reach = (reach.astype(float) @ reach) > 0
    for i, n in enumerate(sizes):
        block = reach[start[i] : start[i] + n, start[i] : start[i] + n]
        if (block & ~np.eye(n, dtype=bool)).any():
            return False
    return all((reach[_block(start, sizes, i, j)] == scores[_block(start, sizes, i, j)]).all() for i, j in matchings)


def _check(matchings: Mapping[Pair, Matching], sizes: Sequence[int], match_prior: float) -> None:
    check_interval("match_prior", match_prior, "(0, 1)")
    for n in sizes:
        check_count("sizes", n, 0)
    for pair, matching in matchings.items():
        robots = range(len(sizes))
        if not (isinstance(pair, tuple) and len(set(pair)) == len(pair) == 2 and all(i in robots for i in pair)):
            raise ValueError(f"pair {pair!r} does not name two of {len(sizes)} robots by their numbers, from 0")
        if not isinstance(matching, Matching):
            raise TypeError(f"matchings[{pair}] must be a Matching, got {type(matching).__name__}")
        i, j = pair
        if len(matching) and (matching.pairs.max(axis=0) >= (sizes[i], sizes[j])).any():
            raise ValueError(f"matching ({i}, {j}) speaks of a detection beyond {sizes[i]} and {sizes[j]}")


def _robots(sizes: Sequence[int]) -> Indices:
    """Robot of each detection."""
    return np.repeat(np.arange(len(sizes)), sizes)


def _starts(sizes: Sequence[int]) -> Indices:
    return np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)


def _block(start: Indices, sizes: Sequence[int], i: int, j: int) -> tuple[slice, slice]:
    return slice(start[i], start[i] + sizes[i]), slice(start[j], start[j] + sizes[j])


def _joint_scores(matchings: Mapping[Pair, Matching], sizes: Sequence[int]) -> Array:
    """Symmetric matrix of all match scores, robot after robot."""
    start = _starts(sizes)
    W = np.zeros((start[-1], start[-1]))
    for (i, j), matching in matchings.items():
        a, b = start[i] + matching.pairs[:, 0], start[j] + matching.pairs[:, 1]
        W[a, b] = np.maximum(W[a, b], matching.scores)
        W[b, a] = W[a, b]
    return W


def _joint_matches(matchings: Mapping[Pair, Matching], sizes: Sequence[int]) -> NDArray[np.bool_]:
    """Symmetric matrix of which detections are matched, whatever the score."""
    certain = {pair: Matching(m.pairs, np.ones(len(m))) for pair, m in matchings.items()}
    return _joint_scores(certain, sizes) > 0


def _affinity(matchings: Mapping[Pair, Matching], sizes: Sequence[int], match_prior: float) -> Array:
    """Log odds of "the same object" of any two detections: 0 where their robots were not compared."""
    start = _starts(sizes)
    W = np.clip(_joint_scores(matchings, sizes), 1e-3, 1 - 1e-3)
    log_odds = np.log(W / (1 - W)) - np.log(match_prior / (1 - match_prior))
    # A match that was not made scored below the matcher's threshold, not zero: it speaks mildly.
    log_odds = np.maximum(log_odds, ABSENT_LOG_ODDS)
    compared = np.zeros(W.shape, dtype=bool)
    for i, j in matchings:
        compared[_block(start, sizes, i, j)] = True
        compared[_block(start, sizes, j, i)] = True
    return np.where(compared, log_odds, 0.0)


def _joint_groups(L: Array, sizes: Sequence[int], sweeps: int = 20) -> Indices:
    """Groups of the largest sum of log odds within them, a robot at most once: greedy merging, then robot by robot.

    In each sweep one robot's detections leave their groups and are assigned anew, optimally given all others; the
    objective never falls.
    """
    start, robot = _starts(sizes), _robots(sizes)
    labels = _merge(L, robot, len(sizes))
    for _ in range(sweeps):
        before = labels.copy()
        for i, n in enumerate(sizes):
            mine = np.arange(start[i], start[i] + n)
            others = np.flatnonzero(robot != i)
            if n == 0 or len(others) == 0:
                continue
            names, member = np.unique(labels[others], return_inverse=True)
            gain = np.zeros((n, len(names)))
            np.add.at(gain.T, member, L[np.ix_(mine, others)].T)
            # Staying alone gains nothing and is open to each.
            rows, cols = linear_sum_assignment(np.hstack([gain, np.zeros((n, n))]), maximize=True)
            fresh = labels.max() + 1
            chosen = np.where(cols < len(names), names[np.minimum(cols, len(names) - 1)], fresh + rows)
            worse = (cols < len(names)) & (gain[rows, np.minimum(cols, len(names) - 1)] <= 0)
            labels[mine[rows]] = np.where(worse, fresh + rows, chosen)
        if _same_partition(before, labels):
            break
    return labels


def _merge(L: Array, robot: Indices, robots: int) -> Indices:
    """Greedy: join the two groups of largest total log odds that share no robot, until none gains."""
    n = len(L)
    labels = np.arange(n)
    total = L.copy()
    occupied = robot[:, None] == np.arange(robots)[None]
    alive = np.ones(n, dtype=bool)
    while n > 1:
        clash = (occupied.astype(float) @ occupied.T) > 0
        open_pairs = ~clash & alive[:, None] & alive[None]
        score = np.where(open_pairs, total, -np.inf)
        a, b = np.unravel_index(np.argmax(score), score.shape)
        if not score[a, b] > 0:
            break
        labels[labels == b] = a
        total[a] += total[b]
        total[:, a] += total[:, b]
        occupied[a] |= occupied[b]
        alive[b] = False
    return labels


def _convex_groups(L: Array, sizes: Sequence[int]) -> Indices:
    """Groups from the convex relaxation, cut by greedy merging where X is large."""
    robot = _robots(sizes)
    return _merge(relaxed(L, robot) - ROUND_AT, robot, len(sizes))


def _spectral_groups(W: Array, sizes: Sequence[int]) -> Indices:
    """Groups from the leading eigenvectors of the joint match matrix, cut by greedy merging of close rows."""
    n = len(W)
    if n == 0:
        return np.zeros(0, dtype=np.int64)
    robot = _robots(sizes)
    values, vectors = np.linalg.eigh(W + np.eye(n))
    # With consistent matches the matrix is a sum of blocks of ones: an object seen by k robots has eigenvalue k.
    universe = max(1, round(_universe_size(W, sizes)))
    lead = np.argsort(-values)[:universe]
    rows = vectors[:, lead] * np.sqrt(np.maximum(values[lead], 0.0))
    length = np.linalg.norm(rows, axis=1, keepdims=True)
    rows = np.divide(rows, length, out=np.zeros_like(rows), where=length > 1e-9)
    similarity = rows @ rows.T
    np.fill_diagonal(similarity, 0.0)
    return _merge(similarity - CLOSE_ROWS, robot, len(sizes))


def _universe_size(W: Array, sizes: Sequence[int]) -> float:
    """Number of distinct objects: every detection counts one over the number of robots that seem to see its object."""
    return float(np.sum(1.0 / (1.0 + np.minimum(W.sum(axis=1), max(0, len(sizes) - 1)))))


def _combined(W: Array, a: Indices, b: Indices, start: Indices, pair: Pair) -> Array:
    """Scores (k,) of matches a-b: direct evidence and every third robot's, each taken as independent."""
    miss = 1.0 - W[a, b]
    for r in range(len(start) - 1):
        if r in pair or start[r] == start[r + 1]:
            continue
        through = W[a, start[r] : start[r + 1]] * W[b, start[r] : start[r + 1]]
        miss *= 1.0 - through.max(axis=1, initial=0.0)
    # Detections that only longer chains join have the product of the best one.
    return np.where(miss < 1.0, 1.0 - miss, _best_chains(W)[a, b] if (miss == 1.0).any() else 0.0)


def _best_chains(W: Array) -> Array:
    """Largest product of scores over any chain of matches between two detections."""
    C = W.copy()
    for k in range(len(C)):
        np.maximum(C, C[:, k, None] * C[None, k], out=C)
    return C


def _same_partition(first: Indices, second: Indices) -> bool:
    return (
        len({*zip(first.tolist(), second.tolist(), strict=True)})
        == len(set(first.tolist()))
        == len(set(second.tolist()))
    )
