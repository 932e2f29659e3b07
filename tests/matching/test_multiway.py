"""Cycle consistency over N robots: exact on small problems, repairs noise, never breaks one-to-one."""

from __future__ import annotations

import re
from itertools import combinations

import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment

from covis.matching import Matching, multiway_convex
from covis.matching.metrics import count, pooled
from covis.matching.multiway import _affinity, _joint_groups, consistent, groups, is_consistent
from covis.matching.multiway_convex import relaxed

METHODS = ("joint", "convex", "spectral")


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


def some_matchings(rng, sizes):
    """One-to-one matchings of each two robots, drawn without regard to one another."""
    out = {}
    for i, j in combinations(range(len(sizes)), 2):
        k = int(rng.integers(1, min(sizes[i], sizes[j]) + 1))
        pairs = np.stack([rng.permutation(sizes[i])[:k], rng.permutation(sizes[j])[:k]], axis=1)
        out[i, j] = Matching(pairs, rng.uniform(0.3, 0.99, k))
    return out


def log_odds(matchings, sizes):
    """Robot of each detection, and log odds between robots; those within a robot do not count."""
    robot = np.repeat(np.arange(len(sizes)), sizes)
    return robot, np.where(robot[:, None] == robot[None], 0.0, _affinity(matchings, sizes, 0.4))


def value(L, labels):
    """Sum of log odds within groups."""
    flat = np.concatenate(labels)
    return L[flat[:, None] == flat[None]].sum() / 2


def f1(matchings, identity):
    return pooled([count(m, identity[i], identity[j]) for (i, j), m in matchings.items()]).f1


@pytest.mark.parametrize("method", METHODS)
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


@pytest.mark.parametrize(("method", "gain"), [("joint", 0.03), ("convex", 0.03), ("spectral", 0.0)])
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


def test_a_chain_over_two_robots_scores_the_product_and_may_be_left_out():
    one = np.array([[0, 0]])
    links = {(i, i + 1): Matching(one, [s]) for i, s in enumerate((0.9, 0.8, 0.7))}
    matchings = {**links, (0, 3): Matching.empty()}
    np.testing.assert_allclose(consistent(matchings, [1] * 4)[0, 3].scores, [0.9 * 0.8 * 0.7])
    assert [len(m) for m in consistent(matchings, [1] * 4, min_score=0.75).values()] == [1, 1, 0, 0]


def test_robots_that_were_not_compared_say_nothing_against_a_match():
    one = np.array([[0, 0]])
    matchings = {(0, 1): Matching(one, [0.9]), (1, 2): Matching(one, [0.47])}  # odds a little above the prior's of .4
    assert len(consistent(matchings, [1, 1, 1])[1, 2]) == 1
    assert len(consistent({**matchings, (0, 2): Matching.empty()}, [1, 1, 1])[1, 2]) == 0
    assert len(consistent(matchings, [1, 1, 1], match_prior=0.5)[1, 2]) == 0


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


@pytest.mark.parametrize("method", METHODS)
def test_degenerate(method):
    assert consistent({}, [], method=method) == {}
    assert groups({}, [2, 1], method=method)[0].tolist() == [0, 1]
    out = consistent({(0, 1): Matching.empty(), (1, 0): Matching.empty()}, [0, 3], method=method)
    assert all(len(m) == 0 for m in out.values())
    reversed_pair = consistent({(1, 0): Matching(np.array([[2, 0]]), [0.9])}, [1, 3], method=method)
    assert reversed_pair[1, 0].pairs.tolist() == [[2, 0]]


def test_bad_input_raises():
    for pair in ((0, 2), (1, 1), (-1, 0), ("a", "b"), (0, 1, 2), 0):
        with pytest.raises(ValueError, match=f"pair {re.escape(repr(pair))} does not name two of 2 robots"):
            groups({pair: Matching.empty()}, [1, 1])  # type: ignore[dict-item]
    with pytest.raises(TypeError, match=r"matchings\[\(0, 1\)\] must be a Matching, got list"):
        consistent({(0, 1): [(0, 0)]}, [1, 1])  # type: ignore[dict-item]
    with pytest.raises(ValueError, match="beyond"):
        groups({(0, 1): Matching(np.array([[0, 1]]), [0.5])}, [1, 1])
    with pytest.raises(ValueError, match="method"):
        groups({}, [1, 1], method="magic")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="match_prior"):
        groups({}, [1], match_prior=1.0)


@pytest.mark.parametrize("method", METHODS)
def test_random_matchings_become_consistent(method):
    rng = np.random.default_rng(3)
    for _ in range(10):
        sizes = rng.integers(1, 6, 4).tolist()
        matchings = some_matchings(rng, sizes)
        out = consistent(matchings, sizes, method=method)
        assert is_consistent(out, sizes)
        assert all(len(set(x)) == len(x) for x in (m.pairs[:, k].tolist() for m in out.values() for k in (0, 1)))


