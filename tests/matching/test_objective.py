"""Eq. 1-15 against plain loops, and the incremental objective against the full one."""

from itertools import combinations, permutations

import numpy as np
import pytest

from covis.matching import ObjectGraph
from covis.matching import objective as ob
from covis.matching import objective_state as st
from covis.matching.rgm_problem import Similarity, build
from covis.matching.similarity import (
    attribute_similarity,
    distances,
    pair_affinity,
    triangle_distance,
    triangle_radius,
    triangle_sides,
    vertex_cosines,
)
from covis.matching.uncertainty import attribute_statistics, certainty, kronecker_plus


def graph(rng, n, **optional):
    return ObjectGraph.from_positions(
        rng.normal(0, 10, (n, 3)),
        attributes=rng.dirichlet(np.ones(3), n),
        position_variance=rng.uniform(0.1, 2.0, n),
        attribute_variance=rng.uniform(0.01, 0.05, n),
        **optional,
    )


def problem(rng, n, m, scaling="mean", count_penalty="squared", **similarity):
    largest = min(n, m)
    return build(
        graph(rng, n, up=[0, 0, 1]),
        graph(rng, m, up=[0, 0, 1]),
        Similarity(distance_width_m2=60.0, **similarity),
        ob.coefficients(largest, 0.1, 0.4, scaling, count_penalty),
        ob.coefficients(largest, 0.0, 0.0, scaling, count_penalty),
    )


def test_vec_goes_by_columns():
    X = np.arange(6).reshape(2, 3)
    assert ob.vec(X).tolist() == [0, 3, 1, 4, 2, 5]
    assert (ob.unvec(ob.vec(X), 2, 3) == X).all()


def test_attribute_similarity_is_the_cosine_and_zero_for_a_zero_vector():
    a = np.array([[1.0, 0.0], [0.0, 0.0]])
    b = np.array([[1.0, 1.0], [0.0, 2.0]])
    np.testing.assert_allclose(attribute_similarity(a, b), [[np.sqrt(0.5), 0.0], [0.0, 0.0]])


def test_vertex_cosines_are_the_law_of_cosines():
    p = np.random.default_rng(0).normal(size=(5, 3))
    s, c = distances(p), vertex_cosines(p)
    for i, j, k in permutations(range(5), 3):
        law = (s[i, j] ** 2 + s[i, k] ** 2 - s[j, k] ** 2) / (2 * s[i, j] * s[i, k])
        assert c[i, j, k] == pytest.approx(law, abs=1e-12)


def test_vertex_cosines_of_coincident_points_are_finite():
    c = vertex_cosines(np.zeros((4, 3)))
    assert (c == 0).all()


def test_pair_affinity_is_eq_2_without_conflicting_matches():
    rng = np.random.default_rng(1)
    s, t = distances(rng.normal(size=(3, 3))), distances(rng.normal(size=(4, 3)))
    D = pair_affinity(s, t, 0.7)
    for i, j in permutations(range(3), 2):
        for a, b in permutations(range(4), 2):
            assert D[i, a, j, b] == pytest.approx(np.exp(-((s[i, j] - t[a, b]) ** 2) / 0.7))
    assert all((D[i, :, i, :] == 0).all() for i in range(3))
    assert all((D[:, a, :, a] == 0).all() for a in range(4))


def test_triangle_sides_change_sign_under_reflection_only():
    rng = np.random.default_rng(0)
    p = rng.normal(size=(5, 3))
    up = np.array([0.0, 0.0, 1.0])
    sides = triangle_sides(p, up)
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    assert (triangle_sides(p @ turn.T, up) == sides).all()
    assert (triangle_sides(p * [1, -1, 1], up) == -sides).all()
    assert triangle_sides(np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]), up)[0, 1, 2] == 1


@pytest.mark.parametrize("nine_terms", [False, True])
@pytest.mark.parametrize("neighbours", [1, 7, 23, 1000])
def test_triangle_radius_is_the_distance_of_the_kth_neighbour(nine_terms, neighbours):
    rng = np.random.default_rng(3)
    c, d = vertex_cosines(rng.normal(size=(5, 3))), vertex_cosines(rng.normal(size=(4, 3)))
    radius = triangle_radius(c, d, neighbours, nine_terms)
    for i, j, k in combinations(range(5), 3):
        near = sorted(triangle_distance(c, i, j, k, d, a, b, e, nine_terms) for a, b, e in permutations(range(4), 3))
        if neighbours >= len(near):
            assert radius[i, j, k] == np.inf
        else:
            assert radius[i, j, k] == pytest.approx(near[neighbours - 1], abs=3e-12)
            assert radius[k, i, j] == radius[i, j, k]


