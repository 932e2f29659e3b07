"""From a prepared problem to the modes of the posterior over relative poses, in compiled code end to end."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from .bayes_hypotheses import (
    candidate_pairs,
    candidate_triangles,
    distinct_best,
    distinct_best_spatial,
    screen,
)
from .bayes_prepare import LOG_2PI, Problem, Settings
from .bayes_refine import refine, rotation_difference, screen_spatial
from .bayes_view import View
from .pose import Array

TEMPERS = (4.0, 2.0, 1.0)
MAX_CHI2 = 6.0
LEAST_EVIDENCE = -3.0
SOURCE_PAIRS = 200


class Prior(NamedTuple):
    """Gaussian prior of the pose between levelled frames; `known` is 0 where nothing is known but heights."""

    known: float
    R: Array
    t: Array
    precision: Array
    log_norm: float


class Modes(NamedTuple):
    """Distinct modes, best first: pose, bias (k, nb), log evidence (k,), marginals (k, n, m), information (k, d, d)."""

    R: Array
    t: Array
    bias: Array
    log_evidence: Array
    marginals: Array
    information: Array


@njit(cache=True)
def levelled_starts(
    x: Problem, prior: Prior, view_a: View, view_b: View, q: Settings, screened: int, refined: int
) -> tuple[Array, Array]:
    """Poses (k, 3, 3), (k, 3) that two correspondences suggest, best first; the prior's own before them."""
    first = 1 if prior.known > 0 else 0
    wanted = 4 * screened if prior.known > 0 else screened
    pairs = candidate_pairs(x.p_a, x.S_a, x.p_b, x.S_b, x.likely, LEAST_EVIDENCE, MAX_CHI2, SOURCE_PAIRS, wanted)
    mean, covariance = np.zeros(3), np.zeros((0, 0))
    if prior.known > 0:
        mean[0] = np.arctan2(prior.R[1, 0], prior.R[0, 0])
        mean[1:] = prior.t[:2]
        covariance = np.ascontiguousarray(np.linalg.inv(prior.precision)[:3, :3])
    poses, scores = np.empty((len(pairs), 3)), np.empty(len(pairs))
    screen(
        x.p_a,
        x.S_a,
        x.p_b,
        x.S_b,
        x.static,
        x.height,
        x.height_variance,
        mean,
        covariance,
        q.initial_log_odds,
        view_a,
        view_b,
        pairs,
        poses,
        scores,
    )
    spread = np.empty(len(x.p_a) - 1)
    for i in range(len(spread)):
        spread[i] = x.S_a[i, 0, 0] + x.S_a[i, 1, 1]
    best = distinct_best(poses, scores, 0.05, np.sqrt(np.median(spread)), refined)
    R, t = np.zeros((first + len(best), 3, 3)), np.zeros((first + len(best), 3))
    if first:
        R[0] = prior.R
        t[0] = prior.t
    for k in range(len(best)):
        yaw, px, py = poses[best[k]]
        c, s = np.cos(yaw), np.sin(yaw)
        R[first + k, 0, 0], R[first + k, 0, 1], R[first + k, 1, 0], R[first + k, 1, 1] = c, -s, s, c
        R[first + k, 2, 2] = 1.0
        t[first + k, 0], t[first + k, 1], t[first + k, 2] = px, py, x.height
    return R, t


@njit(cache=True)
def spatial_starts(x: Problem, prior: Prior, q: Settings, screened: int, refined: int) -> tuple[Array, Array]:
    """Poses (k, 3, 3), (k, 3) in SE(3) that three correspondences suggest, best first; the prior's own before them."""
    first = 1 if prior.known > 0 else 0
    R, t, rank, _ = candidate_triangles(x.p_a, x.S_a, x.p_b, x.S_b, x.likely, LEAST_EVIDENCE, MAX_CHI2, screened, 20000)
    order = np.argsort(-rank)[:screened]
    R, t = R[order], t[order]
    scores = np.empty(len(R))
    screen_spatial(x.p_a, x.S_a, x.p_b, x.S_b, x.static, R, t, 3.0, q.initial_log_odds, scores)
    spread = np.empty(len(x.p_a) - 1)
    for i in range(len(spread)):
        spread[i] = x.S_a[i, 0, 0] + x.S_a[i, 1, 1] + x.S_a[i, 2, 2]
    best = distinct_best_spatial(R, t, scores, 0.1, 2.0 * np.sqrt(np.median(spread)), refined)
    R_out, t_out = np.zeros((first + len(best), 3, 3)), np.zeros((first + len(best), 3))
    if first:
        R_out[0] = prior.R
        t_out[0] = prior.t
    for k in range(len(best)):
        R_out[first + k] = R[best[k]]
        t_out[first + k] = t[best[k]]
    return R_out, t_out


