"""Algorithm 1: the chain against its enumerated distribution, the result against the brute-force optimum."""

import os
from concurrent.futures.process import BrokenProcessPool
from itertools import permutations

import numpy as np
import pytest

from covis.matching import ObjectGraph
from covis.matching import objective as ob
from covis.matching import objective_state as st
from covis.matching import rgm_chain as solver
from covis.matching.rgm import rgm, rgm_no_covisibility, rgm_no_uncertainty, scores
from covis.matching.rgm_chain import Annealing
from covis.matching.rgm_problem import Similarity, build


def make_problem(rng, n=4, m=4, common=3, lambda_1=0.1, lambda_2=0.4):
    p = rng.uniform(-10, 10, (n, 3))
    q = rng.uniform(-10, 10, (m, 3))
    q[:common] = p[:common] @ np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]) + rng.normal(0, 0.2, (common, 3))
    a, b = rng.dirichlet(np.ones(3), n), rng.dirichlet(np.ones(3), m)
    b[:common] = a[:common]
    source = ObjectGraph.from_positions(p, attributes=a, position_variance=rng.uniform(0.02, 0.1, n))
    target = ObjectGraph.from_positions(q, attributes=b, position_variance=rng.uniform(0.02, 0.1, m))
    k = min(n, m)
    tables = (ob.coefficients(k, lambda_1, lambda_2, "mean", "squared"), ob.coefficients(k, 0, 0, "mean", "squared"))
    return build(source, target, Similarity(), *tables)


def matchings(n, m):
    """Every one-to-one partial matching as targets of the sources, -1 = none."""
    for size in range(min(n, m) + 1):
        for rows in (r for r in permutations(range(n), size) if list(r) == sorted(r)):
            for cols in permutations(range(m), size):
                match = np.full(n, -1)
                match[list(rows)] = cols
                yield match


def test_support_is_the_walk_over_attributes_and_distances():
    p = make_problem(np.random.default_rng(2), n=5, m=4)
    K = p.terms.pair.reshape(20, 20) + np.diag(p.terms.attribute.ravel())
    mixed = np.full(20, 1 / 20)
    for _ in range(30):
        walk = K @ mixed
        walk /= walk.sum()
        jump = np.full((5, 5), np.exp(-30.0))  # a slack column makes it square
        jump[:, :4] = np.exp(30.0 * (walk / walk.max() - 1)).reshape(5, 4)
        for _ in range(10):
            change = np.abs(jump.sum(axis=1) - 1).max()
            jump /= jump.sum(axis=1, keepdims=True)
            jump /= jump.sum(axis=0)
            if change < 1e-3:
                break
        mixed = 0.2 * walk + 0.8 * jump[:, :4].ravel() / jump[:, :4].sum()
    np.testing.assert_allclose(p.support.ravel(), walk, rtol=1e-4, atol=1e-9)


def test_pi_is_the_best_assignment_of_the_active_objects():
    hits = total = 0
    for seed in range(40):
        p = make_problem(np.random.default_rng(seed))
        order = np.argsort(-p.support.ravel(), kind="stable")
        for mask in range(1, 16):
            active = np.array([bool(mask >> i & 1) for i in range(4)])
            state = st.empty_state(4, 4)
            solver.assign(p.terms, p.table_pi, state, active, order)
            assert ((state.match >= 0) == active).all()
            value = ob.objective(p.terms, state.match, p.table_pi)
            best = max(ob.objective(p.terms, x, p.table_pi) for x in matchings(4, 4) if ((x >= 0) == active).all())
            hits += value > best - 1e-9
            total += 1
    assert hits / total > 0.85  # greedy and local search on a problem that is NP-hard


def test_result_is_the_brute_force_optimum_on_small_problems():
    hits = 0
    for seed in range(60):
        rng = np.random.default_rng(1000 + seed)
        p = make_problem(rng)
        match, log_p = solver.solve(p, Annealing(acceptance="metropolis", start_temperature=2.0), rng)
        assert log_p == pytest.approx(ob.objective(p.terms, match, p.table), abs=1e-9)
        best = max(ob.objective(p.terms, x, p.table) for x in matchings(4, 4))
        assert log_p <= best + 1e-9
        hits += log_p > best - 1e-9
    assert hits >= 51


