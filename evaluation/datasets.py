"""Reader of the dataset format, version 1 (docs/reference/dataset.md): three files in a folder.

Truth (identity, true positions, true poses) stays in the `View`; the `ObjectGraph` that matchers see has none of it,
and its detections are shuffled, so that no method profits from the order in which they were written.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
from numpy.typing import NDArray

from ..matching import ObjectGraph, RelativePose
from ..matching.pose import Array, invert
from .dataset_tables import DatasetError, bad_row, read_detections, read_meta, read_objects, read_robots

UNFINISHED = "recording.json"
"""A file of folders that `covis record` has not finished."""
POSE_FLOOR_STD_M = 1e-3
"""Least standard deviation of a pose's translation, m."""
POSE_FLOOR_STD_RAD = 1e-3
"""Least standard deviation of a pose's rotation about each axis, rad."""


@dataclass(frozen=True, eq=False)
class View:
    """What one robot saw in one frame, and the truth about it.

    Attributes:
        robot: its name.
        graph: its detections, shuffled.
        identity: (n,) int64 true object of each detection; negative = not a true object.
        truth: (n, 3) m true world position of each detection, NaN where unknown; or None.
        pose: (4, 4) noisy T_world_sensor with `pose_covariance` (6, 6), or None.
        pose_truth: (4, 4), or None. Where a dataset names no error of its poses, they are the truth.
        odometry: (4, 4) noisy own motion since this robot's previous frame, or None.
        order: (n,) row of each detection as stored, within this robot and frame.
        boxes: (n, 4) px [u0, v0, u1, v1] of each detection, or None.
        visible: identities of all objects with at least `min_pixels` visible pixels in this robot's image, detected or
            not; None where the dataset does not say.
    """

    robot: str
    graph: ObjectGraph
    identity: NDArray[np.int64]
    truth: Array | None
    pose: Array | None
    pose_covariance: Array | None
    pose_truth: Array | None
    odometry: Array | None
    order: NDArray[np.int64]
    boxes: Array | None = None
    visible: NDArray[np.int64] | None = None


@dataclass(frozen=True, eq=False)
class Frame:
    """All views of one instant. `episode`, the unit of statistics, is the frame's number where a dataset has none."""

    index: int
    episode: int
    time: float | None
    views: tuple[View, ...]


def prior_between(source: View, target: View) -> RelativePose:
    """The noisy relative pose of two views that carry poses. Raises DatasetError when one has none."""
    return RelativePose.between(*_known_pose(source), *_known_pose(target))


def _known_pose(view: View) -> tuple[Array, Array]:
    if view.pose is None or view.pose_covariance is None:
        raise DatasetError(f"{view.robot} has no pose, so poses cannot be 'known'")
    return view.pose, view.pose_covariance


def true_relative_pose(source: View, target: View) -> Array | None:
    """T_source_target (4, 4) from the true poses, or None."""
    if source.pose_truth is None or target.pose_truth is None:
        return None
    return invert(source.pose_truth) @ target.pose_truth


