"""Scenes to dataset folders: whole or not at all, the same however often it was interrupted."""

import json

import pyarrow.parquet as pq
import pytest

from covis.evaluation import recording
from covis.evaluation.benchmark import benchmark
from covis.evaluation.datasets import DatasetError, load_dataset
from covis.evaluation.methods import Method
from covis.evaluation.recording import ChecksumError, check, record
from covis.evaluation.settings import Settings

SCENE = "box_world:BoxWorld"
SETTINGS = Settings(episodes=2)


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
    assert check(recorded) == 50
    assert not (recorded / "parts").exists()


def test_it_scores_as_the_live_scene_does(recorded):
    methods = [Method.parse("hungarian:gate_m=1"), Method.parse("oracle")]
    live = benchmark([SCENE], methods, Settings(pose="known", episodes=2))
    offline = benchmark([str(recorded)], methods, Settings(pose="known"))
    for a, b in zip(live, offline, strict=True):
        assert (a["pairs"], a["n_retrieved"]) == (b["pairs"], b["n_retrieved"])
        assert a["f1"] == pytest.approx(b["f1"], abs=0.02)


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
    with pytest.raises(DatasetError, match=r"dataset.json is missing"):
        load_dataset(folder)
    with pytest.raises(FileExistsError, match="give --resume"):
        record(SCENE, SETTINGS, folder)
    with pytest.raises(FileExistsError, match="unfinished recording of"):
        record(SCENE, Settings(episodes=2, seed=5), folder, resume=True)
    record(SCENE, SETTINGS, folder, resume=True)
    assert tables(folder) == tables(recorded)


def test_finished_datasets_are_not_overwritten(recorded):
    with pytest.raises(FileExistsError, match="give --overwrite"):
        record(SCENE, SETTINGS, recorded)


def test_check_names_what_changed(recorded, tmp_path):
    import shutil

    folder = tmp_path / "copy"
    shutil.copytree(recorded, folder)
    meta = json.loads((folder / "dataset.json").read_text())
    (folder / "dataset.json").write_text(json.dumps(meta | {"name": "other"}))
    with pytest.raises(ChecksumError, match=r"dataset.json differs from its checksum"):
        check(folder)
    (folder / "detections.parquet").unlink()
    with pytest.raises(ChecksumError, match=r"detections.parquet is missing"):
        check(folder)
    (folder / "checksums.json").unlink()
    with pytest.raises(ChecksumError, match=r"checksums.json is missing"):
        check(folder)