def test_metropolis_chain_has_the_stationary_distribution_of_eq_16():
    rng = np.random.default_rng(3)
    p = make_problem(rng, n=4, m=3)  # all four active cannot be matched: that set has probability zero
    order = np.argsort(-p.support.ravel(), kind="stable")
    temperature = 0.7
    log_p = np.full(16, -np.inf)
    for mask in range(16):
        active = np.array([bool(mask >> i & 1) for i in range(4)])
        if active.sum() <= 3:
            state = st.empty_state(4, 3)
            solver.assign(p.terms, p.table_pi, state, active, order)
            log_p[mask] = ob.value(state.sums, state.size[0], p.table) / temperature
    expected = np.exp(log_p - log_p.max())
    expected /= expected.sum()
    steps = 400_000
    _, _, visited = solver.run_chain(
        p.terms,
        p.table,
        p.table_pi,
        order,
        np.array([1.0, 0.6, 0.3, 0.15]),
        np.zeros(4, dtype=bool),
        np.full(steps, temperature),
        True,
        0.4,
        rng.random((steps, 3)),
    )
    share = np.bincount(visited, minlength=16) / steps
    assert np.abs(share - expected).sum() / 2 < 0.01  # total variation
    assert share[15] == 0


def test_paper_acceptance_only_climbs():
    rng = np.random.default_rng(4)
    p = make_problem(rng, n=5, m=5)
    order = np.argsort(-p.support.ravel(), kind="stable")
    active = solver.initial_active(p.support)
    steps = 300
    _, best, visited = solver.run_chain(
        p.terms, p.table, p.table_pi, order, p.proposal_weight, active, np.ones(steps), False, 0.5,
        rng.random((steps, 3)),
    )  # fmt: skip
    values = []
    for mask in visited:
        state = st.empty_state(5, 5)
        solver.assign(p.terms, p.table_pi, state, np.array([bool(mask >> i & 1) for i in range(5)]), order)
        values.append(ob.value(state.sums, state.size[0], p.table))
    assert (np.diff(values) >= -1e-12).all()
    assert best == pytest.approx(max(values))


def literal_algorithm_1(p, order, active, temperatures, metropolis, alpha, draws):
    """Visited sets, line by line; every pi(y) is found afresh."""
    n, m = p.terms.attribute.shape

    def log_p(y):
        if y.sum() > m:
            return -np.inf
        state = st.empty_state(n, m)
        solver.assign(p.terms, p.table_pi, state, y, order)
        return ob.objective(p.terms, state.match, p.table)  # Eq. (16)

    y, visited = active.copy(), []
    for T, draw in zip(temperatures, draws, strict=True):
        i, log_q = solver.propose(y, p.proposal_weight, alpha, draw)  # Eq. (18)
        if i >= 0:
            proposed = y.copy()
            proposed[i] = not proposed[i]
            rise = log_p(proposed) - log_p(y)
            ratio = min(np.exp((rise / T if metropolis else rise) + log_q), 1.0)  # Eq. (19)
            if ratio > draw[2] and (metropolis or rise > 0):
                y = proposed
        visited.append(sum(1 << k for k in np.flatnonzero(y)))
    return visited


@pytest.mark.parametrize("metropolis", [False, True])
def test_chain_is_algorithm_1_step_by_step(metropolis):
    moves = 0
    for seed in range(8):
        rng = np.random.default_rng(seed)
        p = make_problem(rng, n=5, m=4, common=3, lambda_2=0.6)
        order = np.argsort(-p.support.ravel(), kind="stable")
        active = rng.random(5) < 0.5
        temperatures = Annealing(proposals=60).temperatures(5)
        draws = rng.random((60, 3))
        draws[:, 2] **= 0.25  # high thresholds, so that the ratio decides
        _, _, visited = solver.run_chain(
            p.terms, p.table, p.table_pi, order, p.proposal_weight, active, temperatures, metropolis, 0.4, draws
        )
        expected = literal_algorithm_1(p, order, active, temperatures, metropolis, 0.4, draws)
        assert visited.tolist() == expected
        moves += len(set(expected)) - 1
    assert moves > 10


