import numpy as np
import pytest
from scipy.optimize import least_squares

from covis.fusion.gains import fuse, fuse_own
from covis.fusion.groups import group_detections
from covis.fusion.metrics import nees_per_dof
from covis.fusion.objects import agreement
from covis.fusion.refine import refine
from covis.fusion.registration import log_se3, register
from covis.matching.graph import Matching, ObjectGraph
from covis.matching.pose import RelativePose, exp_se3, invert, rotation_from_vector, transform

UP = np.array([0.0, 0.0, 1.0])


def matching(pairs):
    return Matching(np.array(pairs, dtype=np.int64).reshape(-1, 2), np.ones(len(pairs)))


def team(rng, n_robots=3, n_objects=6, pose_std=(0.5, 0.05), visible=1.0):
    """Upright robots around a scene: graphs, matchings, noisy poses to robot 0, true poses and positions."""
    world = np.column_stack([rng.uniform(-6, 6, size=(n_objects, 2)), rng.uniform(0, 1, size=n_objects)])
    T_world, graphs, seen, truth = [], [], [], []
    for k in range(n_robots):
        T = np.eye(4)
        T[:3, :3] = rotation_from_vector((2 * np.pi * k / n_robots + rng.normal() * 0.2) * UP)
        T[:3, 3] = T[:3, :3] @ [-10, 0, 0] + rng.normal(size=3) * [1, 1, 0.1]
        index = rng.permutation(n_objects)[: max(3, int(visible * n_objects))]
        x = transform(invert(T), world[index])
        ray = x / np.linalg.norm(x, axis=1)[:, None]
        C = 0.03**2 * np.eye(3) + (0.3**2 - 0.03**2) * ray[:, :, None] * ray[:, None, :]
        noise = np.einsum("nij,nj->ni", np.linalg.cholesky(C), rng.normal(size=x.shape))
        graphs.append(ObjectGraph.from_positions(x + noise, position_variance=0.09, covariances=C, up=UP))
        T_world.append(T)
        seen.append(index.tolist())
        truth.append(x)
    sigma = np.array([pose_std[0]] * 3 + [1e-6, 1e-6, pose_std[1]])
    poses, true_poses = {}, {}
    for j in range(1, n_robots):
        true_poses[j] = invert(T_world[0]) @ T_world[j]
        xi = sigma * rng.normal(size=6) * [1, 1, 1, 0, 0, 1]
        poses[0, j] = RelativePose(true_poses[j] @ invert(exp_se3(xi)), np.diag(sigma**2))
    matchings = {
        (i, j): matching([(seen[i].index(o), seen[j].index(o)) for o in seen[i] if o in seen[j]])
        for i in range(n_robots)
        for j in range(i + 1, n_robots)
    }
    return graphs, poses, matchings, true_poses, truth


def test_the_optimum_is_that_of_a_general_solver():
    rng = np.random.default_rng(0)
    graphs, poses, matchings, _, _ = team(rng)
    refined = refine(graphs, poses, matchings)
    groups = group_detections([len(g) for g in graphs], matchings)
    whiten = [[np.linalg.cholesky(np.linalg.inv(C)).T for C in g.covariances] for g in graphs]
    root = {key: np.linalg.cholesky(np.linalg.inv(p.covariance)).T for key, p in poses.items()}

    def residuals(x):
        T = [np.eye(4)]
        for j in (1, 2):
            step = np.zeros(6)
            step[[0, 1, 2, 5]] = x[4 * (j - 1) : 4 * j]
            T.append(poses[0, j].T_source_target @ exp_se3(step))
        objects = x[8:].reshape(-1, 3)
        out = []
        for k, row in enumerate(groups.members):
            for r, d in enumerate(row):
                if d >= 0:
                    out.append(whiten[r][d] @ (graphs[r].positions[d] - transform(invert(T[r]), objects[k : k + 1])[0]))
        for (_, j), L in root.items():
            out.append(L @ log_se3(invert(poses[0, j].T_source_target) @ T[j]))
        return np.concatenate(out)

    start = np.concatenate([np.zeros(8), fuse(graphs, poses, groups).positions.ravel()])
    best = least_squares(residuals, start, xtol=1e-14, ftol=1e-14, gtol=1e-12)
    assert refined.cost == pytest.approx(best.cost, rel=1e-5)
    np.testing.assert_allclose(refined.objects.positions.ravel(), best.x[8:], atol=2e-4)


