import numpy as np
import pytest

from covis.fusion.gains import fuse, fuse_own
from covis.fusion.gaussian import fuse_gaussians, fuse_isotropic
from covis.fusion.groups import group_detections
from covis.fusion.metrics import nees_per_dof
from covis.fusion.objects import relative_pose
from covis.fusion.team import fuse_team
from covis.matching.graph import Matching, ObjectGraph
from covis.matching.pose import RelativePose, exp_se3, invert, transform


def matching(*pairs, scores=None):
    return Matching(np.array(pairs).reshape(-1, 2), np.ones(len(pairs)) if scores is None else np.array(scores))


def random_world_pose(rng):
    return exp_se3(np.concatenate([rng.normal(size=3) * 4, rng.normal(size=3)]))


def ray_covariances(positions, along=0.3, across=0.05):
    ray = positions / np.linalg.norm(positions, axis=1)[:, None]
    return across**2 * np.eye(3) + (along**2 - across**2) * ray[:, :, None] * ray[:, None, :]


def team(rng, n_robots=3, n_objects=5, pose_std=(0.1, 0.02)):
    """Graphs of robots that all see all objects in the same order, noisy relative poses to robot 0, true positions."""
    world = rng.uniform(-10, 10, size=(n_objects, 3))
    T_world = [random_world_pose(rng) for _ in range(n_robots)]
    graphs, truth = [], []
    for T in T_world:
        x = transform(invert(T), world)
        C = ray_covariances(x)
        noise = np.einsum("nij,nj->ni", np.linalg.cholesky(C), rng.normal(size=x.shape))
        graphs.append(ObjectGraph.from_positions(x + noise, position_variance=0.09, covariances=C))
        truth.append(x)
    C_pose = np.diag([pose_std[0] ** 2] * 3 + [pose_std[1] ** 2] * 3)
    poses = {}
    for j in range(1, n_robots):
        xi = np.sqrt(np.diag(C_pose)) * rng.normal(size=6)
        T = invert(T_world[0]) @ T_world[j]
        poses[0, j] = RelativePose(T @ invert(exp_se3(xi)), C_pose)
    full = {
        (i, j): matching(*[(k, k) for k in range(n_objects)]) for i in range(n_robots) for j in range(i + 1, n_robots)
    }
    return graphs, poses, full, truth


def test_groups_of_a_chain_of_matchings():
    groups = group_detections([2, 2, 1], {(0, 1): matching((0, 1)), (1, 2): matching((1, 0))})
    rows = {tuple(r) for r in groups.members.tolist()}
    assert rows == {(0, 1, 0), (1, -1, -1), (-1, 0, -1)}
    np.testing.assert_array_equal(np.sort(groups.sizes), [1, 1, 3])
    np.testing.assert_array_equal(groups.members[groups.of(1), 1], [0, 1])


def test_conflicting_groups_are_cut_at_the_weakest_match():
    # 0:a - 1:a - 2:a - 0:b would put two detections of robot 0 into one group.
    matchings = {
        (0, 1): matching((0, 0), scores=[0.9]),
        (1, 2): matching((0, 0), scores=[0.8]),
        (0, 2): matching((1, 0), scores=[0.3]),
    }
    groups = group_detections([2, 1, 1], matchings)
    assert {tuple(r) for r in groups.members.tolist()} == {(0, 0, 0), (1, -1, -1)}
    assert sorted(groups.scores.tolist()) == [0.8, 1.0]


def test_every_detection_is_in_exactly_one_group():
    rng = np.random.default_rng(0)
    sizes = [5, 7, 0, 4]
    matchings = {}
    for i in range(4):
        for j in range(i + 1, 4):
            k = min(sizes[i], sizes[j])
            pairs = np.stack([rng.permutation(sizes[i])[:k], rng.permutation(sizes[j])[:k]], axis=1)
            matchings[i, j] = Matching(pairs, rng.uniform(size=k))
    groups = group_detections(sizes, matchings)
    for robot, n in enumerate(sizes):
        own = groups.members[:, robot]
        assert sorted(own[own >= 0].tolist()) == list(range(n))


def test_bad_matchings_raise():
    with pytest.raises(ValueError, match="both directions"):
        group_detections([1, 1], {(0, 1): matching((0, 0)), (1, 0): matching((0, 0))})
    with pytest.raises(ValueError, match="names detections"):
        group_detections([1, 1], {(0, 1): matching((0, 1))})
    with pytest.raises(ValueError, match="2 robots"):
        group_detections([1, 1], {(0, 2): matching((0, 0))})
    with pytest.raises(TypeError, match=r"matchings\[\(0, 1\)\] must be a Matching, got list"):
        group_detections([1, 1], {(0, 1): [(0, 0)]})
    graph = ObjectGraph.from_positions(np.ones((1, 3)))
    with pytest.raises(TypeError, match=r"graphs\[1\] must be an ObjectGraph, got ndarray"):
        fuse([graph, np.ones((1, 3))], {}, {})
    with pytest.raises(TypeError, match=r"poses\[\(0, 1\)\] must be a RelativePose, got ndarray"):
        fuse([graph, graph], {(0, 1): np.eye(4)}, {})
    with pytest.raises(ValueError, match=r"gate must lie in \(0, 1\), got 1"):
        fuse([graph], {}, {}, gate=1.0)
    with pytest.raises(ValueError, match="got 1, 2 and 1"):
        fuse_team([graph], [None, None], [None], {})
    with pytest.raises(ValueError, match="gain"):
        fuse([graph], {}, {}, gain="best")
    with pytest.raises(ValueError, match="frame"):
        fuse([graph], {}, {}, frame=1)