def test_temperature_falls_geometrically_from_start_to_end():
    T = Annealing(proposals=50, start_temperature=5.0, end_temperature=0.2).temperatures(15)
    assert (len(T), T[0], T[-1]) == (50, pytest.approx(5.0), pytest.approx(0.2))
    np.testing.assert_allclose(T[1:] / T[:-1], T[1] / T[0])  # T = xi T
    assert len(Annealing().temperatures(15)) == 200  # the paper's number at n = 15


def scene(rng, common=8, extra=4, noise=0.05):
    p = rng.uniform(-20, 20, (common + extra, 3)) * [1, 1, 0.1]
    q = p @ np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]) + [3, 1, 0] + rng.normal(0, noise, p.shape)
    q[common:] = rng.uniform(-20, 20, (extra, 3)) * [1, 1, 0.1]
    shuffle = rng.permutation(len(q))
    options = {"position_variance": noise**2, "up": [0, 0, 1]}
    truth = {i: int(np.flatnonzero(shuffle == i)[0]) for i in range(common)}
    return ObjectGraph.from_positions(p, **options), ObjectGraph.from_positions(q[shuffle], **options), truth


@pytest.mark.parametrize("acceptance", ["paper", "metropolis"])
def test_finds_covisible_objects_among_identical_ones(acceptance):
    correct = retrieved = common = 0
    for seed in range(10):
        source, target, truth = scene(np.random.default_rng(seed))
        found = rgm(source, target, acceptance=acceptance)
        correct += sum(truth.get(int(a)) == b for a, b in found.pairs)
        retrieved += len(found)
        common += len(truth)
    assert correct / retrieved > 0.9
    assert correct / common > 0.7


def test_scores_are_mean_similarities_of_attributes_pairs_and_triples():
    p = make_problem(np.random.default_rng(5), n=5, m=5)
    terms, match = p.terms, np.array([2, -1, 0, 1, 4])
    matches = [(i, int(ii)) for i, ii in enumerate(match) if ii >= 0]
    found = scores(terms, match)
    assert found[1] == 0
    for a in matches:
        others = [b for b in matches if b != a]
        triples = [
            ob.triple_similarity(terms, *a, *b, *c)
            * terms.angle_weight[a]
            * terms.angle_weight[b]
            * terms.angle_weight[c]
            for b, c in permutations(others, 2)
        ]
        parts = [terms.attribute[a], np.mean([terms.pair[(*a, *b)] for b in others]), np.mean(triples)]
        assert found[a[0]] == pytest.approx(np.mean(parts))


def test_same_stream_same_answer():
    source, target, _ = scene(np.random.default_rng(0))
    a = rgm(source, target, rng=np.random.default_rng(5))
    b = rgm(source, target, rng=np.random.default_rng(5))
    assert (a.pairs == b.pairs).all()
    assert (a.scores == b.scores).all()


def test_workers_share_the_proposals():
    source, target, truth = scene(np.random.default_rng(1))
    one = rgm(source, target, proposals=200)
    two = rgm(source, target, proposals=200, workers=2)
    assert two.diagnostics["log_p"] >= 0.8 * one.diagnostics["log_p"] > 0
    assert sum(truth.get(int(a)) == b for a, b in two.pairs) > len(two) / 2


