"""Recordings for the Rerun viewer, read back."""

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from scipy.spatial.transform import Rotation

from covis.evaluation import extras
from covis.evaluation.benchmark import benchmark
from covis.evaluation.extras import MissingExtraError
from covis.evaluation.methods import Method
from covis.evaluation.moments import dataset_source, scene_source
from covis.evaluation.run_scene import make_env, play
from covis.evaluation.settings import Settings
from covis.evaluation.view import view
from covis.matching.metrics import Counts

SCENE = "box_world:BoxWorld"
METHODS = [Method.parse("hungarian:gate_m=1"), Method.parse("random")]
KNOWN = Settings(pose="known", perception="simulated")


class Recording:
    """What a file holds: entity -> component -> values by frame."""

    def __init__(self, file):
        chunk = pytest.importorskip("rerun.chunk", reason="rerun-sdk is not installed: pip install covis[viz]")
        self.reader = chunk.RrdReader(file)
        self.static, self.values = {}, {}
        for part in self.reader.stream():
            batch = part.to_record_batch()
            columns = {name: batch.column(i).to_pylist() for i, name in enumerate(batch.schema.names)}
            for name, rows in columns.items():
                if ":" not in name:
                    continue
                if part.is_static:
                    self.static.setdefault(part.entity_path, {})[name] = rows[-1]
                    continue
                into = self.values.setdefault(part.entity_path, {}).setdefault(name, {})
                into |= {f: row for f, row in zip(columns["frame"], rows, strict=True) if row is not None}

    def of(self, entity, component):
        return self.values[entity][component]


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    pytest.importorskip("rerun", reason="rerun-sdk is not installed: pip install covis[viz]")
    file = tmp_path_factory.mktemp("view") / "boxes.rrd"
    assert view(SCENE, file, METHODS, KNOWN) == 25
    assert [f.name for f in file.parent.iterdir()] == ["boxes.rrd"], "nothing unfinished stays"
    return Recording(file)


def test_a_scene_is_all_there(scene):
    assert set(scene.values) >= {
        "/world/objects",
        "/world/robot_0/sensor",
        "/world/robot_0/sensor/camera",
        "/world/robot_0/sensor/camera/image",
        "/world/robot_0/sensor/camera/boxes",
        "/world/robot_1/sensor/detections",
        "/world/robot_1/trajectory",
        "/world/robot_1/reported_position",
        "/world/matches/random",
        "/world/estimates/random",
        r"/pairs/robot_0\+robot_1/image",
        r"/pairs/robot_0\+robot_1/random/matches",
        "/metrics/precision/random",
        "/metrics/recall/random",
    }
    assert len(scene.reader.blueprints()) == 1
    assert "Green" in scene.static["/about"]["TextDocument:text"][0]
    image = scene.of("/world/robot_0/sensor/camera/image", "EncodedImage:blob")
    assert len(image) == 25
    assert bytes(image[0][0][:3]) == b"\xff\xd8\xff", "a JPEG"
    trail = scene.of("/world/robot_1/trajectory", "LineStrips3D:strips")
    assert [len(trail[f][0]) for f in (0, 7, 24)] == [1, 8, 25]


def test_colours_and_figures_are_those_of_the_scoring_rules(scene):
    env = make_env(SCENE, KNOWN)
    frames = list(play(env, 0, METHODS, KNOWN))
    env.close()
    for label, name in (("random", "random"), ("hungarian:gate_m=1", r"hungarian\:gate_m\=1")):
        precision = scene.of(f"/metrics/precision/{name}", "Scalars:scalars")
        error = scene.of(f"/metrics/fused/{name}", "Scalars:scalars")
        strips = scene.of(f"/world/matches/{name}", "LineStrips3D:strips")
        colors = scene.of(f"/world/matches/{name}", "LineStrips3D:colors")
        for f, frame in enumerate(frames):
            score = frame.scores[label]
            assert len(strips.get(f) or []) == score.counts.retrieved
            green = [c for c in colors.get(f) or [] if (c >> 16) & 255 > c >> 24]
            assert len(green) == score.counts.correct
            if score.counts.retrieved:
                assert precision[f][0] == pytest.approx(score.counts.precision)
            if score.counts.correct:
                assert error[f][0] == pytest.approx(np.nanmean(score.error_fused), abs=1e-6)


