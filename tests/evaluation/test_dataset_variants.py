"""Dataset folders as others write them: every way that the format leaves open gives the same benchmark."""

import json

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest

from covis.evaluation.benchmark import benchmark
from covis.evaluation.dataset_check import check
from covis.evaluation.datasets import load_dataset
from covis.evaluation.methods import Method
from covis.evaluation.settings import Settings

METHODS = ("oracle", "reid", "bayes", "rgm")
TABLES = ("robots", "detections")
REQUIRED = {
    "robots": ["frame", "robot"],
    "detections": ["frame", "robot", "detection", "identity", "position", "position_variance", "attribute"]
    + ["attribute_variance"],
}


def rows(folder, *methods, **settings):
    found = benchmark([str(folder)], [Method.parse(m) for m in methods or METHODS], Settings(**settings))
    return [{k: v for k, v in row.items() if k not in ("match_ms", "commit")} for row in found]


def rewritten(change, **how):
    """A writer of both tables after `change(name, table)`."""

    def write(folder):
        for name in TABLES:
            table = change(name, pq.read_table(folder / f"{name}.parquet"))
            pq.write_table(table, folder / f"{name}.parquet", **how)

    return write


def as_is(name, table):
    return table


def cast(kinds):
    """Columns of the one type in the other."""

    def change(name, table):
        return table.cast(pa.schema([(f.name, kinds.get(f.type, f.type)) for f in table.schema]))

    return change


def dictionaries(name, table):
    at = table.column_names.index("robot")
    return table.set_column(at, "robot", table["robot"].dictionary_encode())


def categories(name, table):
    """As pandas writes `df.astype("category")` of numbers and names."""
    for column in {"robots": ("robot", "episode"), "detections": ("robot", "detection", "identity")}[name]:
        table = table.set_column(table.column_names.index(column), column, table[column].dictionary_encode())
    return table


def fixed_lists(name, table):
    fields = []
    for field in table.schema:
        kind = field.type
        if pa.types.is_list(kind):
            kind = pa.list_(kind.value_type, pc.list_value_length(table[field.name])[0].as_py())
        fields.append((field.name, kind))
    return pa.Table.from_pylist(table.to_pylist(), schema=pa.schema(fields))


def shuffled(name, table):
    return table.take(np.random.default_rng(3).permutation(table.num_rows))


def further_columns(name, table):
    table = table.append_column("weather", pa.array(["rain"] * table.num_rows))
    return table.append_column("extra", pa.array([{"a": [1, None]}] * table.num_rows)).add_column(
        0, "index", pa.array(range(table.num_rows))
    )


def columns_reversed(name, table):
    return table.select(table.column_names[::-1])


def large_ids(name, table):
    if name == "robots":
        return table
    # Beyond what a float64 tells apart.
    larger = pc.add(pc.multiply(table["identity"], 1), pa.scalar(2**62 + 1, pa.int64()))
    return table.set_column(table.column_names.index("identity"), "identity", larger)


def large_frames(name, table):
    return table.set_column(table.column_names.index("frame"), "frame", pc.add(table["frame"], pa.scalar(10**12)))


SAME = {
    "several row groups": rewritten(as_is, row_group_size=5),
    "no dictionary pages, other compression": rewritten(as_is, use_dictionary=False, compression="zstd"),
    "page version 2": rewritten(as_is, data_page_version="2.0"),
    "dictionary-encoded names": rewritten(dictionaries),
    "categories": rewritten(categories),
    "fixed-size lists": rewritten(fixed_lists),
    "large lists": rewritten(
        cast({pa.list_(pa.float64()): pa.large_list(pa.float64()), pa.string(): pa.large_string()})
    ),
    "narrow integers": rewritten(cast({pa.int64(): pa.int32()})),
    "unsigned integers": rewritten(cast({pa.int64(): pa.uint64()})),
    "further columns": rewritten(further_columns),
    "columns in another order": rewritten(columns_reversed),
    "large identities": rewritten(large_ids),
    "rows out of order": rewritten(shuffled),
}
"""Ways to write that may not change one figure of any method."""


@pytest.mark.parametrize("way", SAME)
def test_ways_of_writing_change_nothing(small_dataset, way):
    before = rows(small_dataset)
    assert before[0]["f1"] == 1.0
    assert before[0]["displacement_fused_m"] > 0
    files = [(small_dataset / f"{name}.parquet").read_bytes() for name in TABLES]
    SAME[way](small_dataset)
    assert files != [(small_dataset / f"{name}.parquet").read_bytes() for name in TABLES]
    check(small_dataset)
    assert rows(small_dataset) == before


SIMILAR = {
    "float32": rewritten(cast({pa.list_(pa.float64()): pa.list_(pa.float32()), pa.float64(): pa.float32()})),
    "large frame numbers": rewritten(large_frames),
}
"""Those that change how detections are shuffled, or the last digits of what matchers see."""


@pytest.mark.parametrize("way", SIMILAR)
def test_shuffling_and_precision_change_no_count(small_dataset, way):
    methods = ("oracle", "bayes")
    before = rows(small_dataset, *methods)
    SIMILAR[way](small_dataset)
    check(small_dataset)
    for a, b in zip(rows(small_dataset, *methods), before, strict=True):
        for key in ("frames", "pairs", "episodes", "n_correct", "n_retrieved", "n_covisible"):
            assert a[key] == b[key], (a["method"], key)
        for key in ("displacement_single_m", "displacement_fused_m"):
            assert a[key] == pytest.approx(b[key], rel=1e-4), (a["method"], key)