def test_every_worker_runs_an_equal_share_and_the_best_result_counts(monkeypatch):
    class Here:
        jobs = ()

        def map(self, function, problems, jobs, streams):
            self.jobs = tuple(jobs)
            self.first_draws = [rng.random() for rng in streams]
            return [(np.array([k]), [1.0, 7.0, 3.0][k]) for k in range(len(self.jobs))]

    here = Here()
    monkeypatch.setattr(solver, "_pool", lambda workers: here)
    p = make_problem(np.random.default_rng(0))
    annealing = Annealing(proposals=100, acceptance="metropolis", add_probability=0.3)
    match, log_p = solver.solve(p, annealing, np.random.default_rng(0), workers=3)
    assert (match.tolist(), log_p) == ([1], 7.0)
    assert here.jobs == (Annealing(proposals=34, acceptance="metropolis", add_probability=0.3),) * 3
    assert len(set(here.first_draws)) == 3


@pytest.mark.parametrize(
    ("ablation", "weight"),
    [(rgm_no_uncertainty, "uncertainty_weight"), (rgm_no_covisibility, "noncovisibility_weight")],
)
def test_an_ablation_is_a_weight_of_zero_and_nothing_else(ablation, weight):
    p = scene(np.random.default_rng(6), common=5, extra=6, noise=0.8)
    found, expected = ablation(*p[:2]), rgm(*p[:2], **{weight: 0.0})
    assert found.pairs.tolist() == expected.pairs.tolist()
    assert found.diagnostics["log_p"] == expected.diagnostics["log_p"] != rgm(*p[:2]).diagnostics["log_p"]


def test_published_weights_are_the_defaults():
    p = scene(np.random.default_rng(7), noise=0.5)
    given = rgm(*p[:2], uncertainty_weight=0.1, noncovisibility_weight=0.4, add_probability=0.5)
    assert given.diagnostics["log_p"] == rgm(*p[:2]).diagnostics["log_p"]


def test_objective_does_not_depend_on_the_order_of_objects_nor_of_robots():
    source, target, _ = scene(np.random.default_rng(8), common=5, extra=2, noise=0.5)
    tables = (ob.coefficients(7, 0.1, 0.4, "mean", "squared"), ob.coefficients(7, 0, 0, "mean", "squared"))
    every_triangle = Similarity(neighbours=7**3)  # nearest triangles are looked for from the source's side
    rng = np.random.default_rng(0)
    a, b = rng.permutation(7), rng.permutation(7)
    straight = build(source, target, every_triangle, *tables)
    shuffled = build(source.take(a), target.take(b), every_triangle, *tables)
    swapped = build(target, source, every_triangle, *tables)
    for _ in range(20):
        match = np.where(rng.random(7) < 0.3, -1, rng.permutation(7))
        expected = ob.objective(straight.terms, match, straight.table)
        # Source object a[k] stands at k, target object b[l] at l.
        moved = np.array([-1 if match[i] < 0 else int(np.flatnonzero(b == match[i])[0]) for i in a])
        assert ob.objective(shuffled.terms, moved, shuffled.table) == pytest.approx(expected)
        back = np.full(7, -1)
        back[match[match >= 0]] = np.flatnonzero(match >= 0)
        assert ob.objective(swapped.terms, back, swapped.table) == pytest.approx(expected)


@pytest.mark.parametrize("acceptance", ["paper", "metropolis"])
def test_matches_hardly_depend_on_the_order_of_objects_nor_of_robots(acceptance):
    same = total = 0
    for seed in range(6):
        rng = np.random.default_rng(seed)
        source, target, _ = scene(rng)
        a, b = rng.permutation(len(source)), rng.permutation(len(target))
        straight = {(int(i), int(j)) for i, j in rgm(source, target, acceptance=acceptance).pairs}
        shuffled = rgm(source.take(a), target.take(b), acceptance=acceptance).pairs
        swapped = rgm(target, source, acceptance=acceptance).pairs
        for other in ({(int(a[i]), int(b[j])) for i, j in shuffled}, {(int(j), int(i)) for i, j in swapped}):
            same += len(straight & other)
            total += max(len(straight), len(other))
    assert same / total > 0.9


