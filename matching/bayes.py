"""`bayes`: who is who by evidence over relative poses. The default matcher.

Every relative pose that two correspondences suggest is verified against all detections with their full covariances,
refined, and weighed by its evidence; the matches' probabilities are averaged over the poses, "nothing in common" among
them.
The model is written out in docs/explanation/bayes.md.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .bayes_hypotheses import candidate_pairs, candidate_triangles, distinct_best, distinct_best_spatial, screen
from .bayes_prepare import (
    LOG_2PI,
    class_evidence,
    height_correction,
    height_spread,
    level,
    levelling_rotation,
    shrink_heights,
    spread_area,
    spread_volume,
)
from .bayes_refine import refine, screen_spatial
from .graph import DEFAULT_BEARING_STD_RAD, Matching, ObjectGraph, check_comparable
from .pose import Array, RelativePose

TEMPERS = np.array([4.0, 2.0, 1.0])


def bayes(
    source: ObjectGraph,
    target: ObjectGraph,
    *,
    prior: RelativePose | None = None,
    rng: np.random.Generator | None = None,
    min_score: float = 0.4,
    common_probability: float = 0.5,
    class_sharpness: float = 2.0,
    mislabel: float = 0.01,
    log_odds: float = 1.5,
    screened: int = 800,
    refined: int = 16,
    max_hypotheses: int = 5,
) -> Matching:
    """Match by evidence over relative poses."""
    check_comparable(source, target)
    n, m = len(source), len(target)
    if n == 0 or m == 0:
        return Matching.empty()
    problem = _prepare(source, target, prior, class_sharpness, mislabel, log_odds)
    starts = _starts(problem, screened, refined)
    modes = [_refine(problem, R, t) for R, t in starts]
    modes = [mode for mode in modes if mode.log_evidence > -1e299]
    modes = _distinct(modes)
    return _decide(problem, modes, common_probability, min_score, max_hypotheses)


@dataclass(frozen=True, eq=False)
class _Problem:
    """Everything known before a pose. `turns`: 1 where gravity levels both views, else 3."""

    turns: int
    L_a: Array
    L_b: Array
    p_a: Array
    S_a: Array
    p_b: Array
    S_b: Array
    static: Array
    height: float
    height_variance: float
    prior_R: Array
    prior_t: Array
    prior_precision: Array
    prior_log_norm: float
    has_prior: bool


@dataclass(frozen=True, eq=False)
class _Mode:
    R: Array
    t: Array
    log_evidence: float
    marginals: Array
    information: Array


def _prepare(
    source: ObjectGraph,
    target: ObjectGraph,
    prior: RelativePose | None,
    sharpness: float,
    mislabel: float,
    log_odds: float,
) -> _Problem:
    n, m = len(source), len(target)
    turns = 1 if source.up is not None and target.up is not None else 3
    L_a, p_a, S_a = _levelled(source, turns == 1)
    L_b, p_b, S_b = _levelled(target, turns == 1)
    static = np.zeros((n, m))
    top_a, top_b = np.zeros(n, np.int64), np.zeros(m, np.int64)
    class_evidence(
        source.attributes,
        source.attribute_variance,
        target.attributes,
        target.attribute_variance,
        sharpness,
        mislabel,
        static,
        top_a,
        top_b,
    )
    precision = np.zeros((turns + 3, turns + 3))
    R0, t0 = np.eye(3), np.zeros(3)
    height = height_variance = 0.0
    if turns == 1:
        variance, mean_a, mean_b = height_spread(p_a, S_a, p_b, S_b)
        shrink_heights(p_a, S_a, mean_a, variance)
        shrink_heights(p_b, S_b, mean_b, variance)
        height_correction(p_a, S_a, mean_a, p_b, S_b, mean_b, variance, static)
        room_a, room_b = spread_area(p_a), spread_area(p_b)
        height = mean_a - mean_b
        height_variance = variance * (1 / n + 1 / m) * 2 + 1e-6
        precision[3, 3] = 1 / height_variance
        t0[2] = height
        log_norm = -np.log(2 * np.pi * (np.sqrt(room_a) + np.sqrt(room_b)) ** 2) - 0.5 * (
            LOG_2PI + np.log(height_variance)
        )
    else:
        room_a, room_b = spread_volume(p_a, S_a), spread_volume(p_b, S_b)
        log_norm = -np.log(8 * np.pi**2 * (np.cbrt(room_a) + np.cbrt(room_b)) ** 3)
    static += log_odds + 0.5 * (np.log(room_a / n) + np.log(room_b / m))
    if prior is not None:
        R0, t0, precision, log_norm = _combine(prior, L_a, L_b, turns, t0, precision)
    return _Problem(
        turns,
        L_a,
        L_b,
        p_a,
        S_a,
        p_b,
        S_b,
        static,
        height,
        height_variance,
        R0,
        t0,
        precision,
        log_norm,
        prior is not None,
    )


def _levelled(graph: ObjectGraph, gravity: bool) -> tuple[Array, Array, Array]:
    L = levelling_rotation(graph.up) if gravity and graph.up is not None else np.eye(3)
    p, S = np.empty((len(graph), 3)), np.empty((len(graph), 3, 3))
    covariances = np.empty((0, 3, 3)) if graph.covariances is None else graph.covariances
    level(graph.positions, graph.position_variance, covariances, DEFAULT_BEARING_STD_RAD**2, L, p, S)
    return L, p, S


def _combine(
    prior: RelativePose, L_a: Array, L_b: Array, turns: int, t0: Array, precision: Array
) -> tuple[Array, Array, Array, float]:
    """Prior pose between levelled frames, with what heights say: rotation, translation, precision, log normaliser."""
    R = L_a @ prior.T_source_target[:3, :3] @ L_b.T
    # The prior perturbs on the right, in target axes; here rotation comes first and both are in source axes.
    G = np.zeros((6, 6))
    G[:3, 3:] = G[3:, :3] = R @ L_b
    covariance = G @ prior.covariance @ G.T + 1e-9 * np.eye(6)
    t = L_a @ prior.T_source_target[:3, 3]
    if turns == 1:
        R = _turn(np.arctan2(R[1, 0] - R[0, 1], R[0, 0] + R[1, 1]))
        covariance = covariance[2:, 2:]
    P = np.linalg.inv(covariance)
    total = P + precision
    shift = np.linalg.solve(total, precision[:, turns:] @ (t0 - t))
    if turns == 1:
        R = _turn(float(shift[0])) @ R
    log_norm = 0.5 * np.linalg.slogdet(total)[1] - 0.5 * len(total) * LOG_2PI
    return R, t + shift[turns:], total, float(log_norm)


def _turn(yaw: float) -> Array:
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def _starts(q: _Problem, screened: int, refined: int) -> list[tuple[Array, Array]]:
    """Poses to refine: the prior's, then the best of those that two (without gravity three) correspondences suggest."""
    first = [(q.prior_R.copy(), q.prior_t.copy())] if q.has_prior else []
    if min(q.static.shape) < (2 if q.turns == 1 else 3):
        return first
    return first + (_starts_levelled(q, screened, refined) if q.turns == 1 else _starts_spatial(q, screened, refined))