def test_the_required_columns_are_enough(small_dataset):
    keep = rewritten(lambda name, table: table.select(REQUIRED[name]))
    with_all = rows(small_dataset)
    keep(small_dataset)
    head = json.loads((small_dataset / "dataset.json").read_text())
    few = {key: head[key] for key in ("format", "version", "name", "classes")}
    (small_dataset / "dataset.json").write_text(json.dumps(few))
    assert check(small_dataset).frames == 6
    found = rows(small_dataset)
    assert found[0]["f1"] == 1.0
    assert found[0]["episodes"] == found[0]["frames"] == 6  # a frame is an episode where nothing else is said
    assert "displacement_fused_m" not in found[0]
    assert "scene_recall" not in found[0]
    assert [row["pairs"] for row in found] == [row["pairs"] for row in with_all]
    rows(small_dataset, "bayes", sequence=True)


def test_poses_without_a_stated_error_are_the_truth(small_dataset):
    rewritten(lambda name, table: table.drop_columns("pose_truth") if name == "robots" else table)(small_dataset)
    assert "displacement_fused_m" not in rows(small_dataset, "oracle")[0]
    head = json.loads((small_dataset / "dataset.json").read_text())
    del head["pose_std"]
    (small_dataset / "dataset.json").write_text(json.dumps(head))
    assert rows(small_dataset, "oracle")[0]["displacement_fused_m"] > 0


def test_some_robots_without_poses_and_some_objects_without_truth(small_dataset):
    def change(name, table):
        out = table.to_pylist()
        for k, row in enumerate(out):
            if name == "robots" and row["frame"] == 2:
                row["pose"] = None
            if name == "robots" and row["frame"] == 3 and row["robot"] == "robot_1":
                row["pose"] = row["pose_truth"] = None
            if name == "detections" and k % 7 == 0:
                row |= {"truth": None, "identity": -1}
        return pa.Table.from_pylist(out)

    before = rows(small_dataset, "oracle")[0]
    rewritten(change)(small_dataset)
    check(small_dataset)
    after = rows(small_dataset, "oracle")[0]
    assert after["pairs"] == before["pairs"]
    assert 0 < after["displacement_fused_m"] < 0.3


def team(folder, n_robots=4, n_episodes=3, frames=4, n_objects=12, seed=5, noise_m=0.1):
    """Several robots and episodes, written by hand: exact poses, noise of a known size; one robot comes and goes."""
    rng = np.random.default_rng(seed)
    robots, detections = [], []
    for frame in range(n_episodes * frames):
        world = rng.uniform(-20, 20, (n_objects, 3))
        for r in range(n_robots):
            if r == 3 and frame % 2:
                continue
            heading, T = rng.uniform(-np.pi, np.pi), np.eye(4)
            T[:2, :2] = [[np.cos(heading), -np.sin(heading)], [np.sin(heading), np.cos(heading)]]
            T[:3, 3] = rng.uniform(-3, 3, 3)
            at = {"frame": 7 * frame, "robot": f"unit {r}"}
            robots.append(at | {"pose": T.ravel().tolist(), "episode": 10 + frame // frames})
            for k, j in enumerate(rng.permutation(n_objects)[:9]):
                position = (world[j] - T[:3, 3]) @ T[:3, :3] + rng.normal(0, noise_m, 3)
                detections.append(
                    at
                    | {"detection": k, "identity": 1000 * frame + int(j), "truth": world[j].tolist()}
                    | {"position": position.tolist(), "position_variance": noise_m**2}
                    | {"covariance": (noise_m**2 * np.eye(3)).ravel().tolist()}
                    | {"attribute": [0.5, 0.5], "attribute_variance": 0.25}
                )
    folder.mkdir()
    pq.write_table(pa.Table.from_pylist(robots), folder / "robots.parquet")
    pq.write_table(pa.Table.from_pylist(detections), folder / "detections.parquet")
    head = {"format": "covis-dataset", "version": 1, "name": "team", "classes": ["a", "b"]}
    (folder / "dataset.json").write_text(json.dumps(head))
    return folder


def test_teams_fuse_what_all_of_them_measured(tmp_path):
    folder = team(tmp_path / "team")
    check(folder)
    (row,) = rows(folder, "oracle")
    assert (row["frames"], row["episodes"]) == (12, 3)
    assert row["pairs"] == 6 * 6 + 6 * 3  # four robots in every other frame, three in the rest
    # The mean length of a three-dimensional normal error of .1 m per axis; about three robots see each matched object.
    assert row["displacement_single_m"] == pytest.approx(0.1596, rel=0.07)
    assert row["displacement_fused_m"] == pytest.approx(0.1596 / np.sqrt(3), rel=0.12)
    alone = rows(folder, "oracle", episodes=1)[0]
    assert (alone["frames"], alone["episodes"]) == (4, 1)


def test_errors_are_counted_once_per_detection(tmp_path):
    from covis.evaluation.run_dataset import run_episodes

    dataset = load_dataset(team(tmp_path / "team", n_episodes=1))
    records = run_episodes(dataset, [10], [Method.parse("oracle")], Settings())
    matched = set()
    for frame in dataset:
        for a in frame.views:
            for b in frame.views:
                if a is not b:
                    both = np.isin(a.identity, b.identity)
                    matched |= {(frame.index, a.robot, int(i)) for i in a.identity[both]}
    assert sum(len(r.error_single_m) for r in records) == len(matched)
    assert all(r.positions_scored and len(r.error_single_m) == len(r.error_range_m) for r in records)
