"""Appearance alone."""

from itertools import permutations

import numpy as np
import pytest

from covis.matching import ObjectGraph, reid


def test_distinct_classes_find_each_other():
    order = np.array([2, 0, 1])
    source = ObjectGraph.from_positions(np.zeros((3, 3)), attributes=np.eye(3))
    target = ObjectGraph.from_positions(np.zeros((3, 3)), attributes=np.eye(3)[order])
    matching = reid(source, target)
    assert {tuple(p) for p in matching.pairs.tolist()} == {(2, 0), (0, 1), (1, 2)}
    np.testing.assert_allclose(matching.scores, 1.0)


@pytest.mark.parametrize(("n", "m"), [(4, 4), (3, 4), (4, 2)])
def test_total_similarity_is_the_largest_of_all_assignments(n, m):
    rng = np.random.default_rng(n + m)
    for _ in range(10):
        a, b = rng.dirichlet(np.ones(3), n), rng.dirichlet(np.ones(3), m)
        found = reid(*(ObjectGraph.from_positions(np.zeros((len(x), 3)), attributes=x) for x in (a, b)))
        A = (a @ b.T) / np.linalg.norm(a, axis=1)[:, None] / np.linalg.norm(b, axis=1)
        few, many = (A, A.T)[n > m], max(n, m)
        best = max(few[np.arange(min(n, m)), list(cols)].sum() for cols in permutations(range(many), min(n, m)))
        assert found.scores.sum() == pytest.approx(best)


def test_embedding_decides_where_both_have_one():
    same = np.ones((2, 2))
    source = ObjectGraph.from_positions(np.zeros((2, 3)), attributes=same, embedding=np.eye(2))
    target = ObjectGraph.from_positions(np.zeros((2, 3)), attributes=same, embedding=np.eye(2)[::-1])
    assert {tuple(p) for p in reid(source, target).pairs.tolist()} == {(0, 1), (1, 0)}


def test_min_similarity_drops_strangers():
    source = ObjectGraph.from_positions(np.zeros((2, 3)), attributes=np.array([[1.0, 0], [0, 1]]))
    target = ObjectGraph.from_positions(np.zeros((1, 3)), attributes=np.array([[1.0, 0.1]]))
    assert reid(source, target, min_similarity=0.5).pairs.tolist() == [[0, 0]]
    assert len(reid(source.take(np.array([1])), target, min_similarity=0.5)) == 0


def test_different_class_lists_are_refused():
    a = ObjectGraph.from_positions(np.eye(3), attributes=np.ones((3, 2)))
    b = ObjectGraph.from_positions(np.eye(3), attributes=np.ones((3, 4)))
    with pytest.raises(ValueError, match="source has 2 attribute classes, target has 4"):
        reid(a, b)
