import numpy as np
import pytest

from covis.fusion.posefilter import (
    Explained,
    PoseFilter,
    PoseFilterOptions,
    from_levelled,
    heading,
    level_motion,
    to_levelled,
)
from covis.fusion.registration import log_se3
from covis.fusion.sequence import PairOptions, PairTracker, propose
from covis.matching.bayes import bayes
from covis.matching.graph import Hypothesis, Matching, ObjectGraph
from covis.matching.pose import RelativePose, exp_se3, invert, rotation_from_vector, transform

CAMERA_UP = np.array([0.0, -1.0, 0.0])
Z_UP = np.array([0.0, 0.0, 1.0])


def turned(angle, up, translation=(0.0, 0.0, 0.0)):
    T = np.eye(4)
    T[:3, :3] = rotation_from_vector(angle * up)
    T[:3, 3] = translation
    return T


def spread(x, y, yaw, up=Z_UP):
    C = np.zeros((6, 6))
    C[:3, :3] = np.diag([x**2, y**2, 1e-4])
    C[3:, 3:] = yaw**2 * np.outer(up, up) + 1e-8 * np.eye(3)
    return C


@pytest.mark.parametrize("up", [Z_UP, CAMERA_UP])
def test_levelled_coordinates_and_back(up):
    rng = np.random.default_rng(0)
    T = turned(0.7, up, rng.normal(size=3))
    A = rng.normal(size=(3, 3))
    pose = RelativePose(T, np.block([[A @ A.T, np.zeros((3, 3))], [np.zeros((3, 3)), 0.04 * np.outer(up, up)]]))
    mean, covariance = to_levelled(pose, up, up)
    back = from_levelled(mean, covariance, up, up)
    np.testing.assert_allclose(back.T_source_target, T, atol=1e-12)
    np.testing.assert_allclose(back.covariance, pose.covariance, atol=2e-6)
    assert mean[3] == pytest.approx(0.7)


def test_prediction_follows_both_odometries():
    rng = np.random.default_rng(1)
    T_world = [turned(rng.normal(), Z_UP, rng.normal(size=3)) for _ in range(2)]
    filter_ = PoseFilter()
    start = to_levelled(RelativePose(invert(T_world[0]) @ T_world[1], spread(0.1, 0.1, 0.01)), Z_UP, Z_UP)
    filter_.update(start[0][None], start[1][None], np.array([0.9]))
    for _ in range(20):
        motions = [turned(0.2 * rng.normal(), Z_UP, 0.3 * rng.normal(size=3)) for _ in range(2)]
        T_world = [T @ M for T, M in zip(T_world, motions, strict=True)]
        filter_.predict(*motions)
    assert len(filter_.weights) == 1
    pose = from_levelled(filter_.means[0], filter_.covariances[0], Z_UP, Z_UP)
    np.testing.assert_allclose(pose.T_source_target, invert(T_world[0]) @ T_world[1], atol=1e-9)


def test_prediction_is_consistent_monte_carlo():
    rng = np.random.default_rng(2)
    options = PoseFilterOptions(
        odometry_std_m=0.05, odometry_std_per_m=0.0, odometry_std_rad=0.03, odometry_std_per_rad=0.0
    )
    values = []
    for _ in range(300):
        T_world = [turned(rng.normal(), Z_UP, [*rng.normal(size=2), 0]), turned(rng.normal(), Z_UP, [8, 2, 0])]
        filter_ = PoseFilter(options)
        start = to_levelled(RelativePose(invert(T_world[0]) @ T_world[1], spread(1e-3, 1e-3, 1e-4)), Z_UP, Z_UP)
        filter_.means, filter_.covariances = start[0][None], start[1][None]
        filter_.weights, filter_.unknown = np.ones(1), 0.0
        for _ in range(5):
            motions = [turned(0.1 * rng.normal(), Z_UP, [*(0.3 * rng.normal(size=2)), 0]) for _ in range(2)]
            noise = [turned(0.03 * rng.normal(), Z_UP, [*(0.05 * rng.normal(size=2)), 0]) for _ in range(2)]
            T_world = [T @ M @ N for T, M, N in zip(T_world, motions, noise, strict=True)]
            filter_.predict(*motions)
        T = invert(T_world[0]) @ T_world[1]
        error = np.array([*T[:3, 3], heading(T)]) - filter_.means[0]
        error[3] = (error[3] + np.pi) % (2 * np.pi) - np.pi
        planar = error[[0, 1, 3]]
        values.append(planar @ np.linalg.solve(filter_.covariances[0][np.ix_([0, 1, 3], [0, 1, 3])], planar) / 3)
    assert np.mean(values) == pytest.approx(1.0, abs=0.2)


