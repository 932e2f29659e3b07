import numpy as np
import pytest

from covis.fusion.gaussian import (
    covariance_intersection,
    fuse_gaussians,
    fuse_isotropic,
    fused_variance,
    fusion_gains,
    information_matrix,
)


def random_covariance(rng, d=3):
    A = rng.normal(size=(d, d))
    return A @ A.T + 0.1 * np.eye(d)


def test_gain_and_fusion_of_eq_20_to_22_by_hand():
    # u = (1, 3): information 1 and 1/3, sum 4/3, gains 3/4 and 1/4.
    np.testing.assert_allclose(fusion_gains([1.0, 3.0]), [0.75, 0.25])
    fused = fuse_isotropic([[0.0, 0.0, 8.0], [4.0, 0.0, 0.0]], [1.0, 3.0])
    np.testing.assert_allclose(fused.mean, [1.0, 0.0, 6.0])
    np.testing.assert_allclose(fused.covariance, 0.75 * np.eye(3))
    # three robots: information 1/2 + 1/3 + 1/6 = 1
    np.testing.assert_allclose(fusion_gains([2.0, 3.0, 6.0]), [1 / 2, 1 / 3, 1 / 6])
    assert fused_variance([2.0, 3.0, 6.0]) == pytest.approx(1.0)


def test_gains_of_many_objects_sum_to_one_over_robots():
    rng = np.random.default_rng(1)
    gains = fusion_gains(rng.uniform(0, 5, size=(4, 7)))
    assert gains.shape == (4, 7)
    np.testing.assert_allclose(gains.sum(axis=0), 1.0)


def test_exact_and_unknown_variances_have_defined_gains():
    np.testing.assert_allclose(fusion_gains([0.0, 1.0]), [1, 0])
    np.testing.assert_allclose(fusion_gains([0.0, 0.0, 1.0]), [0.5, 0.5, 0])
    np.testing.assert_allclose(fusion_gains([np.inf, 1.0]), [0, 1])
    np.testing.assert_allclose(fusion_gains([np.inf, np.inf]), [0.5, 0.5])
    assert fused_variance([0.0, 1.0]) == 0
    assert fused_variance([np.inf, np.inf]) == np.inf
    fused = fuse_isotropic([[1.0, 1.0, 1.0], [3.0, 3.0, 3.0]], [np.inf, np.inf])
    np.testing.assert_allclose(fused.mean, 2.0)
    assert np.isinf(np.diag(fused.covariance)).all()


@pytest.mark.parametrize("bad", [[-1.0, 1.0], [np.nan, 1.0], []])
def test_bad_variances_raise(bad):
    with pytest.raises(ValueError, match="variances"):
        fusion_gains(bad)


def test_information_fusion_of_the_published_case():
    fused = fuse_gaussians([[1, 2, 3], [4, 5, 6]], [np.diag([4.0, 5, 6]), np.diag([7.0, 8, 9])])
    np.testing.assert_allclose(fused.mean, [2.0909, 3.1538, 4.2], atol=5e-5)
    np.testing.assert_allclose(fused.covariance, np.diag([2.5455, 3.0769, 3.6]), atol=5e-5)


def test_information_fusion_equals_isotropic_fusion_for_isotropic_covariances():
    rng = np.random.default_rng(2)
    x, u = rng.normal(size=(4, 3)), rng.uniform(0.5, 2, size=4)
    full = fuse_gaussians(x, u[:, None, None] * np.eye(3))
    plain = fuse_isotropic(x, u)
    np.testing.assert_allclose(full.mean, plain.mean)
    np.testing.assert_allclose(full.covariance, plain.covariance)


def test_fusion_is_the_same_in_any_frame():
    rng = np.random.default_rng(3)
    x, C = rng.normal(size=(3, 3)), np.stack([random_covariance(rng) for _ in range(3)])
    Q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    here, there = fuse_gaussians(x, C), fuse_gaussians(x @ Q.T, Q @ C @ Q.T)
    np.testing.assert_allclose(there.mean, Q @ here.mean)
    np.testing.assert_allclose(there.covariance, Q @ here.covariance @ Q.T)


def test_infinite_and_zero_variances_in_full_covariances():
    fused = fuse_gaussians([[1.0, 1, 1], [3.0, 3, 3]], [np.diag([1.0, np.inf, 0.0]), np.diag([1.0, 1.0, 1.0])])
    np.testing.assert_allclose(fused.mean, [2, 3, 1], atol=1e-9)
    np.testing.assert_allclose(np.diag(fused.covariance), [0.5, 1, 0], atol=1e-9)
    blind = fuse_gaussians([[1.0, 0], [2.0, 0]], [np.diag([1.0, np.inf])] * 2)
    assert blind.covariance[1, 1] == np.inf
    assert blind.mean[0] == pytest.approx(1.5)
    assert (information_matrix(np.diag([np.inf, np.inf])) == 0).all()


