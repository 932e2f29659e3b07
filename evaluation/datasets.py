"""Reader of the dataset format, version 1 (docs/reference/dataset.md): three files in a folder.

Truth (identity, true positions, true poses) stays in the `View`; the `ObjectGraph` that matchers see has none of it,
and its detections are shuffled, so that no method profits from the order in which they were written.
"""

from __future__ import annotations

import json
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from ..matching import ObjectGraph, RelativePose
from ..matching.pose import Array, check_pose, invert

FORMAT = "covis-dataset"
VERSION = 1
POSE_FLOOR_STD_M = 1e-3
"""Least standard deviation of a pose's translation, m."""
POSE_FLOOR_STD_RAD = 1e-3
"""Least standard deviation of a pose's rotation about each axis, rad."""

ROBOT_COLUMNS = ("frame", "robot")
DETECTION_COLUMNS = (
    "frame",
    "robot",
    "detection",
    "identity",
    "position",
    "position_variance",
    "attribute",
    "attribute_variance",
)


class DatasetError(ValueError):
    """A dataset folder that cannot be read; the message names the file, and the column and row where that is known."""


@dataclass(frozen=True, eq=False)
class View:
    """What one robot saw in one frame, and the truth about it.

    Attributes:
        robot: its name.
        graph: its detections, shuffled.
        identity: (n,) int64 true object of each detection; negative = not a true object.
        truth: (n, 3) m true world position of each detection, or None.
        pose: (4, 4) noisy T_world_sensor with `pose_covariance` (6, 6), or None.
        pose_truth: (4, 4), or None.
        odometry: (4, 4) noisy own motion since this robot's previous frame, or None.
        order: (n,) row of each detection as stored, within this robot and frame.
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
        raise DatasetError(f"{view.robot} has no pose in this frame, so poses cannot be 'known'")
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
    seed: int

    def __len__(self) -> int:
        return len(self.frame_index)

    def __iter__(self) -> Iterator[Frame]:
        return (self.frame(i) for i in range(len(self)))

    @property
    def has_poses(self) -> bool:
        return self._robots.get("pose") is not None

    def frame(self, i: int) -> Frame:
        """The i-th frame, counted from 0."""
        index = int(self.frame_index[i])
        rows = self._robot_rows[index]
        time = None if self._robots["time"] is None else float(self._robots["time"][rows[0]])
        time = None if time is None or np.isnan(time) else time
        return Frame(index, int(self.episode[i]), time, tuple(self._view(row) for row in rows))

    def _view(self, row: int) -> View:
        robots, detections, meta = self._robots, self._detections, self._meta
        robot, frame = str(robots["robot"][row]), int(robots["frame"][row])
        stored = self._detection_rows.get((frame, robot), np.zeros(0, dtype=np.int64))
        stream = np.random.default_rng([self.seed, frame, zlib.crc32(robot.encode())])
        order = stream.permutation(len(stored))
        at = stored[order]
        pose = _row(robots["pose"], row, (4, 4))
        own_up = _row(robots["up"], row, (3,))
        up = meta["up"] if own_up is None else own_up
        intrinsics = _row(robots["intrinsics"], row, (3, 3))
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
            truth=_rows(detections["truth"], at, (3,)),
            pose=pose,
            pose_covariance=None if pose is None else pose_covariance(meta["pose_std"], up),
            pose_truth=_row(robots["pose_truth"], row, (4, 4)),
            odometry=_row(robots["odometry"], row, (4, 4)),
            order=order,
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
    """Read a dataset folder.

    Args:
        path: folder with dataset.json, robots.parquet and detections.parquet.
        seed: of the shuffling of detections.

    Raises:
        DatasetError: a missing or unreadable file, another format or version, a missing or malformed column, a value
            that is not finite; the message names file, column and row.
    """
    path = Path(path)
    if not path.is_dir():
        raise DatasetError(f"{path} is not a folder")
    meta = _read_meta(path / "dataset.json")
    robots = _read_robots(path / "robots.parquet")
    detections = _read_detections(path / "detections.parquet", len(meta["classes"]))

    robot_rows: dict[int, list[int]] = {}
    seen: set[tuple[int, str]] = set()
    for row, (frame, robot) in enumerate(zip(robots["frame"], robots["robot"], strict=True)):
        key = (int(frame), str(robot))
        if key in seen:
            raise DatasetError(f"{path / 'robots.parquet'}: row {row} repeats frame {frame}, robot {robot!r}")
        seen.add(key)
        robot_rows.setdefault(key[0], []).append(row)
    for rows in robot_rows.values():
        rows.sort(key=lambda r: str(robots["robot"][r]))

    detection_rows: dict[tuple[int, str], list[int]] = {}
    for row, (frame, robot) in enumerate(zip(detections["frame"], detections["robot"], strict=True)):
        key = (int(frame), str(robot))
        if key not in seen:
            raise DatasetError(
                f"{path / 'detections.parquet'}: row {row} is of frame {frame}, robot {robot!r}, "
                "which robots.parquet lacks"
            )
        detection_rows.setdefault(key, []).append(row)

    frame_index = np.array(sorted(robot_rows), dtype=np.int64)
    episodes = robots["episode"]
    episode = frame_index if episodes is None else np.array([episodes[robot_rows[int(f)][0]] for f in frame_index])
    return Dataset(
        path=path,
        name=meta["name"],
        classes=meta["classes"],
        has_episodes=episodes is not None,
        frame_index=frame_index,
        episode=episode.astype(np.int64),
        _meta=meta,
        _robots=robots,
        _detections=detections,
        _robot_rows=robot_rows,
        _detection_rows={key: np.array(rows, dtype=np.int64) for key, rows in detection_rows.items()},
        seed=seed,
    )


def _read_meta(file: Path) -> dict[str, Any]:
    try:
        raw = json.loads(file.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise DatasetError(f"{file} is missing") from error
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise DatasetError(f"{file} is not JSON: {error}") from error
    if not isinstance(raw, dict) or raw.get("format") != FORMAT:
        raise DatasetError(f"{file}: format is {raw.get('format') if isinstance(raw, dict) else raw!r}, not {FORMAT!r}")
    if raw.get("version") != VERSION:
        raise DatasetError(f"{file}: version is {raw.get('version')!r}, this reader knows {VERSION}")
    for key in ("name", "classes"):
        if key not in raw:
            raise DatasetError(f"{file}: {key!r} is missing")
    classes = raw["classes"]
    if not isinstance(classes, list) or not classes or not all(isinstance(c, str) for c in classes):
        raise DatasetError(f"{file}: classes must be a list of names, got {classes!r}")
    if raw.get("units", "m") != "m":
        raise DatasetError(f"{file}: units must be 'm', got {raw['units']!r}")
    std = raw.get("pose_std")
    size = raw.get("image_size")
    try:
        return {
            "name": str(raw["name"]),
            "classes": tuple(classes),
            "up": None if raw.get("up") is None else np.asarray(raw["up"], dtype=np.float64),
            "forward": _forward(str(raw.get("sensor_frame", ""))),
            "image_size": None if size is None else (int(size[0]), int(size[1])),
            "horizontal_fov_rad": raw.get("horizontal_fov_rad"),
            "pose_std": None if std is None else (float(std["position_m"]), float(std["heading_rad"])),
        }
    except (TypeError, ValueError, KeyError, IndexError) as error:
        raise DatasetError(f"{file}: up, image_size or pose_std is malformed: {error!r}") from error


def _forward(sensor_frame: str) -> Array | None:
    """The optical axis, as the description of the sensor frame names it ("... z forward")."""
    for axis, unit in (("x", (1.0, 0.0, 0.0)), ("y", (0.0, 1.0, 0.0)), ("z", (0.0, 0.0, 1.0))):
        if f"{axis} forward" in sensor_frame:
            return np.array(unit)
    return None


def _read_robots(file: Path) -> dict[str, Any]:
    table = _read_table(file, ROBOT_COLUMNS)
    out: dict[str, Any] = {
        "frame": _scalars(table, "frame", file, np.int64),
        "robot": table.column("robot").to_pylist(),
        "time": _scalars(table, "time", file, np.float64, nullable=True),
        "episode": _scalars(table, "episode", file, np.int64),
    }
    for name, width in (("pose", 16), ("pose_truth", 16), ("odometry", 16), ("intrinsics", 9), ("up", 3)):
        out[name] = _lists(table, name, file, width, nullable=True)
    for name in ("pose", "pose_truth", "odometry"):
        _check_poses(out[name], name, file)
    return out


def _read_detections(file: Path, n_classes: int) -> dict[str, Any]:
    table = _read_table(file, DETECTION_COLUMNS)
    out: dict[str, Any] = {
        "frame": _scalars(table, "frame", file, np.int64),
        "robot": table.column("robot").to_pylist(),
        "identity": _scalars(table, "identity", file, np.int64),
        "position": _lists(table, "position", file, 3),
        "attribute": _lists(table, "attribute", file, n_classes),
        "truth": _lists(table, "truth", file, 3, nullable=True),
        "covariance": _lists(table, "covariance", file, 9),
        "embedding": _lists(table, "embedding", file, None),
    }
    for name in ("position_variance", "attribute_variance"):
        values = _scalars(table, name, file, np.float64)
        assert values is not None
        if len(values) and not (values >= 0).all():
            row = int(np.argmin(values >= 0))
            raise DatasetError(f"{file}: column {name!r}, row {row}: {values[row]} is not a variance")
        out[name] = values
    if len(out["attribute"]) and out["attribute"].min() < 0:
        row = int(np.argmax((out["attribute"] < 0).any(axis=1)))
        raise DatasetError(f"{file}: column 'attribute', row {row}: negative confidence {out['attribute'][row].min()}")
    return out


def _read_table(file: Path, required: tuple[str, ...]) -> pa.Table:
    try:
        table = pq.read_table(file)
    except FileNotFoundError as error:
        raise DatasetError(f"{file} is missing") from error
    except (pa.ArrowException, OSError) as error:
        raise DatasetError(f"{file} cannot be read as Parquet (truncated or corrupt?): {error}") from error
    missing = [name for name in required if name not in table.column_names]
    if missing:
        raise DatasetError(f"{file}: missing column(s) {', '.join(missing)}")
    return table


def _scalars(table: pa.Table, name: str, file: Path, dtype: type, nullable: bool = False) -> NDArray[Any] | None:
    if name not in table.column_names:
        return None
    column = table.column(name)
    if column.null_count and not nullable:
        row = int(np.argmax(column.is_null().to_numpy()))
        raise DatasetError(f"{file}: column {name!r}, row {row} is null")
    try:
        return column.to_numpy().astype(dtype)
    except (TypeError, ValueError) as error:
        raise DatasetError(f"{file}: column {name!r} holds {column.type}, not numbers") from error


def _lists(table: pa.Table, name: str, file: Path, width: int | None, nullable: bool = False) -> Array | None:
    """A list column as (rows, width); a null row becomes NaN. None when absent or null throughout."""
    if name not in table.column_names or (table.num_rows and table.column(name).null_count == table.num_rows):
        return None
    column = table.column(name).combine_chunks()
    if not (
        pa.types.is_list(column.type) or pa.types.is_fixed_size_list(column.type) or pa.types.is_large_list(column.type)
    ):
        raise DatasetError(f"{file}: column {name!r} holds {column.type}, not lists")
    null = column.is_null().to_numpy(zero_copy_only=False)
    if null.any() and not nullable:
        raise DatasetError(f"{file}: column {name!r}, row {int(np.argmax(null))} is null")
    valid = column.drop_null()
    lengths = np.array([len(x) for x in valid]) if not pa.types.is_fixed_size_list(column.type) else None
    if lengths is None:
        lengths = np.full(len(valid), column.type.list_size)
    expected = width if width is not None else (int(lengths[0]) if len(lengths) else 0)
    if len(lengths) and (lengths != expected).any():
        row = int(np.flatnonzero(~null)[np.argmax(lengths != expected)])
        raise DatasetError(
            f"{file}: column {name!r}, row {row} has {lengths[lengths != expected][0]} values, expected {expected}"
        )
    flat = valid.flatten()
    if flat.null_count:
        row = int(np.flatnonzero(~null)[int(np.argmax(flat.is_null().to_numpy(zero_copy_only=False))) // expected])
        raise DatasetError(f"{file}: column {name!r}, row {row} holds a null")
    values = np.asarray(flat.to_numpy(zero_copy_only=False), dtype=np.float64).reshape(-1, expected)
    if not np.isfinite(values).all():
        row = int(np.flatnonzero(~null)[np.argmin(np.isfinite(values).all(axis=1))])
        raise DatasetError(f"{file}: column {name!r}, row {row} is not finite")
    out = np.full((table.num_rows, expected), np.nan)
    out[~null] = values
    return out


def _check_poses(poses: Array | None, name: str, file: Path) -> None:
    if poses is None:
        return
    for row, values in enumerate(poses):
        if np.isnan(values[0]):
            continue
        try:
            check_pose(values.reshape(4, 4), name)
        except ValueError as error:
            raise DatasetError(f"{file}: column {name!r}, row {row}: {error}") from error


def _row(values: Array | None, row: int, shape: tuple[int, ...]) -> Array | None:
    if values is None or np.isnan(values[row, 0]):
        return None
    return values[row].reshape(shape)


def _rows(values: Array | None, rows: NDArray[np.int64], shape: tuple[int, ...] | None) -> Array | None:
    if values is None or np.isnan(values[rows]).any():
        return None
    return values[rows] if shape is None else values[rows].reshape(-1, *shape)
