"""What a run consists of: experiments, cut into units that need nothing else to be run anywhere."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Literal

from . import synthetic
from .dataset_pages import with_images
from .datasets import Dataset, load_dataset
from .methods import Method
from .pictures import Page, PictureBook
from .records import Record
from .run_dataset import run_episodes, run_frames
from .settings import Settings

Kind = Literal["dataset", "scene", "synthetic"]

FRAMES_PER_UNIT = 100
EPISODES_PER_SCENE = 10
EPISODES_PER_UNIT = 2
PAIRS = 200
"""Generated problems of an experiment, unless it says otherwise."""
PAIRS_PER_UNIT = 50


@dataclass(frozen=True)
class Experiment:
    """One target under one set of settings, with every method: what one group of rows is about.

    Attributes:
        id: unique in a run.
        kind: `dataset` (target = folder), `scene` (target = name) or `synthetic` (target = name of a problem).
        target: see `kind`.
        methods: texts of `--method`; all of them see the same frames.
        settings: options; their seed is replaced by each of `seeds`.
        seeds: one independent run each; rows pool over them.
    """

    id: str
    kind: Kind
    target: str
    methods: tuple[str, ...]
    settings: Settings
    seeds: tuple[int, ...]


@dataclass(frozen=True)
class Unit:
    """A chunk of an experiment's episodes under one of its seeds. Its records depend on nothing else."""

    experiment: Experiment
    seed: int
    episodes: tuple[int, ...]

    @property
    def settings(self) -> Settings:
        return replace(self.experiment.settings, seed=self.seed)

    def __str__(self) -> str:
        shown = ", ".join(map(str, self.episodes[:3])) + (", ..." if len(self.episodes) > 3 else "")
        return f"{self.experiment.id}, seed {self.seed}, episodes {shown}"


def units_of(experiments: Sequence[Experiment]) -> list[Unit]:
    """All units, in order of experiment, seed and episode.

    Raises:
        ValueError: two experiments of one id.
        DatasetError: a dataset folder that cannot be read.
    """
    ids = [experiment.id for experiment in experiments]
    if len(set(ids)) < len(ids):
        raise ValueError(f"experiments must have different ids, got {', '.join(ids)}")
    return [
        Unit(experiment, seed, episodes)
        for experiment in experiments
        for seed in experiment.seeds
        for episodes in _chunks(experiment)
    ]


@dataclass(frozen=True, eq=False)
class UnitResult:
    """What a unit leaves behind: its records, and some frames for the report (none unless asked for)."""

    records: list[Record]
    pages: list[Page]


def run_unit(unit: Unit, pictures: bool = False) -> UnitResult:
    """Records of a unit, in order of time, pair and method; with `pictures` also the frames that a report shows."""
    experiment = unit.experiment
    data = dataset(experiment.target, unit.seed) if experiment.kind == "dataset" else None
    book = PictureBook(0 if data is None else int(data.episode[0])) if pictures else None
    records = _matched(unit, book)
    pages = [] if book is None else book.pages()
    if data is not None:
        pages = with_images(data, pages)
    return UnitResult(
        [replace(r, experiment=experiment.id, seed=unit.seed) for r in records],
        [replace(page, seed=unit.seed) for page in pages],
    )


def _matched(unit: Unit, book: PictureBook | None) -> list[Record]:
    """Records of the unit's frames; `book` gets to see every frame."""
    experiment, settings = unit.experiment, unit.settings
    methods = [Method.parse(text) for text in experiment.methods]
    if experiment.kind == "dataset":
        return run_episodes(dataset(experiment.target, unit.seed), unit.episodes, methods, settings, book)
    if experiment.kind == "synthetic":
        frames = synthetic.frames(experiment.target, unit.seed, unit.episodes)
        return run_frames(target_name(experiment), frames, methods, settings, book)
    # Imported here: matching on dataset folders runs without the simulators.
    from . import run_scene

    return run_scene.run_episodes(experiment.target, unit.episodes, methods, settings, book)


def target_name(experiment: Experiment) -> str:
    """The name rows carry: a dataset's own, a scene's, `synthetic-...`."""
    if experiment.kind == "dataset":
        return dataset(experiment.target, experiment.seeds[0]).name
    return synthetic.PREFIX + experiment.target if experiment.kind == "synthetic" else experiment.target


def absolute(experiment: Experiment) -> Experiment:
    """The same, with the whole path of its dataset folder."""
    return (
        replace(experiment, target=str(Path(experiment.target).resolve()))
        if experiment.kind == "dataset"
        else experiment
    )


def _chunks(experiment: Experiment) -> list[tuple[int, ...]]:
    if experiment.kind == "dataset":
        return _by_frames(dataset(experiment.target, experiment.seeds[0]), experiment.settings.episodes)
    count, size = (PAIRS, PAIRS_PER_UNIT) if experiment.kind == "synthetic" else (EPISODES_PER_SCENE, EPISODES_PER_UNIT)
    episodes = range(experiment.settings.episodes or count)
    return [tuple(episodes[k : k + size]) for k in range(0, len(episodes), size)]


def _by_frames(data: Dataset, limit: int | None) -> list[tuple[int, ...]]:
    """The first `limit` episodes (None = all), whole, chunked to about FRAMES_PER_UNIT frames."""
    sizes: dict[int, int] = {}
    for episode in data.episode.tolist():
        sizes[episode] = sizes.get(episode, 0) + 1
    chunks: list[tuple[int, ...]] = []
    chunk: list[int] = []
    for episode in list(sizes)[:limit]:
        chunk.append(episode)
        if sum(sizes[e] for e in chunk) >= FRAMES_PER_UNIT:
            chunks.append(tuple(chunk))
            chunk = []
    return [*chunks, tuple(chunk)] if chunk else chunks


def dataset(path: str, seed: int) -> Dataset:
    """The dataset folder, read once as long as its files stay as they are."""
    files = [file.stat() for file in sorted(Path(path).glob("*")) if file.suffix in (".json", ".parquet")]
    return _read(path, seed, tuple((s.st_ino, s.st_mtime_ns, s.st_size) for s in files))


@lru_cache(maxsize=4)
def _read(path: str, seed: int, state: tuple[tuple[int, int, int], ...]) -> Dataset:
    return load_dataset(path, seed)