def test_eq_3_printed_is_a_flag():
    c, d = vertex_cosines(np.eye(3) * [1, 2, 3]), vertex_cosines(np.eye(3) * [1, 2, 4])
    p, q = [c[0, 1, 2], c[1, 0, 2], c[2, 0, 1]], [d[0, 1, 2], d[1, 0, 2], d[2, 0, 1]]
    matched = sum(abs(x - y) for x, y in zip(p, q, strict=True))
    assert triangle_distance(c, 0, 1, 2, d, 0, 1, 2, False) == pytest.approx(matched)
    assert triangle_distance(c, 0, 1, 2, d, 0, 1, 2, True) == pytest.approx(sum(abs(x - y) for x in p for y in q))


def test_uncertainty_weights():
    v, w = np.array([0.1, 0.2]), np.array([0.0, 0.5, 1.0])
    V = kronecker_plus(v, w)
    np.testing.assert_allclose(V, [[0.1, 0.6, 1.1], [0.2, 0.7, 1.2]])
    np.testing.assert_allclose(certainty(V, 0.5), np.exp(-V / 0.5))
    with pytest.raises(ValueError, match=r"width must lie in \(0, inf\], got 0"):
        certainty(V, 0)


def test_attribute_statistics_add_epistemic_and_aleatoric_variance():
    samples = np.array([[[0.2, 0.8]], [[0.4, 0.6]]])
    a, v = attribute_statistics(samples, np.array([[0.1, 0.3]]))
    np.testing.assert_allclose(a, [[0.3, 0.7]])
    np.testing.assert_allclose(v, [0.01 + 0.2])
    with pytest.raises(ValueError, match=r"shape \(T, n, c\)"):
        attribute_statistics(np.zeros((2, 3)))


def literal_value(problem, match):
    """Eq. (15) as printed, with dense D and T and a flattened X."""
    terms = problem.terms
    n, m = terms.attribute.shape
    size = n * m
    X = np.zeros((n, m))
    for i, ii in enumerate(match):
        if ii >= 0:
            X[i, ii] = 1
    x = ob.vec(X)
    D = terms.pair.transpose(1, 0, 3, 2).reshape(size, size)  # candidate i' n + i: by columns
    T = np.zeros((size, size, size))
    where = [(i, ii) for ii in range(m) for i in range(n)]
    for a, (i, ii) in enumerate(where):
        for b, (j, jj) in enumerate(where):
            for c, (k, kk) in enumerate(where):
                w = terms.angle_weight[i, ii] * terms.angle_weight[j, jj] * terms.angle_weight[k, kk]
                T[a, b, c] = w * ob.triple_similarity(terms, i, ii, j, jj, k, kk)
    similarity = ob.vec(terms.attribute) @ x + x @ D @ x + np.einsum("abc,a,b,c", T, x, x, x)
    return similarity - 0.1 * (np.sqrt(terms.penalty) * X).__pow__(2).sum() - 0.4 * np.linalg.norm(X) ** 2


@pytest.mark.parametrize("options", [{}, {"nine_terms": True}, {"reject_mirrored": True}, {"neighbours": 9}])
def test_sum_scaling_with_the_frobenius_norm_is_eq_15_as_printed(options):
    p = problem(np.random.default_rng(5), 4, 3, "sum", "frobenius", **options)
    for match in ([-1, -1, -1, -1], [0, -1, -1, -1], [2, 0, -1, 1], [-1, 1, 2, 0], [0, 1, 2, -1]):
        assert ob.objective(p.terms, match, p.table) == pytest.approx(literal_value(p, match), abs=1e-12)


