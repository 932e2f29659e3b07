"""Import of the UTIAS MRCLAM data set (Leung et al. 2011): five robots, fifteen landmarks, readings of barcodes.

A frame is one window of time; a robot's readings in it are moved to the window's end by its odometry, and the readings
of one barcode become one detection. The barcode is the identity, which no matcher sees. `mrclam_files` reads the raw
files, `mrclam_odometry` calibrates each robot's odometry and camera.

Robot frame: x forward, y left, z up; everything lies in the plane z = 0.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from ..matching.pose import Array, invert, transform
from . import dataset_tables
from .dataset_schemas import DETECTIONS, ROBOTS, columns
from .mrclam_files import MrclamError, RawSequence, RobotLog, read_sequence
from .mrclam_odometry import Track, pose_at, states_at

MAX_TRUTH_GAP_S = 2.5
"""Longest gap between motion-capture samples that is bridged, s."""
ROBOT_COLUMNS = ("frame", "time", "robot", "episode", "pose", "pose_truth", "odometry")
DETECTION_COLUMNS = (*dataset_tables.DETECTION_COLUMNS, "covariance", "truth")


@dataclass(frozen=True)
class RangeBearingNoise:
    """1 sigma of one reading. Successive readings of a barcode are wrong together, so those of a window count as one.

    Attributes:
        range_std_m: at distance 0. range_std_per_m: added per metre of range.
        bearing_std_rad: across the ray.
        turn_rate_std_rad_s: heading error that odometry gathers per second of compensation.
        height_std_m: of the detections' z, which is 0 by construction.
    """

    range_std_m: float = 0.03
    range_std_per_m: float = 0.035
    bearing_std_rad: float = 0.012
    turn_rate_std_rad_s: float = 0.02
    height_std_m: float = 0.01


RAW_NOISE = RangeBearingNoise()
"""Readings as they are; measured on sequence 6."""
CALIBRATED_NOISE = RangeBearingNoise(range_std_m=0.015, range_std_per_m=0.015)
"""Readings of a calibrated robot; measured on sequence 6."""


@dataclass(frozen=True)
class Imported:
    """What an import wrote: counts, and the folder."""

    path: Path
    frames: int
    robots: int
    detections: int


def import_mrclam(
    source: str | Path, out: str | Path, *, window: float = 1.0, noise: RangeBearingNoise | None = None
) -> Imported:
    """Write one MRCLAM sequence as a dataset folder.

    Args:
        source: folder with the raw files (or with one subfolder that has them), or a .tar.*, .tgz or .zip of it.
        out: folder to write.
        window: length of a frame, s.
        noise: error of a reading; None = as measured on sequence 6, see RAW_NOISE and CALIBRATED_NOISE.

    Raises:
        MrclamError: a file that is missing, malformed or empty, or robots whose times do not overlap.
        ValueError: a window that is not positive.
    """
    if not window > 0:
        raise ValueError(f"window must be a positive number of seconds, got {window}")
    raw = read_sequence(Path(source))
    ends = _window_ends(raw.robots, window)
    return _write(Path(out), f"mrclam-{Path(source).name.split('.')[0]}", raw, ends, window, noise)


def _truth_at(track: Track, time: float) -> Array | None:
    """Motion-capture pose (4, 4), or None where there is no sample near."""
    k = int(np.searchsorted(track.times, time))
    if k == 0 or k == len(track.times) or track.times[k] - track.times[k - 1] > MAX_TRUTH_GAP_S:
        return None
    return pose_at(track, time)


def _window_ends(robots: list[RobotLog], window: float) -> Array:
    """Times (f,) s at which the frames' windows end: from the last robot's start to the first robot's end."""
    start = max(float(r.dead_reckoning.times[0]) for r in robots)
    stop = min(float(r.dead_reckoning.times[-1]) for r in robots)
    count = int((stop - start) / window + 1e-6)
    if count < 1:
        raise MrclamError(f"the robots' odometry overlaps by {stop - start:.1f} s, less than one window of {window} s")
    return np.asarray(start + window * np.arange(1, count + 1), dtype=np.float64)


@dataclass(frozen=True, eq=False)
class _Detections:
    """One robot in one window: barcodes (n,), positions (n, 3) m, covariances (n, 3, 3), range variance (n,)."""

    barcodes: NDArray[np.int64]
    positions: Array
    covariances: Array
    range_variance: Array


