"""Each rival against brute force or its defining property on small problems."""

from itertools import combinations, permutations

import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment

from covis.matching import Matching, ObjectGraph, RelativePose, bcagm, clipper, icp, mos, rrwhm, rrwm
from covis.matching.bcagm import block_ascent, convexity_bound, lifted_gradient
from covis.matching.candidates import affinity_matrix, mean_agreement
from covis.matching.clipper import consistency, densest_clique
from covis.matching.icp import _starts, align, rigid, spread_rotations
from covis.matching.pose import rotation_from_vector
from covis.matching.random_walk import BLOCK, distance_affinity, multiply, reweighted_random_walk, sinkhorn
from covis.matching.rrwhm import hypergraph_walk, triples
from covis.matching.rrwm import distance_width
from covis.matching.similarity import (
    attribute_similarity,
    contract,
    distances,
    nearest_triples,
    pair_affinity,
    triangle_distance,
    triangle_radius,
    vertex_cosines,
)
from covis.matching.testing import scene


def small(seed, n=4, noise=0.3):
    rng = np.random.default_rng(seed)
    p = rng.uniform(-5, 5, (n, 3))
    shuffle = rng.permutation(n)
    q = (p @ rotation_from_vector(np.array([0.3, -1.0, 0.8])).T + rng.normal(0, noise, p.shape))[shuffle]
    options = {"position_variance": noise**2}
    return ObjectGraph.from_positions(p, **options), ObjectGraph.from_positions(q, **options), np.argsort(shuffle)


def dense(index, values, size):
    """The symmetric tensor (size, size, size) that a list of triples stands for."""
    T = np.zeros((size, size, size))
    for (a, b, c), v in zip(index, values, strict=True):
        for order in permutations((a, b, c)):
            T[order] = v
    return T


def indicator(match, m):
    x = np.zeros((len(match), m))
    x[np.arange(len(match)), match] = 1
    return x.ravel()


# RRWM


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


def test_walk_is_the_published_iteration_in_numpy():
    source, target, _ = small(0)
    s, t = distances(source.positions), distances(target.positions)
    A = np.random.default_rng(0).uniform(size=(4, 4))
    K = pair_affinity(s, t, 0.5).reshape(16, 16) * A.ravel() * A.reshape(-1, 1) + np.diag(A.ravel())
    c, beta, steps = 0.2, 30.0, 7
    mixed = np.full(16, 1 / 16)
    for _ in range(steps):
        walk = K @ mixed
        walk /= walk.sum()
        jump = np.exp(beta * walk / walk.max()).reshape(4, 4)
        for _ in range(11):
            jump /= jump.sum(axis=1, keepdims=True)
            jump /= jump.sum(axis=0, keepdims=True)
        mixed = c * walk + (1 - c) * jump.ravel() / jump.sum()
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


def test_rrwm_reaches_the_optimum_of_its_affinity_on_small_problems():
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


def test_rrwm_weighs_attributes_as_it_is_told():
    source, moved, truth = misleading_kinds(5)
    assert as_list(rrwm(source, moved, distance_width_m2=0.1, attribute_weight=0)) == truth
    assert as_list(rrwm(source, moved, distance_width_m2=1e6, attribute_weight=3)) == [[i, i] for i in range(5)]


# Triples


def test_nearest_triples_are_those_within_the_radius():
    rng = np.random.default_rng(2)
    c, d = vertex_cosines(rng.normal(size=(4, 3))), vertex_cosines(rng.normal(size=(5, 3)))
    index, distance = nearest_triples(c, d, 7, False)
    radius = triangle_radius(c, d, 7, False)
    kept = {tuple(row) for row in index.tolist()}
    for i, j, k in combinations(range(4), 3):
        for x, y, z in permutations(range(5), 3):
            near = triangle_distance(c, i, j, k, d, x, y, z, False) <= radius[i, j, k]
            assert near == ((i * 5 + x, j * 5 + y, k * 5 + z) in kept)
    for (a, b, e), far in zip(index, distance, strict=True):
        (i, x), (j, y), (k, z) = divmod(a, 5), divmod(b, 5), divmod(e, 5)
        assert far == pytest.approx(triangle_distance(c, i, j, k, d, x, y, z, False))
        assert far <= radius[i, j, k]


