"""`bayes`: who is who by evidence over relative poses. The default matcher.

Every relative pose that two correspondences suggest is verified against all detections with their full covariances,
refined, and weighed by its evidence; the matches' probabilities are averaged over the poses, "nothing in common" among
them. The model is written out in docs/explanation/bayes.md.
"""

from __future__ import annotations

import math

import numpy as np

from .bayes_calibration import CALIBRATIONS, Evidence, calibrated, kind_of, pair_features
from .bayes_headings import grid_log_evidence, heading_log_prior, level_heading, right_angles_given
from .bayes_overlap import overlap_features
from .bayes_prepare import LOG_2PI, Problem, Settings, levelling_rotation, prepare, ranges, reach_of
from .bayes_solve import Modes, Prior, decode, mix, solve_levelled, solve_spatial
from .bayes_view import View
from .checks import check_count, check_interval
from .graph import DEFAULT_BEARING_STD_RAD, Hypothesis, Matching, ObjectGraph, check_comparable
from .pose import Array, RelativePose

OCCLUDER = 0.017
"""Half width of what hides, as a fraction of the reach."""

OCCLUDED = 0.75
RIGHT_ANGLES = 0.2
"""For cameras whose evidence counts whole: prior probability of headings that differ by a multiple of a right angle."""

HALF_LENGTH = 2.0
"""Half of an object's length, in near-face offsets."""

LEAST_HYPOTHESIS = 0.01
ALTERNATIVES: tuple[tuple[float, float], ...] = ((0.2, 0.0), (4.0, 0.0), (1.0, 0.07))
"""Factor on all variances, and prior deviation of the robots' depth scales, tried where the reported ones fit badly."""

OTHER_SCALE_PROBABILITY = 0.02
DOUBTFUL = -1.0
"""Log evidence below which wrong variances and scales are considered."""

REPORTED_EXTENT = 0.7
"""Factor on `extent` for cameras that report full covariances: these know of part of it."""


