"""The paper's equations written out as printed, from positions to Eq. (15), against what the library builds.

Nothing here uses the library's own similarities, weights or penalties: a wrong sign or a swapped width shows.
"""

from itertools import permutations, product

import numpy as np
import pytest

from covis.matching import ObjectGraph
from covis.matching.objective import coefficients, objective
from covis.matching.rgm_chain import propose
from covis.matching.rgm_problem import Similarity, build

WIDTHS = {
    "distance_width_m2": 31.0,
    "angle_width": 0.7,
    "attribute_uncertainty_width": 0.11,
    "distance_uncertainty_width_m2": 2.3,
    "angle_uncertainty_width_m2": 5.9,
    "attribute_unit": 0.3,
    "position_unit_m2": 4.1,
}


def graph(rng, n):
    return ObjectGraph.from_positions(
        rng.normal(0, 5, (n, 3)),
        attributes=rng.dirichlet(np.ones(3), n),
        position_variance=rng.uniform(0.1, 2.0, n),
        attribute_variance=rng.uniform(0.01, 0.05, n),
    )


def cosines(p, i, j, k):
    """cos(theta) at the corners i, j and k."""

    def at(a, b, c):
        e, f = p[b] - p[a], p[c] - p[a]
        return e @ f / (np.linalg.norm(e) * np.linalg.norm(f))

    return at(i, j, k), at(j, i, k), at(k, i, j)


def triangle_difference(p, q, source_corners, target_corners, nine_terms):
    x, y = cosines(p, *source_corners), cosines(q, *target_corners)
    if nine_terms:
        return sum(abs(a - b) for a in x for b in y)
    return sum(abs(a - b) for a, b in zip(x, y, strict=True))


def eq_3_and_11(g, h, w, k, nine_terms):
    """T o W^t as a dict over ordered triples of matches; only the k nearest triangles of each source triangle."""
    p, q = g.positions, h.positions
    out = {}
    for source_corners in permutations(range(len(g)), 3):
        near = sorted(
            (triangle_difference(p, q, source_corners, target_corners, nine_terms), target_corners)
            for target_corners in permutations(range(len(h)), 3)
        )
        limit = near[min(k, len(near)) - 1][0] + 1e-12
        for difference, target_corners in near:
            if difference <= limit:
                matches = tuple(zip(source_corners, target_corners, strict=True))
                U = sum(g.position_variance[i] + h.position_variance[ii] for i, ii in matches)
                out[matches] = np.exp(-difference / w["angle_width"]) * np.exp(-U / w["angle_uncertainty_width_m2"])
    return out


def eq_15(g, h, matches, T, w, lambda_1, lambda_2):
    """The objective of a list of matches (i, i'), term by term."""
    total = 0.0
    for i, ii in matches:
        a, b = g.attributes[i], h.attributes[ii]
        V = g.attribute_variance[i] + h.attribute_variance[ii]  # Eq. (7)
        U = g.position_variance[i] + h.position_variance[ii]  # Eq. (9)
        A = a @ b / (np.linalg.norm(a) * np.linalg.norm(b))  # Eq. (1)
        total += A * np.exp(-V / w["attribute_uncertainty_width"])  # Eq. (8)
        total -= lambda_1 * (V / w["attribute_unit"] + U / w["position_unit_m2"]) ** 2 + lambda_2
    for (i, ii), (j, jj) in permutations(matches, 2):
        s = np.linalg.norm(g.positions[i] - g.positions[j])
        t = np.linalg.norm(h.positions[ii] - h.positions[jj])
        U = g.position_variance[[i, j]].sum() + h.position_variance[[ii, jj]].sum()
        D = np.exp(-((s - t) ** 2) / w["distance_width_m2"])  # Eq. (2)
        total += D * np.exp(-U / w["distance_uncertainty_width_m2"])  # Eq. (10)
    return total + sum(T.get(triple, 0.0) for triple in permutations(matches, 3))


def matchings(n, m):
    for targets in product(range(-1, m), repeat=n):
        used = [t for t in targets if t >= 0]
        if len(used) == len(set(used)):
            yield np.array(targets)


@pytest.mark.parametrize("nine_terms", [False, True])
@pytest.mark.parametrize("neighbours", [None, 5])
def test_objective_is_eq_15_as_printed_for_every_matching(nine_terms, neighbours):
    rng = np.random.default_rng(11)
    g, h = graph(rng, 4), graph(rng, 3)
    similarity = Similarity(**WIDTHS, nine_terms=nine_terms, neighbours=neighbours)
    table = coefficients(3, 0.13, 0.37, "sum", "frobenius")
    terms = build(g, h, similarity, table, table).terms
    T = eq_3_and_11(g, h, WIDTHS, neighbours or len(g) * len(h), nine_terms)
    for match in matchings(4, 3):
        matches = [(i, int(ii)) for i, ii in enumerate(match) if ii >= 0]
        assert objective(terms, match, table) == pytest.approx(eq_15(g, h, matches, T, WIDTHS, 0.13, 0.37), abs=1e-9)