@pytest.mark.parametrize("width", [None, 0.4])
def test_triples_are_weighted_by_their_distance(width):
    source, target, _ = small(5)
    c, d = vertex_cosines(source.positions), vertex_cosines(target.positions)
    index, distance = nearest_triples(c, d, 8, False)
    found, values = triples(source, target, 0.5, width)
    assert (found == index).all()
    np.testing.assert_allclose(values, np.exp(-distance / (distance.mean() if width is None else width)))


def test_contract_is_the_tensor_product():
    source, target, _ = small(3)
    index, values = triples(source, target, 0.5, None)
    T = dense(index, values, 16)
    x, y = np.random.default_rng(0).uniform(size=(2, 16))
    np.testing.assert_allclose(contract(index, values, x, y), np.einsum("abc,b,c->a", T, x, y), atol=1e-12)


def test_hypergraph_walk_is_the_published_iteration_in_numpy():
    source, target, _ = small(2)
    index, values = triples(source, target, 0.5, None)
    T = dense(index, values, 16)
    c, beta, steps = 0.2, 30.0, 6
    x = np.full(16, 1 / 16)
    for _ in range(steps):
        walk = np.einsum("abc,b,c->a", T, x, x)
        walk /= walk.sum()
        jump = np.exp(beta * walk / walk.max()).reshape(4, 4)
        for _ in range(9):
            jump /= jump.sum(axis=1, keepdims=True)
            jump /= jump.sum(axis=0, keepdims=True)
        x = c * walk + (1 - c) * jump.ravel() / jump.sum()
    found = hypergraph_walk(np.zeros(16), np.zeros((0, 0)), index, values, 4, 4, c, beta, steps, 9, 0.0, 0.0)
    np.testing.assert_allclose(found.ravel(), x, atol=1e-12)


@pytest.mark.parametrize("matcher", [rrwhm, bcagm])
def test_hypergraph_methods_reach_the_optimum_of_the_tensor_on_small_problems(matcher):
    ratios = []
    for seed in range(30):
        source, target, _ = small(seed)
        index, values = triples(source, target, 1.0, None)
        T = dense(index, values, 16)

        def score(match, T=T):
            x = indicator(match, 4)
            return np.einsum("abc,a,b,c", T, x, x, x)

        best = max(score(m) for m in permutations(range(4)))
        found = matcher(source, target, neighbours_factor=1.0, angle_width=None).pairs
        ratios.append(score(found[:, 1]) / best)
    assert np.mean(np.array(ratios) > 1 - 1e-9) >= 0.85
    assert np.mean(ratios) > 0.95


def test_lifted_form_agrees_with_its_gradient_and_ascent_never_loses_to_its_start():
    source, target, _ = small(4)
    index, values = triples(source, target, 1.0, None)
    T = dense(index, values, 16)
    rng = np.random.default_rng(1)
    x, y, z, t = rng.uniform(size=(4, 16))
    alpha = 0.7

    def form(x):
        F = sum(np.einsum("abc,a,b,c", T, *three) for three in ((x, y, z), (x, y, t), (x, z, t)))
        return F + alpha * ((x @ y) * (z @ t) + (x @ z) * (y @ t) + (x @ t) * (y @ z))

    np.testing.assert_allclose(x @ lifted_gradient(index, values, y, z, t, alpha), form(x), rtol=1e-12)
    best = block_ascent(index, values, 4, 4, 50)
    assert best.reshape(4, 4).sum(axis=0).tolist() == [1, 1, 1, 1]
    start = np.full(16, 0.25)
    assert best @ contract(index, values, best, best) >= start @ contract(index, values, start, start)