def bayes(
    source: ObjectGraph,
    target: ObjectGraph,
    *,
    prior: RelativePose | None = None,
    rng: np.random.Generator | None = None,
    min_score: float | None = None,
    common_probability: float = 0.5,
    right_angles: float | None = None,
    bearing_std_rad: float = DEFAULT_BEARING_STD_RAD,
    class_sharpness: float = 2.25,
    mislabel: float = 0.01,
    extent: float = 0.008,
    depth_offset: float = 0.027,
    depth_offset_std: float = 0.012,
    scale_std: float = 0.0,
    detection: float = 0.75,
    screened: int = 300,
    refined: int = 8,
    rescale: bool = True,
    max_hypotheses: int = 5,
) -> Matching:
    """Match by evidence over relative poses.

    Gravity is used where both graphs carry `up`; field of view, the robots themselves and occlusion where both know
    their view (`intrinsics` and `image_size`, or `horizontal_fov_rad` with `forward` and `up`). Lengths without a unit
    are fractions of the reach, the range within which .85 of all detections lie, so that the answer does not depend on
    the unit of length.

    Args:
        source, target: the two robots' graphs.
        prior: noisy relative pose, if known; its Gaussian enters the evidence.
        rng: not used, the method is deterministic.
        min_score: matches of a lower probability are not made. A threshold of half the F1 to be expected maximises
            the F1 pooled over many pairs: by default the `min_score` of the pair's
            entry in `bayes_calibration.CALIBRATIONS`, between .21 and .43.
        common_probability: prior probability that two views show any common object; not used with a prior pose.
        right_angles: prior probability that the robots' headings differ by a multiple of a right angle, as on streets
            and in buildings, before looking at how the objects lie; else all headings are equally likely. By default
            .2 for graphs with intrinsics that do not both report covariances, and 0 for others. Not used with a prior
            pose or without gravity.
        bearing_std_rad: error across the viewing ray of graphs without full covariances, radians.
        class_sharpness: power that turns class confidences into likelihoods.
        mislabel: share of class labels that tell nothing.
        extent: standard deviation of the visible part's centre about the object's, for graphs with intrinsics; about
            half of it where they report full covariances.
        depth_offset, depth_offset_std: prior of the distance from the visible face to the object's centre along the
            ray, which is estimated for every class, for graphs with intrinsics.
        scale_std: prior standard deviation of each robot's relative depth scale, which is then estimated; 0 = no bias.
        detection: probability of detecting a near object in plain view.
        screened: hypotheses verified against all detections.
        refined: hypotheses refined to modes of the posterior.
        rescale: where nothing fits well, also try other scales of the variances and a scale of each robot's depths.
        max_hypotheses: most explanations to return.

    Returns:
        Matches with their posterior probabilities; `pose` (None when refused) and `hypotheses` of the modes;
        `diagnostics["nothing_in_common"]`, the probability that there is nothing to match or none of the modes is
        right; `["probabilities"]` (n, m) of all matches; `["log_evidence"]` of the views given that they share objects,
        over their evidence given that they do not. `["calibration"]`, `["evidence"]` and `["marginals"]` (k, n, m) of
        the k modes are what `covis train calibration` fits weights to.

    Raises:
        ValueError: graphs of different classes, or an option out of its range.
    """
    check_comparable(source, target, prior)
    if min_score is not None:
        check_interval("min_score", min_score, "[0, 1]")
    check_interval("common_probability", common_probability, "(0, 1)")
    if right_angles is not None:
        check_interval("right_angles", right_angles, "[0, 1)")
    check_interval("bearing_std_rad", bearing_std_rad, "[0, inf)")
    check_interval("class_sharpness", class_sharpness, "[0, inf)")
    check_interval("mislabel", mislabel, "[0, 1]")
    check_interval("extent", extent, "[0, inf)")
    check_interval("depth_offset", depth_offset, "[0, inf)")
    check_interval("depth_offset_std", depth_offset_std, "[0, inf)")
    check_interval("scale_std", scale_std, "[0, inf)")
    check_interval("detection", detection, "(0, 1)")
    check_count("screened", screened)
    check_count("refined", refined)
    check_count("max_hypotheses", max_hypotheses)
    n, m = len(source), len(target)
    if n == 0 or m == 0:
        return Matching.empty()
    # Floats, also where whole numbers are given: for other types Numba would compile everything anew.
    q = Settings(
        class_sharpness=float(class_sharpness),
        mislabel=float(mislabel),
        overlap_alpha=4.0,
        overlap_beta=3.0,
        match_bonus=0.8,
        view_bonus=1.2,
        initial_log_odds=1.5,
        extent=float(extent),
        depth_offset=float(depth_offset),
        depth_offset_std=float(depth_offset_std),
        scale_std=float(scale_std),
        robot_extent=0.031,
    )
    if source.covariances is not None and target.covariances is not None:
        q = q._replace(extent=REPORTED_EXTENT * q.extent)
    gravity = source.up is not None and target.up is not None
    L_a, L_b = _levelling(source, gravity), _levelling(target, gravity)
    view_a, view_b = _views(source, target, L_a, L_b, float(detection), q.depth_offset)

    seen = view_a.known > 0 and view_b.known > 0
    kind = kind_of(source, target, gravity, seen, prior is not None)
    calibration = CALIBRATIONS[kind]

    def explain(scale: float, depth_scale_std: float) -> tuple[Problem, Modes]:
        problem = prepare(
            *_arrays(source, scale),
            L_a,
            *_arrays(target, scale),
            L_b,
            float(bearing_std_rad) ** 2,
            gravity,
            source.intrinsics is not None and target.intrinsics is not None,
            seen,
            view_a.planes,
            view_b.planes,
            view_a.half_length,
            q._replace(scale_std=depth_scale_std),
        )
        solve = solve_levelled if gravity else solve_spatial
        pose_prior = _pose_prior(prior, problem, L_a, L_b, gravity)
        return problem, solve(problem, pose_prior, view_a, view_b, q, screened, refined)

    problem, found = explain(1.0, q.scale_std)
    explanations = [(problem, found)]
    if rescale and found.log_evidence.max(initial=-math.inf) < DOUBTFUL:
        explanations += [_improbable(*explain(*x)) for x in ALTERNATIVES]
    evidence = Evidence(np.concatenate([_features(*x) for x in explanations]), pair_features(problem))
    modes = _joined([y for _, y in explanations]) if len(explanations) > 1 else found
    modes = modes._replace(log_evidence=calibrated(evidence, calibration))
    if gravity and prior is None:
        probability = _right_angles(right_angles, kind, source, target, problem, L_a, L_b)
        if probability > 0:
            modes = modes._replace(log_evidence=modes.log_evidence + heading_log_prior(modes.R, probability))
    if prior is None:
        weights, P = mix(modes, math.log(common_probability), math.log1p(-common_probability), n, m)
    else:
        weights, P = mix(modes, 0.0, -1e9, n, m)
    pairs, scores = decode(P, calibration.min_score if min_score is None else min_score)
    hypotheses = _hypotheses(modes, weights, L_a, L_b, gravity, max_hypotheses)
    likeliest = hypotheses[0] if hypotheses else None
    refused = likeliest is None or likeliest.probability < weights[0]
    return Matching(
        pairs,
        scores,
        pose=None if refused or likeliest is None else likeliest.pose,
        hypotheses=hypotheses,
        diagnostics={
            "nothing_in_common": float(weights[0]),
            "modes": len(modes.log_evidence),
            "probabilities": P,
            "log_evidence": float(np.logaddexp.reduce(modes.log_evidence, initial=-math.inf)),
            "calibration": kind,
            "evidence": evidence,
            "marginals": modes.marginals,
        },
    )


