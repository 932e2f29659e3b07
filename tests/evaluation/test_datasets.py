"""The dataset reader: what it gives, what it hides, and how it refuses."""

import json

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from covis.evaluation.dataset_check import check
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


def each(of=None, **values):
    """Changes every row, or those whose numbers are given."""
    return lambda rows: [row | values if of is None or k in of else row for k, row in enumerate(rows)]


def moved(metres):
    T = np.eye(4)
    T[0, 3] = metres
    return T.ravel().tolist()


def ragged_embeddings(rows):
    return [row | {"embedding": [0.5] * (2 if k == 3 else 4)} for k, row in enumerate(rows)]


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
        ("detections.parquet", edit(position=[1.0, 2.0, np.nan]), "column 'position', row 0: nan is not finite"),
        ("detections.parquet", edit(position=None), "column 'position', row 0 is null"),
        ("detections.parquet", edit(position_variance=-1.0), "column 'position_variance', row 0: -1.0"),
        ("detections.parquet", edit(attribute=[0.5, 0.5]), "column 'attribute', row 0 has 2 values, expected 3"),
        ("detections.parquet", edit(attribute=[0.5, -0.5, 1.0]), "column 'attribute', row 0: negative"),
        ("detections.parquet", edit(identity=None), "column 'identity', row 0 is null"),
        ("detections.parquet", edit(robot="ghost"), "row 0 is of frame 0, robot 'ghost', which robots.parquet lacks"),
        ("robots.parquet", edit(pose=np.diag([2.0, 1, 1, 1]).ravel().tolist()), "column 'pose', row 0: .*rigid motion"),
        ("robots.parquet", lambda rows: [*rows, rows[0]], "repeats frame 0, robot 'robot_0'"),
        ("robots.parquet", lambda rows: [], "missing column"),
        ("robots.parquet", edit(frame=-1), "column 'frame', row 0: -1 is less than 0"),
        ("robots.parquet", edit(frame=0.5), "column 'frame', row 0: 0.5 is not a whole number"),
        ("robots.parquet", edit(frame=None), "column 'frame', row 0 is null"),
        ("robots.parquet", edit(robot=None), "column 'robot', row 0 is null"),
        ("robots.parquet", each(robot=1), "column 'robot' holds int64, not text"),
        ("robots.parquet", edit(episode=-3), "column 'episode', row 0: -3 is less than 0"),
        ("robots.parquet", edit(episode=7), "column 'episode', row 1: frame 0 is of episode 7 and of 0"),
        (
            "robots.parquet",
            each(of={6, 7, 10, 11}, episode=0),
            "column 'episode', row 10: frame 5 goes back to episode 0",
        ),
        ("robots.parquet", edit(time=np.inf), "column 'time', row 0: inf is not a time"),
        ("robots.parquet", each(of={2, 3}, time=-1.0), "column 'time', row 2: frame 1 is at -1.0 s"),
        ("robots.parquet", each(time="noon"), "column 'time' holds string, not numbers"),
        ("robots.parquet", edit(pose=moved(1e300)), "column 'pose', row 0: 1e\\+300 is beyond"),
        ("robots.parquet", edit(pose=moved(np.nan)), "column 'pose', row 0: nan is not finite"),
        ("robots.parquet", edit(pose=[1.0] * 15), "column 'pose', row 0 has 15 values, expected 16"),
        (
            "robots.parquet",
            edit(pose_truth=np.diag([-1.0, 1, 1, 1]).ravel().tolist()),
            "column 'pose_truth', row 0: .*det R",
        ),
        ("robots.parquet", each(odometry=[0.0] * 16), "column 'odometry', row 0: .*rigid motion"),
        ("robots.parquet", each(intrinsics=[0.0] * 9), "column 'intrinsics', row 0: focal lengths"),
        ("robots.parquet", each(up=[0.0, 0.0, 3.0]), "column 'up', row 0: a unit vector's length is not 3"),
        ("detections.parquet", edit(frame=99), "row 0 is of frame 99, robot 'robot_0', which robots.parquet lacks"),
        ("detections.parquet", edit(frame=-1), "column 'frame', row 0: -1 is less than 0"),
        ("detections.parquet", edit(detection=-1), "column 'detection', row 0: -1 is less than 0"),
        ("detections.parquet", edit(detection=2**31), "column 'detection', row 0: 2147483648 is beyond"),
        (
            "detections.parquet",
            lambda rows: [*rows[:1], rows[1] | {"identity": rows[0]["identity"]}, *rows[2:]],
            "column 'identity', row 1: frame 0, robot 'robot_0' has object .* twice",
        ),
        ("detections.parquet", edit(identity=2.0**63), "column 'identity', row 0: .* is not a whole number of 64 bits"),
        ("detections.parquet", edit(detection=1), "row 1 repeats frame 0, robot 'robot_0', detection 1"),
        (
            "detections.parquet",
            edit(position=[1.0, 2.0, 1e300]),
            "column 'position', row 0: 1e\\+300 is beyond 1e\\+07",
        ),
        ("detections.parquet", edit(position=[1.0, None, 2.0]), "column 'position', row 0 holds a null"),
        ("detections.parquet", each(position=None), "column 'position' holds null, not lists"),
        ("detections.parquet", each(position=["a", "b", "c"]), "column 'position' holds list.*string.*, not numbers"),
        ("detections.parquet", each(position=["1", "2", "3"]), "column 'position' holds list.*string.*, not numbers"),
        ("detections.parquet", each(position=[True] * 3), "column 'position' holds list.*bool.*, not numbers"),
        ("detections.parquet", each(position=1.0), "column 'position' holds double, not lists"),
        (
            "detections.parquet",
            edit(position_variance=np.nan),
            "column 'position_variance', row 0: nan is not a variance",
        ),
        ("detections.parquet", edit(position_variance=1e300), "column 'position_variance', row 0: 1e\\+300"),
        ("detections.parquet", edit(attribute_variance=-1e-9), "column 'attribute_variance', row 0: -1e-09"),
        ("detections.parquet", edit(attribute=[np.nan, 0.5, 0.5]), "column 'attribute', row 0: nan is not finite"),
        ("detections.parquet", each(attribute=[0.5, 0.5]), "column 'attribute', row 0 has 2 values, expected 3"),
        ("detections.parquet", each(of={5}, attribute=[0.2] * 5), "column 'attribute', row 5 has 5 values, expected 3"),
        ("detections.parquet", edit(truth=[1.0, 2.0, np.inf]), "column 'truth', row 0: inf is not finite"),
        ("detections.parquet", edit(covariance=[1.0] * 9), "column 'covariance', row 1 is null"),
        (
            "detections.parquet",
            each(covariance=[1.0, 2, 0, 0, 1, 0, 0, 0, 1]),
            "column 'covariance', row 0: not symmetric",
        ),
        (
            "detections.parquet",
            each(covariance=[-1.0, 0, 0, 0, 1, 0, 0, 0, 1]),
            "'covariance', row 0: not positive semi",
        ),
        ("detections.parquet", each(box=[5.0, 0, 1, 1]), r"column 'box', row 0: .* is not \[u0, v0, u1, v1\]"),
        ("detections.parquet", ragged_embeddings, "column 'embedding', row 3 has 2 values, expected 4"),
    ],
)
def test_bad_tables_name_file_column_and_row(small_dataset, file, change, message):
    rewrite(small_dataset, file, change)
    for read in (load_dataset, check):
        with pytest.raises(DatasetError, match=message) as caught:
            read(small_dataset)
        assert str(small_dataset / file) in str(caught.value)


