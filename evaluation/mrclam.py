"""Import of the UTIAS MRCLAM data set (Leung et al. 2011): five robots, fifteen landmarks, readings of barcodes.

Raw files of one sequence: `Barcodes.dat`, `Landmark_Groundtruth.dat` and, for each robot i, `Robot<i>_Measurement.dat`
(time, barcode, range, bearing), `Robot<i>_Odometry.dat` (time, speed, turn rate) and `Robot<i>_Groundtruth.dat` (time,
x, y, heading from motion capture). A frame is one window of time; a robot's readings in it are moved to the window's
end by its odometry, and the readings of one barcode become one detection. The barcode is the identity, which no
matcher sees.

Two things in these logs are not what their headers say. The odometry is what the robots were told to do: on sequence 6
the motion follows 0.2 to 0.25 s later, and turns are 0.91 to 0.95 as large. And the range is the distance along the
optical axis, short by the cosine of the bearing: that explains 92 to 98 % of its error's variance there. Both show
without any truth, in how a robot's readings of a landmark that stands still move from one moment to the next, and are
calibrated from them, robot by robot; short logs are left as they are.

Robot frame: x forward, y left, z up; everything lies in the plane z = 0.
"""

from __future__ import annotations

import json
import re
import tarfile
import tempfile
import zipfile
from collections.abc import Iterator, Set
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray
from scipy.optimize import least_squares

from ..matching.pose import Array, invert, transform

COMMENT = "#"
ROBOT_FILES = ("Measurement", "Odometry", "Groundtruth")
COLUMNS = {"Measurement": 4, "Odometry": 3, "Groundtruth": 4}
MAX_COAST_S = 1.0
"""Longest time an odometry reading is held, s: a longer gap is taken as standing still."""
MIN_CALIBRATION_PAIRS = 300
"""Successive readings of landmarks below which odometry is not calibrated."""
CALIBRATION_DELAYS_S = tuple(0.05 * k for k in range(9))
"""Delays of the motion behind the odometry that are tried, s."""
CAMERA_RANGE_SCALE = 1.036
"""Depth that the platform's cameras report over true depth: 1.025 to 1.052 on the five robots of sequence 6, measured
there with motion capture; a robot's own readings cannot tell it."""
MAX_TRUTH_GAP_S = 2.5
"""Longest gap between motion-capture samples that is bridged, s."""


class MrclamError(ValueError):
    """Raw files that are missing or malformed; the message names the file."""


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


@dataclass(frozen=True, eq=False)
class Track:
    """Planar poses over time: times (k,) s, states (k, 3) x m, y m, unwrapped heading rad."""

    times: Array
    states: Array


@dataclass(frozen=True, eq=False)
class RobotLog:
    """One robot's raw files.

    Attributes:
        name: "robot_<i>".
        number: i, which is also its identity as an object.
        readings: (k, 4) time s, barcode, range m, bearing rad; corrected where `calibrated`.
        dead_reckoning: odometry integrated from an arbitrary start; likewise.
        truth: motion capture.
    """

    name: str
    number: int
    readings: Array
    calibrated: bool
    dead_reckoning: Track
    truth: Track


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
    with _raw_folder(Path(source)) as folder:
        subjects = _read_barcodes(folder / "Barcodes.dat")
        landmarks = _read_landmarks(folder / "Landmark_Groundtruth.dat")
        robots = _read_robots(folder, {b for b, subject in subjects.items() if subject in landmarks})
    ends = _window_ends(robots, window)
    return _write(
        Path(out), f"mrclam-{Path(source).name.split('.')[0]}", robots, subjects, landmarks, ends, window, noise
    )


@contextmanager
def _raw_folder(source: Path) -> Iterator[Path]:
    """The folder that holds Barcodes.dat, unpacked first where the source is an archive."""
    if source.is_dir():
        yield _folder_of_barcodes(source, source)
        return
    if not source.exists():
        raise MrclamError(f"{source} does not exist")
    with tempfile.TemporaryDirectory() as scratch:
        try:
            if zipfile.is_zipfile(source):
                with zipfile.ZipFile(source) as bundle:
                    bundle.extractall(scratch)
            else:
                with tarfile.open(source) as archive:
                    archive.extractall(scratch, filter="data")
        except (tarfile.TarError, zipfile.BadZipFile, EOFError, OSError) as error:
            raise MrclamError(f"{source} is neither a folder nor an archive that can be read: {error}") from error
        yield _folder_of_barcodes(Path(scratch), source)


