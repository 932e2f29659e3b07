import tarfile
from itertools import pairwise

import numpy as np
import pytest

from covis.evaluation.datasets import load_dataset, true_relative_pose
from covis.evaluation.mrclam import import_mrclam
from covis.evaluation.mrclam_files import MrclamError
from covis.evaluation.mrclam_odometry import UNCALIBRATED, calibrate, integrate_odometry, pose_at
from covis.matching.pose import invert, transform

START = 1_000_000.0
LANDMARKS = {3: (3.0, 0.5), 4: (2.5, -1.0), 5: (4.0, 1.5), 6: (-3.0, 0.0)}
BARCODES = {1: 5, 2: 14, 3: 63, 4: 7, 5: 90, 6: 11}
HEADER = "# made by hand\n# Time [s]    more\n"


def state(robot, t):
    """Robot 1 drives an arc at 0.2 m/s and 0.1 rad/s; robot 2 stands 1 m to its right."""
    if robot == 2:
        return np.array([0.0, -1.0, 0.1])
    heading = 0.1 * t
    return np.array([2.0 * np.sin(heading), 2.0 * (1 - np.cos(heading)), heading])


def write_raw(folder, seconds=6.0, wrong_barcode=False):
    """A miniature sequence without noise."""
    folder.mkdir(parents=True, exist_ok=True)

    def put(name, rows):
        text = "\n".join(" \t ".join(f"{x:.9f}" for x in row) for row in rows)
        (folder / name).write_text(HEADER + text + "\n")

    (folder / "Barcodes.dat").write_text(HEADER + "\n".join(f"  {s} \t {b}" for s, b in BARCODES.items()) + "\n")
    put("Landmark_Groundtruth.dat", [(s, *xy, 1e-4, 1e-4) for s, xy in LANDMARKS.items()])
    for robot in (1, 2):
        times = np.arange(0, seconds + 0.01, 0.05)
        speed, turn = (0.2, 0.1) if robot == 1 else (0.0, 0.0)
        put(f"Robot{robot}_Groundtruth.dat", [(START + t, *state(robot, t)) for t in times])
        put(f"Robot{robot}_Odometry.dat", [(START + t, speed, turn) for t in times])
        readings = []
        for t in np.arange(0.1, seconds, 0.3):
            x, y, heading = state(robot, t)
            for subject, (lx, ly) in LANDMARKS.items():
                bearing = np.arctan2(ly - y, lx - x) - heading
                bearing = (bearing + np.pi) % (2 * np.pi) - np.pi
                if abs(bearing) < 0.6:
                    readings.append((START + t, BARCODES[subject], np.hypot(lx - x, ly - y), bearing))
        if wrong_barcode:
            readings.append((START + 0.5, 99, 2.0, 0.0))
        put(f"Robot{robot}_Measurement.dat", readings)
    return folder


def test_a_sequence_without_noise_is_imported_exactly(tmp_path):
    write_raw(tmp_path / "raw")
    done = import_mrclam(tmp_path / "raw", tmp_path / "out", window=1.0)
    dataset = load_dataset(tmp_path / "out")
    assert (done.frames, done.robots) == (6, 2) == (len(dataset), 2)
    assert not dataset.has_poses
    assert dataset.has_episodes
    seen = 0
    for frame in dataset:
        for view in frame.views:
            seen += len(view.graph)
            np.testing.assert_allclose(transform(view.pose_truth, view.graph.positions), view.truth, atol=1e-3)
            assert set(view.identity.tolist()) <= set(LANDMARKS)
            assert len(set(view.identity.tolist())) == len(view.identity)  # one detection per barcode
            np.testing.assert_allclose(view.graph.up, [0, 0, 1])
            np.testing.assert_allclose(view.graph.forward, [1, 0, 0])
            assert view.graph.attributes.shape[1] == 1
    assert seen == done.detections > 20


def test_odometry_links_the_frames(tmp_path):
    import_mrclam(write_raw(tmp_path / "raw"), tmp_path / "out")
    frames = list(load_dataset(tmp_path / "out"))
    for before, now in pairwise(frames):
        assert now.time - before.time == pytest.approx(1.0)
        for a, b in zip(before.views, now.views, strict=True):
            np.testing.assert_allclose(b.odometry, invert(a.pose_truth) @ b.pose_truth, atol=1e-3)
    assert true_relative_pose(*frames[0].views) is not None


def test_covariances_lie_along_the_ray_and_grow_with_range(tmp_path):
    import_mrclam(write_raw(tmp_path / "raw"), tmp_path / "out")
    graph = load_dataset(tmp_path / "out").frame(0).views[1].graph
    ray = graph.positions / np.linalg.norm(graph.positions, axis=1)[:, None]
    along = np.einsum("ni,nij,nj->n", ray, graph.covariances, ray)
    np.testing.assert_allclose(along, graph.position_variance)
    order = np.argsort(np.linalg.norm(graph.positions, axis=1))
    assert (np.diff(along[order]) > 0).all()


def test_the_window_sets_the_number_of_frames(tmp_path):
    raw = write_raw(tmp_path / "raw")
    assert import_mrclam(raw, tmp_path / "half", window=0.5).frames == 12
    with pytest.raises(ValueError, match="window"):
        import_mrclam(raw, tmp_path / "none", window=0.0)
    with pytest.raises(MrclamError, match=r"overlaps by 6\.0 s"):
        import_mrclam(raw, tmp_path / "long", window=10.0)


