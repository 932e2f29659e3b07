"""Scenes to dataset folders: whole or not at all, the same however often it was interrupted."""

import json
import shutil

import cv2
import numpy as np
import pandas
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import yaml
from pycocotools import mask as coco_mask

from covis.evaluation import recording
from covis.evaluation.benchmark import benchmark
from covis.evaluation.dataset_check import Checked, ChecksumError, check
from covis.evaluation.datasets import DatasetError, load_dataset
from covis.evaluation.methods import Method
from covis.evaluation.recording import record
from covis.evaluation.recording_rows import run_lengths
from covis.evaluation.settings import Settings

SCENE = "box_world:BoxWorld"
SETTINGS = Settings(episodes=2, perception="simulated")


def tables(folder):
    return {name: pq.read_table(folder / f"{name}.parquet").to_pylist() for name in recording.TABLES}


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    folder = tmp_path_factory.mktemp("recorded") / "boxes"
    record(SCENE, SETTINGS, folder)
    return folder


def test_a_recording_is_a_dataset(recorded):
    dataset = load_dataset(recorded)
    assert dataset.classes == ("red", "blue")
    assert len(dataset) == 2 * 25
    assert sorted(set(dataset.episode.tolist())) == [0, 1]
    view = dataset.frame(0).views[0]
    assert view.graph.image_size == (320, 240)
    assert view.graph.covariances is not None
    assert view.graph.up is not None
    assert view.visible is not None
    assert check(recorded) == Checked(frames=50, verified=True)
    assert sorted(f.name for f in recorded.iterdir()) == sorted(recording.FILES)


@pytest.mark.parametrize("pose", ["unknown", "known"])
def test_it_scores_as_the_live_scene_does(recorded, pose):
    # Methods that draw nothing and do not mind the order of detections, which the reader shuffles.
    methods = [Method.parse(m) for m in ("oracle", "reid", "bayes", *(["hungarian"] if pose == "known" else []))]
    live = benchmark([SCENE], methods, Settings(pose=pose, episodes=2, perception="simulated"))
    offline = benchmark([str(recorded)], methods, Settings(pose=pose))
    same = ("frames", "pairs", "n_correct", "n_retrieved", "n_covisible", "n_visible", "f1", "scene_recall")
    for a, b in zip(live, offline, strict=True):
        assert [a[key] for key in same] == [b[key] for key in same]
        # Actions and observations are float32.
        for key in ("displacement_single_m", "displacement_fused_m"):
            assert a[key] == pytest.approx(b[key], rel=1e-3), key
    assert any(row["displacement_fused_m"] < row["displacement_single_m"] for row in offline)


def test_learned_eyes_record_all_that_matchers_saw(tmp_path):
    pytest.importorskip("torch", reason="learned eyes need covis[learned]")
    settings = Settings(episodes=1, preset="easy")
    record("target_localization", settings, tmp_path / "learned")
    check(tmp_path / "learned")
    methods = [Method.parse(name) for name in ("reid", "bayes", "oracle")]
    live = benchmark(["target_localization"], methods, settings)
    offline = benchmark([str(tmp_path / "learned")], methods, Settings())
    detections = pq.read_table(tmp_path / "learned" / "detections.parquet")
    assert detections.num_rows > detections["mask"].null_count == detections["embedding"].null_count == 0
    for a, b in zip(live, offline, strict=True):
        assert a["pairs"] > 0
        for key in ("pairs", "n_correct", "n_retrieved"):
            assert a[key] == b[key], key
        for key in ("displacement_single_m", "displacement_fused_m"):
            assert a[key] == pytest.approx(b[key], rel=1e-3), key


def test_masks_and_boxes_are_of_what_the_image_shows(recorded):
    robots, objects = (pq.read_table(recorded / f"{t}.parquet").to_pylist() for t in ("robots", "objects"))
    image = cv2.imdecode(np.frombuffer(robots[0]["image"], np.uint8), cv2.IMREAD_COLOR)
    here = [row for row in objects if (row["frame"], row["robot"]) == (robots[0]["frame"], robots[0]["robot"])]
    assert len(here) >= 3
    for row in here:
        mask = coco_mask.decode(coco_mask.frPyObjects({"counts": row["mask"], "size": [240, 320]}, 240, 320)).astype(
            bool
        )
        v, u = np.nonzero(mask)
        assert row["pixels"] == len(v)
        assert row["box"] == [u.min(), v.min(), u.max() + 1, v.max() + 1]
        blue, _, red = np.median(image[mask], axis=0)
        assert (row["class"] == "red") == (red > blue)


