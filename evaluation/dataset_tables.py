"""The three or four files of a dataset folder, read and checked: nothing that gets past here is malformed.

Every error names the file, and the column and row where that is known.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from ..matching.pose import ROTATION_TOLERANCE, Array

FORMAT = "covis-dataset"
VERSION = 1
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
OBJECT_COLUMNS = ("frame", "robot", "identity", "pixels")
MAX_DETECTION = 2**31 - 1
MAX_VALUE = 1e7
"""Metres, pixels or confidence: what lies beyond is a mistake of whoever wrote it, and would overflow when squared."""
UNIT_TOLERANCE = 1e-2


class DatasetError(ValueError):
    """A dataset folder that cannot be read; the message names the file, and the column and row where that is known."""


def bad_row(file: Path, column: str, row: Any, what: str) -> DatasetError:
    return DatasetError(f"{file}: column {column!r}, row {int(row)}{what}")


def read_meta(file: Path) -> dict[str, Any]:
    """dataset.json: `name`, `classes`, `forward` and whatever `_OPTIONAL` lists (None where absent)."""
    raw = read_json(file)
    if raw.get("format") != FORMAT:
        raise DatasetError(f"{file}: format is {raw.get('format')!r}, not {FORMAT!r}")
    if raw.get("version") != VERSION:
        raise DatasetError(f"{file}: version is {raw.get('version')!r}, this reader knows {VERSION}")
    for key in ("name", "classes"):
        if key not in raw:
            raise DatasetError(f"{file}: {key!r} is missing")
    if raw.get("units", "m") != "m":
        raise DatasetError(f"{file}: units must be 'm', got {raw['units']!r}")
    return {
        "name": str(raw["name"]),
        "classes": _classes(raw["classes"], file),
        "forward": _forward(str(raw.get("sensor_frame", ""))),
    } | {key: _optional(raw, key, convert, file) for key, convert in _OPTIONAL.items()}


def read_json(file: Path) -> dict[str, Any]:
    """A JSON object. Raises DatasetError when the file is missing or something else."""
    try:
        raw = json.loads(file.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise DatasetError(f"{file} is missing") from error
    except (json.JSONDecodeError, UnicodeDecodeError, OSError) as error:
        raise DatasetError(f"{file} is not JSON: {error}") from error
    if not isinstance(raw, dict):
        raise DatasetError(f"{file} holds {type(raw).__name__}, not an object")
    return raw


def _classes(classes: Any, file: Path) -> tuple[str, ...]:
    if not isinstance(classes, list) or not classes or not all(isinstance(c, str) for c in classes):
        raise DatasetError(f"{file}: classes must be a list of names, got {classes!r}")
    if len(set(classes)) < len(classes):
        raise DatasetError(f"{file}: classes repeat a name: {classes}")
    return tuple(classes)


def _forward(sensor_frame: str) -> Array | None:
    """The optical axis, as the description of the sensor frame names it ("... z forward")."""
    for axis, unit in (("x", (1.0, 0.0, 0.0)), ("y", (0.0, 1.0, 0.0)), ("z", (0.0, 0.0, 1.0))):
        if f"{axis} forward" in sensor_frame:
            return np.array(unit)
    return None


def _optional(raw: dict[str, Any], key: str, convert: Callable[[Any], Any], file: Path) -> Any:
    if raw.get(key) is None:
        return None
    try:
        return convert(raw[key])
    except (TypeError, ValueError, KeyError, IndexError, OverflowError) as error:
        raise DatasetError(f"{file}: {key} is malformed: {raw[key]!r} ({error})") from error


def _unit_vector(value: Any) -> Array:
    vector = np.asarray(value, dtype=np.float64)
    if vector.shape != (3,) or not abs(np.linalg.norm(vector) - 1) <= UNIT_TOLERANCE:
        raise ValueError("not a unit vector of 3 numbers")
    return vector


def _image_size(value: Any) -> tuple[int, int]:
    width, height = (int(x) for x in value)
    if width < 1 or height < 1 or [width, height] != list(value):
        raise ValueError("width and height must be positive whole numbers")
    return width, height


def _fov(value: Any) -> float:
    if not 0 < value <= 2 * np.pi:
        raise ValueError("must lie in (0, 2 pi]")
    return float(value)


def _pose_std(value: Any) -> tuple[float, float]:
    std = float(value["position_m"]), float(value["heading_rad"])
    if not all(0 <= s <= MAX_VALUE for s in std):
        raise ValueError("standard deviations must be non-negative")
    return std


def _count(value: Any) -> int:
    if int(value) < 1:
        raise ValueError("must be at least 1")
    return int(value)


_OPTIONAL: dict[str, Callable[[Any], Any]] = {
    "up": _unit_vector,
    "image_size": _image_size,
    "horizontal_fov_rad": _fov,
    "pose_std": _pose_std,
    "min_pixels": _count,
}


def read_robots(file: Path) -> dict[str, Any]:
    """robots.parquet without its images, a column as an array each (None where absent)."""
    lists = {"pose": 16, "pose_truth": 16, "odometry": 16, "intrinsics": 9, "up": 3}
    table = read_table(file, ROBOT_COLUMNS, ("time", "episode", *lists))
    if not table.num_rows:
        raise DatasetError(f"{file} has no rows")
    out: dict[str, Any] = {
        "frame": _integers(table, "frame", file, least=0),
        "robot": _names(table, "robot", file),
        "time": _times(table, file),
        "episode": _integers(table, "episode", file, least=0),
    }
    for name, width in lists.items():
        out[name] = _lists(table, name, file, width, nullable=True)
    for name in ("pose", "pose_truth", "odometry"):
        _check_poses(out[name], name, file)
    if (K := out["intrinsics"]) is not None:
        _refuse((K[:, 0] <= 0) | (K[:, 4] <= 0), "intrinsics", file, lambda row: f": focal lengths {K[row, (0, 4)]}")
    if (up := out["up"]) is not None:
        length = np.linalg.norm(up, axis=1)
        wrong = np.abs(length - 1) > UNIT_TOLERANCE
        _refuse(wrong, "up", file, lambda row: f": a unit vector's length is not {length[row]:.3g}")
    return out


def read_detections(file: Path, n_classes: int, image_size: tuple[int, int] | None = None) -> dict[str, Any]:
    """detections.parquet, a column as an array each (None where absent)."""
    table = read_table(file, DETECTION_COLUMNS, ("truth", "covariance", "embedding", "box"))
    out: dict[str, Any] = {
        "frame": _integers(table, "frame", file, least=0),
        "robot": _names(table, "robot", file),
        "detection": _integers(table, "detection", file, least=0),
        "identity": _integers(table, "identity", file),
        "position": _lists(table, "position", file, 3),
        "position_variance": _variances(table, "position_variance", file),
        "attribute": _lists(table, "attribute", file, n_classes),
        "attribute_variance": _variances(table, "attribute_variance", file),
        "truth": _lists(table, "truth", file, 3, nullable=True),
        "covariance": _lists(table, "covariance", file, 9, optional=True),
        "embedding": _lists(table, "embedding", file, None, optional=True),
        "box": _lists(table, "box", file, 4, nullable=True),
    }
    attribute, box, covariance = out["attribute"], out["box"], out["covariance"]
    number = out["detection"]
    _refuse(number > MAX_DETECTION, "detection", file, lambda row: f": {number[row]} is beyond {MAX_DETECTION}")
    negative = (attribute < 0).any(axis=1)
    _refuse(negative, "attribute", file, lambda row: f": negative confidence {attribute[row].min()}")
    if box is not None:
        wrong = (box[:, 2] < box[:, 0]) | (box[:, 3] < box[:, 1])
        _refuse(wrong, "box", file, lambda row: f": {box[row]} is not [u0, v0, u1, v1]")
        _check_inside(box, image_size, file)
    if covariance is not None:
        _check_covariances(covariance.reshape(-1, 3, 3), file)
    _check_identities(out, file)
    return out


def _check_inside(box: Array, image_size: tuple[int, int] | None, file: Path) -> None:
    """Boxes may reach over the image's edge, by the image's own size at most, but must show some of it."""
    if image_size is None:
        return
    size = np.array(image_size)
    outside: NDArray[np.bool_] = np.any(
        (box[:, 2:] < 0) | (box[:, :2] > size) | (box[:, :2] < -size) | (box[:, 2:] > 2 * size), axis=1
    )
    what = f"lies outside the image of {size[0]}x{size[1]} pixels"
    _refuse(outside, "box", file, lambda row: f": {box[row]} {what}")


def _check_identities(detections: dict[str, Any], file: Path) -> None:
    """A robot sees an object once in a frame: matches are counted per object."""
    _, robot = np.unique(np.asarray(detections["robot"], dtype=object).astype(str), return_inverse=True)
    rows = np.flatnonzero(detections["identity"] >= 0)
    keys = np.stack([detections["frame"], robot, detections["identity"]], axis=1)[rows]
    _, first, group = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    again = np.zeros(len(robot), dtype=np.bool_)
    again[rows] = first[group.ravel()] != np.arange(len(rows))
    _refuse(
        again,
        "identity",
        file,
        lambda row: (
            f": frame {detections['frame'][row]}, robot {detections['robot'][row]!r} has object "
            f"{detections['identity'][row]} twice (a second detection of an object has a negative identity)"
        ),
    )


def read_objects(file: Path) -> dict[str, Any] | None:
    """objects.parquet, the truth in each image, without its masks; None where there is none."""
    if not file.exists():
        return None
    table = read_table(file, OBJECT_COLUMNS, ())
    return {
        "frame": _integers(table, "frame", file, least=0),
        "robot": _names(table, "robot", file),
        "identity": _integers(table, "identity", file, least=0),
        "pixels": _integers(table, "pixels", file, least=1),
    }


def read_table(file: Path, required: tuple[str, ...], optional: tuple[str, ...]) -> pa.Table:
    """The named columns; images and whatever else a file holds stay on disk.

    Raises:
        DatasetError: the file is missing, no Parquet, truncated or corrupt, or lacks a required column.
    """
    try:
        names = pq.read_schema(file).names
    except FileNotFoundError as error:
        raise DatasetError(f"{file} is missing") from error
    except (pa.ArrowException, OSError) as error:
        raise DatasetError(f"{file} cannot be read as Parquet (truncated or corrupt?): {error}") from error
    if missing := [name for name in required if name not in names]:
        raise DatasetError(f"{file}: missing column(s) {', '.join(missing)}")
    wanted = [name for name in names if name in (*required, *optional)]
    if len(set(wanted)) < len(wanted):
        raise DatasetError(f"{file}: columns repeat a name: {', '.join(wanted)}")
    try:
        return _columns(file, wanted)
    except (pa.ArrowException, OSError) as error:
        where = next((f"column {name!r} " for name in wanted if not _readable(file, name)), "")
        raise DatasetError(f"{file}: {where}cannot be read (corrupt?): {error}") from error


def _columns(file: Path, names: list[str]) -> pa.Table:
    # One file, not a data set of files: partitions must not be guessed from the names of its folders.
    table = pq.ParquetFile(file, page_checksum_verification=True).read(names)
    return pa.table({field.name: _decoded(table.column(field.name)) for field in table.schema})


def _decoded(column: pa.ChunkedArray) -> pa.ChunkedArray:
    """Without dictionary encoding, as pandas' categories have it."""
    return column.cast(column.type.value_type) if pa.types.is_dictionary(column.type) else column


