"""`bayes`: exact references on small problems, invariances, degenerate problems, refusal, calibration."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations, permutations

import numpy as np
import pytest

from covis.matching import ObjectGraph, RelativePose, bayes
from covis.matching.bayes_assignment import assignment_marginals
from covis.matching.bayes_calibration import CALIBRATIONS, FEW, Evidence, calibrated, kind_of, pair_features
from covis.matching.bayes_headings import grid_log_evidence, heading_log_prior, level_heading, right_angles_given
from covis.matching.bayes_overlap import MARGIN_RAD, N_FEATURES, REACH, overlap_features
from covis.matching.bayes_prepare import (
    Settings,
    allow_for_border,
    class_evidence,
    height_correction,
    levelling_rotation,
    prepare,
)
from covis.matching.bayes_refine import residual_edges, seen_by_other
from covis.matching.bayes_view import View, detection_probability
from covis.matching.metrics import count, expected_calibration_error, is_correct, pooled
from covis.matching.pose import invert

UP = np.array([0.0, 0.0, 1.0])


def rotation_z(yaw: float) -> np.ndarray:
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def scene(rng: np.random.Generator, common: int, alone: int, noise: float = 0.02, classes: int = 4):
    """Two robots 20 m from the middle of a field; `noise` is the depth error as a share of the range."""
    objects = np.c_[rng.uniform(-12, 12, (common, 2)), np.zeros(common)]
    kinds = rng.integers(0, classes, common)
    views = []
    for yaw in (0.0, rng.uniform(-np.pi, np.pi)):
        R = rotation_z(yaw)
        origin = R @ np.array([-20.0, 0.0, 0.0]) + 1.5 * UP
        X = np.r_[objects, np.c_[rng.uniform(-12, 12, (alone, 2)), np.zeros(alone)]]
        kind = np.r_[kinds, rng.integers(0, classes, alone)]
        p = (X - origin) @ R
        r = np.linalg.norm(p, axis=1, keepdims=True)
        p = p * (1 + noise * rng.standard_normal(r.shape)) + 0.007 * r * rng.standard_normal(p.shape)
        a = np.exp(2.0 * np.eye(classes)[kind] + 0.8 * rng.standard_normal((len(X), classes)))
        order = rng.permutation(len(X))
        identity = np.where(np.arange(len(X)) < common, np.arange(len(X)), rng.integers(10**3, 10**9, len(X)))
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = R, origin
        graph = ObjectGraph(
            p[order],
            (a / a.sum(axis=1, keepdims=True))[order],
            ((noise * r[:, 0]) ** 2)[order],
            np.full(len(X), 0.01),
            up=UP,
        )
        views.append((graph, identity[order], T))
    return views[0], views[1]


def matchings(n: int, m: int):
    for k in range(min(n, m) + 1):
        for rows in combinations(range(n), k):
            for cols in permutations(range(m), k):
                yield list(zip(rows, cols, strict=True))


@pytest.mark.parametrize(("n", "m"), [(1, 1), (2, 2), (3, 2), (3, 4), (4, 4)])
def test_assignment_marginals_close_to_enumeration(n, m):
    rng = np.random.default_rng(n * 10 + m)
    for spread in (1.0, 3.0):
        logs = spread * rng.standard_normal((n, m))
        total, exact = 0.0, np.zeros((n, m))
        for matching in matchings(n, m):
            weight = np.exp(sum(logs[i, j] for i, j in matching))
            total += weight
            for i, j in matching:
                exact[i, j] += weight
        exact /= total
        rows, cols = (x.ravel() for x in np.indices((n, m)))
        out = np.empty(n * m)
        log_z = assignment_marginals(rows, cols, logs.ravel(), n * m, n, m, 200, out)
        # Sum-product is exact without cycles and near elsewhere.
        tolerance = 1e-6 if min(n, m) == 1 else 0.08
        np.testing.assert_allclose(out.reshape(n, m), exact, atol=tolerance)
        assert abs(log_z - np.log(total)) < (1e-6 if min(n, m) == 1 else 0.4)


def test_assignment_marginals_with_overwhelming_weights():
    rows, cols = np.array([0, 0, 1]), np.array([0, 1, 0])
    out = np.empty(3)
    log_z = assignment_marginals(rows, cols, np.array([500.0, 1.0, 0.0]), 3, 2, 2, 100, out)
    assert np.isfinite(log_z)
    assert out[0] > 0.99
    assert np.isfinite(out).all()


@pytest.mark.parametrize("up", [UP, -UP, [0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.6, 0.0, 0.8]])
def test_levelling_rotation(up):
    L = levelling_rotation(np.asarray(up, dtype=float))
    np.testing.assert_allclose(L @ np.asarray(up), UP, atol=1e-9)
    np.testing.assert_allclose(L @ L.T, np.eye(3), atol=1e-9)
    assert np.linalg.det(L) > 0


def test_height_correction_is_the_exact_integral():
    """log of the integral of N(X; z1, v1) N(X; z2, v2) / N(X; 0, V), by quadrature."""
    V, cases = 0.5, [(0.1, -0.2, 0.3, 0.2), (0.0, 0.0, 0.45, 0.45), (1.0, 0.6, 0.01, 0.02)]
    grid = np.linspace(-30, 30, 400001)

    def log_normal(x, v):
        return -0.5 * (x * x / v + np.log(2 * np.pi * v))

    for z1, z2, v1, v2 in cases:
        f = log_normal(grid - z1, v1) + log_normal(grid - z2, v2) - log_normal(grid, V)
        expected = np.log(np.exp(f).sum() * (grid[1] - grid[0])) - log_normal(z1 - z2, v1 + v2)
        p1, p2 = np.array([[0.0, 0.0, z1 + 5]]), np.array([[0.0, 0.0, z2 - 2]])
        out = np.zeros((1, 1))
        height_correction(p1, np.eye(3)[None] * v1, 5.0, p2, np.eye(3)[None] * v2, -2.0, V, out)
        np.testing.assert_allclose(out[0, 0], expected, atol=1e-6)


def test_class_evidence_prefers_equal_classes_and_rare_ones():
    a = np.eye(3)[[0, 0, 0, 0, 1, 2]] * 0.9 + 0.05
    out = np.zeros((6, 6))
    tops = np.zeros(6, np.int64), np.zeros(6, np.int64)
    class_evidence(a, np.zeros(6), a, np.zeros(6), 2.0, 0.01, out, *tops)
    assert out[0, 0] > 0 > out[0, 4]
    assert out[4, 4] > out[0, 0]
    unknown = np.zeros((6, 6))
    class_evidence(a, np.full(6, np.inf), a, np.full(6, np.inf), 2.0, 0.01, unknown, *tops)
    np.testing.assert_allclose(unknown, 0, atol=1e-9)


def test_finds_common_objects_and_the_pose():
    rng = np.random.default_rng(0)
    counts = []
    for _ in range(15):
        (a, ia, Ta), (b, ib, Tb) = scene(rng, common=7, alone=4)
        matching = bayes(a, b)
        counts.append(count(matching, ia, ib))
        if counts[-1].correct >= 5:
            error = invert(invert(Ta) @ Tb) @ matching.pose.T_source_target
            assert np.linalg.norm(error[:3, 3]) < 2.0
            assert abs(error[1, 0]) < 0.1
    assert pooled(counts).f1 > 0.95


def test_without_gravity():
    rng = np.random.default_rng(1)
    counts = []
    for _ in range(5):
        (a, ia, _), (b, ib, _) = scene(rng, common=8, alone=2, noise=0.01)
        T = np.eye(4)
        T[:3, :3] = np.linalg.qr(rng.standard_normal((3, 3)))[0]
        T[:3, :3] *= np.sign(np.linalg.det(T[:3, :3]))
        b = b.transformed(T)
        plain = ObjectGraph(b.positions, b.attributes, b.position_variance, b.attribute_variance)
        counts.append(count(bayes(a, plain), ia, ib))
    assert pooled(counts).f1 > 0.9


def test_a_prior_pose_helps_and_a_refusal_needs_none():
    rng = np.random.default_rng(2)
    known, unknown = [], []
    for _ in range(15):
        (a, ia, Ta), (b, ib, Tb) = scene(rng, common=4, alone=8, noise=0.05)
        truth = invert(Ta) @ Tb
        noisy = truth.copy()
        noisy[:3, :3] = truth[:3, :3] @ rotation_z(0.02 * rng.standard_normal())
        noisy[:2, 3] += 0.3 * rng.standard_normal(2)
        covariance = np.diag([0.09, 0.09, 1e-4, 1e-6, 1e-6, 4e-4])
        known.append(count(bayes(a, b, prior=RelativePose(noisy, covariance)), ia, ib))
        unknown.append(count(bayes(a, b), ia, ib))
    # Over 60 other draws of this scene: known .81, unknown below .5.
    assert pooled(known).f1 > 0.75
    assert pooled(known).f1 > pooled(unknown).f1 + 0.2


def test_refuses_where_nothing_is_common():
    rng = np.random.default_rng(3)
    retrieved = refused = 0
    for _ in range(20):
        (a, _, _), (b, _, _) = scene(rng, common=0, alone=10)
        matching = bayes(a, b)
        retrieved += len(matching)
        refused += matching.pose is None
        assert 0 <= matching.diagnostics["nothing_in_common"] <= 1
        shared = np.exp(matching.diagnostics["log_evidence"])
        assert matching.diagnostics["nothing_in_common"] == pytest.approx(1 / (1 + shared))
    assert refused >= 15
    assert retrieved <= 20


def test_scores_are_calibrated_on_an_own_simulation():
    rng = np.random.default_rng(4)
    scores, correct = [], []
    for k in range(150):
        (a, ia, _), (b, ib, _) = scene(rng, common=0 if k % 3 == 0 else 5, alone=5, noise=0.04)
        matching = bayes(a, b, min_score=0.05)
        scores.append(matching.scores)
        correct.append(is_correct(matching, ia, ib))
    assert expected_calibration_error(np.concatenate(scores), np.concatenate(correct), bins=5) < 0.12


def same(first, second):
    np.testing.assert_array_equal(first[0], second[0])
    np.testing.assert_allclose(first[1], second[1], atol=2e-3)


def ordered(matching, source_names, target_names):
    named = [(source_names[i], target_names[j]) for i, j in matching.pairs]
    order = sorted(range(len(named)), key=named.__getitem__)
    return np.array([named[k] for k in order]).reshape(-1, 2), matching.scores[order]


def test_invariances():
    rng = np.random.default_rng(5)
    for _ in range(4):
        (a, _, _), (b, _, _) = scene(rng, common=7, alone=3)
        names = np.arange(10)
        reference = ordered(bayes(a, b), names, names)
        assert len(reference[0]) >= 5
        sigma = rng.permutation(10)
        same(reference, ordered(bayes(a.take(sigma), b), names[sigma], names))
        same(reference, ordered(bayes(a, b.take(sigma)), names, names[sigma]))
        swapped = bayes(b, a)
        same(reference, ordered(type(swapped)(swapped.pairs[:, ::-1], swapped.scores), names, names))
        # A sensor turned about its own origin sees the same rays and the same gravity.
        T = np.eye(4)
        T[:3, :3] = rotation_z(1.0)
        same(reference, ordered(bayes(a.transformed(T), b), names, names))
        T[:3, :3] = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
        same(reference, ordered(bayes(a, b.transformed(T)), names, names))


def test_unit_of_length_does_not_matter():
    (a, _, _), (b, _, _) = scene(np.random.default_rng(6), common=6, alone=4)

    def scaled(g, s):
        return ObjectGraph(g.positions * s, g.attributes, g.position_variance * s * s, g.attribute_variance, up=UP)

    one, other = bayes(a, b), bayes(scaled(a, 0.1), scaled(b, 0.1))
    np.testing.assert_array_equal(one.pairs, other.pairs)
    np.testing.assert_allclose(one.scores, other.scores, atol=0.02)


def graph(positions, up=UP, **kw):
    return ObjectGraph.from_positions(np.asarray(positions, dtype=float).reshape(-1, 3), up=up, **kw)


LINE = [[float(x), 2.0, 0.0] for x in range(1, 7)]
CLOUD = np.random.default_rng(7).uniform(-5, 5, (6, 3)) + np.array([8.0, 0, 0])
MIRROR = CLOUD * np.array([1.0, -1.0, 1.0])
DEGENERATE = {
    "empty": ([], CLOUD),
    "both empty": ([], []),
    "one": (CLOUD[:1], CLOUD),
    "one each": (CLOUD[:1], CLOUD[:1]),
    "two": (CLOUD[:2], CLOUD[:2]),
    "collinear": (LINE, LINE),
    "coincident": ([[3.0, 1.0, 0.5]] * 5, [[3.0, 1.0, 0.5]] * 4),
    "at the origin": (np.zeros((3, 3)), CLOUD),
    "mirror image": (CLOUD, MIRROR),
    "unequal": (CLOUD, CLOUD[:3]),
}


@pytest.mark.parametrize("gravity", [True, False])
@pytest.mark.parametrize("variance", [0.01, 0.0, np.inf])
@pytest.mark.parametrize("name", DEGENERATE)
def test_degenerate_problems(name, variance, gravity):
    a, b = DEGENERATE[name]
    up = UP if gravity else None
    source = graph(a, up, position_variance=variance, attribute_variance=variance)
    target = graph(b, up, position_variance=variance, attribute_variance=variance)
    for prior in (None, RelativePose(np.eye(4), 0.01 * np.eye(6)), RelativePose(np.eye(4), np.zeros((6, 6)))):
        matching = bayes(source, target, prior=prior)
        assert np.isfinite(matching.scores).all()
        assert len(matching) <= min(len(source), len(target))
        for hypothesis in matching.hypotheses:
            assert np.isfinite(hypothesis.pose.T_source_target).all()
            assert np.isfinite(hypothesis.pose.covariance).all()


def test_mirror_image_is_not_matched_whole():
    assert len(bayes(graph(CLOUD), graph(CLOUD))) == 6
    assert len(bayes(graph(CLOUD), graph(MIRROR))) < 6


def test_a_camera_that_looks_away_sees_nothing_in_common():
    """Field of view as evidence: what should be seen and is not speaks against a pose."""
    rng = np.random.default_rng(8)
    R_camera = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    K = np.array([[320.0, 0, 320], [0, 320, 240], [0, 0, 1]])
    objects = np.c_[rng.uniform(6, 20, 9), rng.uniform(-5, 5, 9), np.full(9, -1.0)]

    def view(X):
        return graph(X @ R_camera, R_camera.T @ UP, position_variance=0.05, intrinsics=K, image_size=(640, 480))

    both = bayes(view(objects), view(objects + np.array([0.0, 1.0, 0.0])))
    assert len(both) == 9
    np.testing.assert_allclose(both.pose.T_source_target[:3, :3], np.eye(3), atol=0.05)


def test_an_object_cut_off_by_the_border_of_an_image_is_matched():
    """Of an object at the border only a part is seen, whose middle lies further inside; elsewhere that is too far."""
    rng = np.random.default_rng(21)
    R_camera = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    K = np.array([[320.0, 0, 320], [0, 320, 240], [0, 0, 1]])
    others = np.c_[rng.uniform(20, 60, 7), rng.uniform(-15, 15, 7), np.full(7, -1.0)]

    def view(X):
        return graph(X @ R_camera, R_camera.T @ UP, position_variance=0.02, intrinsics=K, image_size=(640, 480))

    for near, matched in (([6.0, -7.8, -1.0], True), ([6.0, 0.0, -1.0], False)):
        seen_there = view(np.r_[[near], others] + [0.0, 8.0, 0.0])
        seen_here = view(np.r_[[np.add(near, [2.0, 2.0, 0.0])], others])
        pairs = bayes(seen_here, seen_there, extent=0.005).pairs.tolist()
        assert ([0, 0] in pairs) == matched
        assert all([i, i] in pairs for i in range(1, 8))


def test_lengths_of_objects_do_not_follow_a_few_near_ones():
    """Near faces lie as far from the middles, and the robots are as large, when most of the objects come near."""
    q = Settings(2.25, 0.01, 4.0, 3.0, 0.8, 1.2, 1.5, 0.008, 0.03, 0.012, 0.0, 0.03)
    far, near = np.linspace(30.0, 60.0, 10), np.linspace(30.0, 60.0, 10)
    near[:6] = np.linspace(3.0, 8.0, 6)

    def prepared(ranges):
        p = np.c_[ranges, np.zeros(10), np.zeros(10)]
        side = p, np.full(10, 0.1), np.empty((0, 3, 3)), np.ones((10, 1)), np.zeros(10), np.eye(3)
        return prepare(*side, *side, 0.007**2, True, True, False, np.empty((0, 3)), np.empty((0, 3)), 0.0, q)

    a, b = prepared(far), prepared(near)
    assert b.median_range < 0.6 * a.median_range
    np.testing.assert_allclose(a.p_a[-2, 0], 60.0 + 0.03 * far[8], atol=0.05)
    np.testing.assert_allclose(a.p_a[-2], b.p_a[-2], atol=0.01)
    np.testing.assert_allclose(a.S_a[-1, :2, :2], b.S_a[-1, :2, :2])
    np.testing.assert_allclose(a.bias_precision, b.bias_precision)


def test_border_of_the_view_moves_and_widens_only_what_is_near_it_and_only_across_the_border():
    planes = np.array([[0.0, 1.0, 0.0]])
    p = np.array([[5.0, 0.5, 0.0], [5.0, -0.3, 0.0], [5.0, 2.0, 0.0]])
    S = np.tile(np.eye(3), (3, 1, 1))
    allow_for_border(p, S, planes, 1.5)
    np.testing.assert_allclose(p, [[5.0, 0.5 - 0.5, 0.0], [5.0, -0.3 - 0.75, 0.0], [5.0, 2.0, 0.0]])
    np.testing.assert_allclose(S[:, 1, 1], [1 + 0.5**2, 1 + 0.75**2, 1.0])
    np.testing.assert_allclose(S[:, [0, 2], [0, 2]], 1.0)


def test_a_near_object_is_seen_beyond_the_border_of_the_view():
    view = View(1.0, np.array([[0.0, 1.0, 0.0]]), 500.0, 0.75, 0.0, 1.0, 2.0)
    nothing = np.zeros((1, 3))
    near, far = (detection_probability(r, -0.1 * r, 0.0, view, nothing) for r in (5.0, 100.0))
    point = detection_probability(5.0, -0.5, 0.0, view._replace(half_length=0.0), nothing)
    assert near > 0.2 > 0.05 > far > point


def test_prior_of_the_headings():
    yaw = np.linspace(-np.pi, np.pi, 20001)[:-1]
    R = np.array([rotation_z(y) for y in yaw])
    log_prior = heading_log_prior(R, 0.3)
    np.testing.assert_allclose(np.exp(log_prior).mean(), 1.0, atol=1e-3)
    np.testing.assert_allclose(heading_log_prior(R, 0.0), 0.0)
    right = heading_log_prior(np.array([rotation_z(k * np.pi / 2) for k in range(4)]), 0.3)
    np.testing.assert_allclose(right, log_prior.max(), atol=1e-3)
    np.testing.assert_allclose(log_prior.min(), np.log(0.7))


def test_robots_on_a_grid_of_streets_prefer_headings_at_right_angles():
    (a, _, _), (b, _, _) = scene(np.random.default_rng(9), common=4, alone=7, noise=0.05)
    plain, streets = bayes(a, b, max_hypotheses=50), bayes(a, b, max_hypotheses=50, right_angles=0.5)

    def off(h):
        T = h.pose.T_source_target
        return abs((np.arctan2(T[1, 0], T[0, 0]) + np.pi / 4) % (np.pi / 2) - np.pi / 4)

    def expected(matching):
        return sum(h.probability * off(h) for h in matching.hypotheses) / sum(
            h.probability for h in matching.hypotheses
        )

    assert expected(streets) < expected(plain)


def laid_out(rng: np.random.Generator, n: int, lanes: bool) -> np.ndarray:
    """Objects (n, 3) before a robot that looks along x: in lanes 4 m wide, or anywhere."""
    y = 4.0 * rng.integers(-2, 3, n) if lanes else rng.uniform(-20, 20, n)
    return np.c_[rng.uniform(5, 45, n), y + 0.1 * rng.standard_normal(n), np.full(n, -1.0)]


def test_objects_in_lanes_tell_of_a_grid_and_scattered_ones_against_it():
    forward = np.array([1.0, 0.0])
    S = np.tile(0.04 * np.eye(3), (11, 1, 1))

    def evidence(seed, lanes, turn=0.0, scale=1.0):
        p = np.r_[laid_out(np.random.default_rng(seed), 10, lanes), np.zeros((1, 3))] @ rotation_z(turn).T
        return grid_log_evidence(p, scale * S, forward)

    in_lanes, scattered = (np.array([evidence(s, lanes) for s in range(40)]) for lanes in (True, False))
    assert in_lanes.mean() > 1.0 > 0.0 > scattered.mean()
    assert np.mean([evidence(s, True, turn=np.pi / 4) for s in range(40)]) < 0.0
    quarter = [evidence(s, True, turn=np.pi / 2) for s in range(40)]
    np.testing.assert_allclose(quarter, in_lanes, atol=1e-9)
    assert evidence(0, True, scale=1e6) == 0.0
    np.testing.assert_allclose(right_angles_given(0.2, np.log(4.0)), 0.5)
    assert right_angles_given(0.2, -1e9) < 1e-200


def test_cameras_among_objects_in_lanes_expect_right_angles_and_others_do_not():
    rng = np.random.default_rng(5)
    R_camera = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    K = np.array([[320.0, 0, 320], [0, 320, 240], [0, 0, 1]])
    here, there = laid_out(rng, 9, lanes=True), laid_out(rng, 9, lanes=True)
    there[:3] = (here[:3] - [2.0, 3.0, 0.0]) @ rotation_z(0.5)

    def evidence(cameras, **options):
        more = {"intrinsics": K, "image_size": (640, 480)} if cameras else {}
        a, b = (graph(X @ R_camera, R_camera.T @ UP, position_variance=0.5, **more) for X in (here, there))
        return bayes(a, b, **options).diagnostics["log_evidence"]

    assert evidence(True) == evidence(True, right_angles=0.2) != evidence(True, right_angles=0.0)
    assert evidence(False) == evidence(False, right_angles=0.0)
    looks_up = ObjectGraph.from_positions(here, up=(0, 0, 1), forward=(0, 0, 1))
    assert level_heading(looks_up, np.eye(3)) is None


@pytest.mark.parametrize(
    "option",
    [{"min_score": 1.5}, {"common_probability": 0.0}, {"right_angles": 1.0}, {"screened": 0}, {"refined": 0}],
)
def test_bad_options_raise(option):
    with pytest.raises(ValueError, match=next(iter(option))):
        bayes(graph(CLOUD), graph(CLOUD), **option)


def test_same_answer_twice_and_hypotheses_ordered():
    (a, _, _), (b, _, _) = scene(np.random.default_rng(9), common=4, alone=7, noise=0.05)
    one, two = bayes(a, b), bayes(a, b, rng=np.random.default_rng(1))
    np.testing.assert_array_equal(one.pairs, two.pairs)
    np.testing.assert_array_equal(one.scores, two.scores)
    probabilities = [h.probability for h in one.hypotheses]
    assert probabilities == sorted(probabilities, reverse=True)
    assert sum(probabilities) + one.diagnostics["nothing_in_common"] <= 1 + 1e-9
    for h in one.hypotheses:
        RelativePose(h.pose.T_source_target, h.pose.covariance)


@pytest.mark.parametrize(("factor", "scale"), [(0.1, 1.0), (6.0, 1.0), (1.0, 1.1)])
def test_wrong_variances_and_a_wrong_depth_scale_are_noticed(factor, scale):
    rng = np.random.default_rng(10)
    plain, rescaled = [], []
    for _ in range(25):
        (a, ia, _), (b, ib, _) = scene(rng, common=6, alone=5, noise=0.03)
        a, b = (
            ObjectGraph(g.positions * s, g.attributes, g.position_variance * factor, g.attribute_variance, up=UP)
            for g, s in ((a, 1.0), (b, scale))
        )
        plain.append(count(bayes(a, b, rescale=False), ia, ib))
        rescaled.append(count(bayes(a, b), ia, ib))
    assert pooled(rescaled).f1 > pooled(plain).f1 - (0.02 if factor > 1 else 0.0)
    assert pooled(rescaled).f1 > 0.7


def test_overlap_features_against_plain_geometry():
    rng = np.random.default_rng(5)
    n, m, median_range = 6, 5, 7.0
    p_a, p_b = rng.uniform(-10, 10, (n + 1, 3)), rng.uniform(1, 10, (m + 1, 3))
    p_a[-1] = p_b[-1] = 0.0
    R = np.array([rotation_z(w) for w in (0.3, -2.0, 1.2)])
    t = rng.uniform(-8, 8, (3, 3))
    marginals = rng.uniform(0, 1 / n, (3, n, m))
    likely = rng.standard_normal((n + 1, m + 1))
    evidence = rng.standard_normal(3)

    def sector(p):
        ray = p[:-1, 0] + 1j * p[:-1, 1]
        middle = (ray / abs(ray)).sum()
        return np.angle(middle), min(abs(np.angle(ray / middle)).max() + MARGIN_RAD, np.pi), REACH * abs(ray).max()

    def inside(x, p):
        middle, half, reach = sector(p)
        z = x[:, 0] + 1j * x[:, 1]
        return (abs(np.angle(z * np.exp(-1j * middle))) < half) & (abs(z) < reach)

    def places(p):
        middle, half, reach = sector(p)
        z = reach * np.sqrt(rng.random(40000)) * np.exp(1j * (middle + half * rng.uniform(-1, 1, 40000)))
        return np.c_[z.real, z.imag, 0 * z.real]

    found = overlap_features(p_a, p_b, likely, median_range, R, t, marginals, evidence)
    for k in range(3):
        in_b, in_a = inside((p_a[:-1] - t[k]) @ R[k], p_b), inside(p_b[:-1] @ R[k].T + t[k], p_a)
        M = marginals[k]
        alone = ((1 - M.sum(axis=1)) * in_b).sum() + ((1 - M.sum(axis=0)) * in_a).sum()
        share_a, share_b = (
            inside((places(p_a) - t[k]) @ R[k], p_b).mean(),
            inside(places(p_b) @ R[k].T + t[k], p_a).mean(),
        )
        distance = np.hypot(*t[k, :2]) / median_range
        np.testing.assert_allclose(
            found[k, [0, 1, 2, 7]], [evidence[k], (M * likely[:-1, :-1]).sum(), alone, distance], atol=1e-9
        )
        np.testing.assert_allclose(found[k, 3], n * share_a + m * share_b, atol=0.4)
        np.testing.assert_allclose(found[k, 5], np.log(0.5 * (share_a + share_b)), atol=0.15)
        np.testing.assert_allclose(found[k, 4], -0.5 * M.sum() * np.log(share_a * share_b), rtol=0.15)


def test_sectors_tell_a_pose_whose_overlap_is_empty_of_common_objects():
    """Half of what A sees stands where B does not look: evidence for the pose under which B should not see it."""
    p_a = np.array([[5.0, -2, 0], [6, 1, 0], [8, 2, 0], [7, -3, 0], [0, 0, 0]])
    away, towards = rotation_z(np.pi), np.eye(3)
    R, t = np.array([away, towards]), np.zeros((2, 3))
    alone = overlap_features(p_a, p_a, np.zeros((5, 5)), 6.0, R, t, np.zeros((2, 4, 4)), np.zeros(2))[:, 2]
    np.testing.assert_array_equal(alone, [0.0, 8.0])


def crowd(rng: np.random.Generator, n: int = 20):
    """Two cameras on the rim of a round arena with n equal objects; errors are as full covariances say.

    Distances err by 7 %; far objects are missed, so that about four in ten are common, as in the scenes of robots.
    """
    R_camera = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    K = np.array([[160.0, 0, 160], [0, 160, 120], [0, 0, 1]])
    angle, radius = rng.uniform(-np.pi, np.pi, n), 7 * np.sqrt(rng.random(n))
    objects = np.c_[radius * np.cos(angle), radius * np.sin(angle), np.full(n, 0.3)]
    views = []
    for yaw in rng.uniform(-np.pi, np.pi, 2):
        X = (objects - rotation_z(yaw) @ [-8.0, 0, 1.0]) @ rotation_z(yaw) @ R_camera
        detected = rng.random(n) < 0.8 / (1 + np.exp((np.linalg.norm(X, axis=1) - 10) / 2))
        seen = rng.permutation(np.flatnonzero((X[:, 2] > 1) & (abs(X[:, 0]) < X[:, 2]) & detected))
        r = np.linalg.norm(X[seen], axis=1)[:, None]
        ray = X[seen] / r
        p = X[seen] * (1 + 0.07 * rng.standard_normal(r.shape)) + 0.015 * r * rng.standard_normal(ray.shape)
        along, across = (0.07 * r[:, 0]) ** 2, (0.015 * r[:, 0]) ** 2
        S = across[:, None, None] * np.eye(3) + (along - across)[:, None, None] * ray[:, :, None] * ray[:, None, :]
        graph = ObjectGraph.from_positions(
            p, position_variance=along, covariances=S, up=R_camera.T @ UP, intrinsics=K, image_size=(320, 240)
        )
        views.append((graph, seen))
    return views[0], views[1]


def test_scores_among_look_alikes_promise_no_more_than_they_keep():
    """A wrong pose wins two times in three here; taken at its word the model would promise .50."""
    rng = np.random.default_rng(11)
    scores, correct = [], []
    for _ in range(60):
        (a, ia), (b, ib) = crowd(rng)
        matching = bayes(a, b, min_score=0.05)
        scores.append(matching.scores)
        correct.append(is_correct(matching, ia, ib))
    assert sum(len(x) for x in scores) > 100
    assert np.concatenate(scores).mean() < np.concatenate(correct).mean() + 0.05


def test_pair_features():
    """What a match says by its place falls with the errors, what it says by its class is 0 where all look alike."""
    rng = np.random.default_rng(12)
    (a, _, _), (b, _, _) = scene(rng, common=6, alone=3)

    def features(a, b):
        q = Settings(2.25, 0.01, 4.0, 3.0, 0.8, 1.2, 1.5, 0.013, 0.035, 0.015, 0.0, 0.04)
        none, unbounded = np.empty((0, 3, 3)), np.empty((0, 3))
        sides = [
            (g.positions, g.position_variance, none, g.attributes, g.attribute_variance, np.eye(3)) for g in (a, b)
        ]
        return pair_features(prepare(*sides[0], *sides[1], 0.007**2, True, False, False, unbounded, unbounded, 0.0, q))

    known, swapped = features(a, b), features(b, a)
    np.testing.assert_allclose(known, swapped, atol=1e-9)
    vague = [ObjectGraph.from_positions(g.positions, position_variance=16 * g.position_variance, up=UP) for g in (a, b)]
    worse = features(*vague)
    np.testing.assert_allclose(worse[2], -0.5, atol=1e-9)
    assert known[2] > worse[2] + 0.3
    # Four times the error along the ray is four times the area, but for the heights, which tell something of it.
    assert 0.5 * np.log(4) < known[1] - worse[1] < np.log(4) + 0.05
    raised = replace(b, positions=b.positions - [0, 0, 30.0])
    assert features(a, raised)[3] > known[3] + 0.5


def test_calibrated_evidence_keeps_the_order_of_equal_modes_and_falls_where_matches_say_little():
    rng = np.random.default_rng(13)
    features = rng.standard_normal((20, N_FEATURES))
    features[:, 1:] = features[0, 1:]
    telling, vague = (Evidence(features, np.array([1.0, place, 0.0, 0.0, 0.0])) for place in (1.0, -1.0))
    for calibration in CALIBRATIONS.values():
        np.testing.assert_array_equal(np.argsort(calibrated(telling, calibration)), np.argsort(features[:, 0]))
    unseen = CALIBRATIONS["unseen"]
    assert np.ptp(calibrated(vague, unseen)) < 0.5 * np.ptp(calibrated(telling, unseen))


def test_which_calibration():
    (a, _), (b, _) = crowd(np.random.default_rng(15), n=60)
    assert min(len(a), len(b)) > FEW
    assert kind_of(a, b, gravity=True, seen=True, posed=False) == "eyes"
    assert kind_of(a, b, gravity=True, seen=True, posed=True) == "posed"
    assert kind_of(a, b, gravity=False, seen=True, posed=False) == "whole"
    plain, other = (replace(g, intrinsics=None, image_size=None) for g in (a, b))
    assert kind_of(plain, other, gravity=True, seen=False, posed=False) == "unseen"
    assert kind_of(plain, other, gravity=True, seen=True, posed=False) == "fields"
    assert kind_of(plain, other.take(np.arange(4)), gravity=True, seen=True, posed=False) == "few"
    # Images without covariances: the detector says nothing of its own errors.
    assert kind_of(replace(a, covariances=None), b, gravity=True, seen=True, posed=False) == "whole"


def test_default_threshold():
    rng = np.random.default_rng(14)
    (camera, _), (other, _) = crowd(rng)
    (a, _, T_a), (b, _, T_b) = scene(rng, common=4, alone=7, noise=0.05)
    prior = RelativePose(invert(T_a) @ T_b, 0.01 * np.eye(6))
    seen = [replace(g, forward=np.array([1.0, 0.0, 0.0]), horizontal_fov_rad=1.5) for g in (a, b)]
    few = [g.take(np.arange(5)) for g in seen]
    bare = [replace(g, up=None) for g in (a, b)]
    problems = {"eyes": (camera, other), "unseen": (a, b), "fields": seen, "few": few, "whole": bare, "posed": (a, b)}
    assert problems.keys() == CALIBRATIONS.keys()
    for kind, (one, two) in problems.items():
        known = prior if kind == "posed" else None
        least = CALIBRATIONS[kind].min_score
        default = bayes(one, two, prior=known)
        assert default.diagnostics["calibration"] == kind
        np.testing.assert_array_equal(default.pairs, bayes(one, two, prior=known, min_score=least).pairs)


def test_a_detection_that_is_the_other_robot_is_no_common_object():
    """Its log weight has the robot's odds of being detected and what staying alone would cost it, nothing shared."""
    log_bonus = 1.2
    planes = np.array([[0.6, 0.8, 0.0], [0.6, -0.8, 0.0]])  # looks along x
    view = View(1.0, planes, 500.0, 0.75, 0.0, 1.0, 0.0)
    detected = np.array([[10.0, 0.0, 0.0], [10.0, 30.0, 0.0], [0.0, 0.0, 0.0]])  # in view, out of view, the robot
    in_front = np.eye(3), np.array([5.0, 0.0, 0.0])
    behind = np.eye(3), np.array([-5.0, 0.0, 0.0])

    near, robot = (detection_probability(x, 0.0, 0.0, view, detected[:0]) for x in (15.0, 5.0))
    assert 0.74 < near <= robot < 0.75
    bonus, shared = np.zeros(3), np.zeros(3)
    void = seen_by_other(detected, *in_front, view, detected[:0], log_bonus, bonus, shared)
    assert bonus == pytest.approx([-np.log(1 - near), -np.log(0.99), np.log(robot / (1 - robot))])
    assert shared == pytest.approx([0.5 * (np.log(near) + log_bonus), 0.5 * (np.log(0.01) + log_bonus), 0])
    assert void == pytest.approx(np.log((1 - near) * 0.99 * (1 - robot)) + 0.5 * (near + 0.01))
    seen_by_other(detected, *behind, view, detected[:0], log_bonus, bonus, shared)
    assert bonus[2] < -4

    # Two views of one object each: what an ordinary match gets more than one with the robot is what is shared.
    p, S = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 0.0]]), np.stack([np.eye(3)] * 2)
    none, no_bias = np.zeros((2, 0, 3)), np.zeros(0)
    rows, cols, logs = np.zeros(4, np.int64), np.zeros(4, np.int64), np.zeros(4)
    spare = np.zeros((4, 3)), np.zeros((4, 6)), np.zeros((2, 3))
    shared_a, shared_b = np.array([0.3, 0.0]), np.array([0.4, 0.0])
    count = residual_edges(
        *(p, S, none, p, S, none, np.zeros((2, 2)), np.eye(3), np.zeros(3), no_bias, 1.0),
        *(np.zeros(2), np.zeros(2), shared_a, shared_b, -50.0, rows, cols, logs, *spare),
    )
    weight = {(i, j): w for i, j, w in zip(rows[:count], cols[:count], logs[:count], strict=True)}
    assert weight[0, 0] - weight[1, 1] == pytest.approx(0.7)
    assert weight[0, 1] == weight[1, 0] == pytest.approx(weight[1, 1] - 0.25)
