"""`covis export coco`: a dataset folder's images as PNG files, and what they show in COCO's JSON.

`annotations.json` holds the truth where the folder has `objects.parquet`, otherwise what the robots' eyes reported;
`detections.json` holds that in COCO's format of results, so that `COCOeval` can score one against the other.
"""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq

from .dataset_check import check
from .dataset_tables import DatasetError, bad_row, read_json
from .files import write_atomically
from .progress import Progress, silent

ANNOTATIONS, RESULTS, IMAGES = "annotations.json", "detections.json", "images"
KEPT = ("frame", "robot", "episode", "time", "intrinsics", "pose", "pose_truth")
"""Columns of robots.parquet that an image's entry keeps."""

Key = tuple[int, str]


@dataclass(frozen=True)
class Exported:
    """How much was written."""

    images: int
    annotations: int
    detections: int


def export_coco(
    folder: Path,
    out: Path,
    *,
    overwrite: bool = False,
    progress: Progress = silent,
) -> Exported:
    """Write a dataset folder with images as a COCO data set; `annotations.json`, which makes it one, comes last.

    Objects with fewer visible pixels than the dataset's `min_pixels` are marked `iscrowd`, which COCO's evaluation does
    not count either way.

    Raises:
        DatasetError: a malformed folder, or one without images.
        FileExistsError: `out` holds something and `overwrite` is off.
    """
    check(folder)
    head = read_json(folder / "dataset.json")
    names = pq.read_schema(folder / "robots.parquet").names
    if "image" not in names or not head.get("image_size"):
        raise DatasetError(f"{folder} has no images (column 'image' of robots.parquet, image_size of dataset.json)")
    _prepare(out, overwrite)
    images = _write_images(folder, out / IMAGES, head["image_size"], progress)
    numbers = {(image["frame"], image["robot"]): image["id"] for image in images}
    results = list(_results(folder, numbers, head))
    truth = list(_truth(folder, numbers, head)) if (folder / "objects.parquet").exists() else _as_truth(results)
    content = {
        "info": {"description": f"{head['name']}: {head.get('source', '')}", "version": "1", "contributor": "covis"},
        "licenses": [{"id": 1, "name": head.get("licence", ""), "url": ""}],
        "categories": [{"id": k, "name": name, "supercategory": ""} for k, name in enumerate(head["classes"], 1)],
        "images": images,
        "annotations": truth,
    }
    write_atomically(out / RESULTS, json.dumps(results).encode())
    write_atomically(out / ANNOTATIONS, json.dumps(content).encode())
    return Exported(len(images), len(truth), len(results))


def _prepare(out: Path, overwrite: bool) -> None:
    if out.exists() and any(out.iterdir()):
        if not overwrite:
            raise FileExistsError(f"{out} is not empty; give --overwrite to replace the export in it")
        for name in (ANNOTATIONS, RESULTS):
            (out / name).unlink(missing_ok=True)
        shutil.rmtree(out / IMAGES, ignore_errors=True)
    (out / IMAGES).mkdir(parents=True, exist_ok=True)


def _write_images(folder: Path, images: Path, size: list[int], progress: Progress) -> list[dict[str, Any]]:
    """Every image as a file, and its entry; robots without one in a frame are left out."""
    file = folder / "robots.parquet"
    total = pq.read_metadata(file).num_rows
    entries = []
    for number, row in enumerate(_rows(file, (*KEPT, "image")), 1):
        progress(number, total)
        if row["image"] is None:
            continue
        if not re.fullmatch(r"[\w.-]+", row["robot"]):
            raise bad_row(file, "robot", number - 1, f": {row['robot']!r} cannot be part of a file's name")
        name = f"{row['frame']:07d}-{row['robot']}.png"
        (images / name).write_bytes(row.pop("image"))
        entries.append({"id": number, "file_name": name, "width": size[0], "height": size[1], "license": 1} | row)
    return entries


def _truth(folder: Path, numbers: dict[Key, int], head: dict[str, Any]) -> Iterator[dict[str, Any]]:
    file = folder / "objects.parquet"
    for column in ("class", "box"):
        if column not in pq.read_schema(file).names:
            raise DatasetError(f"{file}: missing column(s) {column}")
    categories = {name: k for k, name in enumerate(head["classes"], 1)}
    rows = _rows(file, ("frame", "robot", "identity", "class", "pixels", "box", "mask"))
    for number, row in enumerate(rows):
        if row["class"] not in categories:
            raise bad_row(file, "class", number, f": {row['class']!r} is not one of {', '.join(categories)}")
        if (image := numbers.get((row["frame"], row["robot"]))) is None:
            continue
        yield {
            "id": number + 1,
            "image_id": image,
            "category_id": categories[row["class"]],
            "bbox": _bbox(row["box"]),
            "area": row["pixels"],
            "iscrowd": int(row["pixels"] < head.get("min_pixels", 0)),
            "track_id": row["identity"],
        } | _segmentation(row["mask"], head)


def _results(folder: Path, numbers: dict[Key, int], head: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """Detections with a box, in COCO's format of results."""
    for row in _rows(folder / "detections.parquet", ("frame", "robot", "attribute", "box", "mask")):
        image = numbers.get((row["frame"], row["robot"]))
        if image is None or row["box"] is None:
            continue
        yield {
            "image_id": image,
            "category_id": int(np.argmax(row["attribute"])) + 1,
            "bbox": _bbox(row["box"]),
            "score": max(row["attribute"]),
        } | _segmentation(row["mask"], head)


def _as_truth(results: list[dict[str, Any]]) -> list[dict[str, Any]]:
    return [r | {"id": k, "area": r["bbox"][2] * r["bbox"][3], "iscrowd": 0} for k, r in enumerate(results, 1)]


def _bbox(box: list[float]) -> list[float]:
    """[u0, v0, u1, v1] as COCO's [x, y, width, height]."""
    return [box[0], box[1], box[2] - box[0], box[3] - box[1]]


def _segmentation(mask: list[int] | None, head: dict[str, Any]) -> dict[str, Any]:
    width, height = head["image_size"]
    return {} if mask is None else {"segmentation": {"counts": mask, "size": [height, width]}}


def _rows(file: Path, columns: tuple[str, ...]) -> Iterator[dict[str, Any]]:
    """Rows of a file, a few at a time; columns it lacks are None."""
    table = pq.ParquetFile(file)
    there = [name for name in columns if name in table.schema_arrow.names]
    empty = dict.fromkeys(columns)
    for batch in table.iter_batches(64, columns=there):
        yield from (empty | row for row in batch.to_pylist())