def test_what_several_frames_agree_on_wins_over_what_each_frame_prefers():
    rng = np.random.default_rng(3)
    filter_ = PoseFilter()
    true = np.array([5.0, 1.0, 0.0, 0.3])
    C = np.diag([0.01, 0.01, 0.01, 1e-4])
    for _ in range(8):
        wrong = np.array([*rng.uniform(-20, 20, size=2), 0.0, rng.uniform(-3, 3)])
        filter_.predict(None, None)
        choice = filter_.update(np.array([wrong, true]), np.stack([C, C]), np.array([0.6, 0.3]))
    mean, _, probability = filter_.best()
    np.testing.assert_allclose(mean, true, atol=0.05)
    assert probability > 0.9
    assert (choice.component, choice.hypothesis) == (0, 1)


def test_a_wrong_belief_is_given_up():
    filter_ = PoseFilter()
    C = np.diag([0.01, 0.01, 0.01, 1e-4])
    old, new = np.array([5.0, 1.0, 0.0, 0.3]), np.array([-8.0, 3.0, 0.0, -2.0])
    for mean in [old] * 10 + [new] * 30:
        filter_.predict(None, None)
        filter_.update(mean[None], C[None], np.array([0.9]))
    np.testing.assert_allclose(filter_.best()[0], new, atol=0.05)
    assert filter_.best()[2] > 0.8


def test_weights_always_sum_to_one():
    rng = np.random.default_rng(4)
    filter_ = PoseFilter(PoseFilterOptions(max_components=3))
    for _ in range(30):
        h = int(rng.integers(0, 4))
        filter_.predict(None, None)
        filter_.update(
            rng.normal(size=(h, 4)) * [10, 10, 0.1, 1],
            np.tile(0.01 * np.eye(4), (h, 1, 1)),
            rng.dirichlet(np.ones(h + 1))[:h],
        )
        assert len(filter_.weights) <= 3
        assert filter_.weights.sum() + filter_.unknown == pytest.approx(1.0, abs=1e-6)
        assert (np.linalg.eigvalsh(filter_.covariances) > 0).all() if len(filter_.weights) else True


def ambiguous_matcher(T_true, wrong_first):
    """Without a prior: the true pose and a wrong one; with it: matches at the prior's pose, or none when it is off."""

    def matcher(source, target, *, prior=None, rng=None):
        pairs = np.stack([np.arange(len(source))] * 2, axis=1)
        if prior is None:
            other = T_true @ exp_se3(np.array([4.0, -3.0, 0, 0, 0, 1.0]))
            found = [
                Hypothesis(RelativePose(T, spread(0.1, 0.1, 0.02)), p, pairs, np.full(len(pairs), p))
                for T, p in ((other, 0.55), (T_true, 0.4))
            ]
            wrong = np.roll(pairs[:, 1], 1)
            chosen = np.stack([pairs[:, 0], wrong], axis=1) if wrong_first else pairs
            return Matching(chosen, np.full(len(pairs), 0.55), pose=found[0].pose, hypotheses=tuple(found))
        off = log_se3(invert(prior.T_source_target) @ T_true)
        if np.linalg.norm(off[:3]) > 1:
            return Matching.empty()
        return Matching(pairs, np.full(len(pairs), 0.99), pose=RelativePose(T_true, spread(0.05, 0.05, 0.01)))

    return matcher


