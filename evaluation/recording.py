"""Scenes to dataset folders: `covis record`, resumable.

Each episode is one set of part files, each written whole by an atomic rename; the final tables are streamed from the
parts, so that memory holds one episode. A folder without dataset.json is unfinished, and no reader opens it.
"""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from .data_card import card
from .dataset_schemas import TABLES
from .dataset_tables import FORMAT, VERSION
from .datasets import UNFINISHED
from .engine import make_executor
from .executors import Done, Executor, Failure
from .files import replacing, write_atomically
from .progress import Progress, silent
from .recording_rows import Rows, frames
from .settings import Settings, scene_preset

CHECKSUMS = "checksums.json"
REQUEST = UNFINISHED
HEAD = "dataset.json"
FILES = (HEAD, CHECKSUMS, "README.md", *(f"{table}.parquet" for table in TABLES))
FRAMES_PER_EPISODE_NUMBER = 1000
"""Frames are numbered through: so many numbers for each episode, whether it has as many steps or not."""
EPISODES = 50
"""Unless the settings say otherwise."""


def record(
    scene: str,
    settings: Settings,
    out: Path,
    *,
    workers: int = 1,
    resume: bool = False,
    overwrite: bool = False,
    progress: Progress = silent,
) -> None:
    """Write `settings.episodes` episodes of a scene as a dataset folder, images and masks included.

    The same call with `resume` goes on after any interruption and ends with the same files; it returns at once where
    they are there already. The number of `workers` processes changes nothing but the time.

    Raises:
        FileExistsError: the folder holds a finished dataset or another's files and `overwrite` is off, an unfinished
            recording and `resume` is off, or one of another request.
        ValueError: fewer than one worker.
    """
    episodes = settings.episodes or EPISODES
    request = {"scene": scene} | {key: getattr(settings, key) for key in ("preset", "seed", "perception", "n_robots")}
    if resume and (_stored(out / HEAD) or {}).get("recording") == request | {"episodes": episodes}:
        _tidy(out)
        return
    goes_on = resume and _stored(out / REQUEST) == request
    if not goes_on:
        _refuse_to_replace(out, overwrite)
    executor = make_executor("local", workers)
    from .run_scene import make_eyes

    env = _own_env(scene, settings)
    try:
        make_eyes(settings, env)  # what cannot be recorded is found out before anything is replaced
        _begin(out, request, goes_on)
        _record_parts(RecordOne(scene, settings, out / "parts"), episodes, executor, progress)
        head = _head(scene, env, settings) | {"recording": request | {"episodes": episodes}}
    finally:
        env.close()
        _own_env.cache_clear()
    _finish(out, head, episodes)


def _finish(out: Path, head: dict[str, Any], episodes: int) -> None:
    """Tables from the parts; dataset.json, which makes the folder a dataset, comes last."""
    for table, schema in TABLES.items():
        _concatenate([_part(out / "parts", table, e) for e in range(episodes)], out / f"{table}.parquet", schema)
    content = json.dumps(head, indent=1).encode()
    write_atomically(out / CHECKSUMS, json.dumps(_checksums(out, content), indent=1).encode())
    write_atomically(out / "README.md", card(head, TABLES, _sizes(out)).encode())
    write_atomically(out / HEAD, content)
    _tidy(out)


def _tidy(out: Path) -> None:
    """Remove what only an unfinished recording needs, and what killed ones left."""
    if (out / REQUEST).exists():
        shutil.rmtree(out / "parts", ignore_errors=True)
    for name in (*FILES, REQUEST):
        for leftover in out.glob(f"{name}.*.tmp"):
            leftover.unlink()
    (out / REQUEST).unlink(missing_ok=True)


def unfinished(out: Path) -> int | None:
    """How many whole episodes an unfinished recording holds; None where there is none."""
    if not (out / REQUEST).exists():
        return None
    return len(list((out / "parts").glob(f"{list(TABLES)[-1]}-*.parquet")))


