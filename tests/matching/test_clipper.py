"""CLIPPER: consistency of candidates and their densest clique."""

from itertools import combinations

import numpy as np
import pytest

from covis.matching import ObjectGraph, clipper
from covis.matching.clipper import consistency, densest_clique
from covis.matching.similarity import distances
from covis.matching.testing import scene


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


def test_densest_clique_is_the_published_ascent(small):
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


def test_densest_clique_is_that_of_the_enumeration_on_small_problems(small):
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


def test_clipper_leaves_out_candidates_of_other_kinds(as_list):
    p = np.random.default_rng(5).uniform(-5, 5, (6, 3))
    kinds = np.tile([[1.0, 0.0], [0.0, 1.0]], (3, 1))
    other = kinds.copy()
    other[:2] = other[1::-1]  # the first two seem to have changed places
    source, target = (ObjectGraph.from_positions(p, attributes=k) for k in (kinds, other))
    assert as_list(clipper(source, target, min_similarity=0.5)) == [[i, i] for i in range(2, 6)]
    assert as_list(clipper(source, target, min_similarity=0.0)) == [[i, i] for i in range(6)]
