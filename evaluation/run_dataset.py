"""Every method on every pair of views of a dataset folder."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import combinations

import numpy as np

from .datasets import Dataset, Frame, View, prior_between
from .matching_run import match_pair
from .methods import Method
from .records import Record
from .sequence import PairTrackers
from .settings import MIN_DETECTIONS, Settings


def run_episodes(
    dataset: Dataset, episodes: Sequence[int], methods: Sequence[Method], settings: Settings
) -> list[Record]:
    """Records of the given episodes, in order of time, pair and method."""
    records: list[Record] = []
    trackers = PairTrackers() if settings.sequence else None
    for i in np.flatnonzero(np.isin(dataset.episode, np.asarray(episodes))):
        frame = dataset.frame(int(i))
        if trackers is not None:
            trackers.begin(frame.episode, {view.robot: view.odometry for view in frame.views})
        for pair in pairs(frame, 0 if trackers is not None else settings.min_common):
            found = list(_match_all(dataset, pair, methods, settings, trackers))
            # A tracker sees every frame; which of them are scored is another matter.
            if n_common(pair[1], pair[2]) >= settings.min_common:
                records += found
    return records


def pairs(frame: Frame, min_common: int = 0) -> Iterator[tuple[Frame, View, View]]:
    """Unordered pairs of views with enough detections and at least `min_common` common objects."""
    for source, target in combinations(frame.views, 2):
        if min(len(source.graph), len(target.graph)) < MIN_DETECTIONS:
            continue
        if n_common(source, target) >= min_common:
            yield frame, source, target


def n_common(source: View, target: View) -> int:
    common = np.intersect1d(source.identity, target.identity)
    return int((common >= 0).sum())


def _match_all(
    dataset: Dataset,
    pair: tuple[Frame, View, View],
    methods: Sequence[Method],
    settings: Settings,
    trackers: PairTrackers | None,
) -> Iterator[Record]:
    frame, source, target = pair
    prior = prior_between(source, target) if settings.pose == "known" else None
    where = f"{dataset.name}, frame {frame.index}, {source.robot} and {target.robot}"
    number = frame.views.index(source) * len(frame.views) + frame.views.index(target)
    for method in methods:
        matching, elapsed = match_pair(
            method,
            source.graph,
            target.graph,
            (source.identity, target.identity),
            prior,
            (settings.seed, frame.index, number),
            where,
            None if trackers is None else trackers.of(method.label, source.robot, target.robot),
        )
        yield Record.of_matching(
            matching,
            source.identity,
            target.identity,
            elapsed,
            target=dataset.name,
            method=method.label,
            episode=frame.episode,
            frame=frame.index,
            source=source.robot,
            partner=target.robot,
        )