@dataclass(frozen=True, eq=False)
class Dataset:
    """A dataset folder in memory; iterate for `Frame`s in time order."""

    path: Path
    name: str
    classes: tuple[str, ...]
    has_episodes: bool
    frame_index: NDArray[np.int64]
    episode: NDArray[np.int64]
    _meta: dict[str, Any]
    _robots: dict[str, Any]
    _detections: dict[str, Any]
    _robot_rows: dict[int, list[int]]
    _detection_rows: dict[tuple[int, str], NDArray[np.int64]]
    _visible: dict[tuple[int, str], NDArray[np.int64]] | None
    seed: int

    def __len__(self) -> int:
        return len(self.frame_index)

    def __iter__(self) -> Iterator[Frame]:
        return (self.frame(i) for i in range(len(self)))

    @property
    def has_poses(self) -> bool:
        return self._robots.get("pose") is not None

    @property
    def has_true_poses(self) -> bool:
        return self._robots.get("pose_truth") is not None

    def frame(self, i: int) -> Frame:
        """The i-th frame, counted from 0."""
        index = int(self.frame_index[i])
        rows = self._robot_rows[index]
        time = None if self._robots["time"] is None else float(self._robots["time"][rows[0]])
        time = None if time is None or np.isnan(time) else time
        return Frame(index, int(self.episode[i]), time, tuple(self._view(row) for row in rows))

    def spread(self, number: int | None) -> list[Frame]:
        """At most so many frames, evenly spread over all; None = all."""
        n = len(self) if number is None else min(number, len(self))
        return [self.frame(i * len(self) // n) for i in range(n)]

    def _view(self, row: int) -> View:
        robots, detections, meta = self._robots, self._detections, self._meta
        robot, frame = str(robots["robot"][row]), int(robots["frame"][row])
        stored = self._detection_rows.get((frame, robot), np.zeros(0, dtype=np.int64))
        stream = np.random.default_rng([self.seed, frame, zlib.crc32(robot.encode())])
        # Shuffled from the order of their numbers, so that nothing depends on the order of rows.
        order = np.argsort(detections["detection"][stored])[stream.permutation(len(stored))]
        at = stored[order]
        pose = _row(robots["pose"], row, (4, 4))
        own_up = _row(robots["up"], row, (3,))
        up = meta["up"] if own_up is None else own_up
        intrinsics = _row(robots["intrinsics"], row, (3, 3))
        pose_truth = _row(robots["pose_truth"], row, (4, 4))
        if pose_truth is None and meta["pose_std"] is None:
            pose_truth = pose
        graph = ObjectGraph(
            positions=detections["position"][at],
            attributes=detections["attribute"][at],
            position_variance=detections["position_variance"][at],
            attribute_variance=detections["attribute_variance"][at],
            covariances=_rows(detections["covariance"], at, (3, 3)),
            up=up,
            forward=meta["forward"],
            embedding=_rows(detections["embedding"], at, None),
            intrinsics=intrinsics,
            image_size=meta["image_size"],
            horizontal_fov_rad=meta["horizontal_fov_rad"],
        )
        return View(
            robot=robot,
            graph=graph,
            identity=detections["identity"][at],
            truth=None if detections["truth"] is None else detections["truth"][at],
            pose=pose,
            pose_covariance=None if pose is None else pose_covariance(meta["pose_std"], up),
            pose_truth=pose_truth,
            odometry=_row(robots["odometry"], row, (4, 4)),
            order=order,
            boxes=_rows(detections["box"], at, (4,)),
            visible=None if self._visible is None else self._visible.get((frame, robot), np.zeros(0, dtype=np.int64)),
        )


def pose_covariance(pose_std: tuple[float, float] | None, up: Array | None) -> Array:
    """Covariance (6, 6) of a robot's pose from its standard deviations (position m per axis, heading rad about `up`).

    Both get a small floor; without `pose_std` poses are taken to be exact, which leaves the floor. Without `up` the
    heading error holds for every axis.
    """
    position, heading = pose_std or (0.0, 0.0)
    covariance = np.zeros((6, 6))
    covariance[:3, :3] = (position**2 + POSE_FLOOR_STD_M**2) * np.eye(3)
    axes = np.eye(3) if up is None else np.outer(up, up)
    covariance[3:, 3:] = heading**2 * axes + POSE_FLOOR_STD_RAD**2 * np.eye(3)
    return covariance


def load_dataset(path: str | Path, seed: int = 0) -> Dataset:
    """Read a dataset folder; its images stay on disk.

    Args:
        path: folder with dataset.json, robots.parquet, detections.parquet and perhaps objects.parquet.
        seed: of the shuffling of detections.

    Raises:
        DatasetError: a missing or unreadable file, another format or version, a missing or malformed column, a value
            that is not finite or makes no sense; the message names file, column and row.
    """
    path = Path(path)
    if not path.is_dir():
        raise DatasetError(f"{path} is not a folder")
    if (path / UNFINISHED).exists() and not (path / "dataset.json").exists():
        raise DatasetError(f"{path} is an unfinished recording: go on with covis record --resume")
    meta = read_meta(path / "dataset.json")
    robots = read_robots(path / "robots.parquet")
    detections = read_detections(path / "detections.parquet", len(meta["classes"]), meta["image_size"])
    objects = read_objects(path / "objects.parquet")

    robot_rows = _group_robots(robots, path / "robots.parquet")
    known = {(int(frame), robot) for frame, robot in zip(robots["frame"], robots["robot"], strict=True)}
    detection_rows = _group(detections, "detection", known, path / "detections.parquet")
    visible = None
    if objects is not None and meta["min_pixels"] is not None:
        rows = _group(objects, "identity", known, path / "objects.parquet")
        enough = objects["pixels"] >= meta["min_pixels"]
        visible = {key: objects["identity"][at[enough[at]]] for key, at in rows.items()}
    frame_index = np.array(sorted(robot_rows), dtype=np.int64)
    episode = frame_index
    if robots["episode"] is not None:
        episode = robots["episode"][[robot_rows[int(f)][0] for f in frame_index]]
    return Dataset(
        path=path,
        name=meta["name"],
        classes=meta["classes"],
        has_episodes=robots["episode"] is not None,
        frame_index=frame_index,
        episode=episode,
        _meta=meta,
        _robots=robots,
        _detections=detections,
        _robot_rows=robot_rows,
        _detection_rows=detection_rows,
        _visible=visible,
        seed=seed,
    )


def _group_robots(robots: dict[str, Any], file: Path) -> dict[int, list[int]]:
    """Rows of each frame, robots in the order of their names."""
    groups: dict[int, list[int]] = {}
    seen: set[tuple[int, str]] = set()
    for row, key in enumerate(zip(robots["frame"].tolist(), robots["robot"], strict=True)):
        if key in seen:
            raise DatasetError(f"{file}: row {row} repeats frame {key[0]}, robot {key[1]!r}")
        seen.add(key)
        groups.setdefault(key[0], []).append(row)
    for rows in groups.values():
        rows.sort(key=lambda r: str(robots["robot"][r]))
    if robots["episode"] is not None:
        _check_episodes(robots, groups, file)
    return groups


def _check_episodes(robots: dict[str, Any], groups: dict[int, list[int]], file: Path) -> None:
    """One episode a frame, each episode's frames in one stretch, and its time does not run backwards."""
    episode, time = robots["episode"], robots["time"]
    over: set[int] = set()
    last: int | None = None
    for frame in sorted(groups):
        rows = groups[frame]
        now = int(episode[rows[0]])
        for row in rows[1:]:
            if episode[row] != now:
                raise bad_row(file, "episode", row, f": frame {frame} is of episode {now} and of {episode[row]}")
        if last is not None and now != episode[last]:
            over.add(int(episode[last]))
        elif last is not None and time is not None and time[rows[0]] < time[last]:
            raise bad_row(
                file, "time", rows[0], f": frame {frame} is at {time[rows[0]]} s, the one before at {time[last]}"
            )
        if now in over:
            raise bad_row(
                file, "episode", rows[0], f": frame {frame} goes back to episode {now}: its frames must be consecutive"
            )
        last = rows[0]


def _group(
    table: dict[str, Any], number: str, known: set[tuple[int, str]], file: Path
) -> dict[tuple[int, str], NDArray[np.int64]]:
    """Rows of each (frame, robot); `number` tells the rows of one group apart."""
    groups: dict[tuple[int, str], list[int]] = {}
    seen: set[tuple[int, str, int]] = set()
    columns = zip(table["frame"].tolist(), table["robot"], table[number].tolist(), strict=True)
    for row, (frame, robot, index) in enumerate(columns):
        if (frame, robot) not in known:
            raise DatasetError(f"{file}: row {row} is of frame {frame}, robot {robot!r}, which robots.parquet lacks")
        if (frame, robot, index) in seen:
            raise DatasetError(f"{file}: row {row} repeats frame {frame}, robot {robot!r}, {number} {index}")
        seen.add((frame, robot, index))
        groups.setdefault((frame, robot), []).append(row)
    return {key: np.array(rows, dtype=np.int64) for key, rows in groups.items()}


def _row(values: Array | None, row: int, shape: tuple[int, ...]) -> Array | None:
    if values is None or np.isnan(values[row, 0]):
        return None
    return values[row].reshape(shape)


def _rows(values: Array | None, rows: NDArray[np.int64], shape: tuple[int, ...] | None) -> Array | None:
    if values is None or np.isnan(values[rows]).any():
        return None
    return values[rows] if shape is None else values[rows].reshape(-1, *shape)


Stored = dict[tuple[int, str], list[Any]]
"""(frame, robot) -> values of a column, in stored order."""


def optional_column(file: Path, name: str, frames: Sequence[int]) -> Stored:
    """A column that matching has no use for, of some frames, without nulls; nothing if the file lacks it."""
    if not frames or name not in pq.read_schema(file).names:
        return {}
    table = pq.read_table(file, columns=["frame", "robot", name], filters=[("frame", "in", list(frames))])
    found: Stored = {}
    for row in table.to_pylist():
        if row[name] is not None:
            found.setdefault((row["frame"], row["robot"]), []).append(row[name])
    return found
