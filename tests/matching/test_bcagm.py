"""BCAGM: the lifted form, its ascent and what convexifies it."""

import numpy as np
import pytest

from covis.matching import ObjectGraph, bcagm
from covis.matching.bcagm import block_ascent, convexity_bound, lifted_gradient
from covis.matching.rrwhm import triples
from covis.matching.similarity import contract


def test_lifted_form_agrees_with_its_gradient_and_ascent_never_loses_to_its_start(small, dense):
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


def test_bcagm_scores_are_parts_of_the_third_order_score(small, dense, indicator):
    source, target, _ = small(6)
    found = bcagm(source, target, neighbours_factor=1.0)
    T = dense(*triples(source, target, 1.0, 0.3), 16)
    x = indicator(found.pairs[np.argsort(found.pairs[:, 0]), 1], 4)
    part = np.einsum("abc,b,c->a", T, x, x).reshape(4, 4)[tuple(found.pairs.T)]
    np.testing.assert_allclose(found.scores, part / part.max())
