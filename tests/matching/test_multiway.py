"""Cycle consistency over N robots: exact on small problems, repairs noise, never breaks one-to-one."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest

from covis.matching import Matching
from covis.matching.metrics import count, pooled
from covis.matching.multiway import _affinity, _joint_groups, consistent, groups, is_consistent


def world(rng, robots=5, objects=12, seen=0.7, wrong=0.0, missing=0.0):
    """Identities per robot, and pairwise matchings of which a share is missing or wrong."""
    identity = [rng.permutation(np.flatnonzero(rng.random(objects) < seen)) for _ in range(robots)]
    matchings = {}
    for i, j in combinations(range(robots), 2):
        pairs = [(a, b) for a, x in enumerate(identity[i]) for b, y in enumerate(identity[j]) if x == y]
        pairs = [p for p in pairs if rng.random() >= missing]
        scores = [rng.uniform(0.7, 0.99) for _ in pairs]
        for k in range(len(pairs)):
            if rng.random() < wrong:
                free = sorted(set(range(len(identity[j]))) - {b for _, b in pairs})
                if free:
                    pairs[k] = (pairs[k][0], int(rng.choice(free)))
                    scores[k] = rng.uniform(0.4, 0.8)
        matchings[i, j] = Matching(np.array(pairs, dtype=np.int64).reshape(-1, 2), np.array(scores))
    return identity, matchings


def f1(matchings, identity):
    return pooled([count(m, identity[i], identity[j]) for (i, j), m in matchings.items()]).f1


@pytest.mark.parametrize("method", ["joint", "spectral"])
def test_consistent_input_stays(method):
    identity, matchings = world(np.random.default_rng(0))
    sizes = [len(x) for x in identity]
    assert is_consistent(matchings, sizes)
    out = consistent(matchings, sizes, method=method)
    for pair, matching in matchings.items():
        assert {tuple(p) for p in out[pair].pairs.tolist()} == {tuple(p) for p in matching.pairs.tolist()}
    labels = groups(matchings, sizes, method=method)
    for (i, x), (j, y) in combinations(enumerate(identity), 2):
        np.testing.assert_array_equal(labels[i][:, None] == labels[j][None], x[:, None] == y[None])


@pytest.mark.parametrize(("method", "gain"), [("joint", 0.03), ("spectral", 0.0)])
def test_noise_is_repaired(method, gain):
    rng = np.random.default_rng(1)
    before, after = [], []
    for _ in range(10):
        identity, matchings = world(rng, wrong=0.15, missing=0.15)
        sizes = [len(x) for x in identity]
        out = consistent(matchings, sizes, method=method)
        assert is_consistent(out, sizes)
        before.append(f1(matchings, identity))
        after.append(f1(out, identity))
        for matching in out.values():
            assert ((matching.scores >= 0) & (matching.scores <= 1)).all()
    assert np.mean(after) > np.mean(before) + gain


def test_a_missing_match_is_closed_over_the_third_robot_and_scored_by_it():
    one = np.array([[0, 0]])
    matchings = {(0, 1): Matching(one, [0.9]), (1, 2): Matching(one, [0.8]), (0, 2): Matching.empty()}
    out = consistent(matchings, [1, 1, 1])
    np.testing.assert_array_equal(out[0, 2].pairs, one)
    np.testing.assert_allclose(out[0, 2].scores, [0.72])
    np.testing.assert_allclose(out[0, 1].scores, [0.9])
    assert not is_consistent(matchings, [1, 1, 1])
    full = {**matchings, (0, 2): Matching(one, [0.5])}
    np.testing.assert_allclose(consistent(full, [1, 1, 1])[0, 2].scores, [1 - 0.5 * (1 - 0.72)])


def partitions(items):
    if not items:
        yield []
        return
    first, rest = items[0], items[1:]
    for smaller in partitions(rest):
        for k in range(len(smaller)):
            yield [*smaller[:k], [first, *smaller[k]], *smaller[k + 1 :]]
        yield [[first], *smaller]


def test_joint_groups_reach_the_enumerated_optimum():
    rng = np.random.default_rng(2)
    sizes = [2, 2, 3]
    robot = np.repeat(np.arange(3), sizes)
    reached = 0
    for _ in range(20):
        _, matchings = world(rng, robots=3, objects=3, seen=1.0, wrong=0.4, missing=0.2)
        matchings = {(i, j): Matching(*_cut(m, sizes[i], sizes[j])) for (i, j), m in matchings.items()}
        L = _affinity(matchings, sizes, 0.4)

        def value(parts, L=L):
            return sum(L[np.ix_(p, p)].sum() / 2 for p in parts)

        legal = [p for p in partitions(list(range(7))) if all(len(set(robot[q])) == len(q) for q in p)]
        best = max(value(p) for p in legal)
        labels = _joint_groups(L, sizes)
        got = value([np.flatnonzero(labels == x) for x in np.unique(labels)])
        assert got <= best + 1e-9
        reached += got >= best - 1e-9
    assert reached >= 18


def _cut(matching, n, m):
    keep = (matching.pairs[:, 0] < n) & (matching.pairs[:, 1] < m)
    return matching.pairs[keep], matching.scores[keep]


@pytest.mark.parametrize("method", ["joint", "spectral"])
def test_degenerate(method):
    assert consistent({}, [], method=method) == {}
    assert groups({}, [2, 1], method=method)[0].tolist() == [0, 1]
    out = consistent({(0, 1): Matching.empty(), (1, 0): Matching.empty()}, [0, 3], method=method)
    assert all(len(m) == 0 for m in out.values())
    reversed_pair = consistent({(1, 0): Matching(np.array([[2, 0]]), [0.9])}, [1, 3], method=method)
    assert reversed_pair[1, 0].pairs.tolist() == [[2, 0]]


def test_bad_input_raises():
    with pytest.raises(ValueError, match="two of 2 robots"):
        groups({(0, 2): Matching.empty()}, [1, 1])
    with pytest.raises(ValueError, match="beyond"):
        groups({(0, 1): Matching(np.array([[0, 1]]), [0.5])}, [1, 1])
    with pytest.raises(ValueError, match="method"):
        groups({}, [1, 1], method="magic")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="match_prior"):
        groups({}, [1], match_prior=1.0)
