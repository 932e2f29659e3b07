"""Work units and the local engine: a benchmark run is a list of units, each a chunk of episodes times all methods.

A unit's records depend on nothing but the unit, so that serial, parallel and resumed runs agree bit for bit. With an
output folder each finished unit becomes one Parquet shard by an atomic rename; a resumed run skips the shards it finds.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from functools import lru_cache
from multiprocessing import get_context
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from .dataset_pages import with_images
from .datasets import Dataset, load_dataset
from .methods import Method
from .pictures import Page, PictureBook
from .pictures import to_table as pictures_table
from .provenance import FILE as PROVENANCE
from .provenance import with_session
from .records import Record, from_table, to_table
from .run_dataset import run_episodes
from .settings import Settings

FRAMES_PER_UNIT = 100
EPISODES_PER_SCENE = 10
EPISODES_PER_UNIT = 2


@dataclass(frozen=True)
class Unit:
    """A chunk of episodes of one target. `kind` is `dataset` (target = folder) or `scene` (target = name)."""

    kind: str
    target: str
    episodes: tuple[int, ...]


def dataset_units(path: str, settings: Settings) -> list[Unit]:
    """Whole episodes, chunked to about FRAMES_PER_UNIT frames."""
    dataset = _dataset(path, settings.seed)
    chunk: list[int] = []
    size = 0
    units: list[Unit] = []
    episodes, frames = _episode_sizes(dataset)
    for episode, n in list(zip(episodes, frames, strict=True))[: settings.episodes]:
        chunk.append(episode)
        size += n
        if size >= FRAMES_PER_UNIT:
            units.append(Unit("dataset", path, tuple(chunk)))
            chunk, size = [], 0
    if chunk:
        units.append(Unit("dataset", path, tuple(chunk)))
    return units


def scene_units(scene: str, settings: Settings) -> list[Unit]:
    """Episodes 0, 1, ... of a scene, two a unit."""
    episodes = range(settings.episodes or EPISODES_PER_SCENE)
    return [
        Unit("scene", scene, tuple(episodes[k : k + EPISODES_PER_UNIT]))
        for k in range(0, len(episodes), EPISODES_PER_UNIT)
    ]


@dataclass(frozen=True)
class UnitResult:
    """What a unit leaves behind: its records, and some frames for the report (none unless asked for)."""

    records: list[Record]
    pages: list[Page]


def run_unit(unit: Unit, methods: Sequence[Method], settings: Settings, pictures: bool = False) -> UnitResult:
    """Records of a unit; with `pictures` also the frames that a report shows."""
    if unit.kind == "dataset":
        dataset = _dataset(unit.target, settings.seed)
        book = PictureBook(int(dataset.episode[0])) if pictures else None
        records = run_episodes(dataset, unit.episodes, methods, settings, book)
        return UnitResult(records, [] if book is None else with_images(dataset, book.pages()))
    # Imported here: matching on dataset folders runs without the simulators.
    from . import run_scene

    book = PictureBook(0) if pictures else None
    records = run_scene.run_episodes(unit.target, unit.episodes, methods, settings, book)
    return UnitResult(records, [] if book is None else book.pages())


def run(
    units: Sequence[Unit],
    methods: Sequence[Method],
    settings: Settings,
    *,
    workers: int = 1,
    out: Path | None = None,
    resume: bool = False,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> list[Record]:
    """All records, in the order of the units.

    Args:
        units: the work.
        workers: processes; 1 runs here.
        out: folder for shards and run.json; None keeps everything in memory.
        resume: skip units whose shard is there.
        progress: called with (units done, units in all).

    Raises:
        FileExistsError: `out` holds another run, or holds this one and `resume` is off.
        ValueError: fewer than one worker.
    """
    if workers < 1:
        raise ValueError(f"workers must be at least 1, got {workers}")
    shards = None if out is None else Shards.open(out, units, methods, settings, resume)
    results: dict[int, list[Record]] = {} if shards is None else shards.finished()
    progress(len(results), len(units))
    todo = [i for i in range(len(units)) if i not in results]
    for number, result in _execute(todo, units, methods, settings, workers, pictures=shards is not None):
        if shards is not None:
            shards.write(number, result)
        results[number] = result.records
        progress(len(results), len(units))
    return [record for number in sorted(results) for record in results[number]]


def _execute(
    todo: Sequence[int],
    units: Sequence[Unit],
    methods: Sequence[Method],
    settings: Settings,
    workers: int,
    pictures: bool,
) -> Iterator[tuple[int, UnitResult]]:
    if workers == 1:
        for i in todo:
            yield i, run_unit(units[i], methods, settings, pictures)
        return
    # Spawned, not forked: Numba's and pybullet's state does not survive a fork.
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        futures = {pool.submit(run_unit, units[i], methods, settings, pictures): i for i in todo}
        try:
            for future in as_completed(futures):
                yield futures[future], future.result()
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


@dataclass(frozen=True)
class Shards:
    """The output folder of one run."""

    folder: Path
    n: int

    @classmethod
    def open(
        cls, out: Path, units: Sequence[Unit], methods: Sequence[Method], settings: Settings, resume: bool
    ) -> Shards:
        config = {
            "units": [asdict(u) for u in units],
            "methods": [m.label for m in methods],
            "settings": asdict(settings),
        }
        folder = out / "records"
        file = out / "run.json"
        if file.exists():
            if json.loads(file.read_text()) != json.loads(json.dumps(config)):
                raise FileExistsError(
                    f"{out} holds a run with other targets, methods or settings; choose another --out"
                )
            if not resume:
                raise FileExistsError(f"{out} holds this run already; give --resume to go on with it")
        folder.mkdir(parents=True, exist_ok=True)
        (out / "pictures").mkdir(exist_ok=True)
        sessions = out / PROVENANCE
        earlier = sessions.read_text() if file.exists() and sessions.exists() else None
        write_atomically(sessions, with_session(earlier, settings))
        write_atomically(file, json.dumps(config, indent=1).encode())
        return cls(folder, len(units))

    def finished(self) -> dict[int, list[Record]]:
        return {i: from_table(pq.read_table(self._file(i))) for i in range(self.n) if self._file(i).exists()}

    def write(self, number: int, result: UnitResult) -> None:
        """The records last: a unit whose records are there is finished."""
        _write_table(pictures_table(result.pages), self.folder.parent / "pictures" / self._file(number).name)
        _write_table(to_table(result.records), self._file(number))

    def _file(self, number: int) -> Path:
        return self.folder / f"unit-{number:05d}.parquet"


def _write_table(table: pa.Table, file: Path) -> None:
    temporary = file.with_suffix(f".{os.getpid()}.tmp")
    pq.write_table(table, temporary)
    os.replace(temporary, file)


def write_atomically(file: Path, content: bytes) -> None:
    temporary = file.with_name(f"{file.name}.{os.getpid()}.tmp")
    temporary.write_bytes(content)
    os.replace(temporary, file)


def _episode_sizes(dataset: Dataset) -> tuple[list[int], list[int]]:
    sizes: dict[int, int] = {}
    for episode in dataset.episode.tolist():
        sizes[episode] = sizes.get(episode, 0) + 1
    return list(sizes), list(sizes.values())


@lru_cache(maxsize=4)
def _dataset(path: str, seed: int) -> Dataset:
    return load_dataset(path, seed)


def target_name(unit: Unit, settings: Settings) -> str:
    """The name rows carry: a dataset's own, a scene's."""
    return _dataset(unit.target, settings.seed).name if unit.kind == "dataset" else unit.target