def graphs(rng, T):
    q = rng.uniform(-5, 5, size=(6, 3)) * [1, 1, 0.1]
    return ObjectGraph.from_positions(transform(T, q), up=Z_UP), ObjectGraph.from_positions(q, up=Z_UP)


def test_a_tracker_lets_a_moving_truth_win_over_a_wrong_favourite():
    rng = np.random.default_rng(5)
    tracker = PairTracker()
    right = []
    for k in range(20):
        # The wrong pose jumps with the source's heading, the true one moves as the odometry says.
        T = turned(0.3, Z_UP, (6.0, 0.1 * k, 0.0))
        tracker.predict(turned(0.0, Z_UP, (0, 0, 0)), turned(0.0, Z_UP, T[:3, :3].T @ [0, 0.1, 0]))
        source, target = graphs(rng, T)
        jumping = ambiguous_matcher(T, wrong_first=True)

        def matcher(source, target, *, prior=None, rng=None, jumping=jumping, k=k):
            found = jumping(source, target, prior=prior)
            if prior is not None:
                return found
            wrong = found.hypotheses[0]
            moved = RelativePose(
                wrong.pose.T_source_target @ turned(0.5 * k, Z_UP, (0.7 * k, 0, 0)), wrong.pose.covariance
            )
            hypotheses = (Hypothesis(moved, wrong.probability, wrong.pairs, wrong.scores), found.hypotheses[1])
            return Matching(found.pairs, found.scores, pose=moved, hypotheses=hypotheses)

        matching = tracker.match(matcher, source, target)
        right.append(len(matching) > 0 and (matching.pairs[:, 0] == matching.pairs[:, 1]).all())
    assert not right[0]
    assert all(right[8:])
    tracker.reset()
    assert tracker.prior() is None


def test_prior_and_update_by_hand():
    rng = np.random.default_rng(6)
    T = turned(0.3, Z_UP, (6.0, 1.0, 0.0))
    matcher = ambiguous_matcher(T, wrong_first=False)
    tracker = PairTracker(PairOptions(trust=0.5))
    source, target = graphs(rng, T)
    sure = Matching(
        np.stack([np.arange(6)] * 2, axis=1), np.full(6, 0.95), pose=RelativePose(T, spread(0.05, 0.05, 0.01))
    )
    for _ in range(20):
        prior = tracker.prior()
        if prior is not None:
            break
        tracker.update(source, target, sure)
    np.testing.assert_allclose(prior.T_source_target, T, atol=0.05)
    tracker.update(source, target, matcher(source, target, prior=prior))
    for _ in range(10):
        prior = tracker.prior()
        tracker.update(source, target, Matching.empty())
    assert tracker.prior() is None  # a prior that explains nothing loses its trust


def test_motion_of_frames_without_a_match_is_not_lost():
    rng = np.random.default_rng(7)
    T = turned(0.0, Z_UP, (6.0, 0.0, 0.0))
    tracker = PairTracker()
    source, target = graphs(rng, T)
    sure = Matching(
        np.stack([np.arange(6)] * 2, axis=1), np.full(6, 0.95), pose=RelativePose(T, spread(0.05, 0.05, 0.01))
    )
    for _ in range(10):
        tracker.prior(np.eye(4), np.eye(4))
        tracker.update(source, target, sure)
    for _ in range(5):
        tracker.predict(turned(0.0, Z_UP, (1.0, 0, 0)), np.eye(4))
    prior = tracker.prior(turned(0.0, Z_UP, (1.0, 0, 0)), np.eye(4))
    np.testing.assert_allclose(prior.T_source_target[:3, 3], [0, 0, 0], atol=0.1)


def test_graphs_without_gravity_are_matched_frame_by_frame():
    q = np.ones((3, 3)) * np.arange(3)[:, None]
    plain = ObjectGraph.from_positions(q)

    def matcher(source, target, *, prior=None, rng=None):
        assert prior is None
        return Matching.empty()

    tracker = PairTracker()
    for _ in range(3):
        tracker.predict()
        assert len(tracker.match(matcher, plain, plain)) == 0