def _folder_of_barcodes(root: Path, source: Path) -> Path:
    found = sorted(root.rglob("Barcodes.dat"))
    if not found:
        raise MrclamError(f"{source}: Barcodes.dat is missing")
    if len(found) > 1:
        names = ", ".join(str(f.parent.relative_to(root)) for f in found)
        raise MrclamError(f"{source} holds {len(found)} sequences ({names}); give the folder of one")
    return found[0].parent


def _read_table(file: Path, columns: int) -> Array:
    """Numbers (k, columns) of a raw file, k >= 1."""
    try:
        lines = file.read_text(encoding="utf-8").splitlines()
    except FileNotFoundError as error:
        raise MrclamError(f"{file.name} is missing in {file.parent}") from error
    except (UnicodeDecodeError, OSError) as error:
        raise MrclamError(f"{file.name} cannot be read: {error}") from error
    rows: list[list[float]] = []
    for number, line in enumerate(lines, start=1):
        fields = line.split(COMMENT)[0].split()
        if not fields:
            continue
        try:
            row = [float(x) for x in fields]
        except ValueError as error:
            raise MrclamError(f"{file.name}, line {number}: {line.strip()!r} is not {columns} numbers") from error
        if len(row) != columns or not np.isfinite(row).all():
            raise MrclamError(f"{file.name}, line {number}: expected {columns} finite numbers, got {line.strip()!r}")
        rows.append(row)
    if not rows:
        raise MrclamError(f"{file.name} holds no data")
    return np.array(rows)


def _read_barcodes(file: Path) -> dict[int, int]:
    """Barcode -> subject."""
    return {int(barcode): int(subject) for subject, barcode in _read_table(file, 2)}


def _read_landmarks(file: Path) -> dict[int, Array]:
    """Subject -> position (3,) m, world frame."""
    return {int(row[0]): np.array([row[1], row[2], 0.0]) for row in _read_table(file, 5)}


def _read_robots(folder: Path, landmark_barcodes: Set[int]) -> list[RobotLog]:
    numbers = sorted(
        int(match.group(1)) for f in folder.iterdir() if (match := re.fullmatch(r"Robot(\d+)_\w+\.dat", f.name))
    )
    if not numbers:
        raise MrclamError(f"{folder}: no Robot<i>_Measurement.dat")
    return [_read_robot(folder, number, landmark_barcodes) for number in dict.fromkeys(numbers)]


def _read_robot(folder: Path, number: int, landmark_barcodes: Set[int]) -> RobotLog:
    tables = {kind: _read_table(folder / f"Robot{number}_{kind}.dat", COLUMNS[kind]) for kind in ROBOT_FILES}
    tables = {kind: table[np.argsort(table[:, 0], kind="stable")] for kind, table in tables.items()}
    readings, truth = tables["Measurement"], tables["Groundtruth"]
    if (readings[:, 2] < 0).any():
        raise MrclamError(f"Robot{number}_Measurement.dat: negative range {readings[:, 2].min()}")
    calibration = calibrate(tables["Odometry"], readings, landmark_barcodes)
    states = truth[:, 1:].copy()
    states[:, 2] = np.unwrap(states[:, 2])
    return RobotLog(
        name=f"robot_{number}",
        number=number,
        readings=calibration.readings(readings),
        calibrated=calibration != UNCALIBRATED,
        dead_reckoning=calibration.dead_reckoning(tables["Odometry"]),
        truth=Track(truth[:, 0], states),
    )


def integrate_odometry(odometry: Array) -> Track:
    """Dead reckoning from readings (k, 3) of time s, speed m/s and turn rate rad/s, each held until the next."""
    times, speed, turn = odometry.T
    held = np.minimum(np.diff(times), MAX_COAST_S)
    states = np.zeros((len(times), 3))
    states[1:, 2] = np.cumsum(turn[:-1] * held)
    # A chord of the arc: the speed shrinks by sinc(half the turn) and points along the middle heading.
    half = 0.5 * turn[:-1] * held
    chord = speed[:-1] * held * np.sinc(half / np.pi)
    middle = states[:-1, 2] + half
    states[1:, 0] = np.cumsum(chord * np.cos(middle))
    states[1:, 1] = np.cumsum(chord * np.sin(middle))
    return Track(times, states)