def test_pandas_reads_it(recorded):
    robots, objects = (pandas.read_parquet(recorded / f"{t}.parquet") for t in ("robots", "objects"))
    assert len(robots.merge(objects, on=["frame", "robot"])) == len(objects)
    assert robots["pose"].map(len).eq(16).all()


def test_polars_reads_it(recorded):
    polars = pytest.importorskip("polars", reason="polars is not among the development packages")
    assert (
        polars.read_parquet(recorded / "objects.parquet").height
        == pq.read_metadata(recorded / "objects.parquet").num_rows
    )


def test_the_data_card_tells_hugging_face_what_the_tables_hold(recorded):
    front, body = (recorded / "README.md").read_text().removeprefix("---\n").split("---\n", 1)
    head = yaml.safe_load(front)
    assert {c["config_name"]: c["data_files"] for c in head["configs"]} == {t: f"{t}.parquet" for t in recording.TABLES}
    assert [c["config_name"] for c in head["configs"] if c.get("default")] == ["robots"]
    for info in head["dataset_info"]:
        schema = pq.read_schema(recorded / f"{info['config_name']}.parquet")
        assert [feature["name"] for feature in info["features"]] == schema.names
    assert all(f"| `{name}` |" in body for schema in recording.TABLES.values() for name in schema.names)


def test_hugging_face_reads_it(recorded, monkeypatch, tmp_path):
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    monkeypatch.setenv("HF_HOME", str(tmp_path))
    datasets = pytest.importorskip("datasets", reason="Hugging Face's datasets is not among the development packages")
    robots = datasets.load_dataset(str(recorded), split="train")
    assert robots[0]["image"].size == (320, 240)
    for table in recording.TABLES:
        rows = pq.read_metadata(recorded / f"{table}.parquet").num_rows
        assert len(datasets.load_dataset(str(recorded), table, split="train")) == rows


@pytest.mark.parametrize("mask", [[[0, 1], [1, 0]], [[1, 1], [1, 1]], [[0, 0], [0, 0]], [[1, 0], [0, 0]]])
def test_run_lengths_are_cocos(mask):
    runs = run_lengths(np.array(mask, dtype=bool))
    np.testing.assert_array_equal(coco_mask.decode(coco_mask.frPyObjects({"counts": runs, "size": [2, 2]}, 2, 2)), mask)


def test_workers_change_nothing(recorded, tmp_path):
    record(SCENE, SETTINGS, tmp_path / "parallel", workers=2)
    for file in recording.FILES:
        assert (tmp_path / "parallel" / file).read_bytes() == (recorded / file).read_bytes(), file


def test_interrupted_recordings_end_the_same(recorded, tmp_path, monkeypatch):
    write = recording._write_episode

    def stop_at_second(env, episode, settings, parts):
        if episode == 1:
            raise KeyboardInterrupt
        write(env, episode, settings, parts)

    folder = tmp_path / "again"
    monkeypatch.setattr(recording, "_write_episode", stop_at_second)
    with pytest.raises(KeyboardInterrupt):
        record(SCENE, SETTINGS, folder)
    monkeypatch.undo()
    with pytest.raises(DatasetError, match=r"is an unfinished recording: go on with covis record --resume"):
        load_dataset(folder)
    with pytest.raises(DatasetError, match=r"unfinished recording \(1 whole episodes\)"):
        check(folder)
    with pytest.raises(FileExistsError, match="give --resume"):
        record(SCENE, SETTINGS, folder)
    with pytest.raises(FileExistsError, match="unfinished recording of"):
        record(SCENE, Settings(episodes=2, seed=5, perception="simulated"), folder, resume=True)
    record(SCENE, SETTINGS, folder, resume=True)
    assert tables(folder) == tables(recorded)


def test_nothing_is_overwritten_unasked(recorded, tmp_path):
    before = {f.name: f.stat().st_mtime_ns for f in recorded.iterdir()}
    with pytest.raises(FileExistsError, match="give --overwrite"):
        record(SCENE, SETTINGS, recorded)
    with pytest.raises(FileExistsError, match="give --overwrite"):
        record(SCENE, Settings(episodes=3, perception="simulated"), recorded, resume=True)
    record(SCENE, SETTINGS, recorded, resume=True)
    assert before == {f.name: f.stat().st_mtime_ns for f in recorded.iterdir()}
    (tmp_path / "README.md").write_text("mine")
    for option in ("resume", "overwrite"):
        with pytest.raises(FileExistsError, match=r"files of another kind \(README.md\)"):
            record(SCENE, SETTINGS, tmp_path, **{option: True})
    assert (tmp_path / "README.md").read_text() == "mine"