def _readable(file: Path, name: str) -> bool:
    try:
        _columns(file, [name])
    except (pa.ArrowException, OSError):
        return False
    return True


def _refuse(wrong: NDArray[np.bool_], name: str, file: Path, what: Callable[[int], str]) -> None:
    """Raise for the first wrong row; rows that are null compare false and pass."""
    if wrong.any():
        row = int(np.argmax(wrong))
        raise bad_row(file, name, row, what(row))


def _names(table: pa.Table, name: str, file: Path) -> list[str]:
    _no_nulls(table, name, file)
    values = table.column(name).to_pylist()
    wrong = next((row for row, value in enumerate(values) if not isinstance(value, str)), None)
    if wrong is not None:
        raise DatasetError(f"{file}: column {name!r} holds {table.column(name).type}, not text")
    return values


def _no_nulls(table: pa.Table, name: str, file: Path) -> None:
    if table.column(name).null_count:
        raise bad_row(file, name, np.argmax(table.column(name).is_null().to_numpy()), " is null")


def _numbers(table: pa.Table, name: str, file: Path) -> NDArray[Any]:
    kind = table.column(name).type
    if not _numeric(kind):
        raise DatasetError(f"{file}: column {name!r} holds {kind}, not numbers")
    return table.column(name).to_numpy()


