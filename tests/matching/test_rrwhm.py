"""RRWHM: the walk over triples."""

import numpy as np

from covis.matching.rrwhm import hypergraph_walk, triples


def test_hypergraph_walk_is_the_published_iteration_in_numpy(small, dense, reweighted_jump):
    source, target, _ = small(2)
    index, values = triples(source, target, 0.5, None)
    T = dense(index, values, 16)
    c, beta, steps = 0.2, 30.0, 6
    x = np.full(16, 1 / 16)
    for _ in range(steps):
        walk = np.einsum("abc,b,c->a", T, x, x)
        walk /= walk.sum()
        x = c * walk + (1 - c) * reweighted_jump(walk, beta, 9)
    found = hypergraph_walk(np.zeros(16), np.zeros((0, 0)), index, values, 4, 4, c, beta, steps, 9, 0.0, 0.0)
    np.testing.assert_allclose(found.ravel(), x, atol=1e-12)