def detect(robot: RobotLog, end: float, window: float, noise: RangeBearingNoise) -> _Detections:
    """The readings in (end - window, end], one detection per barcode, in the robot's frame at `end`."""
    first, last = np.searchsorted(robot.readings[:, 0], [end - window, end], side="right")
    readings = robot.readings[first:last]
    then = states_at(robot.dead_reckoning, readings[:, 0])
    heading = then[:, 2] + readings[:, 3]
    reached = np.zeros((len(readings), 3))  # dead-reckoning frame
    reached[:, 0] = then[:, 0] + readings[:, 2] * np.cos(heading)
    reached[:, 1] = then[:, 1] + readings[:, 2] * np.sin(heading)
    moved = transform(invert(pose_at(robot.dead_reckoning, end)), reached)
    barcodes = np.unique(readings[:, 1].astype(np.int64))
    # The median of a few readings drops a gross error, which the mean would not.
    positions = np.array([np.median(moved[readings[:, 1] == b], axis=0) for b in barcodes]).reshape(-1, 3)
    age = np.array([end - float(np.mean(readings[readings[:, 1] == b, 0])) for b in barcodes])
    distance = np.linalg.norm(positions, axis=1)
    along = (noise.range_std_m + noise.range_std_per_m * distance) ** 2
    across = (distance**2) * (noise.bearing_std_rad**2 + (noise.turn_rate_std_rad_s * age) ** 2)
    covariances = np.zeros((len(barcodes), 3, 3))
    if len(barcodes):
        ray = positions[:, :2] / np.maximum(distance, 1e-9)[:, None]
        side = np.stack([-ray[:, 1], ray[:, 0]], axis=1)
        covariances[:, :2, :2] = (
            along[:, None, None] * ray[:, :, None] * ray[:, None, :]
            + across[:, None, None] * side[:, :, None] * side[:, None, :]
        )
        covariances[:, 2, 2] = noise.height_std_m**2
    return _Detections(barcodes, positions, covariances, along)


def _write(
    out: Path, name: str, raw: RawSequence, ends: Array, window: float, noise: RangeBearingNoise | None
) -> Imported:
    robot_rows: list[dict[str, object]] = []
    detection_rows: list[dict[str, object]] = []
    for frame, end in enumerate(ends.tolist()):
        for robot in raw.robots:
            robot_rows.append(_robot_row(robot, frame, end, window, float(ends[0])))
            assumed = noise or (CALIBRATED_NOISE if robot.calibrated else RAW_NOISE)
            detection_rows += _detection_rows(detect(robot, end, window, assumed), robot.name, frame, end, raw)
    out.mkdir(parents=True, exist_ok=True)
    robots, detections = columns(ROBOTS, ROBOT_COLUMNS), columns(DETECTIONS, DETECTION_COLUMNS)
    pq.write_table(pa.Table.from_pylist(robot_rows, schema=robots), out / "robots.parquet")
    pq.write_table(pa.Table.from_pylist(detection_rows, schema=detections), out / "detections.parquet")
    meta = _meta(name, raw.robots, window)
    (out / "dataset.json").write_text(json.dumps(meta, indent=1) + "\n", encoding="utf-8")
    return Imported(out, len(ends), len(raw.robots), len(detection_rows))


def _detection_rows(
    seen: _Detections, robot: str, frame: int, time: float, raw: RawSequence
) -> list[dict[str, object]]:
    subjects = [raw.subjects.get(barcode, -1) for barcode in seen.barcodes.tolist()]
    return [
        {
            "frame": frame,
            "robot": robot,
            "detection": index,
            "identity": subject,
            "position": seen.positions[index].tolist(),
            "position_variance": float(seen.range_variance[index]),
            "attribute": [1.0],
            "attribute_variance": 0.0,
            "covariance": seen.covariances[index].ravel().tolist(),
            "truth": _subject_truth(subject, time, raw),
        }
        for index, subject in enumerate(subjects)
    ]


def _robot_row(robot: RobotLog, frame: int, end: float, window: float, first_end: float) -> dict[str, object]:
    truth = _truth_at(robot.truth, end)
    now = pose_at(robot.dead_reckoning, end)
    before = pose_at(robot.dead_reckoning, end - window)
    return {
        "frame": frame,
        "time": end - first_end,
        "robot": robot.name,
        "episode": 0,
        "pose": None,
        "pose_truth": None if truth is None else truth.ravel().tolist(),
        "odometry": (invert(before) @ now).ravel().tolist(),
    }


def _subject_truth(subject: int, time: float, raw: RawSequence) -> list[float] | None:
    """True position (3,) m of a landmark or a robot, world frame; None where it is unknown."""
    if subject in raw.landmarks:
        return [float(x) for x in raw.landmarks[subject]]
    track = next((robot.truth for robot in raw.robots if robot.number == subject), None)
    pose = None if track is None else _truth_at(track, time)
    return None if pose is None else [float(x) for x in pose[:3, 3]]


def _meta(name: str, robots: list[RobotLog], window: float) -> dict[str, object]:
    bearings = np.concatenate([robot.readings[:, 3] for robot in robots])
    return {
        "format": dataset_tables.FORMAT,
        "version": dataset_tables.VERSION,
        "name": name,
        "classes": ["object"],
        "sensor_frame": "robot: x forward, y left, z up",
        "up": [0, 0, 1],
        "units": "m",
        "horizontal_fov_rad": round(float(2 * np.quantile(np.abs(bearings), 0.999)), 4),
        "window_s": window,
        "source": "UTIAS Multi-Robot Cooperative Localization and Mapping (Leung et al. 2011)",
        "licence": "none stated by the source; educational use",
    }