def test_ellipsoids_are_the_covariances(scene):
    source = scene_source(SCENE, METHODS, KNOWN)
    moment = next(source.moments)
    graph = moment.sightings[0].graph
    entity = "/world/robot_0/sensor/detections"
    assert np.allclose(scene.of(entity, "Ellipsoids3D:centers")[0], graph.positions, atol=1e-4)
    half = np.array(scene.of(entity, "Ellipsoids3D:half_sizes")[0])
    R = Rotation.from_quat(scene.of(entity, "Ellipsoids3D:quaternions")[0]).as_matrix()
    drawn = R * half[:, None] ** 2 @ R.transpose(0, 2, 1)
    assert np.allclose(drawn, graph.full_covariances(), atol=1e-4)


def test_a_dataset_without_pictures(small_dataset, tmp_path):
    file = tmp_path / "out" / "small.rrd"
    settings = Settings(pose="known", episodes=1)
    assert view(str(small_dataset), file, METHODS[:1], settings) == 3
    recording = Recording(file)
    assert not [e for e in recording.values if e.startswith("/pairs") or e.endswith("/image")]
    assert set(recording.of("/world/objects", "Points3D:positions")) == {0, 1, 2}
    benchmark_row = benchmark([str(small_dataset)], METHODS[:1], settings)[0]
    counts = Counts()
    for moment in dataset_source(str(small_dataset), METHODS[:1], settings).moments:
        (hits,) = moment.results[METHODS[0].label].hits.values()
        counts += Counts(int(hits.sum()), len(hits), 0)
    assert counts.precision == pytest.approx(benchmark_row["precision"])


def test_a_recorded_dataset_shows_what_the_scene_shows(tmp_path, scene):
    from covis.evaluation.recording import record

    folder, file = tmp_path / "boxes", tmp_path / "boxes.rrd"
    record(SCENE, Settings(episodes=1, perception="simulated"), folder)
    view(str(folder), file, METHODS[:1], KNOWN)
    recording = Recording(file)
    for entity in ("/world/robot_0/sensor/camera/boxes", "/world/robot_1/sensor/detections"):
        component = "Boxes2D:half_sizes" if entity.endswith("boxes") else "Ellipsoids3D:half_sizes"
        ours, live = recording.of(entity, component)[3], scene.of(entity, component)[3]
        assert np.allclose(sorted(map(tuple, ours)), sorted(map(tuple, live)), atol=1e-4)
    image = recording.of("/world/robot_0/sensor/camera/image", "EncodedImage:blob")
    assert bytes(image[3][0][1:4]) == b"PNG"


def test_robots_that_leave_are_cleared(small_dataset, tmp_path):
    for name in ("robots", "detections"):
        file = small_dataset / f"{name}.parquet"
        rows = [r for r in pq.read_table(file).to_pylist() if (r["frame"], r["robot"]) != (2, "robot_1")]
        pq.write_table(pa.Table.from_pylist(rows), file)
    view(str(small_dataset), tmp_path / "a.rrd", METHODS[:1], Settings(pose="known", episodes=1))
    assert list(Recording(tmp_path / "a.rrd").of("/world/robot_1", "Clear:is_recursive")) == [2]


def test_without_poses_nothing_can_be_drawn(small_dataset, tmp_path):
    file = small_dataset / "robots.parquet"
    pq.write_table(pq.read_table(file).drop_columns(["pose", "pose_truth"]), file)
    with pytest.raises(ValueError, match="no robot has a pose"):
        view(str(small_dataset), tmp_path / "a.rrd", METHODS[:1], Settings())
    assert not (tmp_path / "a.rrd").exists()


def test_what_is_missing_is_named(tmp_path, monkeypatch):
    with pytest.raises(ValueError, match="'nowhere' is neither a dataset folder nor a scene"):
        view("nowhere", tmp_path / "a.rrd", METHODS, Settings())
    with pytest.raises(ValueError, match="at least one method"):
        view(SCENE, tmp_path / "a.rrd", [], Settings())
    monkeypatch.setattr(extras, "find_spec", lambda name: None if name == "rerun" else name)
    with pytest.raises(MissingExtraError, match=r"rerun is missing: install covis\[viz\]"):
        view(SCENE, tmp_path / "a.rrd", METHODS, Settings())