def test_boxes_outside_the_image_are_refused(small_dataset):
    head = json.loads((small_dataset / "dataset.json").read_text()) | {"image_size": [320, 240]}
    (small_dataset / "dataset.json").write_text(json.dumps(head))
    rewrite(small_dataset, "detections.parquet", each(box=[1.0, 1.0, 9.0, 9.0]))
    for box in ([-60, 0, -20, 40], [0, 250, 10, 260], [0, 0, 5000, 40], [-900, 0, 20, 40]):
        rewrite(small_dataset, "detections.parquet", each(of={3}, box=[float(x) for x in box]))
        for read in (load_dataset, check):
            with pytest.raises(DatasetError, match=r"'box', row 3: .* lies outside the image of 320x240 pixels"):
                read(small_dataset)
    rewrite(small_dataset, "detections.parquet", each(of={3}, box=[-5.0, 0.0, 330.0, 240.0]))
    load_dataset(small_dataset)


def test_bad_true_objects_are_refused_too(small_dataset):
    head = small_dataset / "dataset.json"
    head.write_text(json.dumps(json.loads(head.read_text()) | {"min_pixels": 60}))
    row = {"frame": 0, "robot": "robot_0", "identity": 3, "pixels": 80}

    def write(*rows):
        pq.write_table(pa.Table.from_pylist(list(rows)), small_dataset / "objects.parquet")

    write(row, row | {"identity": 4, "pixels": 59})
    views = load_dataset(small_dataset).frame(0).views
    assert [view.visible.tolist() for view in views] == [[3], []]
    for wrong, message in (
        ({"pixels": 0}, "column 'pixels', row 1: 0 is less than 1"),
        ({"identity": -1}, "column 'identity', row 1: -1"),
        ({}, "row 1 repeats frame 0, robot 'robot_0', identity 3"),
        ({"robot": "ghost"}, "row 1 is of frame 0, robot 'ghost'"),
    ):
        write(row, row | wrong)
        with pytest.raises(DatasetError, match=rf"objects.parquet: .*{message}"):
            load_dataset(small_dataset)


