"""Sparse third-order similarity, which `rrwhm`, `bcagm` and `mos` share."""

from itertools import combinations, permutations

import numpy as np
import pytest

from covis.matching import bcagm, rrwhm
from covis.matching.rrwhm import triples
from covis.matching.similarity import (
    contract,
    nearest_triples,
    triangle_distance,
    triangle_radius,
    vertex_cosines,
)


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
def test_triples_are_weighted_by_their_distance(width, small):
    source, target, _ = small(5)
    c, d = vertex_cosines(source.positions), vertex_cosines(target.positions)
    index, distance = nearest_triples(c, d, 8, False)
    found, values = triples(source, target, 0.5, width)
    assert (found == index).all()
    np.testing.assert_allclose(values, np.exp(-distance / (distance.mean() if width is None else width)))


def test_contract_is_the_tensor_product(small, dense):
    source, target, _ = small(3)
    index, values = triples(source, target, 0.5, None)
    T = dense(index, values, 16)
    x, y = np.random.default_rng(0).uniform(size=(2, 16))
    np.testing.assert_allclose(contract(index, values, x, y), np.einsum("abc,b,c->a", T, x, y), atol=1e-12)


@pytest.mark.parametrize("matcher", [rrwhm, bcagm])
def test_hypergraph_methods_reach_the_optimum_of_the_tensor_on_small_problems(matcher, small, dense, indicator):
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
