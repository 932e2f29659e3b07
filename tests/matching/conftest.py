"""Small problems and plain NumPy references that tests of several rivals share, as functions."""

from itertools import permutations

import numpy as np
import pytest

from covis.matching import ObjectGraph
from covis.matching.pose import rotation_from_vector


@pytest.fixture
def small():
    """Two views of the same n objects, one turned, shuffled and noisy, and the target of each source object."""

    def make(seed, n=4, noise=0.3):
        rng = np.random.default_rng(seed)
        p = rng.uniform(-5, 5, (n, 3))
        shuffle = rng.permutation(n)
        q = (p @ rotation_from_vector(np.array([0.3, -1.0, 0.8])).T + rng.normal(0, noise, p.shape))[shuffle]
        options = {"position_variance": noise**2}
        return ObjectGraph.from_positions(p, **options), ObjectGraph.from_positions(q, **options), np.argsort(shuffle)

    return make


@pytest.fixture
def misleading_kinds():
    """Graphs of n objects, one moved and in another order, with kinds that say otherwise, and the true matches."""

    def make(n):
        rng = np.random.default_rng(5)
        p, order = rng.uniform(-5, 5, (n, 3)), rng.permutation(n)
        kinds = 0.9 * np.eye(n) + 0.1 / n
        source, moved = (ObjectGraph.from_positions(x, attributes=kinds) for x in (p, p[order] + 1.0))
        return source, moved, sorted([int(i), k] for k, i in enumerate(order))

    return make


@pytest.fixture
def as_list():
    """The matches of a matching in order, as lists."""
    return lambda matching: sorted(matching.pairs.tolist())


@pytest.fixture
def indicator():
    """The vector x (n m,) in {0, 1} of the targets (n,) of all source objects, of m target objects."""

    def make(match, m):
        x = np.zeros((len(match), m))
        x[np.arange(len(match)), match] = 1
        return x.ravel()

    return make


@pytest.fixture
def dense():
    """The symmetric tensor (size, size, size) that a list of triples stands for."""

    def make(index, values, size):
        T = np.zeros((size, size, size))
        for (a, b, c), v in zip(index, values, strict=True):
            for order in permutations((a, b, c)):
                T[order] = v
        return T

    return make


@pytest.fixture
def reweighted_jump():
    """Cho, Lee and Lee's jump from visits (n n,): inflated, then rows and columns normalised in turn; of sum 1."""

    def jump(walk, beta, normalisations):
        n = round(len(walk) ** 0.5)
        X = np.exp(beta * walk / walk.max()).reshape(n, n)
        for _ in range(normalisations):
            X /= X.sum(axis=1, keepdims=True)
            X /= X.sum(axis=0, keepdims=True)
        return X.ravel() / X.sum()

    return jump