def test_right_angles_do_not_count_again_with_every_frame():
    rng = np.random.default_rng(5)
    R_camera = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    K = np.array([[320.0, 0, 320], [0, 320, 240], [0, 0, 1]])
    lanes = np.c_[rng.uniform(5, 45, 9), 4.0 * rng.integers(-2, 3, 9), np.full(9, -1.0)]
    other = np.r_[(lanes[:3] - [2.0, 3.0, 0.0]) @ rotation_from_vector(np.array([0, 0, 0.5])), lanes[::-1][:5]]
    camera = {"up": R_camera.T @ Z_UP, "intrinsics": K, "image_size": (640, 480), "position_variance": 0.5}
    a, b = (ObjectGraph.from_positions(X @ R_camera, **camera) for X in (lanes, other))

    def evidence(**options):
        tracker = PairTracker()
        tracker.predict()
        return tracker.match(bayes, a, b, **options).diagnostics["log_evidence"]

    plain = bayes(a, b, right_angles=0.0).diagnostics["log_evidence"]
    assert evidence() == plain != bayes(a, b).diagnostics["log_evidence"]
    assert evidence(right_angles=0.2) == bayes(a, b).diagnostics["log_evidence"]


def test_poses_that_a_matching_stands_for():
    rng = np.random.default_rng(8)
    T = turned(0.3, Z_UP, (6.0, 1.0, 0.0))
    source, target = graphs(rng, T)
    pairs = np.stack([np.arange(6)] * 2, axis=1)
    ((pose, probability),) = propose(source, target, Matching(pairs, np.full(6, 0.8)))
    np.testing.assert_allclose(pose.T_source_target, T, atol=1e-6)
    assert probability == pytest.approx(0.4)
    assert propose(source, target, Matching.empty()) == []
    assert propose(source, target, Matching(pairs[:2], np.ones(2))) == []


def test_motions_are_levelled():
    T = turned(0.2, CAMERA_UP, (0.0, 0.0, 1.0))
    flat = level_motion(T, CAMERA_UP, CAMERA_UP)
    assert heading(flat) == pytest.approx(0.2)
    assert flat[2, 3] == pytest.approx(0.0)
    assert np.linalg.norm(flat[:2, 3]) == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("options", "field", "value"),
    [
        (PoseFilterOptions, "lost", 0.0),
        (PoseFilterOptions, "overlooked", 1.0),
        (PoseFilterOptions, "independence", 0.0),
        (PoseFilterOptions, "max_components", 0),
        (PoseFilterOptions, "walk_std_m", -0.1),
        (PoseFilterOptions, "odometry_std_rad", np.nan),
        (PoseFilterOptions, "extent_m", 0.0),
        (PairOptions, "trust", 1.5),
        (PairOptions, "widen", 0.0),
        (PairOptions, "common", 1.0),
        (PairOptions, "max_asked", 2.5),
        (PairOptions, "beside_maps", 0.0),
    ],
)
def test_bad_options_are_named_with_their_value(options, field, value):
    with pytest.raises(ValueError, match=f"^{field} must .*, got {value}$"):
        options(**{field: value})


def test_components_are_reweighed_by_what_the_frame_says_under_each():
    filter_ = PoseFilter(PoseFilterOptions(independence=0.5, overlooked=0.1))
    means, C = np.array([[0.0, 0, 0, 0], [20.0, 0, 0, 1]]), 0.01 * np.eye(4)
    filter_.means, filter_.covariances = means, np.stack([C, C])
    filter_.weights, filter_.unknown = np.array([0.6, 0.3]), 0.1
    evidence = np.array([1.0, 5.0])
    explained = [Explained(k, means[k], C, evidence[k]) for k in range(2)]
    filter_.reweigh(explained, 2.0, np.array([[50.0, 0, 0, 2]]), C[None], np.array([0.8]))
    share = np.sqrt([0.8 * 0.9, 0.2])
    born, none = 0.1 * np.exp(0.5 * 2.0) * share / share.sum()
    expected = np.array([0.6 * np.exp(0.5), 0.3 * np.exp(2.5), born, none])
    expected /= expected.sum()
    order = np.argsort(-expected[:3])
    assert filter_.weights == pytest.approx(expected[:3][order])
    assert filter_.unknown == pytest.approx(expected[3])
    assert filter_.means == pytest.approx(np.array([*means, [50.0, 0, 0, 2]])[order])