def _numeric(kind: pa.DataType) -> bool:
    return bool(pa.types.is_integer(kind) or pa.types.is_floating(kind) or pa.types.is_null(kind))


def _integers(table: pa.Table, name: str, file: Path, least: int | None = None) -> NDArray[np.int64] | None:
    """None where the column is absent."""
    if name not in table.column_names:
        return None
    _no_nulls(table, name, file)
    values = _numbers(table, name, file)
    with np.errstate(invalid="ignore"):
        out = values.astype(np.int64)
    _refuse(out != values, name, file, lambda row: f": {values[row]} is not a whole number of 64 bits")
    if least is not None:
        _refuse(out < least, name, file, lambda row: f": {out[row]} is less than {least}")
    return out


def _times(table: pa.Table, file: Path) -> Array | None:
    if "time" not in table.column_names:
        return None
    null = table.column("time").is_null().to_numpy()
    values = _numbers(table, "time", file).astype(np.float64)
    _refuse(~null & ~np.isfinite(values), "time", file, lambda row: f": {values[row]} is not a time")
    return values


def _variances(table: pa.Table, name: str, file: Path) -> Array:
    """Non-negative; infinite stands for unknown."""
    _no_nulls(table, name, file)
    values = _numbers(table, name, file).astype(np.float64)
    fine = ((values >= 0) & (values <= MAX_VALUE**2)) | (values == np.inf)
    _refuse(~fine, name, file, lambda row: f": {values[row]} is not a variance")
    return values