def test_mean_scaling_is_m_squared_times_mean_similarity_less_penalties():
    p = problem(np.random.default_rng(6), 5, 5)
    match = np.array([0, 3, -1, 1, 2])
    A, D, T, P = ob.full_sums(p.terms, match)
    mean = (A / 4 + D / 12 + T / 24) / 3
    assert ob.objective(p.terms, match, p.table) == pytest.approx(16 * (mean - 0.1 * P / 4 - 0.4))


@pytest.mark.parametrize("options", [{}, {"nine_terms": True}, {"reject_mirrored": True}, {"neighbours": 10}])
@pytest.mark.parametrize("scaling", ob.SCALINGS)
def test_incremental_objective_equals_full(scaling, options):
    rng = np.random.default_rng(7)
    p = problem(rng, 6, 5, scaling, **options)
    state = st.empty_state(6, 5)

    def full(match):
        return ob.objective(p.terms, match, p.table)

    for _ in range(150):
        match = state.match.copy()
        i = int(rng.integers(6))
        ii = int(rng.integers(5))
        holder = int(state.holder[ii])
        changed = match.copy()
        if match[i] == ii:
            changed[i] = -1
        elif holder < 0:
            changed[i] = ii
            assert st.value_after(p.terms, state, p.table, i, ii) == pytest.approx(full(changed), abs=1e-9)
        else:
            changed[i], changed[holder] = ii, match[i]
        ob_change(p.terms, state, match, changed)
        assert (state.match == changed).all()
        assert ob.value(state.sums, state.size[0], p.table) == pytest.approx(full(changed), abs=1e-9)
        check_best_changes(p, state, full)
    np.testing.assert_allclose(state.sums, ob.full_sums(p.terms, state.match), atol=1e-9)


def check_best_changes(p, state, full):
    """The best reassignment and the best exchange have the values that the full objective gives them."""
    now = full(state.match)
    exchanges, reassignments = [now], [now]
    for i in np.flatnonzero(state.match >= 0):
        for j in np.flatnonzero(state.match >= 0):
            changed = state.match.copy()
            changed[[i, j]] = changed[[j, i]]
            exchanges.append(full(changed))
        for ii in np.flatnonzero(state.holder < 0):
            changed = state.match.copy()
            changed[i] = ii
            reassignments.append(full(changed))
    assert st.best_exchange(p.terms, state, p.table, now)[0] == pytest.approx(max(exchanges), abs=1e-9)
    assert st.best_reassignment(p.terms, state, p.table, now)[0] == pytest.approx(max(reassignments), abs=1e-9)


def ob_change(terms, state, before, after):
    for i in np.flatnonzero((before != after) & (before >= 0)):
        st.remove(terms, state, i)
    for i in np.flatnonzero((before != after) & (after >= 0)):
        st.add(terms, state, i, after[i])


def test_lists_of_triples_start_anew_when_full():
    p = problem(np.random.default_rng(9), 6, 6, neighbours=1000)
    state = st.empty_state(6, 6)
    state.list_used[0] = st.LIST_CAPACITY + 1
    for i in range(6):
        st.add(p.terms, state, i, 5 - i)
        state.list_used[0] = max(state.list_used[0], st.LIST_CAPACITY - 20 * i)
    np.testing.assert_allclose(state.sums, ob.full_sums(p.terms, state.match), atol=1e-9)


def test_removing_everything_leaves_nothing_behind():
    p = problem(np.random.default_rng(8), 6, 6)
    state = st.empty_state(6, 6)
    for i in range(6):
        st.add(p.terms, state, i, (i + 2) % 6)
    for i in (3, 1, 5, 0, 2, 4):
        st.remove(p.terms, state, i)
    for array in (state.sums, state.pair_gain, state.triple_gain):
        np.testing.assert_allclose(array, 0.0, atol=1e-12)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((0.1, 0.4, "median", "squared"), "scaling must be one of"),
        ((0.1, 0.4, "mean", "l1"), "count_penalty must be one of"),
        ((-0.1, 0.4, "mean", "squared"), r"uncertainty_weight must lie in \[0, inf\), got -0.1"),
        ((0.1, np.nan, "mean", "squared"), r"noncovisibility_weight must lie in \[0, inf\), got nan"),
    ],
)
def test_bad_parameters_name_the_value(arguments, message):
    with pytest.raises(ValueError, match=message):
        ob.coefficients(3, *arguments)