@dataclass(frozen=True)
class Calibration:
    """What a robot's own readings say about its odometry and its camera.

    Attributes:
        delay_s: of the motion behind the odometry.
        speed_gain, turn_gain: real motion over odometry.
        axis_exponent, range_scale: true range = reading / (range_scale * cos(bearing) ** axis_exponent); the exponent
            is 0 for a range, 1 for a depth along the axis.
    """

    delay_s: float
    speed_gain: float
    turn_gain: float
    axis_exponent: float
    range_scale: float = 1.0

    def dead_reckoning(self, odometry: Array) -> Track:
        """Corrected odometry (k, 3), integrated."""
        gains = np.array([self.speed_gain, self.turn_gain])
        return integrate_odometry(np.column_stack([odometry[:, 0] + self.delay_s, odometry[:, 1:] * gains]))

    def readings(self, readings: Array) -> Array:
        """Readings (n, 4) with their range corrected."""
        corrected = readings.copy()
        corrected[:, 2] /= self.range_scale * np.maximum(np.cos(readings[:, 3]), 0.1) ** self.axis_exponent
        return corrected


UNCALIBRATED = Calibration(0.0, 1.0, 1.0, 0.0)


def calibrate(odometry: Array, readings: Array, landmark_barcodes: Set[int]) -> Calibration:
    """The calibration that explains best how barcodes that stand still move in view.

    Args:
        odometry: (k, 3) time s, speed m/s, turn rate rad/s.
        readings: (n, 4) time s, barcode, range m, bearing rad.
        landmark_barcodes: barcodes that do not move.

    Returns:
        UNCALIBRATED where there are fewer than MIN_CALIBRATION_PAIRS successive readings.
    """
    before, after = _successive(readings, landmark_barcodes)
    if len(before) < MIN_CALIBRATION_PAIRS:
        return UNCALIBRATED

    def errors(x: Array, delay: float) -> Array:
        trial = Calibration(delay, float(x[0]), float(x[1]), float(x[2]))
        return _prediction_errors(trial.dead_reckoning(odometry), trial.readings(before), trial.readings(after))

    start = np.array([1.0, 1.0, 0.0])
    fits = []
    for delay in CALIBRATION_DELAYS_S:
        fit = least_squares(errors, start, args=(delay,), loss="soft_l1", max_nfev=20)
        fits.append((float(fit.cost), delay, fit.x))
        start = fit.x
    _, delay, best = min(fits, key=lambda f: f[0])
    scale = CAMERA_RANGE_SCALE if best[2] > 0.5 else 1.0
    # Landmarks and odometry fix speed over range only: the motion shrinks with the ranges.
    return Calibration(delay, float(best[0]) / scale, float(best[1]), float(best[2]), scale)


def _successive(readings: Array, barcodes: Set[int]) -> tuple[Array, Array]:
    """Readings (m, 4) and the next reading (m, 4) of the same barcode, at most 1.5 s later."""
    before, after = [np.zeros((0, 4))], [np.zeros((0, 4))]
    for barcode in barcodes:
        own = readings[readings[:, 1] == barcode]
        gap = np.diff(own[:, 0])
        near = (gap > 0) & (gap < 1.5)
        before.append(own[:-1][near])
        after.append(own[1:][near])
    return np.concatenate(before), np.concatenate(after)


def _prediction_errors(track: Track, before: Array, after: Array) -> Array:
    """Errors in range and bearing, over their typical size, of predicting a reading from the last by the odometry."""
    start, end = _states_at(track, before[:, 0]), _states_at(track, after[:, 0])
    # Landmark in the dead-reckoning frame, then seen from the later pose.
    heading = start[:, 2] + before[:, 3]
    dx = start[:, 0] + before[:, 2] * np.cos(heading) - end[:, 0]
    dy = start[:, 1] + before[:, 2] * np.sin(heading) - end[:, 1]
    bearing = after[:, 3] - np.arctan2(dy, dx) + end[:, 2]
    bearing = (bearing + np.pi) % (2 * np.pi) - np.pi
    return np.concatenate([(after[:, 2] - np.hypot(dx, dy)) / 0.03, bearing / 0.01])