@pytest.mark.parametrize("shape", [(4, 4), (3, 6), (6, 3)])
def test_lifted_form_is_convex_at_the_bound_and_only_there(shape):
    n, m = shape
    rng = np.random.default_rng(n)
    source, target = (ObjectGraph.from_positions(rng.uniform(-5, 5, (k, 3))) for k in shape)
    index, values = triples(source, target, 1.0, None)

    def least_curvature(x, alpha):
        unit = np.eye(n * m)
        hessian = np.array([lifted_gradient(index, values, x, x, e, alpha) for e in unit])
        return np.linalg.eigvalsh(hessian).min()

    bound = convexity_bound(values, min(n, m))
    for x in rng.uniform(size=(20, n * m)):
        assert least_curvature(x, bound) >= 0 > least_curvature(x, 0.0)


def test_bcagm_scores_are_parts_of_the_third_order_score():
    source, target, _ = small(6)
    found = bcagm(source, target, neighbours_factor=1.0)
    T = dense(*triples(source, target, 1.0, 0.3), 16)
    x = indicator(found.pairs[np.argsort(found.pairs[:, 0]), 1], 4)
    part = np.einsum("abc,b,c->a", T, x, x).reshape(4, 4)[tuple(found.pairs.T)]
    np.testing.assert_allclose(found.scores, part / part.max())


# MOS


def misleading_kinds(n):
    """Graphs of n objects, one moved and in another order, with kinds that say otherwise, and the true matches."""
    rng = np.random.default_rng(5)
    p, order = rng.uniform(-5, 5, (n, 3)), rng.permutation(n)
    kinds = 0.9 * np.eye(n) + 0.1 / n
    source, moved = (ObjectGraph.from_positions(x, attributes=kinds) for x in (p, p[order] + 1.0))
    return source, moved, sorted([int(i), k] for k, i in enumerate(order))


def test_mos_uses_every_order():
    source, moved, truth = misleading_kinds(5)
    assert truth != [[i, i] for i in range(5)]
    assert as_list(mos(source, moved, order_weights=(1, 0, 0))) == [[i, i] for i in range(5)]
    assert as_list(mos(source, moved, order_weights=(0, 1, 0), distance_width_m2=0.1)) == truth
    assert as_list(mos(source, moved, order_weights=(0, 0, 1), angle_width=0.1)) == truth
    with pytest.raises(ValueError, match="order_weights must be three"):
        mos(source, moved, order_weights=(0, 0, 0))


def test_mos_is_the_published_walk_over_three_orders_in_numpy():
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
        jump = np.exp(30.0 * walk / walk.max()).reshape(4, 4)
        for _ in range(9):
            jump /= jump.sum(axis=1, keepdims=True)
            jump /= jump.sum(axis=0, keepdims=True)
        x = 0.2 * walk + 0.8 * jump.ravel() / jump.sum()
    found = mos(
        source, target, order_weights=weights, attribute_exponent=2.0, distance_width_m2=3.0, angle_width=0.5,
        neighbours_factor=0.8, iterations=6, sinkhorn_iterations=9, tolerance=0.0, sinkhorn_tolerance=0.0,
    )  # fmt: skip
    rows, cols = linear_sum_assignment(x.reshape(4, 4), maximize=True)
    assert as_list(found) == np.stack([rows, cols], axis=1).tolist()
    np.testing.assert_allclose(found.scores, x.reshape(4, 4)[tuple(found.pairs.T)] / x.max(), rtol=1e-9)


def test_mos_reaches_the_optimum_of_its_three_orders_on_small_problems():
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


def as_list(matching):
    return sorted(matching.pairs.tolist())


# CLIPPER


def test_consistency_is_zero_for_conflicts_and_beyond_epsilon():
    s = distances(np.array([[0.0, 0, 0], [1, 0, 0], [5, 0, 0]]))
    candidates = np.argwhere(np.ones((3, 3)))
    M = consistency(s, s, candidates, 0.2, 0.6, 0.0)
    assert (M == M.T).all()
    assert (np.diag(M) == 1).all()
    assert M[0, 1] == 0  # shares source object 0
    assert M[0, 4] == 1  # (0, 0) and (1, 1)
    assert M[0, 5] == 0  # distance 1 against 5
    close = consistency(s, s * 1.3, candidates, 0.2, 0.6, 0.0)
    assert close[0, 4] == pytest.approx(np.exp(-0.5 * 0.3**2 / 0.2**2))
    assert consistency(s, s, candidates, 0.2, 0.6, 2.0)[0, 4] == 0  # closer than the least distance


