"""The dataset reader: what it gives, what it hides, and how it refuses."""

import json

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from covis.evaluation.datasets import DatasetError, load_dataset, pose_covariance, prior_between, true_relative_pose
from covis.matching.pose import transform


def rewrite(folder, file, change):
    table = pq.read_table(folder / file).to_pylist()
    pq.write_table(pa.Table.from_pylist(change(table)), folder / file)


def edit(**values):
    """Changes the first row."""

    def change(rows):
        rows[0] |= values
        return rows

    return change


def drop(column):
    return lambda rows: [{k: v for k, v in row.items() if k != column} for row in rows]


def test_reads_what_was_written(small_dataset):
    dataset = load_dataset(small_dataset)
    assert dataset.name == "small"
    assert dataset.classes == ("a", "b", "c")
    assert len(dataset) == 6
    assert dataset.has_episodes
    frame = dataset.frame(4)
    assert (frame.index, frame.episode) == (4, 1)
    assert frame.time == pytest.approx(0.8)
    source, target = frame.views
    assert source.robot == "robot_0"
    np.testing.assert_allclose(source.graph.up, [0, 0, 1])
    np.testing.assert_allclose(source.graph.forward, [1, 0, 0])
    T = true_relative_pose(source, target)
    common, i, j = np.intersect1d(source.identity, target.identity, return_indices=True)
    assert len(common) >= 3
    gap = source.graph.positions[i] - transform(T, target.graph.positions[j])
    assert np.abs(gap).max() < 0.5
    prior = prior_between(source, target)
    assert np.linalg.norm(prior.T_source_target[:3, 3] - T[:3, 3]) < 1.0


def test_detections_are_shuffled_reproducibly_and_stay_whole(small_dataset):
    views = [load_dataset(small_dataset, seed=s).frame(0).views[0] for s in (0, 0, 1)]
    np.testing.assert_array_equal(views[0].order, views[1].order)
    assert not np.array_equal(views[0].order, views[2].order)
    assert not np.array_equal(views[0].order, np.sort(views[0].order))
    back = np.argsort(views[0].order)
    again = np.argsort(views[2].order)
    for name in ("positions", "attributes"):
        np.testing.assert_array_equal(getattr(views[0].graph, name)[back], getattr(views[2].graph, name)[again])
    np.testing.assert_array_equal(views[0].identity[back], views[2].identity[again])


def test_matchers_never_see_truth(small_dataset):
    graph = load_dataset(small_dataset).frame(0).views[0].graph
    assert not any("identity" in name or "truth" in name for name in vars(graph))


def test_frames_are_the_episodes_where_there_are_none(small_dataset):
    rewrite(small_dataset, "robots.parquet", drop("episode"))
    dataset = load_dataset(small_dataset)
    assert not dataset.has_episodes
    assert [f.episode for f in dataset] == [f.index for f in dataset]


def test_robot_without_detections_has_an_empty_graph(small_dataset):
    rewrite(small_dataset, "detections.parquet", lambda rows: [r for r in rows if r["frame"] != 0])
    view = load_dataset(small_dataset).frame(0).views[0]
    assert len(view.graph) == 0
    assert view.graph.attributes.shape == (0, 3)


def test_null_poses_are_none(small_dataset):
    rewrite(small_dataset, "robots.parquet", edit(pose=None))
    first, second = load_dataset(small_dataset).frame(0).views
    assert first.pose is None
    with pytest.raises(DatasetError, match="robot_0 has no pose"):
        prior_between(first, second)


def test_unknown_columns_are_ignored(small_dataset):
    rewrite(small_dataset, "detections.parquet", lambda rows: [r | {"colour": "red"} for r in rows])
    assert len(load_dataset(small_dataset)) == 6


@pytest.mark.parametrize(
    ("file", "change", "message"),
    [
        ("detections.parquet", drop("attribute"), r"detections.parquet: missing column\(s\) attribute"),
        ("robots.parquet", drop("frame"), r"robots.parquet: missing column\(s\) frame"),
        ("detections.parquet", edit(position=[1.0, 2.0]), "column 'position', row 0 has 2 values, expected 3"),
        ("detections.parquet", edit(position=[1.0, 2.0, np.nan]), "column 'position', row 0 is not finite"),
        ("detections.parquet", edit(position=None), "column 'position', row 0 is null"),
        ("detections.parquet", edit(position_variance=-1.0), "column 'position_variance', row 0: -1.0"),
        ("detections.parquet", edit(attribute=[0.5, 0.5]), "column 'attribute', row 0 has 2 values, expected 3"),
        ("detections.parquet", edit(attribute=[0.5, -0.5, 1.0]), "column 'attribute', row 0: negative"),
        ("detections.parquet", edit(identity=None), "column 'identity', row 0 is null"),
        ("detections.parquet", edit(robot="ghost"), "row 0 is of frame 0, robot 'ghost', which robots.parquet lacks"),
        ("robots.parquet", edit(pose=np.diag([2.0, 1, 1, 1]).ravel().tolist()), "column 'pose', row 0: .*rigid motion"),
        ("robots.parquet", lambda rows: [*rows, rows[0]], "repeats frame 0, robot 'robot_0'"),
    ],
)
def test_bad_tables_name_file_column_and_row(small_dataset, file, change, message):
    rewrite(small_dataset, file, change)
    with pytest.raises(DatasetError, match=message):
        load_dataset(small_dataset)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"version": 2}, "version is 2, this reader knows 1"),
        ({"format": "coco"}, "format is 'coco'"),
        ({"classes": []}, "classes must be a list of names"),
        ({"units": "cm"}, "units must be 'm'"),
        ({"pose_std": {"position_m": 1}}, "pose_std is malformed"),
    ],
)
def test_bad_heads_are_refused(small_dataset, change, message):
    file = small_dataset / "dataset.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | change))
    with pytest.raises(DatasetError, match=message):
        load_dataset(small_dataset)


def test_broken_files_are_refused(small_dataset):
    (small_dataset / "dataset.json").write_text("{")
    with pytest.raises(DatasetError, match="is not JSON"):
        load_dataset(small_dataset)


@pytest.mark.parametrize("keep", [0, 100])
def test_truncated_parquet_is_refused(small_dataset, keep):
    file = small_dataset / "detections.parquet"
    file.write_bytes(file.read_bytes()[:keep])
    with pytest.raises(DatasetError, match=r"detections.parquet cannot be read as Parquet"):
        load_dataset(small_dataset)


@pytest.mark.parametrize("file", ["dataset.json", "robots.parquet", "detections.parquet"])
def test_missing_files_are_named(small_dataset, file):
    (small_dataset / file).unlink()
    with pytest.raises(DatasetError, match=f"{file} is missing"):
        load_dataset(small_dataset)


def test_pose_covariance_turns_about_up():
    covariance = pose_covariance((2.0, 0.1), np.array([0.0, -1.0, 0.0]))
    np.testing.assert_allclose(np.diag(covariance), [4, 4, 4, 0, 0.01, 0], atol=1e-5)


def test_development_data_is_readable(shared_data):
    for folder in sorted(shared_data.iterdir()):
        if folder.is_dir():
            dataset = load_dataset(folder)
            assert len(dataset.frame(0).views) == 2
