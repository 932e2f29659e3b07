"""Scenes to dataset folders: `covis record`, resumable; and `covis check`, which verifies a folder's checksums.

Each episode is one pair of part files, written whole by an atomic rename; the final tables are streamed from the parts.
A folder without dataset.json is unfinished, and no reader opens it.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from .datasets import FORMAT, VERSION, DatasetError, load_dataset
from .settings import Settings, scene_preset
from .shards import write_atomically

FLOATS = pa.list_(pa.float64())
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
        ("box", FLOATS),
        ("truth", FLOATS),
    ]
)
TABLES = {"robots": ROBOTS, "detections": DETECTIONS}
CHECKSUMS = "checksums.json"
REQUEST = "recording.json"


class ChecksumError(DatasetError):
    """A file of a dataset folder is missing or not what was written."""


def record(
    scene: str,
    settings: Settings,
    out: Path,
    *,
    resume: bool = False,
    overwrite: bool = False,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> None:
    """Write `settings.episodes` episodes of a scene as a dataset folder, images included.

    Raises:
        FileExistsError: the folder holds a finished dataset and `overwrite` is off, an unfinished one and `resume` is
            off, or one of another request.
    """
    episodes = settings.episodes or 50
    request = {"scene": scene, "preset": settings.preset, "seed": settings.seed, "perception": settings.perception}
    parts = _prepare(out, request, resume, overwrite)
    from .run_scene import make_env

    env = make_env(scene, settings)
    try:
        for episode in range(episodes):
            progress(episode, episodes)
            if not all((parts / f"{name}-{episode:05d}.parquet").exists() for name in TABLES):
                _write_episode(env, episode, settings, parts)
        meta = _meta(scene, env, settings)
    finally:
        env.close()
    for name, schema in TABLES.items():
        _concatenate([parts / f"{name}-{e:05d}.parquet" for e in range(episodes)], out / f"{name}.parquet", schema)
    content = json.dumps(meta, indent=1).encode()
    write_atomically(out / CHECKSUMS, json.dumps(_checksums(out, content), indent=1).encode())
    write_atomically(out / "README.md", _card(meta, settings, episodes).encode())
    write_atomically(out / "dataset.json", content)
    shutil.rmtree(parts)
    (out / REQUEST).unlink()
    progress(episodes, episodes)


def check(folder: Path) -> int:
    """Verify a dataset folder against its checksums and read it whole; the number of frames.

    Raises:
        ChecksumError: no checksums, or a file that differs from them; the message names it.
        DatasetError: the folder cannot be read.
    """
    file = folder / CHECKSUMS
    if not file.exists():
        raise ChecksumError(f"{file} is missing")
    for name, expected in json.loads(file.read_text()).items():
        if not (folder / name).exists():
            raise ChecksumError(f"{folder / name} is missing")
        if _sha256(folder / name) != expected:
            raise ChecksumError(f"{folder / name} differs from its checksum")
    return sum(1 for _ in load_dataset(folder))


def _prepare(out: Path, request: dict[str, Any], resume: bool, overwrite: bool) -> Path:
    """The folder of part files, empty or to be gone on with."""
    parts, file = out / "parts", out / REQUEST
    if (out / "dataset.json").exists() and not overwrite:
        raise FileExistsError(f"{out} holds a dataset already; give --overwrite to replace it")
    if file.exists() and not overwrite:
        if not resume:
            raise FileExistsError(
                f"{out} holds an unfinished recording; give --resume to go on, --overwrite to replace"
            )
        if json.loads(file.read_text()) != request:
            raise FileExistsError(f"{out} holds an unfinished recording of {json.loads(file.read_text())}")
    elif overwrite:
        shutil.rmtree(parts, ignore_errors=True)
        for name in ("dataset.json", CHECKSUMS, *(f"{t}.parquet" for t in TABLES)):
            (out / name).unlink(missing_ok=True)
    parts.mkdir(parents=True, exist_ok=True)
    write_atomically(file, json.dumps(request).encode())
    return parts


def _write_episode(env: Any, episode: int, settings: Settings, parts: Path) -> None:
    robots: list[dict[str, Any]] = []
    detections: list[dict[str, Any]] = []
    for step, rows in enumerate(_frames(env, episode, settings)):
        frame = 1000 * episode + step
        for robot, found in rows:
            robots.append({"frame": frame, "episode": episode} | robot)
            detections += [{"frame": frame, "detection": k} | row for k, row in enumerate(found)]
    for name, table in (("robots", robots), ("detections", detections)):
        file = parts / f"{name}-{episode:05d}.parquet"
        temporary = file.with_suffix(".tmp")
        pq.write_table(pa.Table.from_pylist(table, schema=TABLES[name]), temporary)
        os.replace(temporary, file)


def _frames(env: Any, episode: int, settings: Settings) -> Iterator[list[tuple[dict[str, Any], list[dict[str, Any]]]]]:
    """Per step and robot: its row, and those of its detections."""
    import cv2

    from ..agents.perception import make_perceptor
    from .run_scene import identity, look_around, step_scripted

    perceive = make_perceptor(settings.perception, env)
    observations, _ = env.reset(seed=[settings.seed, episode])
    step = 0
    while env.agents:
        views = look_around(env, perceive, observations, (settings.seed, episode, step))
        truth, snapshot = env.ground_truth(), env.snapshot()
        place = dict(zip(truth.identity.tolist(), truth.positions.tolist(), strict=True))
        rows = []
        for i, (agent, view) in enumerate(zip(env.agents, views, strict=True)):
            seen = observations[agent]
            image = cv2.imencode(".png", cv2.cvtColor(seen["image"], cv2.COLOR_RGB2BGR))[1].tobytes()
            robot = {
                "time": snapshot.time,
                "robot": agent,
                "pose": _flat(seen["pose"]),
                "pose_truth": _flat(truth.T_world_camera[i]),
                "odometry": _flat(seen["odometry"]),
                "intrinsics": _flat(seen["intrinsics"]),
                "up": _flat(seen["up"]),
                "image": image,
            }
            rows.append((robot, _detection_rows(agent, view, identity(view, i, env), place)))
        yield rows
        observations = step_scripted(env)
        step += 1


def _detection_rows(agent: str, view: Any, identities: Any, place: dict[int, list[float]]) -> list[dict[str, Any]]:
    graph = view.detections.graph
    covariances = graph.full_covariances()
    return [
        {
            "robot": agent,
            "identity": int(identities[k]),
            "position": _flat(graph.positions[k]),
            "position_variance": float(graph.position_variance[k]),
            "attribute": _flat(graph.attributes[k]),
            "attribute_variance": float(graph.attribute_variance[k]),
            "covariance": _flat(covariances[k]),
            "box": _flat(view.detections.boxes[k]),
            "truth": place.get(int(identities[k])),
        }
        for k in range(len(graph))
    ]


def _meta(scene: str, env: Any, settings: Settings) -> dict[str, Any]:
    return {
        "format": FORMAT,
        "version": VERSION,
        "name": "-".join(filter(None, (scene, scene_preset(scene, settings), f"seed{settings.seed}"))),
        "classes": list(env.classes),
        "sensor_frame": "camera: x right, y down, z forward",
        "units": "m",
        "pose": "world_from_sensor, row-major 4x4, noisy",
        "pose_std": {"position_m": env.pose_noise.position_m, "heading_rad": env.pose_noise.heading_rad},
        "image_size": [env.width, env.height],
        "source": f"covis record {scene}, preset {scene_preset(scene, settings)}, seed {settings.seed}, "
        f"{settings.perception} perception",
        "licence": "CC0",
    }


def _card(meta: dict[str, Any], settings: Settings, episodes: int) -> str:
    return f"""---