def _right_angles(
    before: float | None, kind: str, source: ObjectGraph, target: ObjectGraph, x: Problem, L_a: Array, L_b: Array
) -> float:
    """Probability that headings differ by a multiple of a right angle, after a look at how the objects lie."""
    heading_a, heading_b = level_heading(source, L_a), level_heading(target, L_b)
    if heading_a is None or heading_b is None:
        return before or 0.0
    if before is None:
        cameras = source.intrinsics is not None and target.intrinsics is not None
        # Weights of the other kinds were fitted without it.
        before = RIGHT_ANGLES if cameras and kind == "whole" else 0.0
    if before == 0.0:
        return before
    seen = grid_log_evidence(x.p_a, x.S_a, heading_a) + grid_log_evidence(x.p_b, x.S_b, heading_b)
    return right_angles_given(before, seen)


def _levelling(graph: ObjectGraph, gravity: bool) -> Array:
    return levelling_rotation(graph.up) if gravity else np.eye(3)


def _improbable(problem: Problem, modes: Modes) -> tuple[Problem, Modes]:
    """Modes under other variances or scales than the reported ones."""
    return problem, modes._replace(log_evidence=modes.log_evidence + math.log(OTHER_SCALE_PROBABILITY))


def _features(x: Problem, modes: Modes) -> Array:
    return overlap_features(
        x.p_a, x.p_b, x.likely, x.median_range, modes.R, modes.t, modes.marginals, modes.log_evidence
    )


def _joined(alternatives: list[Modes]) -> Modes:
    """All modes as one list, with the parameters that all of them have."""
    size = min(x.information.shape[1] for x in alternatives)
    bias = min(x.bias.shape[1] for x in alternatives)
    trimmed = [x._replace(bias=x.bias[:, :bias], information=_marginal(x.information, size)) for x in alternatives]
    return Modes(*(np.concatenate(x) for x in zip(*trimmed, strict=True)))


def _marginal(information: Array, size: int) -> Array:
    """Information (k, size, size) of the first parameters when the others are unknown, of information (k, d, d)."""
    A, B, D = information[:, :size, :size], information[:, :size, size:], information[:, size:, size:]
    return A - B @ np.linalg.solve(D, B.transpose(0, 2, 1)) if D.shape[1] else A


def _arrays(graph: ObjectGraph, scale: float) -> tuple[Array, Array, Array, Array, Array]:
    covariances = np.empty((0, 3, 3)) if graph.covariances is None else graph.covariances * scale
    arrays = graph.positions, graph.position_variance * scale, covariances, graph.attributes, graph.attribute_variance
    return tuple(np.ascontiguousarray(x) for x in arrays)  # type: ignore[return-value]


def _views(
    source: ObjectGraph, target: ObjectGraph, L_a: Array, L_b: Array, detection: float, depth_offset: float
) -> tuple[View, View]:
    distance = ranges(np.ascontiguousarray(source.positions), np.ascontiguousarray(target.positions))
    reach = float(reach_of(distance))
    planes = [_view_planes(source), _view_planes(target)]
    known = float(planes[0] is not None and planes[1] is not None)
    images = all(g.intrinsics is not None and g.covariances is None for g in (source, target))
    half_length = HALF_LENGTH * depth_offset * reach if images else 0.0
    views = []
    for normals, L in zip(planes, (L_a, L_b), strict=True):
        turned = np.zeros((0, 3)) if normals is None else np.ascontiguousarray(normals @ L.T)
        views.append(View(known, turned, reach, detection, OCCLUDER * reach, OCCLUDED, half_length))
    return views[0], views[1]


def _view_planes(graph: ObjectGraph) -> Array | None:
    """Inward normals (2, 3), sensor frame, of the planes left and right of a graph's field of view; None = unknown."""
    if graph.intrinsics is not None and graph.image_size is not None:
        focal, centre, width = graph.intrinsics[0, 0], graph.intrinsics[0, 2], graph.image_size[0]
        # Left: x / z > -centre / focal; right: x / z < (width - centre) / focal.
        planes = np.array([[focal, 0.0, centre], [-focal, 0.0, width - centre]])
        return planes / np.sqrt((planes**2).sum(axis=1, keepdims=True))
    fov = graph.horizontal_fov_rad
    if fov is None or graph.forward is None or graph.up is None or fov >= np.pi:
        return None
    side = np.cross(graph.up, graph.forward)
    return np.stack([np.sin(fov / 2) * graph.forward + s * np.cos(fov / 2) * side for s in (1.0, -1.0)])


