"""MOS: attributes, distances and angles in one walk."""

from itertools import permutations

import numpy as np
from scipy.optimize import linear_sum_assignment

from covis.matching import ObjectGraph, mos
from covis.matching.candidates import affinity_matrix
from covis.matching.rrwhm import triples
from covis.matching.similarity import attribute_similarity, distances, pair_affinity


def test_mos_uses_every_order(as_list, misleading_kinds):
    source, moved, truth = misleading_kinds(5)
    assert truth != [[i, i] for i in range(5)]
    assert as_list(mos(source, moved, order_weights=(1, 0, 0))) == [[i, i] for i in range(5)]
    assert as_list(mos(source, moved, order_weights=(0, 1, 0), distance_width_m2=0.1)) == truth
    assert as_list(mos(source, moved, order_weights=(0, 0, 1), angle_width=0.1)) == truth


def test_mos_is_the_published_walk_over_three_orders_in_numpy(dense, as_list, reweighted_jump):
    rng = np.random.default_rng(9)
    source, target = (
        ObjectGraph.from_positions(rng.uniform(-5, 5, (n, 3)), attributes=rng.dirichlet(np.ones(3), n)) for n in (4, 4)
    )
    weights, u = (0.7, 1.3, 0.4), np.full(16, 1 / 16)
    first = (attribute_similarity(source.attributes, target.attributes) ** 2).ravel()
    second = pair_affinity(distances(source.positions), distances(target.positions), 3.0).reshape(16, 16)
    third = dense(*triples(source, target, 0.8, 0.5), 16)
    first *= weights[0] / first.max()
    second *= weights[1] / (second @ u).max()
    third *= weights[2] / np.einsum("abc,b,c->a", third, u, u).max()
    x = u
    for _ in range(6):
        walk = first * x.sum() ** 2 + second @ x * x.sum() + np.einsum("abc,b,c->a", third, x, x)
        walk /= walk.sum()
        x = 0.2 * walk + 0.8 * reweighted_jump(walk, 30.0, 9)
    found = mos(
        source, target, order_weights=weights, attribute_exponent=2.0, distance_width_m2=3.0, angle_width=0.5,
        neighbours_factor=0.8, iterations=6, sinkhorn_iterations=9, tolerance=0.0, sinkhorn_tolerance=0.0,
    )  # fmt: skip
    rows, cols = linear_sum_assignment(x.reshape(4, 4), maximize=True)
    assert as_list(found) == np.stack([rows, cols], axis=1).tolist()
    np.testing.assert_allclose(found.scores, x.reshape(4, 4)[tuple(found.pairs.T)] / x.max(), rtol=1e-9)


def test_mos_reaches_the_optimum_of_its_three_orders_on_small_problems(small, dense, indicator):
    """The largest sum of first, second and third order, each normalised by its largest degree and weighted."""
    ratios = []
    for seed in range(30):
        source, target, _ = small(seed)
        K = affinity_matrix(source, target, distances(source.positions), distances(target.positions), 0.18, 0.0)
        T = dense(*triples(source, target, 1.0, None), 16)
        u = np.full(16, 1 / 16)
        third = T / np.einsum("abc,b,c", T, u, u).max()

        def score(match, K=K, third=third, u=u):
            x = indicator(match, 4)
            return x.sum() + x @ K @ x / (K @ u).max() + 0.3 * np.einsum("abc,a,b,c", third, x, x, x)

        best = max(score(m) for m in permutations(range(4)))
        found = mos(source, target, distance_width_m2=0.18).pairs
        ratios.append(score(found[:, 1]) / best)
    assert np.mean(np.array(ratios) > 1 - 1e-9) >= 0.8
    assert np.mean(ratios) > 0.95
