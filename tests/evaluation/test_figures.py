"""Figures hold the numbers they are given."""

import numpy as np
import pytest

pytest.importorskip("matplotlib")

from covis.evaluation.figures import benchmark_figure, reliability_figure, save, scaling_figure, sensitivity_figure
from covis.matching.metrics import reliability


def test_sensitivity_shows_every_cell_and_frames_the_published(tmp_path):
    rows = [
        {"target": t, "uncertainty_weight": a, "noncovisibility_weight": b, "f1": 0.1 * a + b}
        for t in ("x", "y")
        for a in (0.0, 0.1)
        for b in (0.2, 0.4, 0.6)
    ]
    figure = sensitivity_figure(rows)
    assert len(figure.axes) == 2
    axis = figure.axes[0]
    assert [t.get_text() for t in axis.texts] == [".200", ".400", ".600", ".210", ".410", ".610"]
    assert len(axis.patches) == 1
    save(figure, tmp_path / "new" / "sensitivity.png")
    assert (tmp_path / "new" / "sensitivity.png").stat().st_size > 5000


def test_scaling_draws_milliseconds_and_memory():
    rows = [{"what": m, "n": n, "ours": 100.0, "memory_mib": 2.0 * n} for m in ("bayes", "rgm") for n in (5, 50)]
    time, memory = scaling_figure(rows).axes
    np.testing.assert_allclose(time.lines[0].get_ydata(), [10.0, 10.0])
    np.testing.assert_allclose(memory.lines[0].get_ydata(), [10.0, 100.0])
    assert [t.get_text() for t in time.get_xticklabels()] == ["5", "50"]


def test_scaling_leaves_out_what_was_not_measured():
    rows = [{"what": "bayes", "n": 5, "ours": 100.0, "memory_mib": None}]
    assert len(scaling_figure(rows).axes[1].lines[0].get_xdata()) == 0


def test_reliability_has_a_line_per_method():
    bins = reliability(np.linspace(0, 1, 50), np.linspace(0, 1, 50) > 0.5)
    (axis,) = reliability_figure({"bayes": bins, "rgm": bins}).axes
    assert len(axis.lines) == 3


def row(method, f1, disturbance=None, target="multi_robot"):
    return {
        "experiment": target,
        "target": target,
        "method": method,
        "options": {},
        "disturbance": disturbance or {},
        "precision": f1,
        "recall": f1 / 2,
        "f1": f1,
        "f1_low": f1 - 0.1,
        "f1_high": f1 + 0.1,
    }


def test_f1_figure_has_the_papers_value_beside_ours():
    figure = benchmark_figure([row("rgm", 0.5), row("bayes", 0.8), row("oracle", 1.0)])
    (axis,) = figure.axes
    assert [label.get_text() for label in axis.get_yticklabels()] == ["rgm", "bayes", "oracle"]
    published = [line for line in axis.lines if line.get_marker() == "D"]
    assert [float(line.get_xdata()[0]) for line in published] == pytest.approx([2 * 0.701 * 0.711 / (0.701 + 0.711)])


def test_robustness_figure_goes_from_undisturbed_to_the_highest_rate():
    disturbed = [row("rgm", 0.5 - rate, {"position_noise": rate}) for rate in (0.2, 0.1)]
    figure = benchmark_figure([row("rgm", 0.5), *disturbed, row("random", 0.1)])
    (axis,) = figure.axes
    precision, recall = axis.lines
    np.testing.assert_allclose(precision.get_xdata(), [0, 10, 20])
    np.testing.assert_allclose(precision.get_ydata(), [0.5, 0.4, 0.3])
    np.testing.assert_allclose(recall.get_ydata(), [0.25, 0.2, 0.15])
    with pytest.raises(ValueError, match="no rows"):
        benchmark_figure([])
