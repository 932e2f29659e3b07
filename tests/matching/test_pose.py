"""Rigid motions, and how their errors travel."""

import numpy as np
import pytest

from covis.matching.pose import RelativePose, adjoint, exp_se3, invert, rotation_from_vector, transform


def random_pose(rng, turn=1.0):
    return exp_se3(np.concatenate([rng.normal(0, 3, 3), rng.normal(0, turn, 3)]))


def test_rotation_turns_about_its_axis():
    R = rotation_from_vector(np.array([0, 0, np.pi / 2]))
    np.testing.assert_allclose(R @ [1, 0, 0], [0, 1, 0], atol=1e-12)


def test_inverse_undoes():
    T = random_pose(np.random.default_rng(0))
    np.testing.assert_allclose(invert(T) @ T, np.eye(4), atol=1e-12)
    p = np.array([[1.0, 2, 3]])
    np.testing.assert_allclose(transform(invert(T), transform(T, p)), p)


def test_adjoint_moves_a_small_twist_through_a_pose():
    rng = np.random.default_rng(1)
    T, xi = random_pose(rng), rng.normal(0, 1e-5, 6)
    np.testing.assert_allclose(exp_se3(adjoint(T) @ xi), T @ exp_se3(xi) @ invert(T), atol=1e-9)


def test_relative_pose_covariance_agrees_with_sampling():
    rng = np.random.default_rng(2)
    A, B = random_pose(rng), random_pose(rng)
    S_a, S_b = np.diag([1, 2, 3, 0.5, 1, 2]) * 1e-4, np.diag([3, 1, 2, 2, 1, 0.5]) * 1e-4
    relative = RelativePose.between(A, S_a, B, S_b)
    xis = []
    errors_a = rng.multivariate_normal(np.zeros(6), S_a, 20000)
    errors_b = rng.multivariate_normal(np.zeros(6), S_b, 20000)
    for a, b in zip(errors_a, errors_b, strict=True):
        T = invert(A @ exp_se3(a)) @ B @ exp_se3(b)
        D = invert(relative.T_source_target) @ T
        w = np.array([D[2, 1] - D[1, 2], D[0, 2] - D[2, 0], D[1, 0] - D[0, 1]]) / 2
        xis.append(np.concatenate([D[:3, 3], w]))
    np.testing.assert_allclose(np.cov(np.array(xis).T), relative.covariance, rtol=0.1, atol=2e-4)


def test_inverse_relative_pose_twice_is_the_same():
    rng = np.random.default_rng(3)
    root = rng.normal(size=(6, 6))
    pose = RelativePose(random_pose(rng), root @ root.T)
    again = pose.inverse().inverse()
    np.testing.assert_allclose(again.T_source_target, pose.T_source_target, atol=1e-12)
    np.testing.assert_allclose(again.covariance, pose.covariance, rtol=1e-9, atol=1e-9)


def test_position_covariances_agree_with_sampling():
    rng = np.random.default_rng(4)
    root = rng.normal(0, 0.01, size=(6, 6))
    pose = RelativePose(random_pose(rng), root @ root.T)
    p = np.array([[2.0, -1.0, 4.0]])
    samples = [
        transform(pose.T_source_target @ exp_se3(xi), p)[0]
        for xi in rng.multivariate_normal(np.zeros(6), pose.covariance, 20000)
    ]
    expected = np.cov(np.array(samples).T)
    np.testing.assert_allclose(pose.position_covariances(p)[0], expected, rtol=0.1, atol=0.05 * expected.max())


@pytest.mark.parametrize(
    ("T", "message"),
    [
        (np.eye(3), r"must have shape \(4, 4\)"),
        ([[1], [2, 3]], "T_source_target must be a regular array of numbers"),
        (None, "T_source_target must be real numbers, got object None"),
        (np.full((4, 4), np.nan), "must be finite"),
        (np.diag([2.0, 1, 1, 1]), "not a rigid motion"),
        (np.diag([-1.0, 1, 1, 1]), "not a rigid motion"),
    ],
)
def test_bad_poses_are_refused(T, message):
    with pytest.raises(ValueError, match=message):
        RelativePose(T, np.eye(6))


@pytest.mark.parametrize(
    ("covariance", "message"),
    [
        (np.eye(3), r"must have shape \(6, 6\)"),
        (-np.eye(6), "positive semidefinite"),
        (np.triu(np.ones((6, 6))), "symmetric, it differs from its transpose by 1"),
        (np.full((6, 6), np.inf), "finite"),
    ],
)
def test_bad_covariances_are_refused(covariance, message):
    with pytest.raises(ValueError, match=message):
        RelativePose(np.eye(4), covariance)


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        (0, np.eye(3), r"T_world_source must have shape \(4, 4\), got \(3, 3\)"),
        (1, np.eye(3), r"covariance_source must have shape \(6, 6\), got \(3, 3\)"),
        (2, np.full((4, 4), np.nan), r"T_world_target must be finite, got nan at \(0, 0\)"),
        (3, "small", "covariance_target must be real numbers"),
    ],
)
def test_bad_world_poses_are_named(field, value, message):
    given = [np.eye(4), np.eye(6), np.eye(4), np.eye(6)]
    given[field] = value
    with pytest.raises(ValueError, match=message):
        RelativePose.between(*given)


def test_world_poses_may_be_lists():
    given = [np.eye(4).tolist(), np.eye(6).tolist()] * 2
    np.testing.assert_array_equal(RelativePose.between(*given).covariance, 2 * np.eye(6))
