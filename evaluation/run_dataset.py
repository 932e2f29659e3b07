"""Every method on every pair of views of given frames: of a dataset folder, or generated."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from functools import partial
from itertools import combinations
from typing import Any

import numpy as np

from ..matching import Matching, RelativePose
from ..matching.metrics import Counts, is_correct
from .dataset_errors import Matched, fused, with_errors
from .dataset_pages import page, shared
from .datasets import Dataset, DatasetError, Frame, View, prior_between, true_relative_pose
from .matching_run import PairTruth, attempt
from .methods import Method
from .pictures import PictureBook
from .records import Record
from .sequence import PairTrackers
from .settings import MIN_DETECTIONS, Settings


def run_episodes(
    dataset: Dataset,
    episodes: Sequence[int],
    methods: Sequence[Method],
    settings: Settings,
    book: PictureBook | None = None,
) -> list[Record]:
    """Records of the given episodes, in order of time, pair and method; `book` gets to see every frame."""
    chosen = np.flatnonzero(np.isin(dataset.episode, np.asarray(episodes)))
    return run_frames(dataset.name, (dataset.frame(int(i)) for i in chosen), methods, settings, book)


def run_frames(
    name: str,
    frames: Iterable[Frame],
    methods: Sequence[Method],
    settings: Settings,
    book: PictureBook | None = None,
) -> list[Record]:
    """Records of the frames of the target called `name`, in order of time, pair and method."""
    records: list[Record] = []
    trackers = PairTrackers() if settings.sequence else None
    for frame in frames:
        begin(trackers, frame)
        found, scored = [], []
        for pair in pairs(frame, 0 if trackers is not None else settings.min_common):
            matched = list(_match_all(name, pair, methods, settings, trackers))
            found += matched
            # A tracker sees every frame; which of them are scored is another matter.
            if n_common(pair[1], pair[2]) >= settings.min_common:
                scored += matched
        teams = fused(frame, found)
        scored = with_errors(frame, scored, teams)
        records += [m.record for m in scored]
        if book is not None and scored:
            counts: dict[str, Counts] = {}
            for m in scored:
                counts[m.record.method] = counts.get(m.record.method, Counts()) + m.record.counts
            book.see(frame.episode, counts, partial(page, name, frame, scored, teams), shared(frame))
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


def begin(trackers: PairTrackers | None, frame: Frame) -> None:
    """Carry the trackers, where there are any, on to a frame."""
    if trackers is not None:
        odometry = {view.robot: view.odometry for view in frame.views}
        trackers.begin(frame.episode, odometry, {view.robot: view.graph for view in frame.views})


def _place(name: str, frame: Frame, source: View, target: View) -> str:
    """Where in a run a pair of views is, for messages."""
    return f"{name}, frame {frame.index}, {source.robot} and {target.robot}"


def of_views(
    name: str,
    frame: Frame,
    pair: tuple[int, int],
    method: Method,
    prior: RelativePose | None,
    settings: Settings,
    trackers: PairTrackers | None,
) -> tuple[Any, ...]:
    """Arguments of `match_pair` and `attempt`: two views of a frame, by their numbers; `name` is the target's."""
    source, target = (frame.views[i] for i in pair)
    return (
        method,
        source.graph,
        target.graph,
        PairTruth((source.identity, target.identity), true_relative_pose(source, target)),
        prior,
        (settings.seed, frame.index, pair[0] * len(frame.views) + pair[1]),
        _place(name, frame, source, target),
        None if trackers is None else trackers.of(method.label, source.robot, target.robot),
        None if trackers is None else trackers.maps(source.robot, target.robot),
    )


def _match_all(
    name: str,
    pair: tuple[Frame, View, View],
    methods: Sequence[Method],
    settings: Settings,
    trackers: PairTrackers | None,
) -> Iterator[Matched]:
    """What each method makes of a pair of views."""
    frame, source, target = pair
    try:
        prior = prior_between(source, target) if settings.pose == "known" else None
    except DatasetError as error:
        raise DatasetError(f"{_place(name, frame, source, target)}: {error}") from error
    a, b = frame.views.index(source), frame.views.index(target)
    for method in methods:
        matching, elapsed, failure = attempt(*of_views(name, frame, (a, b), method, prior, settings, trackers))
        record = Record.of_matching(
            matching,
            source.identity,
            target.identity,
            elapsed,
            target=name,
            method=method.label,
            episode=frame.episode,
            frame=frame.index,
            source=source.robot,
            partner=target.robot,
            visible=_n_visible(source, target),
            failure=failure,
            **_common(source, target, matching),
        )
        yield Matched(a, b, matching, record)


def _common(source: View, target: View, matching: Matching) -> dict[str, list[Any]]:
    """Of the objects both detected: the larger of the two distances, and whether they were matched rightly."""
    shared, i, j = np.intersect1d(source.identity, target.identity, return_indices=True)
    real = shared >= 0
    distance = np.maximum(
        np.linalg.norm(source.graph.positions[i[real]], axis=1), np.linalg.norm(target.graph.positions[j[real]], axis=1)
    )
    right = matching.pairs[is_correct(matching, source.identity, target.identity), 0]
    found = np.isin(shared[real], source.identity[right])
    return {"common_range_m": distance.tolist(), "common_found": found.tolist()}


def _n_visible(source: View, target: View) -> int | None:
    """Objects that both images show, detected or not; None where the dataset does not say."""
    if source.visible is None or target.visible is None:
        return None
    return len(np.intersect1d(source.visible, target.visible))
