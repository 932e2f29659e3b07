"""The data card (README.md) of a recorded dataset, which is also what makes the folder a Hugging Face dataset."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import pyarrow as pa

from .dataset_tables import VERSION

COLUMNS: Mapping[str, str] = {
    "frame": "number of the instant; the same for all robots",
    "time": "s since the episode began",
    "robot": "name",
    "episode": "frames of one episode are consecutive in time; nothing carries over to the next",
    "pose": "world from camera as the robot believes it (noisy), row-major 4x4, m",
    "pose_truth": "the true one",
    "odometry": "own motion since the last frame, noisy, row-major 4x4",
    "intrinsics": "pinhole matrix, row-major 3x3, px",
    "up": "unit vector against gravity, camera frame",
    "image": "PNG",
    "detection": "number within frame and robot",
    "identity": "true object, the same number in all images of an episode; negative: no true object",
    "position": "m; in `detections` as measured, camera frame; in `objects` as it is, world frame",
    "position_variance": "m², along the viewing ray",
    "attribute": "confidence per class, in the order of `classes` in dataset.json",
    "attribute_variance": "mean variance of the confidences",
    "covariance": "of the position, row-major 3x3, m²",
    "embedding": "appearance, for re-identification; null where the eyes give none",
    "box": "[u0, v0, u1, v1] px; in `objects` the tight box of the visible pixels",
    "mask": "run lengths, column by column, outside first (COCO's uncompressed RLE); null where the eyes give none",
    "truth": "true position of the object, m, world frame",
    "class": "true class",
    "pixels": "visible pixels",
}
ABOUT = {
    "robots": "a row per robot and frame",
    "detections": "a row per detection: what the robot's eyes make of the image",
    "objects": "a row per object of which an image shows at least one pixel: what is there",
}


def card(head: Mapping[str, Any], tables: Mapping[str, pa.Schema], sizes: Mapping[str, tuple[int, int]]) -> str:
    """Markdown with the front matter that Hugging Face's `datasets` reads.

    Args:
        head: what dataset.json holds.
        tables: schema of each table.
        sizes: rows and bytes of each table.
    """
    request = head["recording"]
    width, height = head["image_size"]
    return f"""---
{_front_matter(head, tables, sizes)}
---

# {head["name"]}

{request["episodes"]} episodes of the scene `{request["scene"]}`: several robots with cameras ({width}x{height}) look at
the same objects. Made by covis:

    {_command(request)}

{_contents(tables, sizes)}

Classes: {", ".join(head["classes"])}. Poses carry noise of {head["pose_std"]["position_m"]:g} m per axis and
{head["pose_std"]["heading_rad"]:g} rad of heading (1 sigma). An object counts as visible from
{head["min_pixels"]} pixels on. `checksums.json` holds the SHA-256 of every file (`covis check`).

## Read it

```python
import pandas as pd
robots = pd.read_parquet("robots.parquet")

from datasets import load_dataset  # Hugging Face
objects = load_dataset(".", "objects", split="train")

from covis.evaluation.datasets import load_dataset  # views and graphs, truth kept apart
frame = load_dataset(".").frame(0)
```

## Columns

Dataset format version {VERSION} of covis: metres, radians, variances in m²; camera x right, y down, z forward; world
z up.

{_column_tables(tables)}

## What it is not

Synthetic: rendered by a software rasteriser, no persons, no real places. Detections and their uncertainties come from
{request["perception"]} perception, so their errors are those of that model. Robots follow scripted controllers.
Each episode is one independent sample; frames within an episode are not.
"""


def _command(request: Mapping[str, Any]) -> str:
    preset = f" --preset {request['preset']}" if request["preset"] else ""
    return (
        f"covis record {request['scene']} --episodes {request['episodes']}{preset} --seed {request['seed']} "
        f"--perception {request['perception']} --out DIR"
    )


def _contents(tables: Mapping[str, pa.Schema], sizes: Mapping[str, tuple[int, int]]) -> str:
    rows = [f"| `{t}.parquet` | {ABOUT[t]} | {sizes[t][0]:,} | {sizes[t][1] / 1e6:.1f} |" for t in tables]
    return "\n".join(["| file | | rows | MB |", "| --- | --- | --- | --- |", *rows])


def _column_tables(tables: Mapping[str, pa.Schema]) -> str:
    parts = []
    for table, schema in tables.items():
        rows = [f"| `{field.name}` | {_type_name(field.type)} | {COLUMNS[field.name]} |" for field in schema]
        parts.append("\n".join([f"`{table}`\n", "| column | type | |", "| --- | --- | --- |", *rows]))
    return "\n\n".join(parts)


def _type_name(kind: pa.DataType) -> str:
    return f"list of {_feature_name(kind.value_type)}" if pa.types.is_list(kind) else _feature_name(kind)


def _front_matter(
    head: Mapping[str, Any], tables: Mapping[str, pa.Schema], sizes: Mapping[str, tuple[int, int]]
) -> str:
    lines = [
        "license: cc0-1.0",
        f"pretty_name: {head['name']}",
        "task_categories:",
        "- object-detection",
        "tags:",
        "- collaborative-perception",
        "- multi-robot",
        "- synthetic",
        "size_categories:",
        f"- {_size_category(max(rows for rows, _ in sizes.values()))}",
        "configs:",
    ]
    for table in tables:
        lines += [f"- config_name: {table}", f"  data_files: {table}.parquet"]
        lines += ["  default: true"] if table == "robots" else []
    lines += ["dataset_info:"]
    for table, schema in tables.items():
        lines += [f"- config_name: {table}", "  features:"]
        for field in schema:
            lines += [f"  - name: {field.name}", f"    {_feature(field)}"]
    return "\n".join(lines)


def _feature(field: pa.Field) -> str:
    """One column in the words of Hugging Face's dataset cards."""
    if field.name == "image":
        return "dtype: image"
    if pa.types.is_list(field.type):
        return f"sequence: {_feature_name(field.type.value_type)}"
    return f"dtype: {_feature_name(field.type)}"


def _feature_name(kind: pa.DataType) -> str:
    return {"double": "float64"}.get(str(kind), str(kind))


def _size_category(rows: int) -> str:
    for limit, name in ((1e3, "n<1K"), (1e4, "1K<n<10K"), (1e5, "10K<n<100K"), (1e6, "100K<n<1M")):
        if rows < limit:
            return name
    return "1M<n<10M"