def test_components_that_were_not_asked_join_the_unknown():
    filter_ = PoseFilter()
    filter_.means, filter_.covariances = np.zeros((2, 4)), np.stack([np.eye(4)] * 2)
    filter_.weights, filter_.unknown = np.array([0.9, 0.01]), 0.09
    nothing = np.zeros((0, 4)), np.zeros((0, 4, 4)), np.zeros(0)
    filter_.reweigh([Explained(0, np.zeros(4), np.eye(4), 0.0)], 0.0, *nothing)
    assert filter_.weights == pytest.approx([0.9])
    filter_.reweigh([], 0.0, *nothing)
    assert len(filter_.weights) == 0
    assert filter_.unknown == pytest.approx(1.0)


def weighing_matcher(T_true, favourite):
    """Without a prior: a favourite pose and the true one, little evidence; with one: much evidence near the truth."""

    def matcher(source, target, *, prior=None, rng=None):
        straight = np.stack([np.arange(len(source))] * 2, axis=1)
        rolled = np.stack([straight[:, 0], np.roll(straight[:, 1], 1)], axis=1)

        def matching(pairs, probability, pose, evidence, hypotheses=()):
            P = np.zeros((len(source), len(target)))
            P[pairs[:, 0], pairs[:, 1]] = probability
            said = {"probabilities": P, "log_evidence": evidence}
            scores = np.full(len(pairs), probability)
            return Matching(pairs, scores, pose=pose, hypotheses=hypotheses, diagnostics=said)

        true = RelativePose(T_true, spread(0.1, 0.1, 0.02))
        if prior is None:
            wrong = RelativePose(favourite, spread(0.1, 0.1, 0.02))
            found = [(wrong, 0.6, rolled), (true, 0.35, straight)]
            hypotheses = tuple(Hypothesis(T, p, pairs, np.full(len(pairs), p)) for T, p, pairs in found)
            return matching(rolled, 0.6, wrong, 3.0, hypotheses)
        if np.linalg.norm(log_se3(invert(prior.T_source_target) @ T_true)[:3]) < 1:
            return matching(straight, 0.99, true, 8.0)
        return matching(rolled[:1], 0.3, prior, -2.0)

    return matcher


def test_the_pose_that_explains_frame_after_frame_wins_without_odometry():
    rng = np.random.default_rng(6)
    tracker, right = PairTracker(), []
    for k in range(12):
        T = turned(0.3, Z_UP, (6.0, 0.1 * k, 0.0))
        favourite = turned(0.3 + 0.7 * k, Z_UP, (-6.0, 2.0 * k, 0.0))
        tracker.predict()
        matching = tracker.match(weighing_matcher(T, favourite), *graphs(rng, T))
        right.append(len(matching) == 6 and (matching.pairs[:, 0] == matching.pairs[:, 1]).all())
    assert not right[0]
    assert all(right[4:])
    assert matching.pose.T_source_target == pytest.approx(T, abs=1e-6)


def test_a_wrong_pose_is_given_up_when_another_explains_more():
    rng = np.random.default_rng(7)
    T, wrong = turned(0.3, Z_UP, (6.0, 0, 0.0)), turned(2.0, Z_UP, (-6.0, 0, 0.0))
    tracker = PairTracker()
    for k in range(30):
        truth = wrong if k < 8 else T
        tracker.predict()
        tracker.match(weighing_matcher(truth, turned(0.4 * k, Z_UP, (9.0 + 2 * k, 0, 0.0))), *graphs(rng, truth))
        if k == 7:
            assert tracker.filter.best()[0][:3] == pytest.approx([-6, 0, 0], abs=0.1)
    assert tracker.filter.best()[0][:3] == pytest.approx([6, 0, 0], abs=0.1)
