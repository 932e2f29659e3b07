"""Arrow schemas of the tables that we write into dataset folders; readers take more, see `dataset_tables`."""

from __future__ import annotations

from collections.abc import Sequence

import pyarrow as pa

FLOATS = pa.list_(pa.float64())
RUNS = pa.list_(pa.int32())
"""Run lengths of a mask."""
ROBOTS = pa.schema(
    [
        ("frame", pa.int64()),
        ("time", pa.float64()),
        ("robot", pa.string()),
        ("episode", pa.int32()),
        ("pose", FLOATS),
        ("pose_truth", FLOATS),
        ("odometry", FLOATS),
        ("intrinsics", FLOATS),
        ("up", FLOATS),
        ("image", pa.binary()),
    ]
)
DETECTIONS = pa.schema(
    [
        ("frame", pa.int64()),
        ("robot", pa.string()),
        ("detection", pa.int32()),
        ("identity", pa.int64()),
        ("position", FLOATS),
        ("position_variance", pa.float64()),
        ("attribute", FLOATS),
        ("attribute_variance", pa.float64()),
        ("covariance", FLOATS),
        ("embedding", FLOATS),
        ("box", FLOATS),
        ("mask", RUNS),
        ("truth", FLOATS),
    ]
)
OBJECTS = pa.schema(
    [
        ("frame", pa.int64()),
        ("robot", pa.string()),
        ("identity", pa.int64()),
        ("class", pa.string()),
        ("position", FLOATS),
        ("pixels", pa.int32()),
        ("box", FLOATS),
        ("mask", RUNS),
    ]
)
TABLES = {"robots": ROBOTS, "detections": DETECTIONS, "objects": OBJECTS}
"""Name of the Parquet file -> its schema, as `covis record` writes them."""


def columns(schema: pa.Schema, names: Sequence[str]) -> pa.Schema:
    """Some columns of a schema, in this order."""
    return pa.schema([schema.field(name) for name in names])