@pytest.mark.parametrize("method", METHODS)
def test_two_right_matches_overrule_a_wrong_one(method):
    right = Matching(np.array([[0, 0], [1, 1]]), [0.9, 0.9])
    wrong = Matching(np.array([[0, 1], [1, 0]]), [0.8, 0.8])
    out = consistent({(0, 1): right, (1, 2): right, (0, 2): wrong}, [2, 2, 2], method=method)
    assert {tuple(p) for p in out[0, 2].pairs.tolist()} == {(0, 0), (1, 1)}


def test_convex_does_not_depend_on_the_order_of_robots_or_detections():
    rng = np.random.default_rng(4)
    for _ in range(5):
        identity, matchings = world(rng, robots=4, objects=8, wrong=0.3, missing=0.2)
        sizes = [len(x) for x in identity]
        first = np.concatenate(groups(matchings, sizes, method="convex"))
        order = rng.permutation(4)
        shuffle = [rng.permutation(n) for n in sizes]
        place = [np.argsort(x) for x in shuffle]
        moved = {}
        for (i, j), m in matchings.items():
            pairs = np.stack([place[i][m.pairs[:, 0]], place[j][m.pairs[:, 1]]], axis=1)
            moved[int(np.argsort(order)[i]), int(np.argsort(order)[j])] = Matching(pairs, m.scores)
        labels = groups(moved, [sizes[r] for r in order], method="convex")
        back = [np.zeros(0)] * 4
        for r, found in zip(order, labels, strict=True):
            back[r] = found[place[r]]
        second = np.concatenate(back)
        np.testing.assert_array_equal(first[:, None] == first[None], second[:, None] == second[None])


@pytest.mark.parametrize("seed", range(3))
def test_relaxed_solution_is_feasible(seed):
    sizes = [3, 2, 4]
    robot, L = log_odds(some_matchings(np.random.default_rng(seed), sizes), sizes)
    X = relaxed(L, robot)
    np.testing.assert_allclose(X, X.T, atol=1e-9)
    assert np.linalg.eigvalsh(X).min() > -1e-3
    assert X.min() > -1e-3
    for r in range(3):
        np.testing.assert_allclose(X[robot == r][:, robot == r], np.eye(sizes[r]), atol=1e-3)
        assert X[robot != r][:, robot == r].sum(axis=1).max() < 1 + 1e-3


@pytest.mark.parametrize("seed", range(5))
def test_relaxation_of_two_robots_is_the_assignment_problem(seed):
    # With two robots the semidefinite constraint follows from the others, and the vertices are matchings.
    gain = np.random.default_rng(seed).normal(size=(5, 7))
    L = np.block([[np.zeros((5, 5)), gain], [gain.T, np.zeros((7, 7))]])
    rows, cols = linear_sum_assignment(np.maximum(gain, 0.0), maximize=True)
    X = relaxed(L, np.repeat([0, 1], [5, 7]))
    assert (L * X).sum() / 2 == pytest.approx(np.maximum(gain, 0.0)[rows, cols].sum(), rel=1e-3)


def test_relaxation_bounds_every_grouping_and_mostly_rounds_to_the_best():
    rng = np.random.default_rng(2)
    sizes = [2, 2, 3]
    reached = 0
    for _ in range(20):
        matchings = some_matchings(rng, sizes)
        robot, L = log_odds(matchings, sizes)
        legal = [p for p in partitions(list(range(7))) if all(len(set(robot[q])) == len(q) for q in p)]
        best = max(sum(L[np.ix_(q, q)].sum() / 2 for q in p) for p in legal)
        got = value(L, groups(matchings, sizes, method="convex"))
        assert (L * relaxed(L, robot)).sum() / 2 >= best - 1e-3
        assert got <= best + 1e-9
        reached += got >= best - 1e-9
    assert reached >= 18


def test_convex_is_no_worse_than_spectral_by_the_sum_of_log_odds():
    for seed in range(10):
        identity, matchings = world(np.random.default_rng(seed), robots=4, objects=8, wrong=0.3, missing=0.2)
        sizes = [len(x) for x in identity]
        _, L = log_odds(matchings, sizes)
        convex, spectral = (value(L, groups(matchings, sizes, method=m)) for m in ("convex", "spectral"))
        assert convex >= spectral - 1e-9


def test_convex_refuses_more_detections_than_it_can_take(monkeypatch):
    monkeypatch.setattr(multiway_convex, "MAX_CONNECTED", 3)
    chain = {(i, i + 1): Matching(np.array([[0, 0]]), [0.9]) for i in range(3)}
    with pytest.raises(ValueError, match="at most 3 detections chained together by likely matches, got 4"):
        groups(chain, [1] * 4, method="convex")
    assert len(groups(chain, [3] * 4, method="joint")) == 4