@njit(cache=True)
def climb(x: Problem, prior: Prior, view_a: View, view_b: View, q: Settings, turns: int, R: Array, t: Array) -> Modes:
    """Refine every start (in place) and keep one of each mode, best first."""
    n, m = len(x.p_a) - 1, len(x.p_b) - 1
    nb = len(x.bias_precision)
    d = turns + 3 + nb
    count = len(R)
    precision = np.zeros((d, d))
    precision[: turns + 3, : turns + 3] = prior.precision
    log_norm = prior.log_norm - 0.5 * nb * LOG_2PI
    for k in range(nb):
        precision[turns + 3 + k, turns + 3 + k] = x.bias_precision[k]
        log_norm += 0.5 * np.log(x.bias_precision[k])
    bias = np.zeros((count, nb))
    evidence = np.empty(count)
    marginals, information = np.zeros((count, n + 1, m + 1)), np.zeros((count, d, d))
    tempers = np.array(TEMPERS)
    for k in range(count):
        evidence[k] = refine(
            x.p_a,
            x.S_a,
            x.B_a,
            x.p_b,
            x.S_b,
            x.B_b,
            x.static,
            prior.R,
            prior.t,
            precision,
            log_norm,
            R[k],
            t[k],
            bias[k],
            turns,
            tempers,
            12,
            q,
            view_a,
            view_b,
            marginals[k],
            information[k],
        )
    keep = np.empty(count, np.int64)
    kept = 0
    w, e = np.empty(3), np.empty(turns + 3)
    for k in np.argsort(-evidence):
        if not evidence[k] > -1e200:
            break
        fresh = True
        for c in range(kept):
            g = keep[c]
            rotation_difference(R[k], R[g], w)
            for a in range(turns):
                e[a] = w[3 - turns + a]
            for a in range(3):
                e[turns + a] = t[k, a] - t[g, a]
            square = 0.0
            for a in range(turns + 3):
                for b in range(turns + 3):
                    square += e[a] * information[g, a, b] * e[b]
            if square < 1.0:
                fresh = False
                break
        if fresh:
            keep[kept] = k
            kept += 1
    keep = keep[:kept]
    return Modes(R[keep], t[keep], bias[keep], evidence[keep], marginals[keep][:, :n, :m].copy(), information[keep])


@njit(cache=True)
def solve_levelled(
    x: Problem, prior: Prior, view_a: View, view_b: View, q: Settings, screened: int, refined: int
) -> Modes:
    """Search and climb with gravity known (yaw and translation)."""
    R, t = levelled_starts(x, prior, view_a, view_b, q, screened, refined)
    return climb(x, prior, view_a, view_b, q, 1, R, t)


@njit(cache=True)
def solve_spatial(
    x: Problem, prior: Prior, view_a: View, view_b: View, q: Settings, screened: int, refined: int
) -> Modes:
    """Search and climb in SE(3)."""
    R, t = spatial_starts(x, prior, q, screened, refined)
    return climb(x, prior, view_a, view_b, q, 3, R, t)


@njit(cache=True)
def mix(modes: Modes, log_common: float, log_nothing: float, n: int, m: int) -> tuple[Array, Array]:
    """Posterior weights (1 + k,) of "nothing in common" and the modes, and match probabilities (n, m)."""
    count = len(modes.log_evidence)
    logs = np.empty(1 + count)
    logs[0] = log_nothing
    for k in range(count):
        logs[1 + k] = log_common + modes.log_evidence[k]
    weights = np.exp(logs - logs.max())
    weights /= weights.sum()
    P = np.zeros((n, m))
    for k in range(count):
        P += weights[1 + k] * modes.marginals[k]
    return weights, np.minimum(P, 1.0)


@njit(cache=True)
def decode(P: Array, threshold: float) -> tuple[Array, Array]:
    """One-to-one matches (k, 2) of probability at least `threshold`, most probable first, with their probabilities."""
    n, m = P.shape
    rows, cols = np.nonzero(max(threshold, 1e-12) <= P)
    score = np.empty(len(rows))
    for e in range(len(rows)):
        score[e] = P[rows[e], cols[e]]
    free_a, free_b = np.ones(n, np.bool_), np.ones(m, np.bool_)
    pairs = np.empty((min(n, m), 2), np.int64)
    scores = np.empty(min(n, m))
    k = 0
    for e in np.argsort(-score):
        if free_a[rows[e]] and free_b[cols[e]]:
            free_a[rows[e]] = free_b[cols[e]] = False
            pairs[k, 0], pairs[k, 1] = rows[e], cols[e]
            scores[k] = score[e]
            k += 1
    return pairs[:k], scores[:k]
