"""Every built-in matcher keeps the contract, on one shared list of problems."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from covis.matching import METHODS, Matching, ObjectGraph
from covis.matching.testing import check_matcher, check_well_formed, degenerate_problems, scene

NEEDS_PRIOR = {"hungarian"}
STOCHASTIC = {"rgm", "rgm-no-uncertainty", "rgm-no-covisibility"}
USES_PLACE_OF_ROBOT = {"bayes"}
"""Methods for which moving the objects without the robot is another problem: depth errors point along the rays."""

# Least F1 on the easy scenes. The hypergraph methods see angles only and match every object of the smaller view.
LEAST_F1 = {"rrwhm": 0.3, "bcagm": 0.3, "reid": 0.4}
EVERY = sorted(METHODS)


@pytest.mark.parametrize("name", EVERY)
def test_contract(name):
    check_matcher(
        METHODS[name],
        invariant=name not in STOCHASTIC,
        needs_prior=name in NEEDS_PRIOR,
        min_f1=LEAST_F1.get(name, 0.6),
    )


@pytest.mark.parametrize("name", sorted(set(EVERY) - NEEDS_PRIOR - {"reid"}))
def test_rigid_motion_of_one_view_changes_nothing(name):
    problem = scene(np.random.default_rng(5))
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("z", 2.0).as_matrix()
    if name not in USES_PLACE_OF_ROBOT:
        T[:3, 3] = [4.0, 7.0, -1.0]
    target = problem.target
    moved = ObjectGraph.from_positions(
        target.positions @ T[:3, :3].T + T[:3, 3],
        attributes=target.attributes,
        position_variance=target.position_variance,
        attribute_variance=target.attribute_variance,
        up=target.up,
    )
    before = METHODS[name](problem.source, problem.target, rng=np.random.default_rng(1))
    after = METHODS[name](problem.source, moved, rng=np.random.default_rng(1))
    if name == "icp":  # its starts turn by fixed steps: a turned view is another set of starts
        overlap = as_set(before) & as_set(after)
        assert len(overlap) >= 0.6 * max(len(before), len(after))
    else:
        assert as_set(before) == as_set(after)


@pytest.mark.parametrize("name", sorted(set(EVERY) - STOCHASTIC - {"icp", "bcagm"}))
def test_exchanging_the_robots_exchanges_the_matches(name):
    problem = scene(np.random.default_rng(6))
    prior = problem.prior if name in NEEDS_PRIOR else None
    back = None if prior is None else prior.inverse()
    there = METHODS[name](problem.source, problem.target, prior=prior)
    again = METHODS[name](problem.target, problem.source, prior=back)
    one, other = as_set(there), {(b, a) for a, b in as_set(again)}
    # The tensor of the hypergraph methods keeps neighbours of source triangles, so it is not quite symmetric.
    least = 0.5 if name in {"rrwhm", "mos"} else 1.0
    assert len(one & other) >= least * max(len(one), len(other))


def as_set(matching):
    return {(int(a), int(b)) for a, b in matching.pairs}


def test_the_list_of_problems_covers_what_it_promises():
    names = [p.name for p in degenerate_problems()]
    assert len(names) == len(set(names)) >= 20
    for word in (
        "empty",
        "one",
        "two",
        "collinear",
        "coincident",
        "identical",
        "mirror",
        "nothing",
        "zero",
        "infinite",
    ):
        assert any(word in name for name in names), word


@pytest.mark.parametrize(
    ("matcher", "complaint"),
    [
        (lambda s, t, **_: None, "returns a Matching"),
        (lambda s, t, **_: Matching(np.array([[0, 99]]), np.ones(1)), "more matches|no object"),
        (lambda s, t, **_: Matching.empty(), "F1 on easy scenes is 0.00"),
    ],
)
def test_check_matcher_finds_what_is_wrong(matcher, complaint):
    with pytest.raises(AssertionError, match=complaint):
        check_matcher(matcher)


def test_check_matcher_finds_a_lack_of_repeatability_and_of_invariance():
    rng = np.random.default_rng()

    def fickle(source, target, **_):
        k = min(len(source), len(target))
        return Matching(np.stack([np.arange(k), rng.permutation(k)], axis=1), np.ones(k))

    def ordered(source, target, **_):
        k = min(len(source), len(target))
        return Matching(np.stack([np.arange(k), np.arange(k)], axis=1), np.ones(k))

    with pytest.raises(AssertionError, match="same rng gives different"):
        check_matcher(fickle, min_f1=None)
    with pytest.raises(AssertionError, match="another order"):
        check_matcher(ordered, min_f1=None)
    check_matcher(ordered, min_f1=None, invariant=False)


def test_well_formed_accepts_the_empty_matching():
    graph = ObjectGraph.from_positions(np.zeros((0, 3)))
    check_well_formed(Matching.empty(), graph, graph)