def _starts_levelled(q: _Problem, screened: int, refined: int) -> list[tuple[Array, Array]]:
    pairs, rank = candidate_pairs(q.p_a, q.S_a, q.p_b, q.S_b, q.static, q.static.max() - 6.0, 6.0, 50000)
    if len(pairs) == 0:
        return []
    if q.has_prior:
        covariance = np.linalg.inv(q.prior_precision)[:3, :3]
        mean = np.array([np.arctan2(q.prior_R[1, 0], q.prior_R[0, 0]), q.prior_t[0], q.prior_t[1]])
    else:
        mean, covariance = np.zeros(3), np.zeros((0, 0))
        if len(pairs) > screened:
            pairs = pairs[np.argpartition(-rank, screened)[:screened]]
    poses, scores = np.empty((len(pairs), 3)), np.empty(len(pairs))
    screen(q.p_a, q.S_a, q.p_b, q.S_b, q.static, q.height, q.height_variance, mean, covariance, pairs, poses, scores)
    scale = np.sqrt(np.median(q.S_a[:, 0, 0] + q.S_a[:, 1, 1]))
    best = distinct_best(poses, scores, 0.05, scale, 0.0, refined)
    return [(_turn(poses[k, 0]), np.array([poses[k, 1], poses[k, 2], q.height])) for k in best]


