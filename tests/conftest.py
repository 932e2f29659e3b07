"""Shared fixtures: a small dataset folder made here, and the development data where it is at hand."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

SHARED_DATA = Path(__file__).resolve().parents[2] / "shared" / "data"


@pytest.fixture(autouse=True)
def _own_modules_are_forgotten():
    """A test's `mine.py` is not the next test's: commands run in one process here."""
    yield
    sys.modules.pop("mine", None)
    if methods := sys.modules.get("covis.evaluation.methods"):
        methods._loaded.cache_clear()


@pytest.fixture
def shared_data() -> Path:
    """The development datasets beside the repository; tests that need them skip where they are absent."""
    if not SHARED_DATA.is_dir():
        pytest.skip("the development datasets are not beside this repository (../shared/data)")
    return SHARED_DATA


def write_dataset(folder: Path, n_frames: int = 6, n_objects: int = 8, seed: int = 0, **meta) -> Path:
    """Two robots, level frames, `n_objects` in the world, each seen with probability 0.8; poses exact to 0.1 m."""
    rng = np.random.default_rng(seed)
    robots, detections = [], []
    for frame in range(n_frames):
        world = np.column_stack([rng.uniform(-15, 15, (n_objects, 2)), rng.uniform(0, 2, n_objects)])
        kinds = rng.integers(0, 3, n_objects)
        for r in range(2):
            heading, place = rng.uniform(-np.pi, np.pi), rng.uniform(-5, 5, 2)
            T = np.eye(4)
            T[:2, :2] = [[np.cos(heading), -np.sin(heading)], [np.sin(heading), np.cos(heading)]]
            T[:2, 3] = place
            noisy = T.copy()
            noisy[:2, 3] += rng.normal(0, 0.1, 2)
            robots.append(
                {"frame": frame, "time": 0.2 * frame, "robot": f"robot_{r}", "episode": frame // 3}
                | {"pose": noisy.ravel().tolist(), "pose_truth": T.ravel().tolist()}
            )
            seen = np.flatnonzero(rng.random(n_objects) < 0.8)
            for k, j in enumerate(seen):
                position = (world[j] - T[:3, 3]) @ T[:3, :3] + rng.normal(0, 0.05, 3)
                attribute = np.full(3, 0.1)
                attribute[kinds[j]] = 0.8
                detections.append(
                    {"frame": frame, "robot": f"robot_{r}", "detection": k, "identity": int(100 * frame + j)}
                    | {"position": position.tolist(), "position_variance": 0.01, "attribute": attribute.tolist()}
                    | {"attribute_variance": 0.01, "truth": world[j].tolist()}
                )
    folder.mkdir(parents=True, exist_ok=True)
    pq.write_table(pa.Table.from_pylist(robots), folder / "robots.parquet")
    pq.write_table(pa.Table.from_pylist(detections), folder / "detections.parquet")
    head = {
        "format": "covis-dataset",
        "version": 1,
        "name": "small",
        "classes": ["a", "b", "c"],
        "sensor_frame": "levelled: x forward, y left, z up",
        "up": [0, 0, 1],
        "units": "m",
        "source": "made by a test",
        "licence": "CC0",
        "pose_std": {"position_m": 0.1, "heading_rad": 0.0},
    }
    (folder / "dataset.json").write_text(json.dumps(head | meta))
    return folder


@pytest.fixture
def small_dataset(tmp_path: Path) -> Path:
    return write_dataset(tmp_path / "small")


@pytest.fixture
def dataset_writer():
    """`write_dataset`, for tests that need other sizes."""
    return write_dataset
