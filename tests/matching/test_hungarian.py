"""Gated assignment under a prior."""

import itertools

import numpy as np
import pytest

from covis.matching import ObjectGraph, PriorRequiredError, RelativePose, hungarian
from covis.matching.pose import exp_se3, invert, transform


def test_needs_a_prior():
    g = ObjectGraph.from_positions(np.eye(3))
    with pytest.raises(PriorRequiredError, match="relative pose"):
        hungarian(g, g)


def test_finds_the_same_points_through_a_pose():
    rng = np.random.default_rng(0)
    T = exp_se3(np.array([5.0, -3, 1, 0.2, 0.1, 2.0]))
    world = rng.uniform(-20, 20, (8, 3))
    order = rng.permutation(8)
    source = ObjectGraph.from_positions(world)
    target = ObjectGraph.from_positions(transform(invert(T), world)[order])
    matching = hungarian(source, target, prior=RelativePose(T, 1e-6 * np.eye(6)), gate_m=1.0)
    assert sorted(map(tuple, matching.pairs.tolist())) == sorted((int(i), k) for k, i in enumerate(order))
    np.testing.assert_allclose(matching.scores, 1.0, atol=1e-6)


def test_prefers_more_pairs_inside_the_gate_then_least_distance():
    """Against brute force over all partial assignments."""
    rng = np.random.default_rng(1)
    for _ in range(20):
        a, b = rng.uniform(0, 6, (4, 3)), rng.uniform(0, 6, (3, 3))
        matching = hungarian(
            ObjectGraph.from_positions(a),
            ObjectGraph.from_positions(b),
            prior=RelativePose(np.eye(4), np.eye(6)),
            gate_m=3.0,
        )
        distance = np.linalg.norm(a[:, None] - b[None], axis=2)
        best = (0, 0.0)
        for rows in itertools.permutations(range(4), 3):
            inside = [distance[i, j] for j, i in enumerate(rows) if distance[i, j] <= 3.0]
            best = max(best, (len(inside), -sum(inside)))
        total = sum(distance[i, j] for i, j in matching.pairs)
        assert (len(matching), -total) == pytest.approx(best)
        np.testing.assert_allclose(matching.scores, 1 - distance[tuple(matching.pairs.T)] / 3.0)


def test_gate_must_be_positive():
    g = ObjectGraph.from_positions(np.eye(3))
    with pytest.raises(ValueError, match=r"gate_m must lie in \(0, inf\), got 0"):
        hungarian(g, g, prior=RelativePose(np.eye(4), np.eye(6)), gate_m=0)
