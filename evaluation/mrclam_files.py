"""The raw files of one MRCLAM sequence, read and checked.

`Barcodes.dat`, `Landmark_Groundtruth.dat` and, for each robot i, `Robot<i>_Measurement.dat` (time, barcode, range,
bearing), `Robot<i>_Odometry.dat` (time, speed, turn rate) and `Robot<i>_Groundtruth.dat` (time, x, y, heading from
motion capture).
"""

from __future__ import annotations

import re
import tarfile
import tempfile
import zipfile
from collections.abc import Iterator, Set
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..matching.pose import Array
from .mrclam_odometry import UNCALIBRATED, Track, calibrate

COMMENT = "#"
ROBOT_FILES = {"Measurement": 4, "Odometry": 3, "Groundtruth": 4}
"""Files of each robot, and how many columns they have."""


class MrclamError(ValueError):
    """Raw files that are missing or malformed; the message names the file."""


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


@dataclass(frozen=True, eq=False)
class RawSequence:
    """What the files of one sequence hold.

    Attributes:
        subjects: barcode -> subject, a landmark or a robot.
        landmarks: subject -> position (3,) m, world frame.
        robots: their logs, by ascending number.
    """

    subjects: dict[int, int]
    landmarks: dict[int, Array]
    robots: list[RobotLog]


def read_sequence(source: Path) -> RawSequence:
    """Read a folder with the raw files (or with one subfolder that has them), or a .tar.*, .tgz or .zip of it.

    Raises:
        MrclamError: a file that is missing, malformed or empty.
    """
    with _raw_folder(source) as folder:
        subjects = _read_barcodes(folder / "Barcodes.dat")
        landmarks = _read_landmarks(folder / "Landmark_Groundtruth.dat")
        robots = _read_robots(folder, {b for b, subject in subjects.items() if subject in landmarks})
    return RawSequence(subjects, landmarks, robots)


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
    tables = {kind: _read_table(folder / f"Robot{number}_{kind}.dat", columns) for kind, columns in ROBOT_FILES.items()}
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
