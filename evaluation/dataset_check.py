"""`covis check`: a dataset folder against its checksums, its tables against the format, its pictures against both."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from .dataset_tables import DatasetError, bad_row, read_json, read_meta
from .datasets import load_dataset
from .recording import CHECKSUMS, HEAD, sha256, unfinished

PNG = b"\x89PNG\r\n\x1a\n"
ROWS_AT_ONCE = 256


class ChecksumError(DatasetError):
    """A file of a dataset folder is missing or not what was written."""


@dataclass(frozen=True)
class Checked:
    """A sound folder: how many frames it has, and whether there were checksums to compare with."""

    frames: int
    verified: bool


def check(folder: Path) -> Checked:
    """Read a dataset folder whole.

    Raises:
        ChecksumError: a file that is missing or differs from its checksum; the message names it.
        DatasetError: a folder that is unfinished or malformed; the message names file, column and row.
    """
    if not (folder / HEAD).exists() and (episodes := unfinished(folder)) is not None:
        raise DatasetError(
            f"{folder} is an unfinished recording ({episodes} whole episodes): go on with covis record --resume"
        )
    verified = (folder / CHECKSUMS).exists()
    if verified:
        _compare(folder)
    dataset = load_dataset(folder)
    for _ in dataset:
        pass
    for name in ("robots", "detections", "objects"):
        _read_whole(folder / f"{name}.parquet")
    head = read_meta(folder / HEAD)
    size, classes = head["image_size"], head["classes"]
    _each_row(folder / "robots.parquet", ["image"], lambda row: _image_fault(row["image"], size))
    _each_row(folder / "objects.parquet", ["mask", "pixels"], lambda row: _mask_fault(row["mask"], row["pixels"], size))
    _each_row(folder / "objects.parquet", ["class"], lambda row: _class_fault(row["class"], classes))
    _each_row(folder / "objects.parquet", ["position"], lambda row: _vector_fault(row["position"], 3))
    _each_row(folder / "objects.parquet", ["box"], lambda row: _vector_fault(row["box"], 4))
    _each_row(folder / "detections.parquet", ["mask"], lambda row: _mask_fault(row["mask"], None, size))
    return Checked(len(dataset), verified)


def _compare(folder: Path) -> None:
    for name, expected in read_json(folder / CHECKSUMS).items():
        file = folder / Path(name).name
        if not file.exists():
            raise ChecksumError(f"{file} is missing")
        if sha256(file) != expected:
            raise ChecksumError(f"{file} differs from its checksum")


def _read_whole(file: Path) -> None:
    """Also the columns that no reader of ours needs. Raises DatasetError for the first that cannot be read."""
    if file.exists():
        for name in dict.fromkeys(pq.read_schema(file).names):
            for _ in _batches(file, [name]):
                pass


def _each_row(file: Path, columns: list[str], fault: Callable[[dict[str, Any]], str | None]) -> None:
    """Raise for the first row with a fault; a file without these columns has none. The first column is to blame."""
    for number, row in enumerate(_rows(file, columns)):
        if (what := fault(row)) is not None:
            raise bad_row(file, columns[0], number, f": {what}")


def _rows(file: Path, columns: list[str]) -> Iterator[dict[str, Any]]:
    if file.exists() and set(columns) <= set(pq.read_schema(file).names):
        for batch in _batches(file, columns):
            yield from batch.to_pylist()


def _batches(file: Path, columns: list[str]) -> Iterator[pa.RecordBatch]:
    table = pq.ParquetFile(file, page_checksum_verification=True)
    try:
        yield from table.iter_batches(ROWS_AT_ONCE, columns=columns)
    except (pa.ArrowException, OSError) as error:
        raise DatasetError(f"{file}: column {columns[0]!r} cannot be read (corrupt?): {error}") from error


def _class_fault(name: Any, classes: tuple[str, ...]) -> str | None:
    return None if name is None or name in classes else f"{name!r} is none of the classes {', '.join(classes)}"


def _vector_fault(values: Any, length: int) -> str | None:
    if values is None:
        return None
    numbers = isinstance(values, list) and all(isinstance(x, int | float) and math.isfinite(x) for x in values)
    return None if numbers and len(values) == length else f"{values!r} is not {length} finite numbers"


def _image_fault(image: Any, size: tuple[int, int] | None) -> str | None:
    if image is None:
        return None
    if not isinstance(image, bytes) or image[:8] != PNG or len(image) < 24:
        return "not a PNG image"
    found = int.from_bytes(image[16:20], "big"), int.from_bytes(image[20:24], "big")
    if size is not None and found != size:
        return f"an image of {found[0]}x{found[1]} pixels, dataset.json says {size[0]}x{size[1]}"
    if not image.endswith(b"IEND\xaeB`\x82"):
        return "a truncated PNG image"
    return None


def _mask_fault(mask: Any, pixels: int | None, size: tuple[int, int] | None) -> str | None:
    if mask is None:
        return None
    runs = np.asarray(mask)
    if runs.ndim != 1 or not np.issubdtype(runs.dtype, np.integer) or (runs < 0).any():
        return "not run lengths"
    if size is not None and runs.sum() != size[0] * size[1]:
        return f"runs of {runs.sum()} pixels in all, an image has {size[0] * size[1]}"
    if pixels is not None and runs[1::2].sum() != pixels:
        return f"a mask of {runs[1::2].sum()} pixels, column 'pixels' says {pixels}"
    return None
