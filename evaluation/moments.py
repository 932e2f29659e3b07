"""Instants of a scene or of a dataset folder, with what matchers and fusion make of them: what `covis view` draws."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..fusion.gains import fuse
from ..fusion.groups import group_detections
from ..fusion.metrics import displacement_errors
from ..fusion.objects import FusedObjects
from ..fusion.team import GATE, fuse_team
from ..matching import Matching, ObjectGraph, RelativePose
from ..matching.metrics import Counts, count, is_correct
from ..matching.pose import Array, invert, transform
from .datasets import Dataset, DatasetError, Frame, Stored, View, load_dataset, optional_column, prior_between
from .matching_run import match_pair
from .methods import Method
from .pictures import jpeg
from .run_dataset import begin, of_views, pairs
from .sequence import PairTrackers
from .settings import Settings

Matchings = dict[tuple[int, int], Matching]
FRAMES_AT_ONCE = 50
"""Frames whose pictures are held in memory together."""


@dataclass(frozen=True, eq=False)
class Sighting:
    """What one robot saw at one instant, and the truth about it; what is not known is None.

    Attributes:
        robot: its name.
        graph: its detections, n.
        identity: (n,) int64, negative = not a true object.
        truth: (n, 3) m true world positions, NaN where there is none.
        boxes: (n, 4) [u0, v0, u1, v1] pixels.
        image: an encoded picture (PNG or JPEG). size: (width, height) pixels.
        pose: (4, 4) reported T_world_sensor with `pose_covariance` (6, 6). pose_truth: (4, 4).
    """

    robot: str
    graph: ObjectGraph
    identity: NDArray[np.int64]
    truth: Array | None
    boxes: Array | None
    image: bytes | None
    size: tuple[int, int] | None
    pose: Array | None
    pose_covariance: Array | None
    pose_truth: Array | None

    @property
    def place(self) -> Array | None:
        """Where to draw it: the true pose where it is known, else the reported one."""
        return self.pose if self.pose_truth is None else self.pose_truth


@dataclass(frozen=True, eq=False)
class Things:
    """True objects: identity (m,), class (m,) (-1 = unknown), positions (m, 3) m; sizes (m, 3) m and headings (m,)
    where they are known."""

    identity: NDArray[np.int64]
    kind: NDArray[np.int64]
    positions: Array
    sizes: Array | None = None
    headings: Array | None = None


@dataclass(frozen=True, eq=False)
class Result:
    """What one method made of an instant.

    Attributes:
        matchings: (i, j) -> Matching. hits: (i, j) -> (k,) bool, which matches are right.
        fused: objects in the sensor frame of the first robot that has a pose, or None.
        figures: name -> number; what cannot be said is left out.
    """

    matchings: Matchings
    hits: dict[tuple[int, int], NDArray[np.bool_]]
    fused: FusedObjects | None
    figures: dict[str, float]


@dataclass(frozen=True, eq=False)
class Moment:
    """One instant. `time` is s since the episode's begin or whatever the dataset counts from, or None."""

    frame: int
    episode: int
    time: float | None
    sightings: tuple[Sighting, ...]
    things: Things
    results: dict[str, Result]


@dataclass(frozen=True, eq=False)
class Source:
    """Instants to come: `classes` of the objects, the most frames there can be, and the instants, to be used once."""

    classes: tuple[str, ...]
    most_frames: int
    moments: Iterator[Moment]


def scene_source(scene: str, methods: Sequence[Method], settings: Settings) -> Source:
    """`settings.episodes` (default 1) episodes of a scene; frames are numbered as `covis record` does."""
    from .run_scene import make_env

    env = make_env(scene, settings)
    episodes = settings.episodes or 1
    return Source(env.classes, episodes * env.max_cycles, _scene_moments(env, episodes, methods, settings))