def _states_at(track: Track, times: Array) -> Array:
    """States (n, 3) interpolated at times (n,)."""
    return np.stack([np.interp(times, track.times, column) for column in track.states.T], axis=1).astype(np.float64)


def pose_at(track: Track, time: float) -> Array:
    """Pose (4, 4) at a time, interpolated linearly; beyond the ends the nearest."""
    x, y, heading = _states_at(track, np.array([time]))[0]
    T = np.eye(4)
    T[:2, :2] = [[np.cos(heading), -np.sin(heading)], [np.sin(heading), np.cos(heading)]]
    T[:2, 3] = x, y
    return T


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
    then = _states_at(robot.dead_reckoning, readings[:, 0])
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
    out: Path,
    name: str,
    robots: list[RobotLog],
    subjects: dict[int, int],
    landmarks: dict[int, Array],
    ends: Array,
    window: float,
    noise: RangeBearingNoise | None,
) -> Imported:
    by_number = {robot.number: robot for robot in robots}
    robot_rows: list[dict[str, object]] = []
    detection_rows: list[dict[str, object]] = []
    for frame, end in enumerate(ends.tolist()):
        for robot in robots:
            robot_rows.append(_robot_row(robot, frame, end, window, float(ends[0])))
            assumed = noise or (CALIBRATED_NOISE if robot.calibrated else RAW_NOISE)
            seen = detect(robot, end, window, assumed)
            for index, barcode in enumerate(seen.barcodes.tolist()):
                subject = subjects.get(barcode, -1)
                truth = _subject_truth(subject, end, landmarks, by_number)
                detection_rows.append(
                    {
                        "frame": frame,
                        "robot": robot.name,
                        "detection": index,
                        "identity": subject,
                        "position": seen.positions[index].tolist(),
                        "position_variance": float(seen.range_variance[index]),
                        "attribute": [1.0],
                        "attribute_variance": 0.0,
                        "covariance": seen.covariances[index].ravel().tolist(),
                        "truth": truth,
                    }
                )
    out.mkdir(parents=True, exist_ok=True)
    pq.write_table(pa.Table.from_pylist(robot_rows, schema=_ROBOT_SCHEMA), out / "robots.parquet")
    pq.write_table(pa.Table.from_pylist(detection_rows, schema=_DETECTION_SCHEMA), out / "detections.parquet")
    meta = _meta(name, robots, window)
    (out / "dataset.json").write_text(json.dumps(meta, indent=1) + "\n", encoding="utf-8")
    return Imported(out, len(ends), len(robots), len(detection_rows))


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


def _subject_truth(
    subject: int, time: float, landmarks: dict[int, Array], robots: dict[int, RobotLog]
) -> list[float] | None:
    if subject in landmarks:
        return [float(x) for x in landmarks[subject]]
    if subject in robots:
        pose = _truth_at(robots[subject].truth, time)
        return None if pose is None else [float(x) for x in pose[:3, 3]]
    return None


def _meta(name: str, robots: list[RobotLog], window: float) -> dict[str, object]:
    bearings = np.concatenate([robot.readings[:, 3] for robot in robots])
    return {
        "format": "covis-dataset",
        "version": 1,
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


_FLOATS = pa.list_(pa.float64())
_ROBOT_SCHEMA = pa.schema(
    [
        ("frame", pa.int64()),
        ("time", pa.float64()),
        ("robot", pa.string()),
        ("episode", pa.int32()),
        ("pose", _FLOATS),
        ("pose_truth", _FLOATS),
        ("odometry", _FLOATS),
    ]
)
_DETECTION_SCHEMA = pa.schema(
    [
        ("frame", pa.int64()),
        ("robot", pa.string()),
        ("detection", pa.int32()),
        ("identity", pa.int64()),
        ("position", _FLOATS),
        ("position_variance", pa.float64()),
        ("attribute", _FLOATS),
        ("attribute_variance", pa.float64()),
        ("covariance", _FLOATS),
        ("truth", _FLOATS),
    ]
)