def _refuse_to_replace(out: Path, overwrite: bool) -> None:
    """Raise unless the folder is free, or holds what may be overwritten; nobody else's files ever are."""
    begun, head = _stored(out / REQUEST), _stored(out / HEAD)
    if head is not None and not overwrite:
        raise FileExistsError(f"{out} holds a dataset already; give --overwrite to replace it")
    if begun is not None and not overwrite:
        raise FileExistsError(
            f"{out} holds an unfinished recording of {begun}; give --resume to go on with the same, "
            "--overwrite to replace it"
        )
    there = [name for name in (*FILES, "parts") if (out / name).exists()]
    if head is None and begun is None and there:
        raise FileExistsError(f"{out} holds files of another kind ({', '.join(there)}); choose another folder")


def _begin(out: Path, request: dict[str, Any], goes_on: bool) -> None:
    """Make the folder an unfinished recording.

    Killed between any two of these lines, it can still be gone on with or overwritten: recording.json comes before
    parts and goes after them, and of a dataset that is overwritten dataset.json goes first.
    """
    out.mkdir(parents=True, exist_ok=True)
    if not goes_on:
        shutil.rmtree(out / "parts", ignore_errors=True)
    write_atomically(out / REQUEST, json.dumps(request).encode())
    (out / "parts").mkdir(exist_ok=True)
    for name in FILES:
        (out / name).unlink(missing_ok=True)


def _stored(file: Path) -> dict[str, Any] | None:
    """What a JSON file holds: None where it is missing, nothing where it is not an object."""
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return None
    except ValueError:
        return {}
    return content if isinstance(content, dict) else {}


def _part(parts: Path, table: str, episode: int) -> Path:
    return parts / f"{table}-{episode:05d}.parquet"


@dataclass(frozen=True)
class RecordOne:
    """Writes the part files of the episode of a number; can be sent to a worker."""

    scene: str
    settings: Settings
    parts: Path

    def __call__(self, episode: int) -> Done:
        _write_episode(_own_env(self.scene, self.settings), episode, self.settings, self.parts)
        return Done(None)


def _record_parts(record_one: RecordOne, episodes: int, executor: Executor, progress: Progress) -> None:
    """Part files of every episode that has none yet. Raises what an episode raised, or that its worker died."""
    todo = [e for e in range(episodes) if not all(_part(record_one.parts, table, e).exists() for table in TABLES)]
    done = episodes - len(todo)
    progress(done, episodes)
    for count, (_, outcome) in enumerate(executor(todo, record_one), done + 1):
        if isinstance(outcome, Failure):
            raise outcome.error
        progress(count, episodes)


@lru_cache(maxsize=1)
def _own_env(scene: str, settings: Settings) -> Any:
    from .run_scene import make_env

    return make_env(scene, settings)


def _write_episode(env: Any, episode: int, settings: Settings, parts: Path) -> None:
    tables: Rows = {table: [] for table in TABLES}
    for step, rows in enumerate(frames(env, episode, settings)):
        where = {"frame": FRAMES_PER_EPISODE_NUMBER * episode + step, "episode": episode}
        for table in TABLES:
            tables[table] += [where | row for row in rows[table]]
    for table, schema in TABLES.items():
        with replacing(_part(parts, table, episode)) as temporary:
            pq.write_table(pa.Table.from_pylist(tables[table], schema=schema), temporary)


def _head(scene: str, env: Any, settings: Settings) -> dict[str, Any]:
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
        "min_pixels": env.min_pixels,
        "source": f"covis record {scene}, preset {scene_preset(scene, settings)}, seed {settings.seed}, "
        f"{settings.perception} perception",
        "licence": "CC0",
    }


def _sizes(out: Path) -> dict[str, tuple[int, int]]:
    """Rows and bytes of each table."""
    files = {table: out / f"{table}.parquet" for table in TABLES}
    return {table: (pq.read_metadata(file).num_rows, file.stat().st_size) for table, file in files.items()}


def _concatenate(parts: Sequence[Path], file: Path, schema: pa.Schema) -> None:
    """One row group an episode; each page has a checksum of its own, so that readers notice damage by themselves."""
    with replacing(file) as temporary, pq.ParquetWriter(temporary, schema, write_page_checksum=True) as writer:
        for part in parts:
            writer.write_table(pq.read_table(part, schema=schema))


def _checksums(out: Path, head: bytes) -> dict[str, str]:
    sums = {f"{table}.parquet": sha256(out / f"{table}.parquet") for table in TABLES}
    return sums | {HEAD: hashlib.sha256(head).hexdigest()}


def sha256(file: Path) -> str:
    with file.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()
