"""Frames of a dataset folder for the report: what its tables hold, images and boxes where there are any."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ..matching.pose import Array, transform
from .datasets import Dataset, Frame, Stored, View, optional_column
from .pictures import Page, Result, Sight, recompressed, rounded
from .records import Record


def page(name: str, frame: Frame, found: Sequence[tuple[Record, np.ndarray]]) -> Page:
    """A frame of the target called `name`, without images.

    `found` holds every record of the frame with its matched pairs (k, 2).
    """
    numbers = {view.robot: i for i, view in enumerate(frame.views)}
    methods = dict.fromkeys(record.method for record, _ in found)
    results = [_result(method, [f for f in found if f[0].method == method], numbers) for method in methods]
    return Page(name, frame.episode, frame.index, "episode", None, [_sight(v) for v in frame.views], results)


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


def _result(method: str, found: Sequence[tuple[Record, np.ndarray]], numbers: dict[str, int]) -> Result:
    return Result(
        method=method,
        robots=[[numbers[r.source], numbers[r.partner]] for r, pairs in found for _ in pairs],
        pairs=[match for _, pairs in found for match in pairs.tolist()],
        scores=[score for r, _ in found for score in r.scores],
        hits=[hit for r, _ in found for hit in r.hits],
        common=sum(r.common for r, _ in found),
    )


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
