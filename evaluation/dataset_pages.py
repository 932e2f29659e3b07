"""Frames of a dataset folder for the report: what its tables hold, images and boxes where there are any."""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ..matching.pose import Array, transform
from .dataset_errors import Matched, Team
from .datasets import Dataset, Frame, Stored, View, optional_column
from .pictures import Page, Result, Sight, recompressed, rounded


def page(name: str, frame: Frame, found: Sequence[Matched], teams: Mapping[str, Team]) -> Page:
    """A frame of the target called `name`, without images: all that was matched in it, and what fusion gave of it."""
    methods = dict.fromkeys(m.record.method for m in found)
    results = [
        _result(method, [m for m in found if m.record.method == method], _places(frame, teams.get(method)))
        for method in methods
    ]
    return Page(name, frame.episode, frame.index, "episode", None, [_sight(v) for v in frame.views], results)


def shared(frame: Frame) -> dict[int, Array]:
    """True places (3,) m of the objects that the first two robots both detected, where their true poses are known."""
    if len(frame.views) < 2:
        return {}
    a, b = frame.views[:2]
    if a.truth is None or a.pose_truth is None or b.pose_truth is None:
        return {}
    names, at, _ = np.intersect1d(a.identity, b.identity, return_indices=True)
    places = zip(names.tolist(), a.truth[at], strict=True)
    return {name: place for name, place in places if name >= 0 and np.isfinite(place).all()}


def _sight(view: View) -> Sight:
    pose = view.pose_truth
    truth: list[list[float] | None] = []
    if view.truth is not None:
        truth = [rounded(p) if np.isfinite(p).all() else None for p in view.truth]
    return Sight(
        robot=view.robot,
        image=None,
        pose=None if pose is None else rounded(pose.ravel()),
        boxes=[],
        places=rounded(_levelled(view) if pose is None else transform(pose, view.graph.positions)),
        identity=view.identity.tolist(),
        truth=truth,
    )


def _levelled(view: View) -> Array:
    """Positions (n, 3) m as seen from above by a robot that looks along +y; as they are where `up` is unknown."""
    up, forward = view.graph.up, view.graph.forward
    if up is None:
        return view.graph.positions
    up = up / np.linalg.norm(up)
    if forward is None or abs(up @ forward) > 0.99:
        # Any level direction: nothing says where the robot looks, or it looks straight down.
        forward = np.eye(3)[int(np.argmin(np.abs(up)))]
    ahead = forward - (forward @ up) * up
    ahead /= np.linalg.norm(ahead)
    return view.graph.positions @ np.stack([np.cross(ahead, up), ahead, up], axis=1)


def _result(method: str, found: Sequence[Matched], places: list[list[list[float]]]) -> Result:
    return Result(
        method=method,
        robots=[[m.a, m.b] for m in found for _ in m.matching.pairs],
        pairs=[match for m in found for match in m.matching.pairs.tolist()],
        scores=[score for m in found for score in m.record.scores],
        hits=[hit for m in found for hit in m.record.hits],
        common=sum(m.record.common for m in found),
        fused=places,
    )


def _places(frame: Frame, team: Team | None) -> list[list[list[float]]]:
    """Per view and detection the fused place in the world, by the true pose; nothing unless all views have one."""
    places = []
    for view, own in zip(frame.views, team or [None] * len(frame.views), strict=True):
        if own is None or view.pose_truth is None:
            return []
        places.append(rounded(transform(view.pose_truth, own.positions)))
    return places


def with_images(dataset: Dataset, pages: Sequence[Page]) -> list[Page]:
    """The pages, those of role `episode` apart, with images and boxes where the tables have both."""
    wanted = sorted({p.frame for p in pages if p.role != "episode"})
    images = optional_column(dataset.path / "robots.parquet", "image", wanted)
    boxes = optional_column(dataset.path / "detections.parquet", "box", wanted)
    if not images or not boxes:
        return list(pages)
    order = {
        (frame.index, view.robot): view.order
        for frame in (dataset.frame(int(i)) for i in np.flatnonzero(np.isin(dataset.frame_index, wanted)))
        for view in frame.views
    }
    return [page if page.role == "episode" else _illustrated(page, images, boxes, order) for page in pages]


def _illustrated(page: Page, images: Stored, boxes: Stored, order: dict[tuple[int, str], Any]) -> Page:
    """With images and boxes of its sights; as it is when one of them lacks either."""
    sights, size = [], None
    for sight in page.sights:
        at = page.frame, sight.robot
        if at not in images or len(boxes.get(at, ())) != len(sight.identity):
            return page
        png = images[at][0]
        # A PNG begins with its signature and the header's length and type, then its width and height.
        size = list(struct.unpack(">II", png[16:24]))
        own = [rounded(boxes[at][k]) for k in order[at]]
        sights.append(replace(sight, image=recompressed(png), boxes=own))
    return replace(page, sights=sights, image_size=size)
