import numpy as np
import pytest

from covis.fusion.metrics import nees_interval
from covis.fusion.registration import (
    RegistrationError,
    log_se3,
    register,
    register_points,
    registered,
    rotation_between,
)
from covis.matching.graph import Matching, ObjectGraph
from covis.matching.pose import RelativePose, exp_se3, invert, rotation_from_vector, transform

CAMERA_UP = np.array([0.0, -1.0, 0.0])


def ray_covariances(positions, along, across):
    ray = positions / np.linalg.norm(positions, axis=1)[:, None]
    return across**2 * np.eye(3) + (along**2 - across**2) * ray[:, :, None] * ray[:, None, :]


def random_pose(rng, level):
    T = np.eye(4)
    T[:3, :3] = rotation_from_vector(rng.uniform(-3, 3) * CAMERA_UP if level else rng.normal(size=3))
    T[:3, 3] = rng.normal(size=3) * 5
    return T


def scene(rng, n=6, level=True, along=0.0, across=0.0):
    """Two graphs of the same n objects with ray-aligned noise, and the true pose."""
    T = random_pose(rng, level)
    q = rng.uniform(-8, 8, size=(n, 3)) + [0, 0, 15]
    p = transform(T, q)
    graphs = []
    for x in (p, q):
        C = ray_covariances(x, along, across)
        noisy = x + np.einsum("nij,nj->ni", np.linalg.cholesky(C + 1e-300 * np.eye(3)), rng.normal(size=(n, 3)))
        up = CAMERA_UP if level else None
        graphs.append(ObjectGraph.from_positions(noisy if along else x, covariances=C, up=up))
    return graphs[0], graphs[1], T


def identity_pairs(n):
    return Matching(np.stack([np.arange(n), np.arange(n)], axis=1), np.ones(n))


@pytest.mark.parametrize("level", [True, False])
def test_registration_without_noise_is_exact(level):
    rng = np.random.default_rng(0)
    for n in (2 if level else 3, 6):
        source, target, T = scene(rng, n=n, level=level)
        pose = register(source, target, identity_pairs(n))
        np.testing.assert_allclose(pose.T_source_target, T, atol=1e-7)


@pytest.mark.parametrize("level", [True, False])
def test_registration_with_noise_is_consistent(level):
    rng = np.random.default_rng(1)
    dof, runs = (4 if level else 6), 300
    values = []
    for _ in range(runs):
        source, target, T = scene(rng, level=level, along=0.4, across=0.05)
        pose = register(source, target, identity_pairs(6))
        xi = log_se3(invert(pose.T_source_target) @ T)
        values.append(xi @ np.linalg.pinv(pose.covariance, rcond=1e-9) @ xi / dof)
    low, high = nees_interval(runs, dof, 0.999)
    assert low * 0.93 < np.mean(values) < high * 1.07


def test_full_covariances_beat_equal_weights():
    rng = np.random.default_rng(2)
    full, equal = [], []
    for _ in range(100):
        source, target, T = scene(rng, along=0.8, across=0.03)
        pairs = identity_pairs(6)
        plain = [
            ObjectGraph.from_positions(g.positions, covariances=np.stack([np.eye(3)] * 6), up=g.up)
            for g in (source, target)
        ]
        full.append(np.linalg.norm(register(source, target, pairs).T_source_target[:3, 3] - T[:3, 3]))
        equal.append(np.linalg.norm(register(*plain, pairs).T_source_target[:3, 3] - T[:3, 3]))
    assert np.mean(full) < 0.6 * np.mean(equal)


def test_exchanging_the_robots_gives_the_inverse():
    rng = np.random.default_rng(3)
    source, target, _ = scene(rng, along=0.3, across=0.1)
    forth, back = register(source, target, identity_pairs(6)), register(target, source, identity_pairs(6))
    np.testing.assert_allclose(forth.inverse().T_source_target, back.T_source_target, atol=1e-6)
    np.testing.assert_allclose(forth.inverse().covariance, back.covariance, rtol=0.02, atol=1e-6)


def test_gravity_is_kept():
    rng = np.random.default_rng(4)
    source, target, _ = scene(rng, along=0.5, across=0.2)
    pose = register(source, target, identity_pairs(6))
    np.testing.assert_allclose(pose.T_source_target[:3, :3] @ CAMERA_UP, CAMERA_UP, atol=1e-9)