def test_an_archive_and_a_parent_folder_will_do(tmp_path):
    raw = write_raw(tmp_path / "parent" / "7")
    with tarfile.open(tmp_path / "mini.tar.xz", "w:xz") as archive:
        archive.add(raw, arcname="7")
    counts = {
        import_mrclam(source, tmp_path / f"out{i}").detections
        for i, source in enumerate((raw, raw.parent, tmp_path / "mini.tar.xz"))
    }
    assert len(counts) == 1


def test_an_unknown_barcode_is_no_true_object(tmp_path):
    import_mrclam(write_raw(tmp_path / "raw", wrong_barcode=True), tmp_path / "out")
    identity = [i for frame in load_dataset(tmp_path / "out") for view in frame.views for i in view.identity.tolist()]
    assert identity.count(-1) == 2


@pytest.mark.parametrize("name", ["Barcodes", "Landmark_Groundtruth", "Robot1_Odometry", "Robot2_Groundtruth"])
def test_a_missing_file_is_named(tmp_path, name):
    raw = write_raw(tmp_path / "raw")
    (raw / f"{name}.dat").unlink()
    with pytest.raises(MrclamError, match=rf"{name}.dat is missing|{name}.dat"):
        import_mrclam(raw, tmp_path / "out")


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("Robot1_Measurement", "1.0 5 2.0\n", "line 1: expected 4 finite numbers"),
        ("Robot1_Measurement", "1.0 5 two 0.1\n", "line 1: '1.0 5 two 0.1' is not 4 numbers"),
        ("Robot1_Odometry", "# nothing\n", "holds no data"),
        ("Robot2_Odometry", "1.0 nan 0.0\n", "finite"),
        ("Robot1_Measurement", "1.0 5 -2.0 0.1\n", "negative range"),
    ],
)
def test_a_malformed_file_is_named(tmp_path, name, text, message):
    raw = write_raw(tmp_path / "raw")
    (raw / f"{name}.dat").write_text(text)
    with pytest.raises(MrclamError, match=message) as caught:
        import_mrclam(raw, tmp_path / "out")
    assert name in str(caught.value)


def test_wrong_sources_are_named(tmp_path):
    with pytest.raises(MrclamError, match="does not exist"):
        import_mrclam(tmp_path / "nowhere", tmp_path / "out")
    (tmp_path / "note.txt").write_text("no archive")
    with pytest.raises(MrclamError, match=r"neither a folder nor an archive"):
        import_mrclam(tmp_path / "note.txt", tmp_path / "out")
    with pytest.raises(MrclamError, match=r"Barcodes\.dat is missing"):
        import_mrclam(tmp_path, tmp_path / "out")
    write_raw(tmp_path / "both" / "6")
    write_raw(tmp_path / "both" / "7")
    with pytest.raises(MrclamError, match="2 sequences"):
        import_mrclam(tmp_path / "both", tmp_path / "out")


def test_dead_reckoning_of_an_arc_is_exact():
    times = np.arange(0, 5.01, 0.25)
    track = integrate_odometry(np.column_stack([times, np.full_like(times, 0.2), np.full_like(times, 0.1)]))
    np.testing.assert_allclose(track.states[-1], state(1, 5.0), atol=1e-9)
    np.testing.assert_allclose(pose_at(track, 5.0)[:2, 3], state(1, 5.0)[:2], atol=1e-9)


def test_odometry_and_ranges_are_calibrated_on_landmarks_alone():
    rng = np.random.default_rng(0)
    times = np.arange(0, 200, 0.1)
    speed = 0.1 * np.ones_like(times)
    turn = 0.4 * np.sign(np.sin(times * 0.7))
    odometry = np.column_stack([times, speed, turn])
    real = integrate_odometry(np.column_stack([times + 0.2, 0.95 * speed, 0.92 * turn]))
    landmarks = {b: rng.uniform(-6, 6, size=2) for b in range(12)}
    readings = []
    for t in np.arange(1, 199, 0.25):
        x, y, heading = (np.interp(t, real.times, real.states[:, i]) for i in range(3))
        for barcode, (lx, ly) in landmarks.items():
            bearing = (np.arctan2(ly - y, lx - x) - heading + np.pi) % (2 * np.pi) - np.pi
            if abs(bearing) < 0.6:
                r = np.hypot(lx - x, ly - y)
                depth = 1.036 * (r + 0.01 * rng.normal()) * np.cos(bearing)  # as the real cameras report it
                readings.append((t, barcode, depth, bearing + 0.005 * rng.normal()))
    readings = np.array(readings)
    calibration = calibrate(odometry, readings, set(landmarks))
    assert calibration.delay_s == pytest.approx(0.2, abs=0.051)
    assert calibration.turn_gain == pytest.approx(0.92, abs=0.02)
    assert calibration.axis_exponent == pytest.approx(1.0, abs=0.1)
    assert calibration.range_scale > 1

    def drift(track):
        moved = [invert(pose_at(track, t)) @ pose_at(track, t + 1) for t in range(5, 190, 5)]
        true = [invert(pose_at(real, t)) @ pose_at(real, t + 1) for t in range(5, 190, 5)]
        return np.std([np.arctan2(*(invert(a) @ b)[[1, 0], [0, 0]]) for a, b in zip(moved, true, strict=True)])

    assert drift(calibration.dead_reckoning(odometry)) < 0.2 * drift(integrate_odometry(odometry))
    assert calibrate(odometry, readings[:50], set(landmarks)) == UNCALIBRATED
    np.testing.assert_array_equal(UNCALIBRATED.readings(readings), readings)