def published_clique(M, outer_iterations=1000, inner_iterations=200):
    """Lusk, Fathian and How's projected gradient ascent with a homotopy in d, in dense matrices."""
    conflict = (M == 0).astype(float)
    u = M @ np.ones(len(M))
    u /= np.linalg.norm(u)

    def ratios():
        violated = (conflict @ u > 1e-9) & (u > 1e-9)
        return (M @ u)[violated] / (conflict @ u)[violated]

    d = ratios().mean() if len(ratios()) else 0.0
    for _ in range(outer_iterations):
        M_d = M - d * conflict
        for _ in range(inner_iterations):
            before, step = u, 1.0
            while True:
                u = np.maximum(before + step * (M_d @ before), 0)
                u /= np.linalg.norm(u)
                change = u @ M_d @ u - before @ M_d @ before
                if change >= -1e-9:
                    break
                step *= 0.25
            if np.linalg.norm(u - before) < 1e-8 or abs(change) < 1e-9:
                break
        if len(ratios()) == 0:
            break
        d += ratios().mean()
    return sorted(np.argsort(-u)[: round(u @ M_d @ u)].tolist())


def test_densest_clique_is_the_published_ascent():
    rng = np.random.default_rng(4)
    same = 0
    for _ in range(30):
        source, target, _ = small(int(rng.integers(1000)), n=5, noise=0.5)
        s, t = distances(source.positions), distances(target.positions)
        M = consistency(s, t, np.argwhere(np.ones((5, 5))), 0.5, 1.5, 0.0)
        expected = published_clique(M)
        # The published rounding may take candidates that contradict each other; ours passes over them.
        among = M[np.ix_(expected, expected)]
        if (among > 0).all():
            assert sorted(densest_clique(M).tolist()) == expected
            same += 1
    assert same >= 20


def test_densest_clique_is_that_of_the_enumeration_on_small_problems():
    """u^T M u over cliques is at most the first eigenvalue of a clique's block; rounding keeps that many members."""
    hits = 0
    for seed in range(40):
        source, target, _ = small(seed)
        s, t = distances(source.positions), distances(target.positions)
        M = consistency(s, t, np.argwhere(np.ones((4, 4))), 0.6, 1.8, 0.0)
        density = {
            members: np.linalg.eigvalsh(M[np.ix_(members, members)])[-1]
            for size in range(1, 5)
            for members in combinations(range(16), size)
            if (M[np.ix_(members, members)] > 0).all()
        }
        best = max(density, key=density.get)
        found = densest_clique(M).tolist()
        hits += set(found) <= set(best) and len(found) == round(density[best])
    assert hits >= 34


def test_densest_clique_of_a_planted_clique():
    rng = np.random.default_rng(0)
    hits = 0
    for _ in range(20):
        A = np.triu(rng.uniform(size=(30, 30)) < 0.15, 1).astype(float)
        planted = rng.permutation(30)[:8]
        A[np.ix_(planted, planted)] = 1.0
        M = np.triu(A, 1)
        M = M + M.T + np.eye(30)
        hits += set(densest_clique(M).tolist()) == set(planted.tolist())
    assert hits >= 18


def test_clipper_returns_a_clique():
    problem = scene(np.random.default_rng(3))
    found = clipper(problem.source, problem.target, sigma_m=0.05)
    s, t = distances(problem.source.positions), distances(problem.target.positions)
    difference = s[np.ix_(found.pairs[:, 0], found.pairs[:, 0])] - t[np.ix_(found.pairs[:, 1], found.pairs[:, 1])]
    assert len(found) >= 5
    assert np.abs(difference).max() < 0.3


