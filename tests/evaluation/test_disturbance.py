"""Worse reports, worse measurements."""

import numpy as np
import pytest

from covis.evaluation.disturbance import Disturbance
from covis.evaluation.methods import Method
from covis.evaluation.synthetic import frames
from covis.matching import ObjectGraph


def graph(n=4000, covariances=None):
    positions = np.tile([3.0, 0.0, 4.0], (n, 1))
    attributes = np.tile([0.6, 0.4], (n, 1))
    return ObjectGraph(positions, attributes, np.full(n, 0.04), np.full(n, 0.0001), covariances)


def test_reports_grow_and_measurements_stay():
    before = graph(5, np.tile(np.diag([1.0, 2.0, 3.0]), (5, 1, 1)))
    after = Disturbance(attribute_uncertainty=0.1, position_uncertainty=0.15).apply(before, np.random.default_rng(0))
    np.testing.assert_array_equal(after.positions, before.positions)
    np.testing.assert_array_equal(after.attributes, before.attributes)
    np.testing.assert_allclose(after.position_variance, 0.04 * 1.15)
    np.testing.assert_allclose(after.attribute_variance, 0.0001 * 1.1)
    np.testing.assert_allclose(after.covariances, before.covariances * 1.15)


def test_noise_grows_by_the_rate_and_reports_stay():
    """A measurement that errs by s already, and by sqrt(1.5^2 - 1) s more, errs by 1.5 s."""
    rng = np.random.default_rng(0)
    before = graph()
    after = Disturbance(attribute_noise=0.5, position_noise=0.5).apply(before, rng)
    added = after.positions - before.positions
    along = added @ [0.6, 0.0, 0.8]
    assert np.sqrt(0.04 + along.var()) == pytest.approx(1.5 * 0.2, rel=0.03)
    assert np.linalg.norm(added - np.outer(along, [0.6, 0.0, 0.8])) < 1e-6
    np.testing.assert_allclose(after.attributes.sum(axis=1), 1.0)
    # Noise of 0.01 on .6 and .4, as much more as on positions; their sum is brought back to 1.
    assert after.attributes[:, 0].std() == pytest.approx(np.sqrt(1.25) * 0.01 * np.hypot(0.4, 0.6), rel=0.05)
    np.testing.assert_array_equal(after.position_variance, before.position_variance)
    full = Disturbance(position_noise=0.5).apply(graph(4000, np.tile(np.diag([1.0, 4.0, 9.0]), (4000, 1, 1))), rng)
    spread = (full.positions - before.positions).std(axis=0)
    np.testing.assert_allclose(spread, np.sqrt(1.25) * np.array([1, 2, 3]), rtol=0.06)


def test_nothing_to_do():
    before = graph(3)
    assert Disturbance().apply(before, np.random.default_rng(0)) is before
    empty = ObjectGraph.from_positions(np.zeros((0, 3)))
    assert len(Disturbance(position_noise=1.0).apply(empty, np.random.default_rng(0))) == 0


def test_methods_carry_them():
    method = Method.parse("rgm:acceptance=metropolis@position_uncertainty=0.1,attribute_noise=0.5")
    assert (method.name, dict(method.options)) == ("rgm", {"acceptance": "metropolis"})
    assert method.disturbance.rates() == {"position_uncertainty": 0.1, "attribute_noise": 0.5}
    assert Method.parse("mypkg.mine:match@position_noise=1").name == "mypkg.mine:match"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("rgm@weather=1", "'weather' is no disturbance"),
        ("rgm@position_noise=-1", "position_noise must be a finite, non-negative rate, got -1"),
        ("rgm@position_noise=much", "got 'much'"),
        ("rgm@", "names no disturbance"),
    ],
)
def test_bad_ones_are_refused(text, message):
    with pytest.raises(ValueError, match=message):
        Method.parse(text)


def test_generated_problems_are_what_their_names_say():
    hard, moderate, mixed = (list(frames(f"cad-{d}", 5, range(40))) for d in ("hard", "moderate", "mixed"))
    assert common(hard) == pytest.approx(6, abs=1)
    alone = [len(view.identity) for frame in hard for view in frame.views]
    assert np.mean(alone) == pytest.approx(2 * common(hard), rel=0.15)
    assert [len(np.intersect1d(f.views[0].identity, f.views[1].identity)) > 0 for f in mixed] == [True, False] * 20
    sizes = [len(view.identity) for frame in moderate for view in frame.views]
    assert np.mean(sizes) == pytest.approx(1.25 * common(moderate), rel=0.15)


def common(made):
    return np.mean([len(np.intersect1d(f.views[0].identity, f.views[1].identity)) for f in made])


def test_generated_problems_have_the_noise_they_report():
    scaled = []
    for frame in frames("smrc-hard", 3, range(60)):
        for view in frame.views:
            T = view.pose_truth
            true = (view.truth - T[:3, 3]) @ T[:3, :3]
            error = np.linalg.norm(view.graph.positions, axis=1) - np.linalg.norm(true, axis=1)
            scaled.append(error / np.sqrt(view.graph.position_variance))
    assert np.concatenate(scaled).std() == pytest.approx(1.0, abs=0.06)


def test_generated_problems_depend_on_seed_and_number_alone():
    (first,), (again,) = list(frames("rmrc-mid", 2, [7])), list(frames("rmrc-mid", 2, range(8)))[7:]
    np.testing.assert_array_equal(first.views[1].graph.positions, again.views[1].graph.positions)
    (other,) = frames("rmrc-mid", 3, [7])
    assert len(other.views[1].graph) != len(first.views[1].graph) or not np.array_equal(
        other.views[1].graph.positions, first.views[1].graph.positions
    )
    with pytest.raises(ValueError, match="no synthetic problem is called 'cad'"):
        next(frames("cad", 0, [0]))
