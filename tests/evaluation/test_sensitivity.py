"""The sensitivity analysis on a small dataset folder of our own."""

import json

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from covis.evaluation.sensitivity import sensitivity
from covis.matching.testing import scene


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
        every=2,
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
    with pytest.raises(ValueError, match="every must be at least 1, got 0"):
        sensitivity([folder], every=0)