def _scene_moments(env: Any, episodes: int, methods: Sequence[Method], settings: Settings) -> Iterator[Moment]:
    from .recording import FRAMES_PER_EPISODE_NUMBER
    from .run_scene import play

    try:
        for episode in range(episodes):
            for step, frame in enumerate(play(env, episode, methods, settings)):
                sightings = _scene_sightings(env, frame.views)
                now = env.snapshot()
                things = Things(now.identity, now.object_class, now.positions, now.sizes, now.headings)
                results = {label: judge(sightings, found) for label, found in frame.matchings.items()}
                number = FRAMES_PER_EPISODE_NUMBER * episode + step
                yield Moment(number, episode, now.time, sightings, things, results)
    finally:
        env.close()


def _scene_sightings(env: Any, views: Sequence[Any]) -> tuple[Sighting, ...]:
    from .run_scene import identity

    truth = env.ground_truth()
    row = {int(name): k for k, name in enumerate(truth.identity)}
    out = []
    for i, (view, camera) in enumerate(zip(views, env.camera_frames(), strict=True)):
        names = identity(view, i, env)
        places = np.full((len(names), 3), np.nan)
        real = names >= 0
        places[real] = truth.positions[[row[int(name)] for name in names[real]]]
        out.append(
            Sighting(
                robot=f"robot_{i}",
                graph=view.detections.graph,
                identity=names,
                truth=places,
                boxes=view.detections.boxes,
                image=jpeg(camera.rgb),
                size=(env.width, env.height),
                pose=view.T_world_camera,
                pose_covariance=view.pose_covariance,
                pose_truth=truth.T_world_camera[i],
            )
        )
    return tuple(out)


def dataset_source(path: str, methods: Sequence[Method], settings: Settings) -> Source:
    """The first `settings.episodes` (default: all) episodes of a dataset folder.

    Raises:
        DatasetError: a folder that cannot be read, or one without any poses, which cannot be drawn in one world.
    """
    dataset = load_dataset(path, settings.seed)
    if not dataset.has_poses and not dataset.has_true_poses:
        raise DatasetError(f"{path}: no robot has a pose, so that they cannot be drawn in one world")
    episodes = list(dict.fromkeys(dataset.episode.tolist()))[: settings.episodes]
    chosen = np.flatnonzero(np.isin(dataset.episode, episodes))
    return Source(dataset.classes, len(chosen), _dataset_moments(dataset, chosen, methods, settings))