license: cc0-1.0
configs:
- config_name: robots
  data_files: robots.parquet
- config_name: detections
  data_files: detections.parquet
---

# {meta["name"]}

{episodes} episodes made by `{meta["source"]}`.

`robots.parquet` has a row per robot and frame (noisy pose, true pose, odometry, intrinsics, PNG image),
`detections.parquet` a row per detection (position and its covariance in the camera frame, class distribution, box;
truth: identity and position).
Frames of one episode are consecutive in time. Columns and units: dataset format version {VERSION} of covis.

Synthetic; no persons, no places. Detections: {settings.perception} perception.
"""


def _concatenate(parts: Sequence[Path], file: Path, schema: pa.Schema) -> None:
    temporary = file.with_suffix(".tmp")
    with pq.ParquetWriter(temporary, schema) as writer:
        for part in parts:
            writer.write_table(pq.read_table(part, schema=schema))
    os.replace(temporary, file)


def _checksums(out: Path, meta: bytes) -> dict[str, str]:
    sums = {f"{name}.parquet": _sha256(out / f"{name}.parquet") for name in TABLES}
    return sums | {"dataset.json": hashlib.sha256(meta).hexdigest()}


def _sha256(file: Path) -> str:
    with file.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def _flat(values: Any) -> list[float]:
    return np.asarray(values, dtype=np.float64).ravel().tolist()
