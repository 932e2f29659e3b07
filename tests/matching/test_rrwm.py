"""RRWM: the walk, its affinity by windows, and the optimum of its affinity."""

from itertools import permutations

import numpy as np
import pytest

from covis.matching import Matching, ObjectGraph, rrwm
from covis.matching.candidates import affinity_matrix, mean_agreement
from covis.matching.random_walk import (
    BLOCK,
    distance_affinity,
    multiply,
    reweighted_random_walk,
    sinkhorn,
)
from covis.matching.rrwm import distance_width
from covis.matching.similarity import distances, pair_affinity


def test_sinkhorn_makes_rows_and_columns_sum_to_one():
    X = np.random.default_rng(0).uniform(0.1, 1, (5, 5))
    sinkhorn(X, 200)
    np.testing.assert_allclose(X.sum(axis=0), 1, atol=1e-9)
    np.testing.assert_allclose(X.sum(axis=1), 1, atol=1e-9)


@pytest.mark.parametrize("shape", [(3, 5), (5, 3)])
def test_sinkhorn_with_slack_is_sinkhorn_of_the_padded_square(shape):
    X = np.random.default_rng(1).uniform(0.1, 1, shape)
    n, m = shape
    padded = np.full((5, 5), 0.2)
    padded[:n, :m] = X
    sinkhorn(padded, 30)
    sinkhorn(X, 30, 0.0, 0.2)
    np.testing.assert_allclose(X, padded[:n, :m], atol=1e-12)


def test_walk_is_the_published_iteration_in_numpy(small, reweighted_jump):
    source, target, _ = small(0)
    s, t = distances(source.positions), distances(target.positions)
    A = np.random.default_rng(0).uniform(size=(4, 4))
    K = pair_affinity(s, t, 0.5).reshape(16, 16) * A.ravel() * A.reshape(-1, 1) + np.diag(A.ravel())
    c, beta, steps = 0.2, 30.0, 7
    mixed = np.full(16, 1 / 16)
    for _ in range(steps):
        walk = K @ mixed
        walk /= walk.sum()
        mixed = c * walk + (1 - c) * reweighted_jump(walk, beta, 11)
    found = reweighted_random_walk(distance_affinity(s, t, 0.5, A, A), c, beta, steps, 11, 0.0, 0.0)
    np.testing.assert_allclose(found.ravel(), walk, rtol=1e-5, atol=1e-9)


@pytest.mark.parametrize("width", [1e-9, 0.3, 1e9])
@pytest.mark.parametrize("shape", [(7, 7), (4, 9), (9, 4), (1, 5), (5, 1), (2, 2), (1, 1)])
def test_affinity_by_windows_is_the_dense_one(shape, width):
    rng = np.random.default_rng(3)
    n, m = shape
    s, t = (distances(rng.uniform(-5, 5, (k, 3)).round(1)) for k in shape)
    a, diagonal = rng.uniform(size=(2, n, m))
    a[rng.uniform(size=(n, m)) < 0.3] = 0.0  # some have no class in common
    K = pair_affinity(s, t, width).reshape(n * m, n * m) * a.ravel() * a.reshape(-1, 1) + np.diag(diagonal.ravel())
    x = rng.uniform(size=(n, m))
    affinity = distance_affinity(s, t, width, a, diagonal)
    partners = np.full((n, 2, len(affinity.first)), np.nan, dtype=np.float32)
    np.testing.assert_allclose(multiply(affinity, x, partners).ravel(), K @ x.ravel(), rtol=1e-5)


def test_windows_leave_out_what_is_negligible():
    """Of 1,770 target distances, only those within reach of the one source distance, and what fills their blocks."""
    s = np.array([[0.0, 500.0], [500.0, 0.0]])
    t = distances(np.linspace(0, 1000, 60)[:, None] * [1.0, 0, 0])
    agreeing = (np.abs(t[np.triu_indices(60, 1)] - 500.0) <= np.sqrt(27.6 * 500.0)).sum()
    weight = np.ones((2, 60))
    entries = len(distance_affinity(s, t, 500.0, weight, weight).value)
    assert agreeing <= entries <= agreeing + 2 * BLOCK
    assert entries < 1770 / 3


def test_rrwm_reaches_the_optimum_of_its_affinity_on_small_problems(small, indicator):
    hits = 0
    for seed in range(30):
        source, target, _ = small(seed)
        K = affinity_matrix(source, target, distances(source.positions), distances(target.positions), 0.18, 1.0)
        best = max(indicator(m, 4) @ K @ indicator(m, 4) for m in permutations(range(4)))
        found = rrwm(source, target, distance_width_m2=0.18).pairs
        hits += indicator(found[:, 1], 4) @ K @ indicator(found[:, 1], 4) > best - 1e-9
    assert hits >= 26


def test_width_is_a_multiple_of_the_median_variance_of_a_candidate():
    rng = np.random.default_rng(1)
    source, target = (
        ObjectGraph.from_positions(rng.uniform(-5, 5, (n, 3)), position_variance=rng.uniform(0.1, 1, n)) for n in (3, 5)
    )
    s, t = distances(source.positions), distances(target.positions)
    U = source.position_variance[:, None] + target.position_variance
    assert distance_width(source, target, s, t, None, 3.0) == pytest.approx(3 * np.median(U))
    assert distance_width(source, target, s, t, 0.7, 3.0) == 0.7


def test_score_is_the_mean_affinity_with_the_other_matches():
    rng = np.random.default_rng(2)
    s, t = distances(rng.uniform(-1, 1, (4, 3))), distances(rng.uniform(-1, 1, (5, 3)))
    A = rng.uniform(size=(4, 5))
    K = pair_affinity(s, t, 0.5) * A[:, :, None, None] * A
    pairs = [(0, 3), (1, 1), (3, 0)]
    found = mean_agreement(Matching(np.array(pairs), np.ones(3)), s, t, 0.5, A)
    expected = [np.mean([K[i, ii, j, jj] for j, jj in pairs if j != i]) for i, ii in pairs]
    np.testing.assert_allclose(found.scores, expected)


def test_rrwm_weighs_attributes_as_it_is_told(as_list, misleading_kinds):
    source, moved, truth = misleading_kinds(5)
    assert as_list(rrwm(source, moved, distance_width_m2=0.1, attribute_weight=0)) == truth
    assert as_list(rrwm(source, moved, distance_width_m2=1e6, attribute_weight=3)) == [[i, i] for i in range(5)]
