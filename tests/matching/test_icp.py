"""ICP: the alignment, where it starts, and the matches it leaves."""

from itertools import permutations

import numpy as np
import pytest

from covis.matching import ObjectGraph, RelativePose, icp
from covis.matching.icp import (
    _starts,
    align,
    rigid,
    spread_rotations,
)
from covis.matching.pose import rotation_from_vector
from covis.matching.testing import scene


def test_rigid_recovers_a_motion():
    rng = np.random.default_rng(0)
    q = rng.normal(size=(6, 3))
    R = rotation_from_vector(np.array([1.0, -2.0, 0.5]))
    R_found, t_found = rigid(q @ R.T + [1.0, 2, 3], q)
    np.testing.assert_allclose(R_found, R, atol=1e-12)
    np.testing.assert_allclose(t_found, [1, 2, 3], atol=1e-12)


def test_rigid_never_reflects():
    q = np.random.default_rng(1).normal(size=(5, 3))
    R, _ = rigid(q * [1, 1, -1], q)
    assert np.linalg.det(R) == pytest.approx(1)


def test_spread_rotations_cover_all_orientations():
    R = spread_rotations(200)
    np.testing.assert_allclose(R[0], np.eye(3), atol=1e-12)
    for seed in range(20):
        Q = rotation_from_vector(np.random.default_rng(seed).normal(size=3) * 2)
        angle = np.arccos(np.clip((np.trace(R.transpose(0, 2, 1) @ Q, axis1=1, axis2=2) - 1) / 2, -1, 1))
        assert angle.min() < np.radians(45)


@pytest.mark.parametrize("translations", ["centroids", "objects"])
def test_icp_aligns_views_that_overlap_throughout(translations, small):
    source, target, truth = small(7, n=8, noise=0.02)
    found = icp(source, target, translations=translations, restarts=200, gate_m=0.5)
    assert (truth[found.pairs[:, 0]] == found.pairs[:, 1]).all()
    assert len(found) == 8


def test_icp_finds_the_alignment_of_least_error_on_small_problems(small):
    """Against the best rigid fit over every way of sending the target's points to the source's."""
    reached = 0
    for seed in range(20):
        source, target, _ = small(seed, noise=0.1)
        p, q = source.positions, target.positions

        def error(R, t, p=p, q=q):
            return (np.linalg.norm(p[:, None] - (q @ R.T + t)[None], axis=2).min(axis=0) ** 2).mean()

        best = min(error(*rigid(p[list(match)], q)) for match in permutations(range(4)))
        R, t = align(p, q, *_starts(source, target, None, 60, "objects"), 50, 1e-6, 20.0, np.inf, 0.0)
        reached += error(R, t) <= best + 1e-6
    assert reached >= 18


def align_in_numpy(p, q, R, t, iterations, first_gate, final_gate, shrink):
    """Besl and McKay's loop from every start: closest points, then the rigid motion of those within the gate."""
    best, gate = (np.inf, None, None), 0.0
    for R_0, t_0 in zip(R, t, strict=True):
        now, gate = (R_0, t_0), first_gate
        for _ in range(iterations):
            distance = np.linalg.norm(p[:, None] - (q @ now[0].T + now[1])[None], axis=2)
            squared = distance.min(axis=0) ** 2
            error = np.minimum(squared, final_gate**2).mean()
            if error < best[0] * (1 - 1e-12):
                best = (error, *now)
            gate = max(final_gate, shrink * gate)
            pulled = squared <= gate**2
            if pulled.sum() < 2:
                break
            now = rigid(p[distance.argmin(axis=0)[pulled]], q[pulled])
    return best[1:]


@pytest.mark.parametrize("gates", [(np.inf, np.inf, 0.0), (0.8, 0.8, 0.0), (6.0, 0.8, 0.7)])
def test_icp_is_the_published_iteration_in_numpy(gates):
    rng = np.random.default_rng(3)
    p = rng.uniform(-5, 5, (7, 3))
    q = np.r_[p[:5] @ rotation_from_vector(np.array([0.3, -1.0, 0.8])).T, rng.uniform(-5, 5, (2, 3))]
    starts = _starts(*(ObjectGraph.from_positions(x) for x in (p, q)), None, 10, "objects")
    R, t = align(p, q, *starts, 12, 0.0, *gates)
    R_expected, t_expected = align_in_numpy(p, q, *starts, 12, *gates)
    np.testing.assert_allclose(R, R_expected, atol=1e-9)
    np.testing.assert_allclose(t, t_expected, atol=1e-9)


def test_icp_turns_about_gravity_where_it_is_known():
    up = rotation_from_vector(np.array([0.2, -0.1, 0.0])) @ [0.0, 0, 1]
    source = ObjectGraph.from_positions(np.zeros((1, 3)), up=[0, 0, 1])
    target = ObjectGraph.from_positions(np.zeros((1, 3)), up=up)
    R, _ = _starts(source, target, None, 8, "centroids")
    np.testing.assert_allclose(R @ up, np.tile([0.0, 0, 1], (8, 1)), atol=1e-9)
    turn = (R @ R[0].T)[:, :2, 0]
    np.testing.assert_allclose(np.unwrap(np.arctan2(*turn.T[::-1])), np.arange(8) * np.pi / 4, atol=1e-9)


def test_icp_matches_each_others_closest_within_the_gate_scored_by_distance(as_list):
    p = np.array([[0.0, 0, 0], [5, 0, 0], [0, 5, 0], [0, 0, 5], [9, 9, 9]])
    q = p + np.array([[0.0, 0, 0.1], [0, 0, 0], [0, 0, -0.1], [0, 0, 0], [3, 0, 0]])
    source, target = (ObjectGraph.from_positions(x) for x in (p, q))
    prior = RelativePose(np.eye(4), np.eye(6))
    found = icp(source, target, prior=prior, iterations=1, gate_m=0.4)
    assert as_list(found) == [[i, i] for i in range(4)]
    np.testing.assert_allclose(found.scores, [0.75, 1, 0.75, 1])


def test_icp_starts_from_the_prior_if_there_is_one():
    problem = scene(np.random.default_rng(2))
    found = icp(problem.source, problem.target, prior=problem.prior, gate_m=1.0)
    assert (problem.truth[found.pairs[:, 0]] == found.pairs[:, 1]).all()
    assert len(found) >= 5