def test_two_robots_agree_with_registration():
    rng = np.random.default_rng(1)
    graphs, poses, matchings, _, _ = team(rng, n_robots=2)
    joint = refine(graphs, poses, matchings).poses[0, 1]
    alone = register(graphs[0], graphs[1], matchings[0, 1], prior=poses[0, 1])
    np.testing.assert_allclose(joint.T_source_target, alone.T_source_target, atol=1e-5)
    np.testing.assert_allclose(joint.covariance, alone.covariance, atol=1e-5)


@pytest.mark.parametrize("known", [True, False])
def test_poses_and_objects_are_consistent_monte_carlo(known):
    rng = np.random.default_rng(2)
    errors, covariances, pose_errors, pose_covariances = [], [], [], []
    for _ in range(120):
        graphs, poses, matchings, true_poses, truth = team(rng, n_objects=8)
        refined = refine(graphs, poses if known else {}, matchings)
        row = refined.objects.members[:, 0]
        errors.append(refined.objects.positions[row >= 0] - truth[0][row[row >= 0]])
        covariances.append(refined.objects.covariances[row >= 0])
        for j in (1, 2):
            pose = refined.poses[0, j]
            xi = log_se3(invert(pose.T_source_target) @ true_poses[j])
            pose_errors.append(xi[[0, 1, 2, 5]])
            pose_covariances.append(pose.covariance[np.ix_([0, 1, 2, 5], [0, 1, 2, 5])])
    assert nees_per_dof(np.concatenate(errors), np.concatenate(covariances)) == pytest.approx(1.0, abs=0.15)
    assert nees_per_dof(np.array(pose_errors), np.array(pose_covariances)) == pytest.approx(1.0, abs=0.2)


def test_matches_correct_noisy_poses():
    rng = np.random.default_rng(3)
    errors = {"covariance": [], "joint": []}
    for _ in range(40):
        graphs, poses, matchings, _, truth = team(rng)
        for gain, into in errors.items():
            own = fuse_own(graphs, poses, matchings, 0, gain=gain)
            into.append(np.linalg.norm(own.positions - truth[0], axis=1))
    assert np.mean(errors["joint"]) < 0.7 * np.mean(errors["covariance"])


def test_robots_are_placed_through_others():
    rng = np.random.default_rng(4)
    graphs, _, matchings, true_poses, _ = team(rng, n_robots=4, n_objects=8)
    chain = {key: m for key, m in matchings.items() if key in ((0, 1), (1, 2), (2, 3))}
    refined = refine(graphs, {}, chain)
    assert set(refined.poses) == {(0, 1), (0, 2), (0, 3)}
    for j in (1, 2, 3):
        assert np.linalg.norm(refined.poses[0, j].T_source_target[:3, 3] - true_poses[j][:3, 3]) < 0.5
    lonely = refine(graphs, {}, {(0, 1): matchings[0, 1]})
    assert set(lonely.poses) == {(0, 1)}
    assert not lonely.objects.used[:, 2:].any()


def test_the_frame_does_not_matter():
    rng = np.random.default_rng(5)
    graphs, poses, matchings, _, _ = team(rng)
    zero, two = refine(graphs, poses, matchings), refine(graphs, poses, matchings, frame=2)
    moved = transform(zero.poses[0, 2].T_source_target, two.objects.positions)
    np.testing.assert_array_equal(zero.objects.members, two.objects.members)
    np.testing.assert_allclose(moved, zero.objects.positions, atol=1e-4)


def test_one_robot_with_a_wrong_pose_does_not_drag_the_others():
    rng = np.random.default_rng(6)
    clean, plain, gated = [], [], []
    for _ in range(30):
        graphs, poses, matchings, _, truth = team(rng, n_robots=4, pose_std=(0.05, 0.005))
        clean.append(np.linalg.norm(fuse_own(graphs, poses, matchings, 0).positions - truth[0], axis=1))
        wrong = poses[0, 3].T_source_target.copy()
        wrong[:3, 3] += [3.0, 4.0, 0.0]
        broken = {**poses, (0, 3): RelativePose(wrong, poses[0, 3].covariance)}
        plain.append(np.linalg.norm(fuse_own(graphs, broken, matchings, 0).positions - truth[0], axis=1))
        fused = fuse(graphs, broken, matchings, gate=0.999)
        share = agreement(fused)
        assert share[3] < 0.2
        assert share[:3].min() > 0.8
        own = fuse_own(graphs, broken, matchings, 0, gate=0.999)
        gated.append(np.linalg.norm(own.positions - truth[0], axis=1))
    assert np.mean(plain) > 2 * np.mean(clean)
    assert np.mean(gated) < 1.25 * np.mean(clean)