def test_too_few_or_degenerate_matches_raise():
    rng = np.random.default_rng(5)
    source, target, _ = scene(rng, level=True)
    with pytest.raises(RegistrationError, match="1 matches do not determine a pose: 2"):
        register(source, target, identity_pairs(1))
    with pytest.raises(RegistrationError, match="0 matches"):
        register(source, target, Matching.empty())
    free = scene(rng, level=False)
    with pytest.raises(RegistrationError, match="2 matches do not determine a pose: 3"):
        register(free[0], free[1], identity_pairs(2))
    line = np.array([[0, 0, 1.0], [0, 0, 2], [0, 0, 5]])
    with pytest.raises(RegistrationError, match="one line"):
        register(ObjectGraph.from_positions(line), ObjectGraph.from_positions(line), identity_pairs(3))
    pole = np.array([[1, 0, 5.0], [1, 1, 5], [1, 3, 5]])
    graph = ObjectGraph.from_positions(pole, up=CAMERA_UP)
    with pytest.raises(RegistrationError, match="one vertical"):
        register(graph, graph, identity_pairs(3))


def test_a_prior_makes_any_number_of_matches_enough():
    rng = np.random.default_rng(6)
    source, target, T = scene(rng, along=0.2, across=0.05)
    prior = RelativePose(
        T @ exp_se3(np.array([0.5, 0, 0.5, 0, 0.02, 0])), np.diag([0.25, 1e-4, 0.25, 1e-8, 4e-4, 1e-8])
    )
    none = register(source, target, Matching.empty(), prior=prior)
    np.testing.assert_allclose(none.T_source_target, prior.T_source_target, atol=1e-9)
    errors = [np.linalg.norm((invert(T) @ prior.T_source_target)[:3, 3])]
    for k in (1, 3, 6):
        pose = register(source, target, identity_pairs(k), prior=prior)
        errors.append(np.linalg.norm((invert(T) @ pose.T_source_target)[:3, 3]))
        assert np.trace(pose.covariance[:3, :3]) < np.trace(prior.covariance[:3, :3])
    assert errors[3] < 0.6 * errors[0]


def test_registration_with_a_prior_is_consistent():
    rng = np.random.default_rng(7)
    sigma = np.array([1.0, 1e-3, 1.0, 1e-5, 0.05, 1e-5])
    values, runs = [], 300
    for _ in range(runs):
        source, target, T = scene(rng, n=3, along=0.4, across=0.05)
        xi = sigma * rng.normal(size=6) * [1, 1, 1, 0, 1, 0]
        prior = RelativePose(T @ invert(exp_se3(xi)), np.diag(sigma**2))
        pose = register(source, target, identity_pairs(3), prior=prior)
        error = log_se3(invert(pose.T_source_target) @ T)[[0, 1, 2, 4]]
        C = pose.covariance[np.ix_([0, 1, 2, 4], [0, 1, 2, 4])]
        values.append(error @ np.linalg.solve(C, error) / 4)
    low, high = nees_interval(runs, 4, 0.999)
    assert low * 0.9 < np.mean(values) < high * 1.1


def test_huber_limits_the_pull_of_a_wrong_match():
    rng = np.random.default_rng(8)
    source, target, T = scene(rng, n=8, along=0.2, across=0.05)
    moved = source.positions.copy()
    moved[0] += [3.0, 0.0, 2.0]
    wrong = ObjectGraph.from_positions(moved, covariances=source.covariances, up=source.up)
    plain = registered(wrong, target, identity_pairs(8))
    robust = registered(wrong, target, identity_pairs(8), huber=2.0)
    error = [np.linalg.norm(r.pose.T_source_target[:3, 3] - T[:3, 3]) for r in (plain, robust)]
    assert error[1] < 0.5 * error[0]
    assert robust.weights[0] == robust.weights.min() < 0.5


def test_rotation_between_handles_opposite_vectors():
    for a, b in (([1, 0, 0], [-1, 0, 0]), ([0, 0, 1], [0, 0, 1]), ([0, 1, 0], [0, 0, -1])):
        R = rotation_between(np.array(a, float), np.array(b, float))
        np.testing.assert_allclose(R @ a, b, atol=1e-12)
        assert np.linalg.det(R) == pytest.approx(1)


@pytest.mark.parametrize("angle", [0.0, 1e-6, 1.0, 3.1, np.pi])
def test_log_inverts_exp(angle):
    axis = np.array([0.6, -0.8, 0.0])
    xi = np.concatenate([[1.0, 2.0, 3.0], angle * axis])
    back = log_se3(exp_se3(xi))
    np.testing.assert_allclose(exp_se3(back), exp_se3(xi), atol=1e-9)
    assert np.linalg.norm(back[3:]) == pytest.approx(angle, abs=1e-7)


def test_points_without_gravity_and_bad_huber():
    rng = np.random.default_rng(9)
    q = rng.normal(size=(5, 3))
    C = np.stack([0.01 * np.eye(3)] * 5)
    T = random_pose(rng, level=False)
    np.testing.assert_allclose(register_points(transform(T, q), C, q, C).pose.T_source_target, T, atol=1e-9)
    with pytest.raises(ValueError, match="huber"):
        register_points(q, C, q, C, huber=0.0)