def _dataset_moments(
    dataset: Dataset, chosen: NDArray[np.int64], methods: Sequence[Method], settings: Settings
) -> Iterator[Moment]:
    trackers = PairTrackers() if settings.sequence else None
    for chunk in np.array_split(chosen, -(-len(chosen) // FRAMES_AT_ONCE)):
        pictures = _Pictures.read(dataset.path, dataset.frame_index[chunk].tolist())
        for i in chunk.tolist():
            frame = dataset.frame(i)
            begin(trackers, frame)
            sightings = tuple(pictures.sighting(frame.index, view) for view in frame.views)
            results = {m.label: judge(sightings, _match(dataset, frame, m, settings, trackers)) for m in methods}
            yield Moment(frame.index, frame.episode, frame.time, sightings, _things(sightings), results)


def _match(
    dataset: Dataset, frame: Frame, method: Method, settings: Settings, trackers: PairTrackers | None
) -> Matchings:
    found: Matchings = {}
    for _, source, target in pairs(frame):
        prior = prior_between(source, target) if settings.pose == "known" else None
        pair = frame.views.index(source), frame.views.index(target)
        found[pair], _ = match_pair(*of_views(dataset.name, frame, pair, method, prior, settings, trackers))
    return found


@dataclass(frozen=True, eq=False)
class _Pictures:
    """Columns that matching has no use for, of some frames: (frame, robot) -> values in stored order."""

    boxes: Stored
    images: Stored

    @classmethod
    def read(cls, folder: Path, frames: list[int]) -> _Pictures:
        return cls(
            optional_column(folder / "detections.parquet", "box", frames),
            optional_column(folder / "robots.parquet", "image", frames),
        )

    def sighting(self, frame: int, view: View) -> Sighting:
        stored = self.boxes.get((frame, view.robot), [])
        whole = 0 < len(stored) == len(view.identity)
        return Sighting(
            robot=view.robot,
            graph=view.graph,
            identity=view.identity,
            truth=view.truth,
            boxes=np.asarray(stored, dtype=np.float64)[view.order].reshape(-1, 4) if whole else None,
            image=self.images.get((frame, view.robot), [None])[0],
            size=view.graph.image_size,
            pose=view.pose,
            pose_covariance=view.pose_covariance,
            pose_truth=view.pose_truth,
        )


def _things(sightings: Sequence[Sighting]) -> Things:
    """The true objects that anybody detected."""
    found: dict[int, tuple[int, Array]] = {}
    for sighting in sightings:
        if sighting.truth is None:
            continue
        kinds = sighting.graph.attributes.argmax(axis=1) if len(sighting.graph) else []
        for name, kind, place in zip(sighting.identity.tolist(), kinds, sighting.truth, strict=True):
            if name >= 0 and np.isfinite(place).all():
                found.setdefault(name, (int(kind), place))
    names = sorted(found)
    return Things(
        np.array(names, dtype=np.int64),
        np.array([found[n][0] for n in names], dtype=np.int64),
        np.array([found[n][1] for n in names]).reshape(-1, 3),
    )


def judge(sightings: Sequence[Sighting], matchings: Matchings) -> Result:
    """Matchings with the truth beside them: which are right, what fusion gives, and the instant's figures."""
    hits = {
        (i, j): is_correct(matching, sightings[i].identity, sightings[j].identity)
        for (i, j), matching in matchings.items()
    }
    graphs = [s.graph for s in sightings]
    groups = group_detections([len(g) for g in graphs], matchings)
    poses = {
        (i, j): prior
        for i, j in combinations(range(len(sightings)), 2)
        if (prior := _relative(sightings[i], sightings[j])) is not None
    }
    first = next((i for i, s in enumerate(sightings) if s.pose is not None), None)
    fused = None if first is None else fuse(graphs, poses, groups, frame=first, gate=GATE)
    return Result(matchings, hits, fused, _figures(sightings, matchings, hits))


def _figures(
    sightings: Sequence[Sighting],
    matchings: Matchings,
    hits: Mapping[tuple[int, int], NDArray[np.bool_]],
) -> dict[str, float]:
    """Precision and recall over all pairs of robots; displacement errors over rightly matched detections."""
    out: dict[str, float] = {}
    counts = sum(
        (count(m, sightings[i].identity, sightings[j].identity) for (i, j), m in matchings.items()), start=Counts()
    )
    if counts.retrieved:
        out["precision"] = counts.precision
    if counts.common:
        out["recall"] = counts.recall
    team = fuse_team(
        [s.graph for s in sightings], [s.pose for s in sightings], [s.pose_covariance for s in sightings], matchings
    )
    single, merged = [], []
    for i, (sighting, own) in enumerate(zip(sightings, team, strict=True)):
        if own is None or sighting.truth is None or sighting.pose_truth is None:
            continue
        right = _rightly_matched(i, matchings, hits)
        right = right[np.isfinite(sighting.truth[right]).all(axis=1)]
        true = transform(invert(sighting.pose_truth), sighting.truth[right])
        single += displacement_errors(own.positions_single[right], true).tolist()
        merged += displacement_errors(own.positions[right], true).tolist()
    if single:
        out |= {"single": float(np.mean(single)), "fused": float(np.mean(merged))}
    return out


def _rightly_matched(
    robot: int, matchings: Matchings, hits: Mapping[tuple[int, int], NDArray[np.bool_]]
) -> NDArray[np.int64]:
    """This robot's detections that some match ties to the same object of a partner."""
    own = [m.pairs[hits[pair], pair.index(robot)] for pair, m in matchings.items() if robot in pair]
    return np.unique(np.concatenate([np.zeros(0, dtype=np.int64), *own]))


def _relative(source: Sighting, target: Sighting) -> RelativePose | None:
    if source.pose is None or target.pose is None:
        return None
    assert source.pose_covariance is not None
    assert target.pose_covariance is not None
    return RelativePose.between(source.pose, source.pose_covariance, target.pose, target.pose_covariance)