def test_paper_gain_is_eq_20_to_22():
    rng = np.random.default_rng(1)
    graphs, poses, full, _ = team(rng)
    u = rng.uniform(0.1, 1, size=(3, 5))
    graphs = [ObjectGraph.from_positions(g.positions, position_variance=v) for g, v in zip(graphs, u, strict=True)]
    own = fuse_own(graphs, poses, full, 0, gain="paper")
    for i in range(5):
        moved = [graphs[0].positions[i]] + [
            transform(poses[0, j].T_source_target, graphs[j].positions[i : i + 1])[0] for j in (1, 2)
        ]
        expected = fuse_isotropic(moved, u[:, i])
        np.testing.assert_allclose(own.positions[i], expected.mean, rtol=1e-7)
        np.testing.assert_allclose(own.covariances[i], expected.covariance, rtol=1e-7)
    np.testing.assert_allclose(own.position_variance, 1 / (1 / u).sum(axis=0))


def test_covariance_gain_adds_the_pose_to_the_partner():
    rng = np.random.default_rng(2)
    graphs, poses, full, _ = team(rng)
    fused = fuse(graphs, poses, full, frame=0)
    for k, row in enumerate(fused.members):
        means, covariances = [graphs[0].positions[row[0]]], [graphs[0].covariances[row[0]]]
        for j in (1, 2):
            pose, q = poses[0, j], graphs[j].positions[row[j]]
            R = pose.T_source_target[:3, :3]
            means.append(R @ q + pose.T_source_target[:3, 3])
            covariances.append(R @ graphs[j].covariances[row[j]] @ R.T + pose.position_covariances(q[None])[0])
        expected = fuse_gaussians(means, covariances)
        np.testing.assert_allclose(fused.positions[k], expected.mean, rtol=1e-6)
        np.testing.assert_allclose(fused.covariances[k], expected.covariance, rtol=1e-6)


def test_intersection_stays_consistent_where_partners_repeat_one_measurement():
    """Two reports of one robot, taken for two robots: information fusion halves the variance, intersection does not."""
    graph = ObjectGraph.from_positions(np.array([[5.0, 1, 0]]), covariances=np.diag([1.0, 0.1, 0.1])[None])
    pose = RelativePose(np.eye(4), np.zeros((6, 6)))
    same = matching((0, 0))
    args = ([graph, graph, graph], {(0, 1): pose, (0, 2): pose}, {(0, 1): same, (0, 2): same})
    fused = fuse(*args, gain="intersection")
    assert fused.positions[0] == pytest.approx([5, 1, 0])
    assert fused.covariances[0] == pytest.approx(graph.covariances[0], rel=1e-3, abs=1e-6)
    assert fuse(*args).covariances[0] == pytest.approx(graph.covariances[0] / 3, rel=1e-6)


def test_fused_positions_are_consistent_and_better_monte_carlo():
    rng = np.random.default_rng(3)
    errors, covariances, single, paper = [], [], [], []
    for _ in range(150):
        graphs, poses, full, truth = team(rng)
        own = fuse_own(graphs, poses, full, 0)
        errors.append(own.positions - truth[0])
        covariances.append(own.covariances)
        single.append(own.positions_single - truth[0])
        paper.append(fuse_own(graphs, poses, full, 0, gain="paper").positions - truth[0])
    assert nees_per_dof(np.concatenate(errors), np.concatenate(covariances)) == pytest.approx(1.0, abs=0.12)
    rms = [np.sqrt((np.concatenate(e) ** 2).sum(axis=1).mean()) for e in (errors, single, paper)]
    assert rms[0] < rms[1]
    assert rms[0] < rms[2]


def test_exact_inputs_give_the_exact_position_in_every_frame():
    rng = np.random.default_rng(4)
    world = rng.uniform(-5, 5, size=(4, 3))
    T = [random_world_pose(rng) for _ in range(3)]
    graphs = [ObjectGraph.from_positions(transform(invert(t), world)) for t in T]
    poses = {(i, j): RelativePose(invert(T[i]) @ T[j], np.zeros((6, 6))) for i in range(3) for j in range(i + 1, 3)}
    full = {(i, j): matching(*[(k, k) for k in range(4)]) for i in range(3) for j in range(i + 1, 3)}
    for frame in range(3):
        own = fuse_own(graphs, poses, full, frame)
        np.testing.assert_allclose(own.positions, graphs[frame].positions, atol=1e-9)
        assert (own.n_robots == 3).all()