def test_unknown_variance_may_be_infinite(small_dataset):
    rewrite(small_dataset, "detections.parquet", edit(position_variance=np.inf))
    graph = load_dataset(small_dataset).frame(0).views[0].graph
    assert np.isinf(graph.position_variance).sum() == 1


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"version": 2}, "version is 2, this reader knows 1"),
        ({"format": "coco"}, "format is 'coco'"),
        ({"classes": []}, "classes must be a list of names"),
        ({"units": "cm"}, "units must be 'm'"),
        ({"pose_std": {"position_m": 1}}, "pose_std is malformed"),
        ({"pose_std": {"position_m": -1, "heading_rad": 0}}, "pose_std is malformed: .*non-negative"),
        ({"classes": ["a", "b", "a"]}, "classes repeat a name"),
        ({"classes": "abc"}, "classes must be a list of names"),
        ({"up": [0, 0]}, "up is malformed"),
        ({"up": [0, 0, 5]}, "up is malformed: .*unit vector"),
        ({"image_size": [320]}, "image_size is malformed"),
        ({"image_size": [320, 0]}, "image_size is malformed"),
        ({"image_size": [320.5, 240]}, r"image_size is malformed: \[320.5, 240\] \(.* whole numbers"),
        ({"image_size": [np.inf, 240]}, "image_size is malformed"),
        ({"horizontal_fov_rad": 60}, "horizontal_fov_rad is malformed"),
        ({"min_pixels": "many"}, "min_pixels is malformed"),
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
    (small_dataset / "dataset.json").write_text("[1]")
    with pytest.raises(DatasetError, match=r"dataset.json holds list, not an object"):
        load_dataset(small_dataset)


@pytest.mark.parametrize("keep", [0, 100])
def test_truncated_parquet_is_refused(small_dataset, keep):
    file = small_dataset / "detections.parquet"
    file.write_bytes(file.read_bytes()[:keep])
    with pytest.raises(DatasetError, match=r"detections.parquet cannot be read as Parquet"):
        load_dataset(small_dataset)


def test_corrupt_pages_name_the_column(small_dataset):
    file = small_dataset / "detections.parquet"
    pq.write_table(pq.read_table(file), file, write_page_checksum=True, use_dictionary=False)
    column = pq.read_metadata(file).row_group(0).column(4)
    assert column.path_in_schema.startswith("position.")
    content = bytearray(file.read_bytes())
    at = column.data_page_offset + column.total_compressed_size // 2
    content[at : at + 4] = bytes(b ^ 0xFF for b in content[at : at + 4])
    file.write_bytes(content)
    with pytest.raises(DatasetError, match=r"detections.parquet: column 'position' cannot be read \(corrupt\?\)"):
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