def _pose_prior(prior: RelativePose | None, x: Problem, L_a: Array, L_b: Array, gravity: bool) -> Prior:
    """Prior between levelled frames: what heights say, and the prior pose."""
    turns = 1 if gravity else 3
    precision = np.zeros((turns + 3, turns + 3))
    t = np.array([0.0, 0.0, x.height])
    if gravity:
        precision[3, 3] = 1.0 / x.height_variance
        area = (math.sqrt(x.room_a) + math.sqrt(x.room_b)) ** 2
        log_norm = -math.log(2 * math.pi * area) - 0.5 * (LOG_2PI + math.log(x.height_variance))
    else:
        volume = (math.cbrt(x.room_a) + math.cbrt(x.room_b)) ** 3
        log_norm = -math.log(8 * math.pi**2 * volume)
    if prior is None:
        return Prior(0.0, np.eye(3), t, precision, log_norm)
    return _combined(prior, L_a, L_b, turns, t, precision)


def _combined(prior: RelativePose, L_a: Array, L_b: Array, turns: int, height: Array, precision: Array) -> Prior:
    R = L_a @ prior.T_source_target[:3, :3] @ L_b.T
    # The prior perturbs on the right, in target axes; here rotation comes first and both are in source axes.
    G = np.zeros((6, 6))
    G[:3, 3:] = G[3:, :3] = R @ L_b
    covariance = G @ prior.covariance @ G.T + 1e-9 * np.eye(6)
    t = L_a @ prior.T_source_target[:3, 3]
    if turns == 1:
        R = _turn(math.atan2(R[1, 0] - R[0, 1], R[0, 0] + R[1, 1]))
        covariance = covariance[2:, 2:]
    total = np.linalg.inv(covariance) + precision
    shift = np.linalg.solve(total, precision[:, turns:] @ (height - t))
    if turns == 1:
        R = _turn(float(shift[0])) @ R
    log_norm = 0.5 * float(np.linalg.slogdet(total)[1]) - 0.5 * len(total) * LOG_2PI
    return Prior(1.0, np.ascontiguousarray(R), t + shift[turns:], total, log_norm)


def _turn(yaw: float) -> Array:
    c, s = math.cos(yaw), math.sin(yaw)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def _hypotheses(
    modes: Modes, weights: Array, L_a: Array, L_b: Array, gravity: bool, most: int
) -> tuple[Hypothesis, ...]:
    out: list[Hypothesis] = []
    for k in np.argsort(-weights[1:], kind="stable")[:most]:
        probability = float(weights[1 + k])
        if out and probability < LEAST_HYPOTHESIS:
            break
        pairs, scores = decode(np.minimum(modes.marginals[k], 1.0), 0.5)
        pose = _relative_pose(modes.R[k], modes.t[k], modes.information[k], L_a, L_b, gravity)
        out.append(Hypothesis(pose, probability, pairs, scores))
    return tuple(out)


def _relative_pose(R: Array, t: Array, information: Array, L_a: Array, L_b: Array, gravity: bool) -> RelativePose:
    """Pose between sensor frames, with the covariance that biases leave it; roll and pitch are exact under gravity."""
    covariance = np.zeros((6, 6))
    first = 2 if gravity else 0
    d = 6 - first
    scale = np.sqrt(np.maximum(np.diag(information), 1e-12))
    whitened = information / np.outer(scale, scale) + 1e-9 * np.eye(len(scale))
    inverse = np.linalg.inv(whitened) / np.outer(scale, scale)
    covariance[first:, first:] = inverse[:d, :d]
    # To [translation, rotation] in target axes.
    G = np.zeros((6, 6))
    G[:3, 3:] = G[3:, :3] = L_b.T @ R.T
    T = np.eye(4)
    T[:3, :3] = L_a.T @ R @ L_b
    T[:3, 3] = L_a.T @ t
    covariance = G @ covariance @ G.T
    # Rigid and symmetric by construction: `RelativePose`'s checks would cost more than the match.
    pose = object.__new__(RelativePose)
    object.__setattr__(pose, "T_source_target", T)
    object.__setattr__(pose, "covariance", 0.5 * (covariance + covariance.T))
    return pose
