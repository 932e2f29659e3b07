"""Displacement errors on the frames of a dataset, by the rules that score a live scene (docs/reference/scoring.md)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..fusion.groups import MAX_ROBOTS
from ..fusion.objects import OwnObjects
from ..fusion.team import fuse_team
from ..matching import Matching
from ..matching.metrics import is_correct
from ..matching.pose import Array, invert, transform
from .datasets import Frame, View
from .records import Record

Team = Sequence[OwnObjects | None]
"""What fusion gives each robot of a frame; None for one without a pose."""


@dataclass(frozen=True, eq=False)
class Matched:
    """Two views of a frame, by their numbers in it (a < b), matched by one method."""

    a: int
    b: int
    matching: Matching
    record: Record


def fused(frame: Frame, found: Sequence[Matched]) -> dict[str, Team]:
    """By method, what the matches of a whole frame give each robot with a pose; nothing where no truth is known."""
    views = frame.views
    known = any(view.pose is not None and np.isfinite(_true_positions(view)).any() for view in views)
    if len(views) > MAX_ROBOTS or not known:
        return {}
    graphs = [view.graph for view in views]
    poses, covariances = [view.pose for view in views], [view.pose_covariance for view in views]
    matchings: dict[str, dict[tuple[int, int], Matching]] = {}
    for m in found:
        matchings.setdefault(m.record.method, {})[m.a, m.b] = m.matching
    return {method: fuse_team(graphs, poses, covariances, pairs) for method, pairs in matchings.items()}


def with_errors(frame: Frame, found: Sequence[Matched], teams: Mapping[str, Team]) -> list[Matched]:
    """The same with their records' errors, over the detections that a method matched rightly and whose truth is known.

    A detection that several pairs match counts with the first alone.
    """
    true = [_true_positions(view) for view in frame.views]
    given: set[tuple[str, int, int]] = set()
    out = []
    for m in found:
        method = m.record.method
        team = teams.get(method, [None] * len(true))
        robots = [i for i in (m.a, m.b) if team[i] is not None and np.isfinite(true[i]).any()]
        slots = [slot for slot in _right(m, frame.views, robots, true) if (method, *slot) not in given]
        given |= {(method, *slot) for slot in slots}
        out.append(replace(m, record=_scored(m.record, slots, team, true)) if robots else m)
    return out


def _right(m: Matched, views: Sequence[View], robots: Sequence[int], true: Sequence[Array]) -> list[tuple[int, int]]:
    """Robot and detection of the right matches, of the given robots and where the truth is known."""
    hits = is_correct(m.matching, views[m.a].identity, views[m.b].identity)
    slots = [(i, int(k)) for match in m.matching.pairs[hits] for i, k in zip((m.a, m.b), match, strict=True)]
    return [(i, k) for i, k in slots if i in robots and np.isfinite(true[i][k]).all()]


def _scored(record: Record, slots: Sequence[tuple[int, int]], team: Team, true: Sequence[Array]) -> Record:
    single, merged, distance = [], [], []
    for i, k in slots:
        own, place = team[i], true[i]
        assert own is not None
        single.append(float(np.linalg.norm(own.positions_single[k] - place[k])))
        merged.append(float(np.linalg.norm(own.positions[k] - place[k])))
        distance.append(float(np.linalg.norm(place[k])))
    return replace(record, positions_scored=True, error_single_m=single, error_fused_m=merged, error_range_m=distance)


def _true_positions(view: View) -> Array:
    """(n, 3) m in the robot's sensor frame by its true pose, NaN where unknown."""
    if view.truth is None or view.pose_truth is None:
        return np.full((len(view.graph), 3), np.nan)
    return transform(invert(view.pose_truth), view.truth)
