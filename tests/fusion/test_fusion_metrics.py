import numpy as np
import pytest

from covis.fusion.metrics import (
    displacement,
    displacement_errors,
    gospa,
    identity_switches,
    nees,
    nees_interval,
    nees_per_dof,
)


def test_displacement_by_hand():
    errors = displacement_errors([[0, 0, 0], [1, 1, 1]], [[3, 4, 0], [1, 1, 1]])
    np.testing.assert_allclose(errors, [5, 0])
    summary = displacement(np.arange(101.0))
    assert (summary.mean, summary.median, summary.p95, summary.n) == (50, 50, 95, 101)
    assert displacement([]).n == 0
    assert np.isnan(displacement([]).mean)


def test_gospa_by_hand():
    # one pair 1 m apart, one missed, two false; c = 2, p = 2: sqrt(1 + 2 * 3)
    result = gospa([[0, 0, 1], [50, 0, 0], [60, 0, 0]], [[0, 0, 0], [-50, 0, 0]], cutoff=2.0)
    assert result.distance == pytest.approx(np.sqrt(7))
    assert (result.n_assigned, result.n_missed, result.n_false) == (1, 1, 2)
    assert result.localisation == pytest.approx(1.0)


def test_gospa_agrees_with_stone_soup():
    pytest.importorskip("stonesoup", reason="stonesoup is not installed")
    from stonesoup.metricgenerator.ospametric import GOSPAMetric
    from stonesoup.types.state import State

    rng = np.random.default_rng(2)
    for n, m in ((4, 6), (7, 3), (5, 5)):
        x, t = rng.uniform(0, 4, size=(n, 3)), rng.uniform(0, 4, size=(m, 3))
        theirs, _ = GOSPAMetric(p=2, c=1.5).compute_gospa_metric(
            [State(v[:, None]) for v in x], [State(v[:, None]) for v in t]
        )
        ours = gospa(x, t, cutoff=1.5)
        assert ours.distance == pytest.approx(theirs.value["distance"])
        assert ours.localisation == pytest.approx(theirs.value["localisation"])


def test_gospa_of_empty_sets():
    assert gospa(np.zeros((0, 3)), np.zeros((0, 3))).distance == 0
    assert gospa([], [[0.0, 0.0, 0.0]]).n_missed == 1
    assert gospa(np.zeros((0, 3)), np.zeros((4, 3)), cutoff=1.0).distance == pytest.approx(np.sqrt(2))


def test_bad_arguments_are_named():
    nobody = np.zeros((0, 3))
    for arguments, message in (
        ({"cutoff": 0}, r"cutoff must lie in \(0, inf\), got 0"),
        ({"p": 0.5}, r"p must lie in \[1, inf\), got 0.5"),
        ({"truths": np.zeros(3)}, r"estimates must be \(n, d\) and truths \(m, d\), got \(0, 3\) and \(3,\)"),
        ({"estimates": np.zeros((2, 2)), "truths": np.zeros((4, 3))}, r"got \(2, 2\) and \(4, 3\)"),
    ):
        with pytest.raises(ValueError, match=message):
            gospa(**({"estimates": nobody, "truths": nobody} | arguments))
    with pytest.raises(ValueError, match="n must be a whole number of at least 1, got 0"):
        nees_interval(0, 3)
    with pytest.raises(ValueError, match=r"errors must be \(n, d\) .* got \(2, 3\) and \(3, 3\)"):
        nees(np.zeros((2, 3)), np.eye(3))
    with pytest.raises(ValueError, match=r"both be \(n, d\), got \(1, 3\) and \(2, 3\)"):
        displacement_errors(np.zeros((1, 3)), np.zeros((2, 3)))


def test_gospa_does_not_depend_on_order():
    rng = np.random.default_rng(0)
    x, t = rng.normal(size=(6, 3)), rng.normal(size=(5, 3))
    assert gospa(x, t).distance == pytest.approx(gospa(x[rng.permutation(6)], t[rng.permutation(5)]).distance)


def test_nees_by_hand_and_in_the_mean():
    assert nees([[2.0, 0.0]], [np.diag([4.0, 1.0])])[0] == pytest.approx(1.0)
    rng = np.random.default_rng(1)
    C = np.array([[2.0, 0.5], [0.5, 1.0]])
    errors = rng.multivariate_normal(np.zeros(2), C, size=3000)
    low, high = nees_interval(3000, 2, 0.999)
    assert low < nees_per_dof(errors, np.broadcast_to(C, (3000, 2, 2))) < high
    assert np.isnan(nees_per_dof(np.zeros((0, 2)), np.zeros((0, 2, 2))))


def test_identity_switches_count_changes_only():
    frames = [{1: 10, 2: 20}, {1: 10}, {1: 11, 2: 20}, {}, {1: 11, 2: 21}]
    assert identity_switches(frames) == 2