def test_unmatched_detections_stay_as_measured():
    rng = np.random.default_rng(5)
    graphs, poses, _, _ = team(rng, n_robots=2)
    own = fuse_own(graphs, poses, {(0, 1): matching((1, 3))}, 0)
    alone = [0, 2, 3, 4]
    np.testing.assert_array_equal(own.positions[alone], own.positions_single[alone])
    np.testing.assert_array_equal(own.n_robots, [1, 2, 1, 1, 1])
    assert not np.allclose(own.positions[1], own.positions_single[1])
    everything = fuse(graphs, poses, {(0, 1): matching((1, 3))})
    assert len(everything) == 9
    assert (everything.used == (everything.members >= 0)).all()


def test_a_partner_of_unknown_pose_does_not_contribute():
    rng = np.random.default_rng(6)
    graphs, poses, full, _ = team(rng)
    known = {(0, 1): poses[0, 1]}
    fused = fuse(graphs, known, full)
    assert fused.used[:, :2].all()
    assert not fused.used[:, 2].any()
    nobody = fuse(graphs, {}, {}, frame=0)
    assert len(nobody) == 5


def test_either_direction_of_a_pose_will_do():
    rng = np.random.default_rng(7)
    graphs, poses, full, _ = team(rng, n_robots=2)
    forth = fuse_own(graphs, poses, full, 0)
    back = fuse_own(graphs, {(1, 0): poses[0, 1].inverse()}, full, 0)
    np.testing.assert_allclose(forth.positions, back.positions, rtol=1e-6)
    np.testing.assert_allclose(forth.covariances, back.covariances, rtol=1e-5)
    assert relative_pose({}, 0, 1) is None


@pytest.mark.parametrize("gain", ["covariance", "paper"])
def test_zero_and_infinite_variances(gain):
    p = np.array([[1.0, 0, 5], [2, 0, 6]])
    sure = ObjectGraph.from_positions(p, position_variance=0.0)
    unsure = ObjectGraph.from_positions(1.2 * p, position_variance=np.inf)  # off along the ray
    still = {(0, 1): RelativePose(np.eye(4), np.zeros((6, 6)))}
    both = {(0, 1): matching((0, 0), (1, 1))}
    own = fuse_own([sure, unsure], still, both, 0, gain=gain)
    np.testing.assert_allclose(own.positions[:, 2], p[:, 2], atol=1e-3)
    for pair in ([sure, sure], [unsure, unsure]):
        own = fuse_own(pair, still, both, 0, gain=gain)
        assert np.isfinite(own.positions).all()
        assert np.isfinite(own.covariances).all()
        np.testing.assert_allclose(own.positions, pair[0].positions, atol=1e-6)


def test_empty_graphs():
    empty = ObjectGraph.from_positions(np.zeros((0, 3)))
    some = ObjectGraph.from_positions(np.ones((2, 3)))
    still = {(0, 1): RelativePose(np.eye(4), np.zeros((6, 6)))}
    assert len(fuse([empty, empty], still, {})) == 0
    assert fuse_own([empty, some], still, {(0, 1): Matching.empty()}, 0).positions.shape == (0, 3)
    assert len(fuse([empty, some], still, {(0, 1): Matching.empty()})) == 2


def test_relative_poses_surer_than_the_frames_own_pose_are_refused():
    graphs, poses, full, _ = team(np.random.default_rng(3))
    with pytest.raises(ValueError, match="frame_covariance is larger"):
        fuse(graphs, poses, full, frame_covariance=np.eye(6))


def test_of_two_that_disagree_the_more_precise_is_kept():
    vague, precise = (
        ObjectGraph.from_positions([[5.0, y, 0.0]], covariances=std**2 * np.eye(3)[None])
        for y, std in ((0.0, 0.2), (3.0, 0.1))
    )
    still = {(0, 1): RelativePose(np.eye(4), np.zeros((6, 6)))}
    for graphs, used in (([vague, precise], [False, True]), ([precise, vague], [True, False])):
        fused = fuse(graphs, still, {(0, 1): matching((0, 0))}, gate=0.999)
        assert fused.used.tolist() == [used]
        assert fused.positions[0] == pytest.approx([5, 3, 0])


def test_a_team_fuses_groups_that_are_consistent():
    """Five right matches of each object overrule a wrong one, although its score is the highest."""
    graph = ObjectGraph.from_positions([[5.0, 0.0, 0.0], [5.0, 4.0, 0.0]])
    matchings = {(i, j): matching((0, 0), (1, 1), scores=[0.9] * 2) for i in range(4) for j in range(i + 1, 4)}
    matchings[0, 3] = matching((0, 1), (1, 0), scores=[0.95] * 2)
    own = fuse_team([graph] * 4, [np.eye(4)] * 4, [1e-6 * np.eye(6)] * 4, matchings)
    assert [x.n_robots.tolist() for x in own] == [[4, 4]] * 4
    own = fuse_team([graph] * 4, [np.eye(4), None, *[np.eye(4)] * 2], [1e-6 * np.eye(6)] * 4, matchings)
    assert own[1] is None
    assert own[0].n_robots.tolist() == [3, 3]