def test_covariance_intersection_with_equal_weights_has_its_closed_form():
    # Equal weights, as Stone Soup's merge_components takes them: P^-1 = (A^-1 + B^-1) / 2.
    fused = covariance_intersection(
        [[1, 2, 3], [4, 5, 6]], [np.diag([4.0, 5, 6]), np.diag([7.0, 8, 9])], weights=[0.5, 0.5]
    )
    np.testing.assert_allclose(np.diag(fused.covariance), [2 * 28 / 11, 2 * 40 / 13, 2 * 54 / 15])
    np.testing.assert_allclose(fused.mean, [23 / 11, 41 / 13, 63 / 15])


def test_covariance_intersection_agrees_with_stone_soup():
    pytest.importorskip("stonesoup", reason="stonesoup is not installed")
    from stonesoup.types.state import GaussianState

    try:
        from stonesoup.mixturereducer.gaussianmixture import CovarianceIntersection
    except ImportError:
        pytest.skip("this stonesoup has no CovarianceIntersection")
    rng = np.random.default_rng(4)
    x, C = rng.normal(size=(2, 3)), np.stack([random_covariance(rng), random_covariance(rng)])
    theirs = CovarianceIntersection.merge_components(*(GaussianState(m[:, None], c) for m, c in zip(x, C, strict=True)))
    ours = covariance_intersection(x, C, weights=[0.5, 0.5])
    np.testing.assert_allclose(ours.covariance, theirs.covar, rtol=1e-9)
    np.testing.assert_allclose(ours.mean, np.ravel(theirs.mean), rtol=1e-9)


@pytest.mark.parametrize("criterion", ["trace", "determinant"])
def test_optimised_intersection_beats_every_weight_of_a_grid(criterion):
    rng = np.random.default_rng(5)
    measure = np.trace if criterion == "trace" else np.linalg.det
    for _ in range(5):
        x, C = rng.normal(size=(2, 3)), np.stack([random_covariance(rng), random_covariance(rng)])
        best = measure(covariance_intersection(x, C, criterion=criterion).covariance)
        for a in np.linspace(0, 1, 41):
            fused = covariance_intersection(x, C, weights=[a, 1 - a])
            assert best <= measure(fused.covariance) * (1 + 1e-6)


def test_optimised_intersection_of_three_beats_random_weights():
    rng = np.random.default_rng(6)
    x, C = rng.normal(size=(3, 3)), np.stack([random_covariance(rng) for _ in range(3)])
    best = np.trace(covariance_intersection(x, C).covariance)
    for w in rng.dirichlet(np.ones(3), size=50):
        assert best <= np.trace(covariance_intersection(x, C, weights=w / w.sum()).covariance) * (1 + 1e-5)


def test_intersection_is_consistent_where_information_fusion_is_overconfident():
    rng = np.random.default_rng(7)
    C = np.stack([np.diag([1.0, 4.0]), np.diag([4.0, 1.0])])
    independent, intersected = [], []
    for _ in range(400):
        common = rng.normal(size=2)  # fully correlated errors
        x = np.stack([np.sqrt(np.diag(c)) * common for c in C])
        for fuse, into in ((fuse_gaussians, independent), (covariance_intersection, intersected)):
            estimate = fuse(x, C)
            into.append(estimate.mean @ np.linalg.solve(estimate.covariance, estimate.mean) / 2)
    assert np.mean(independent) > 1.3
    assert np.mean(intersected) < 1.05


def test_bad_intersection_arguments_raise():
    x, C = np.zeros((2, 2)), np.stack([np.eye(2)] * 2)
    with pytest.raises(ValueError, match="sum 1"):
        covariance_intersection(x, C, weights=[0.7, 0.7])
    with pytest.raises(ValueError, match="criterion"):
        covariance_intersection(x, C, criterion="area")
    with pytest.raises(ValueError, match="covariances must have shape"):
        fuse_gaussians(x, np.eye(2))


def test_fused_covariance_is_consistent_monte_carlo():
    rng = np.random.default_rng(8)
    C = np.stack([random_covariance(rng) for _ in range(3)])
    L = np.linalg.cholesky(C)
    values = []
    for _ in range(2000):
        fused = fuse_gaussians(np.einsum("nij,nj->ni", L, rng.normal(size=(3, 3))), C)
        values.append(fused.mean @ np.linalg.solve(fused.covariance, fused.mean) / 3)
    assert np.mean(values) == pytest.approx(1.0, abs=0.06)
