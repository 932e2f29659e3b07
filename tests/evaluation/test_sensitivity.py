"""Settings compared, and the sensitivity analysis, on a small dataset folder of our own."""

import inspect
import json

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from typer.testing import CliRunner

from covis.evaluation.sensitivity import sensitivity
from covis.evaluation.tuning import GRIDS, compare_settings, mean_over_targets
from covis.matching import METHODS
from covis.matching.testing import scene
from covis.scripts.main import app


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("data") / "easy"
    path.mkdir()
    meta = {"format": "covis-dataset", "version": 1, "name": "easy", "classes": ["a", "b", "c", "d"], "units": "m"}
    meta |= {"sensor_frame": "levelled", "up": [0, 0, 1], "source": "test", "licence": "CC0"}
    (path / "dataset.json").write_text(json.dumps(meta))
    robots, detections = [], []
    for frame in range(6):
        problem = scene(np.random.default_rng(frame))
        target_identity = np.full(len(problem.target), -1)
        for i, ii in enumerate(problem.truth):
            if ii >= 0:
                target_identity[ii] = i
        views = ((problem.source, np.arange(len(problem.source))), (problem.target, target_identity))
        for r, (graph, identity) in enumerate(views):
            robots.append({"frame": frame, "time": float(frame), "robot": f"robot_{r}", "pose": None})
            for k in range(len(graph)):
                detections.append(
                    {
                        "frame": frame,
                        "robot": f"robot_{r}",
                        "detection": k,
                        "identity": int(identity[k]),
                        "position": graph.positions[k].tolist(),
                        "position_variance": float(graph.position_variance[k]),
                        "attribute": graph.attributes[k].tolist(),
                        "attribute_variance": float(graph.attribute_variance[k]),
                    }
                )
    pq.write_table(pa.Table.from_pylist(robots), path / "robots.parquet")
    pq.write_table(pa.Table.from_pylist(detections), path / "detections.parquet")
    return path


def test_rows_cover_the_grid_and_a_huge_penalty_leaves_nothing(folder):
    calls = []
    rows = sensitivity(
        [folder],
        uncertainty_weights=(0.0, 0.1),
        noncovisibility_weights=(0.0, 0.4, 5.0),
        frames=3,
        progress=lambda done, total: calls.append((done, total)),
    )
    assert [(r["uncertainty_weight"], r["noncovisibility_weight"]) for r in rows] == [
        (a, b) for a in (0.0, 0.1) for b in (0.0, 0.4, 5.0)
    ]
    assert {r["target"] for r in rows} == {"easy"}
    assert {r["pairs"] for r in rows} == {3}
    by = {(r["uncertainty_weight"], r["noncovisibility_weight"]): r for r in rows}
    assert by[0.0, 5.0]["f1"] == 0.0
    assert by[0.0, 0.4]["f1"] > 0.7
    assert by[0.0, 0.4]["precision"] >= by[0.0, 0.0]["precision"]
    assert calls[-1] == (6, 6)


def test_bad_arguments(folder):
    with pytest.raises(ValueError, match="frames must be at least 1, got 0"):
        sensitivity([folder], frames=0)


def test_mean_over_targets_counts_each_alike():
    rows = [
        {"target": t, "uncertainty_weight": 0.1, "noncovisibility_weight": w, "pairs": n}
        | {"precision": f, "recall": f, "f1": f}
        for t, n, fs in (("a", 10, (0.2, 0.4)), ("b", 90, (0.6, 0.0)))
        for w, f in zip((0.3, 0.4), fs, strict=True)
    ]
    means = mean_over_targets(rows)
    assert [(r["target"], r["noncovisibility_weight"], r["pairs"]) for r in means] == [
        ("mean of 2 datasets", 0.3, 100),
        ("mean of 2 datasets", 0.4, 100),
    ]
    assert [r["f1"] for r in means] == [pytest.approx(0.4), pytest.approx(0.2)]


def test_command_prints_the_best_and_draws_the_mean(folder, tmp_path):
    pytest.importorskip("matplotlib")
    out = CliRunner().invoke(app, ["sensitivity", str(folder), "--frames", "1", "--figure", str(tmp_path / "f.png")])
    assert out.exit_code == 0, out.output
    assert "easy: F1" in out.output
    assert "at the published weights, best" in out.output
    assert (tmp_path / "f.png").stat().st_size > 1000


@pytest.mark.parametrize("method", sorted(GRIDS))
def test_grids_are_of_twelve_settings_with_the_default_among_them(method):
    assert len(GRIDS[method]) == 12
    defaults = {n: p.default for n, p in inspect.signature(METHODS[method]).parameters.items()}
    assert {name: defaults[name] for name in GRIDS[method][0]} in GRIDS[method]


def test_a_setting_changes_what_is_found(folder):
    rows = compare_settings([folder], "clipper", GRIDS["clipper"], frames=2)
    assert [r["sigma_factor"] for r in rows] == [s["sigma_factor"] for s in GRIDS["clipper"]]
    assert {r["pairs"] for r in rows} == {2}
    assert len({r["f1"] for r in rows}) > 1


def test_tune_prints_the_settings_best_first(folder):
    out = CliRunner().invoke(app, ["tune", "reid", str(folder), "--frames", "2"])
    assert out.exit_code == 0, out.output
    assert "reid, easy" in out.output
    refused = CliRunner().invoke(app, ["tune", "bayes", str(folder)])
    assert refused.exit_code == 2