def _starts_spatial(q: _Problem, screened: int, refined: int) -> list[tuple[Array, Array]]:
    R, t, rank, _ = candidate_triangles(
        q.p_a, q.S_a, q.p_b, q.S_b, q.static, q.static.max() - 6.0, 6.0, screened, 20000
    )
    if len(R) == 0:
        return []
    if len(R) > screened:
        best = np.argpartition(-rank, screened)[:screened]
        R, t = R[best], t[best]
    scores = np.empty(len(R))
    screen_spatial(q.p_a, q.S_a, q.p_b, q.S_b, q.static, R, t, 3.0, scores)
    scale = np.sqrt(np.median(np.trace(q.S_a, axis1=1, axis2=2)))
    best = distinct_best_spatial(R, t, scores, 0.1, 2 * scale, refined)
    return [(R[k].copy(), t[k].copy()) for k in best]


def _refine(q: _Problem, R: Array, t: Array) -> _Mode:
    n, m = q.static.shape
    d = q.turns + 3
    marginals, information = np.zeros((n, m)), np.zeros((d, d))
    none_a, none_b = np.zeros((n, 0, 3)), np.zeros((m, 0, 3))
    evidence = refine(
        q.p_a,
        q.S_a,
        none_a,
        q.p_b,
        q.S_b,
        none_b,
        q.static,
        q.prior_R,
        q.prior_t,
        q.prior_precision,
        q.prior_log_norm,
        R,
        t,
        np.zeros(0),
        q.turns,
        TEMPERS,
        12,
        marginals,
        information,
    )
    return _Mode(R, t, evidence, marginals, information)


def _distinct(modes: list[_Mode]) -> list[_Mode]:
    keep: list[_Mode] = []
    for mode in sorted(modes, key=lambda x: -x.log_evidence):
        for other in keep:
            D = mode.R @ other.R.T
            w = 0.5 * np.array([D[2, 1] - D[1, 2], D[0, 2] - D[2, 0], D[1, 0] - D[0, 1]])
            if np.trace(D) < 1.0:
                continue
            d = np.concatenate([w[3 - (len(mode.information) - 3) :], mode.t - other.t])
            if d @ other.information @ d < 1.0:
                break
        else:
            keep.append(mode)
    return keep


def _decide(q: _Problem, modes: list[_Mode], common: float, min_score: float, count: int) -> Matching:
    if not modes:
        return Matching.empty()
    logs = np.array([0.0] + [x.log_evidence for x in modes])
    if not q.has_prior:
        logs[0] += np.log1p(-common)
        logs[1:] += np.log(common)
    else:
        logs[0] = -np.inf
    weights = np.exp(logs - logs.max())
    weights /= weights.sum()
    P = sum(w * x.marginals for w, x in zip(weights[1:], modes, strict=True))
    pairs, scores = _decode(P, min_score)
    return Matching(pairs, scores, diagnostics={"modes": modes, "weights": weights, "P": P})


def _decode(P: Array, threshold: float) -> tuple[NDArray[np.int64], Array]:
    pairs, scores = [], []
    P = np.minimum(P, 1.0)
    work = P.copy()
    while work.size:
        i, j = np.unravel_index(np.argmax(work), work.shape)
        if work[i, j] < threshold:
            break
        pairs.append((i, j))
        scores.append(work[i, j])
        work[i] = 0
        work[:, j] = 0
    return np.array(pairs, dtype=np.int64).reshape(-1, 2), np.array(scores)