def test_a_robot_with_random_positions_is_outvoted_even_in_its_own_frame():
    rng = np.random.default_rng(7)
    graphs, _, matchings, true_poses, truth = team(rng, n_robots=4, pose_std=(0.05, 0.005))
    poses = {(0, j): RelativePose(T, 1e-6 * np.eye(6)) for j, T in true_poses.items()}
    random = ObjectGraph.from_positions(
        graphs[0].positions + rng.uniform(2, 5, size=(6, 3)), covariances=graphs[0].covariances, up=UP
    )
    own = fuse_own([random, *graphs[1:]], poses, matchings, 0, gate=0.999)
    assert np.linalg.norm(own.positions - truth[0], axis=1).max() < 0.6


@pytest.mark.parametrize("gain", ["covariance", "joint"])
def test_two_partners_with_a_wrong_match_do_not_outvote_a_robots_own_measurement(gain):
    rng = np.random.default_rng(11)
    graphs, poses, matchings, _, truth = team(rng, n_robots=4, pose_std=(0.05, 0.005))
    # The other robots have one object right among themselves, but it is not the one robot 0 detected.
    there = {j: int(matchings[0, j].pairs[matchings[0, j].pairs[:, 0] == 1, 1][0]) for j in (1, 2)}
    wrong = {
        (0, 1): matching([(0, there[1])]),
        (0, 2): matching([(0, there[2])]),
        (1, 2): matching([tuple(there.values())]),
    }
    voted, trusting = (
        fuse_own(graphs, poses, wrong, 0, gain=gain, gate=0.999, trust_own=trust) for trust in (False, True)
    )
    assert np.linalg.norm(voted.positions[0] - truth[0][0]) > 1.0
    assert trusting.positions[0] == pytest.approx(graphs[0].positions[0], abs=1e-3)
    honest = fuse_own(graphs, poses, matchings, 0, gain=gain, gate=0.999, trust_own=True)
    assert (honest.n_robots > 2).all()


def test_gate_keeps_honest_measurements():
    rng = np.random.default_rng(8)
    used = []
    for _ in range(50):
        graphs, poses, matchings, _, _ = team(rng, pose_std=(0.05, 0.005))
        fused = fuse(graphs, poses, matchings, gate=0.99)
        used.append(fused.used[fused.members >= 0])
    assert np.concatenate(used).mean() > 0.98
    with pytest.raises(ValueError, match="gate"):
        fuse(graphs, poses, matchings, gate=1.0)


def test_huber_limits_one_gross_error():
    plain, robust = [], []
    for seed in range(10):
        rng = np.random.default_rng(seed)
        graphs, _, matchings, true_poses, _ = team(rng, n_objects=10)
        moved = graphs[1].positions.copy()
        moved[0] += [2.0, 2.0, 0.0]
        broken = [graphs[0], ObjectGraph.from_positions(moved, covariances=graphs[1].covariances, up=UP), graphs[2]]
        for errors, huber in ((plain, None), (robust, 2.0)):
            pose = refine(broken, {}, matchings, huber=huber).poses[0, 1]
            errors.append(np.linalg.norm(pose.T_source_target[:3, 3] - true_poses[1][:3, 3]))
    assert np.mean(robust) < 0.5 * np.mean(plain)
    assert max(robust) < max(plain)


def test_empty_teams():
    empty = ObjectGraph.from_positions(np.zeros((0, 3)), up=UP)
    some = ObjectGraph.from_positions(np.ones((2, 3)), up=UP)
    known = {(0, 1): RelativePose(np.eye(4), 1e-4 * np.eye(6))}
    assert len(refine([empty, empty], known, {}).objects) == 0
    both = refine([some, empty], known, {})
    assert len(both.objects) == 2
    np.testing.assert_allclose(both.poses[0, 1].T_source_target, np.eye(4), atol=1e-9)
    alone = refine([some], {}, {})
    np.testing.assert_allclose(alone.objects.positions, 1.0)
    with pytest.raises(ValueError, match="frame"):
        refine([some], {}, {}, frame=3)


def test_robust_covariances_are_covariances():
    """Where matches are wrong, what the robust weights leave open is a covariance all the same."""
    for seed in range(10):
        graphs, poses, matchings, _, _ = team(np.random.default_rng(seed), n_robots=2)
        pairs = matchings[0, 1].pairs
        wrong = matching(np.column_stack([pairs[:, 0], np.roll(pairs[:, 1], 1)]))
        refined = refine(graphs, poses, {(0, 1): wrong}, huber=1.0)
        assert (np.linalg.eigvalsh(refined.objects.covariances) > 0).all()
        assert np.linalg.eigvalsh(refined.poses[0, 1].covariance).min() > -1e-9