def test_what_cannot_be_recorded_replaces_nothing(recorded):
    before = {f.name: f.stat().st_mtime_ns for f in recorded.iterdir()}
    with pytest.raises(ValueError, match="workers must be at least 1, got 0"):
        record(SCENE, Settings(perception="simulated"), recorded, workers=0, overwrite=True)
    pytest.importorskip("torch", reason="learned eyes need covis[learned]")
    with pytest.raises(ValueError, match="does not know the class"):
        record(SCENE, Settings(perception="learned"), recorded, overwrite=True)
    assert before == {f.name: f.stat().st_mtime_ns for f in recorded.iterdir()}


def test_overwriting_replaces_another_dataset(recorded, tmp_path):
    folder = tmp_path / "again"
    record(SCENE, Settings(episodes=1, seed=3, perception="simulated"), folder)
    (folder / "notes.txt").write_text("stay")
    record(SCENE, SETTINGS, folder, overwrite=True)
    for file in recording.FILES:
        assert (folder / file).read_bytes() == (recorded / file).read_bytes(), file
    assert (folder / "notes.txt").read_text() == "stay"


def test_check_names_what_changed(recorded, tmp_path):
    folder = tmp_path / "copy"
    shutil.copytree(recorded, folder)
    meta = json.loads((folder / "dataset.json").read_text())
    (folder / "dataset.json").write_text(json.dumps(meta | {"name": "other"}))
    with pytest.raises(ChecksumError, match=r"dataset.json differs from its checksum"):
        check(folder)
    (folder / "detections.parquet").unlink()
    with pytest.raises(ChecksumError, match=r"detections.parquet is missing"):
        check(folder)


def test_check_looks_at_images_and_masks(recorded, tmp_path):
    folder = tmp_path / "copy"
    shutil.copytree(recorded, folder)
    (folder / "checksums.json").unlink()
    assert check(folder) == Checked(frames=50, verified=False)

    def spoil(table, column, value):
        rows = pq.read_table(recorded / f"{table}.parquet").to_pylist()
        rows[3][column] = value(rows[3][column])
        pq.write_table(pa.Table.from_pylist(rows, schema=recording.TABLES[table]), folder / f"{table}.parquet")
        with pytest.raises(DatasetError) as caught:
            check(folder)
        shutil.copy(recorded / f"{table}.parquet", folder)
        return str(caught.value).removeprefix(str(folder / table))

    assert spoil("robots", "image", lambda _: b"GIF89a") == ".parquet: column 'image', row 3: not a PNG image"
    assert "row 3: a truncated PNG image" in spoil("robots", "image", lambda png: png[:-9])
    small = cv2.imencode(".png", np.zeros((2, 4, 3), np.uint8))[1].tobytes()
    assert "an image of 4x2 pixels, dataset.json says 320x240" in spoil("robots", "image", lambda _: small)
    assert "column 'mask', row 3: runs of" in spoil("objects", "mask", lambda runs: runs[:-1])
    assert "column 'mask', row 3: a mask of 76800 pixels" in spoil("objects", "mask", lambda _: [0, 76800])
    assert "column 'mask', row 3: not run lengths" in spoil("objects", "mask", lambda runs: [-1, *runs])
    assert "column 'class', row 3: 'zebra' is none of the classes red, blue" in spoil(
        "objects", "class", lambda _: "zebra"
    )
    assert "'position', row 3: [nan, 0.0, 0.0] is not 3" in spoil("objects", "position", lambda _: [np.nan, 0.0, 0.0])
    assert "column 'box', row 3: [1.0, 2.0] is not 4 finite" in spoil("objects", "box", lambda _: [1.0, 2.0])


def test_check_finds_a_flipped_bit_in_any_column(recorded, tmp_path):
    """Without checksums.json: recorded files carry a checksum in every page of every column."""
    folder = tmp_path / "copy"
    shutil.copytree(recorded, folder)
    (folder / "checksums.json").unlink()
    for table in recording.TABLES:
        file = folder / f"{table}.parquet"
        whole = file.read_bytes()
        meta = pq.read_metadata(file).row_group(0)
        for number in range(meta.num_columns):
            column = meta.column(number)
            start = column.dictionary_page_offset or column.data_page_offset
            spoilt = bytearray(whole)
            spoilt[start + column.total_compressed_size - 2] ^= 0x10  # in its last page's values
            file.write_bytes(bytes(spoilt))
            with pytest.raises(DatasetError, match=f"{table}.parquet"):
                check(folder)
        file.write_bytes(whole)