def test_a_lost_process_costs_one_call():
    source, target, _ = scene(np.random.default_rng(1))
    expected = rgm(source, target, rng=np.random.default_rng(0), proposals=40, workers=2)
    lost = solver._pool(2).submit(os._exit, 1)
    assert isinstance(lost.exception(), BrokenProcessPool)
    with pytest.raises(BrokenProcessPool):
        rgm(source, target, proposals=40, workers=2)
    again = rgm(source, target, rng=np.random.default_rng(0), proposals=40, workers=2)
    assert again.pairs.tolist() == expected.pairs.tolist()


def test_reject_mirrored_tells_a_scene_from_its_reflection():
    rng = np.random.default_rng(2)
    p = rng.uniform(-10, 10, (8, 3))
    p[:, 2] = 0
    source = ObjectGraph.from_positions(p, up=[0, 0, 1])
    mirrored = ObjectGraph.from_positions(p * [1, -1, 1], up=[0, 0, 1])
    blind = rgm(source, mirrored)
    seeing = rgm(source, mirrored, reject_mirrored=True)
    assert len(blind) == 8
    assert seeing.diagnostics["log_p"] < 0.8 * blind.diagnostics["log_p"]


def test_noncovisibility_weight_reduces_the_number_of_matches():
    source, target, _ = scene(np.random.default_rng(3), common=6, extra=6)
    counts = [len(rgm(source, target, noncovisibility_weight=w)) for w in (0.0, 0.4, 0.9, 2.0)]
    assert counts[0] == 12
    assert counts == sorted(counts, reverse=True)
    assert counts[-1] == 0


def test_uncertainty_weight_drops_uncertain_objects_first():
    source, target, _ = scene(np.random.default_rng(4), common=8, extra=0)
    u = source.position_variance.copy()
    u[:2] *= 60
    source = ObjectGraph.from_positions(source.positions, position_variance=u)
    kept = {int(a) for a in rgm(source, target, uncertainty_weight=0.1).pairs[:, 0]}
    assert kept
    assert not kept & {0, 1}


def test_objects_of_unknown_variance_are_not_matched():
    source, target, _ = scene(np.random.default_rng(5))
    u = source.position_variance.copy()
    u[3] = np.inf
    found = rgm(ObjectGraph.from_positions(source.positions, position_variance=u), target)
    assert len(found) > 0
    assert 3 not in found.pairs[:, 0]


@pytest.mark.parametrize("acceptance", ["paper", "metropolis"])
def test_objects_of_hopeless_variance_do_not_end_the_chain(acceptance):
    source, target, _ = scene(np.random.default_rng(6))
    u = source.position_variance.copy()
    u[:2] *= 1e9
    hopeless = ObjectGraph.from_positions(source.positions, position_variance=u)
    for seed in range(5):
        # Nothing but these two is left to choose from once the chain has taken in everything else.
        found = rgm_no_uncertainty(hopeless, target, acceptance=acceptance, rng=np.random.default_rng(seed))
        assert np.isfinite(found.scores).all()


def test_too_many_objects_are_refused_with_the_limit():
    big = ObjectGraph.from_positions(np.zeros((65, 3)))
    with pytest.raises(ValueError, match="rgm accepts at most 64 objects a side, target has 65"):
        rgm(ObjectGraph.from_positions(np.zeros((2, 3))), big)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"acceptance": "greedy"}, "acceptance must be one of"),
        ({"proposals": -1}, "proposals must be a whole number of at least 0, got -1"),
        ({"end_temperature": 0.0}, "end_temperature"),
        ({"add_probability": 1.0}, "add_probability must lie in"),
        ({"proposal_width": 0.0}, r"proposal_width must lie in \(0, inf\], got 0"),
        ({"distance_width_m2": -1.0}, r"distance_width_m2 must lie in \(0, inf\], got -1"),
        ({"neighbours": 0}, "neighbours must be a whole number of at least 1, got 0"),
        ({"workers": 0}, "workers must be a whole number of at least 1, got 0"),
    ],
)
def test_bad_options_name_the_value(options, message):
    g = ObjectGraph.from_positions(np.eye(3))
    with pytest.raises(ValueError, match=message):
        rgm(g, g, **options)