def test_infinite_uncertainty_widths_and_no_regulariser_are_eq_4():
    rng = np.random.default_rng(12)
    g, h = graph(rng, 3), graph(rng, 4)
    unweighted = {name: np.inf if "uncertainty" in name else value for name, value in WIDTHS.items()}
    table = coefficients(3, 0.0, 0.0, "sum", "frobenius")
    terms = build(g, h, Similarity(**unweighted), table, table).terms
    T = eq_3_and_11(g, h, unweighted, 12, False)
    matches = [(0, 2), (1, 0), (2, 3)]
    found = objective(terms, np.array([2, 0, 3]), table)
    assert found == pytest.approx(eq_15(g, h, matches, T, unweighted, 0.0, 0.0), abs=1e-9)


def test_only_the_nearest_triangles_have_a_similarity():
    """k = n n' as the paper sets it: of the 6 x 5 x 4 target triangles every source triangle keeps 30."""
    rng = np.random.default_rng(13)
    g, h = graph(rng, 5), graph(rng, 6)
    table = coefficients(5, 0.0, 0.0, "sum", "frobenius")
    terms = build(g, h, Similarity(**WIDTHS), table, table).terms
    kept = eq_3_and_11(g, h, WIDTHS, 30, False)
    assert 60 * 30 <= len(kept) < 60 * 31  # sums of absolute differences tie now and then
    inside = sum(
        triangle_difference(g.positions, h.positions, abc, xyz, False) <= terms.radius[abc]
        for abc in permutations(range(5), 3)
        for xyz in permutations(range(6), 3)
    )
    assert inside == len(kept)
    assert all(np.size(part) <= (5 * 6) ** 2 for part in terms)  # nothing of the size of T, (5 * 6)^3


def test_widths_not_given_follow_the_medians_of_the_variances():
    rng = np.random.default_rng(14)
    g, h = graph(rng, 4), graph(rng, 4)
    V = g.attribute_variance[:, None] + h.attribute_variance
    U = g.position_variance[:, None] + h.position_variance
    given = Similarity(
        distance_width_m2=3.0 * np.median(U),
        attribute_uncertainty_width=20.0 * np.median(V),
        distance_uncertainty_width_m2=20.0 * np.median(U),
        angle_uncertainty_width_m2=20.0 * np.median(U),
        attribute_unit=6.0 * np.median(V),
        position_unit_m2=6.0 * np.median(U),
    )
    table = coefficients(4, 0.1, 0.4, "mean", "squared")
    open_ = build(g, h, Similarity(distance_width_factor=3.0, uncertainty_width_factor=20.0), table, table)
    fixed = build(g, h, given, table, table)
    for one, other in zip(open_.terms, fixed.terms, strict=True):
        np.testing.assert_allclose(one, other)
    np.testing.assert_allclose(open_.proposal_weight, fixed.proposal_weight)


def test_proposals_are_drawn_from_eq_18():
    rng = np.random.default_rng(15)
    g, h = graph(rng, 5), graph(rng, 5)
    table = coefficients(5, 0.1, 0.4, "mean", "squared")
    weight = build(g, h, Similarity(**WIDTHS), table, table, proposal_width=0.6).proposal_weight
    active = np.array([True, False, False, True, False])
    alpha, draws = 0.3, 60_000
    switched = np.zeros(5)
    for draw in rng.random((draws, 3)):
        i, _ = propose(active, weight, alpha, draw)
        switched[i] += 1

    uncertainty = g.attribute_variance / WIDTHS["attribute_unit"] + g.position_variance / WIDTHS["position_unit_m2"]

    def unnormalised(i):
        after = active.copy()
        after[i] = True
        return np.exp(-(after @ uncertainty) / 0.6)

    add = np.array([0.0 if active[i] else unnormalised(i) for i in range(5)])
    expected = alpha * add / add.sum() + (1 - alpha) * active / active.sum()
    np.testing.assert_allclose(switched / draws, expected, atol=0.008)


def test_proposal_ratio_is_that_of_eq_18_both_ways():
    weight, alpha = np.array([1.0, 0.5, 0.2, 0.1]), 0.3
    active = np.array([True, False, True, False])

    def q(before, i):
        """Probability of switching i."""
        if before[i]:
            return (1 - alpha) / before.sum()
        return alpha * weight[i] / weight[~before].sum()

    for draw in np.random.default_rng(0).random((50, 3)):
        i, log_ratio = propose(active, weight, alpha, draw)
        after = active.copy()
        after[i] = not after[i]
        assert log_ratio == pytest.approx(np.log(q(after, i) / q(active, i)))