def _lists(
    table: pa.Table, name: str, file: Path, width: int | None, nullable: bool = False, optional: bool = False
) -> Array | None:
    """A list column as (rows, width); a null row, where `nullable`, becomes NaN.

    A column that may be null or is `optional` comes out as None when absent or null throughout.
    """
    if name not in table.column_names:
        return None
    column = table.column(name).combine_chunks()
    if (nullable or optional) and column.null_count == len(column) > 0:
        return None
    if not _is_list(column.type):
        raise DatasetError(f"{file}: column {name!r} holds {column.type}, not lists")
    if not nullable:
        _no_nulls(table, name, file)
    present = np.flatnonzero(column.is_valid().to_numpy(zero_copy_only=False))
    values = _matrix(column.drop_null(), name, file, width, present)
    out = np.full((table.num_rows, values.shape[1]), np.nan)
    out[present] = values
    return out


def _is_list(kind: pa.DataType) -> bool:
    return pa.types.is_list(kind) or pa.types.is_large_list(kind) or pa.types.is_fixed_size_list(kind)


def _matrix(column: pa.Array, name: str, file: Path, width: int | None, rows: NDArray[np.int64]) -> Array:
    """Lists without nulls as (rows, width); `rows` are their numbers in the file."""
    lengths = column.value_lengths().to_numpy(zero_copy_only=False)
    expected = width if width is not None else (int(lengths[0]) if len(lengths) else 0)
    if (wrong := lengths != expected).any():
        first = int(np.argmax(wrong))
        raise bad_row(file, name, rows[first], f" has {lengths[first]} values, expected {expected}")
    flat = column.flatten()
    if flat.null_count:
        first = int(np.argmax(flat.is_null().to_numpy(zero_copy_only=False)))
        raise bad_row(file, name, rows[first // expected], " holds a null")
    if not _numeric(flat.type):
        raise DatasetError(f"{file}: column {name!r} holds {column.type}, not numbers")
    values = np.asarray(flat.to_numpy(zero_copy_only=False), dtype=np.float64).reshape(len(rows), expected)
    if (wrong := ~np.isfinite(values)).any():
        first, element = np.argwhere(wrong)[0]
        raise bad_row(file, name, rows[first], f": {values[first, element]} is not finite")
    limit = MAX_VALUE**2 if name == "covariance" else MAX_VALUE
    size = np.abs(values).max(axis=1, initial=0)
    if (size > limit).any():
        first = int(np.argmax(size > limit))
        raise bad_row(file, name, rows[first], f": {size[first]:.3g} is beyond {limit:.0e}, which makes no sense")
    return values


def _check_poses(poses: Array | None, name: str, file: Path) -> None:
    """Rigid motions all of them, as `covis.matching.pose.check_pose` has it, for many rows at once."""
    if poses is None:
        return
    # A null row stands here as no motion at all.
    T = np.where(np.isnan(poses[:, :1]), np.eye(4).ravel(), poses).reshape(-1, 4, 4)
    R = T[:, :3, :3]
    error = np.abs(R @ R.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
    determinant = np.linalg.det(R)
    last = ~np.isclose(T[:, 3], (0, 0, 0, 1)).all(axis=1)
    _refuse(
        (error > ROTATION_TOLERANCE) | (determinant < 0) | last,
        name,
        file,
        lambda row: (
            f": {name} is not a rigid motion: |R R^T - I| = {error[row]:.2g}, det R = {determinant[row]:.3g}, "
            f"last row {T[row, 3]}"
        ),
    )


def _check_covariances(covariances: Array, file: Path) -> None:
    apart = np.abs(covariances - covariances.transpose(0, 2, 1)).max(axis=(1, 2), initial=0)
    largest = np.abs(covariances).max(axis=(1, 2), initial=0)
    lopsided = apart > 1e-9 + 1e-5 * largest
    _refuse(lopsided, "covariance", file, lambda row: f": not symmetric, entries differ by {apart[row]:.2g}")
    least = np.linalg.eigvalsh(covariances)[:, 0]
    negative = least < -1e-6 * np.maximum(largest, 1e-9)
    _refuse(negative, "covariance", file, lambda row: f": not positive semidefinite, eigenvalue {least[row]:.2g}")