def test_clipper_scores_are_mean_consistencies_under_widths_from_the_variances():
    rng = np.random.default_rng(4)
    p = rng.uniform(-5, 5, (6, 3))
    source = ObjectGraph.from_positions(p, position_variance=0.03)
    target = ObjectGraph.from_positions(p + rng.normal(0, 0.1, p.shape), position_variance=0.05)
    found = clipper(source, target, sigma_factor=2.0, epsilon_sigmas=4.0)
    sigma = 2 * np.sqrt(0.08)
    s, t = (distances(g.positions[k]) for g, k in zip((source, target), found.pairs.T, strict=True))
    agreement = np.exp(-0.5 * (s - t) ** 2 / sigma**2)
    assert len(found) >= 4
    assert np.abs(s - t).max() < 4 * sigma
    np.testing.assert_allclose(found.scores, (agreement.sum(axis=1) - 1) / (len(found) - 1))


def test_clipper_leaves_out_candidates_of_other_kinds():
    p = np.random.default_rng(5).uniform(-5, 5, (6, 3))
    kinds = np.tile([[1.0, 0.0], [0.0, 1.0]], (3, 1))
    other = kinds.copy()
    other[:2] = other[1::-1]  # the first two seem to have changed places
    source, target = (ObjectGraph.from_positions(p, attributes=k) for k in (kinds, other))
    assert as_list(clipper(source, target, min_similarity=0.5)) == [[i, i] for i in range(2, 6)]
    assert as_list(clipper(source, target, min_similarity=0.0)) == [[i, i] for i in range(6)]


# ICP


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
def test_icp_aligns_views_that_overlap_throughout(translations):
    source, target, truth = small(7, n=8, noise=0.02)
    found = icp(source, target, translations=translations, restarts=200, gate_m=0.5)
    assert (truth[found.pairs[:, 0]] == found.pairs[:, 1]).all()
    assert len(found) == 8


def test_icp_finds_the_alignment_of_least_error_on_small_problems():
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


def test_icp_matches_each_others_closest_within_the_gate_scored_by_distance():
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


# Limits and bad options


@pytest.mark.parametrize(("matcher", "n"), [(rrwm, 71), (clipper, 71), (rrwhm, 33), (mos, 33), (bcagm, 33), (icp, 33)])
def test_too_many_objects_are_refused_with_the_numbers(matcher, n):
    graph = ObjectGraph.from_positions(np.random.default_rng(0).normal(size=(n, 3)))
    with pytest.raises(ValueError, match=f"accepts at most .* candidate matches .* got {n} x {n}"):
        matcher(graph, graph)


@pytest.mark.parametrize(
    ("matcher", "options", "message"),
    [
        (rrwm, {"walk_weight": 1.5}, "walk_weight must lie in"),
        (rrwm, {"iterations": 0}, "iterations must be at least 1"),
        (rrwm, {"distance_width_m2": 0.0}, "distance width must be positive, got 0"),
        (rrwhm, {"neighbours_factor": 0.0}, "neighbours_factor must be positive"),
        (rrwhm, {"angle_width": -1.0}, "angle_width must be positive"),
        (bcagm, {"iterations": 0}, "iterations must be at least 1"),
        (clipper, {"sigma_m": -1.0}, "sigma_m and epsilon_m must be positive"),
        (clipper, {"min_similarity": 2.0}, "min_similarity must lie in"),
        (icp, {"restarts": 0}, "restarts and iterations must be at least 1"),
        (icp, {"translations": "none"}, "translations must be"),
        (icp, {"gate_m": 0.0}, "the gate must be positive"),
        (icp, {"gate_shrink": 1.0}, "gate_shrink must lie in"),
    ],
)
def test_bad_options_name_the_value(matcher, options, message):
    graph = ObjectGraph.from_positions(np.random.default_rng(0).normal(size=(4, 3)))
    with pytest.raises(ValueError, match=message):
        matcher(graph, graph, **options)
