"""Pictures for people: what every camera sees, the scene from above, and two cameras with their matches."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from .claims import Claims
from .colors import CANVAS, FAINT, IDENTITY_COLORS, INK, RIGHT, WRONG, Color, identity_colors, robot_color
from .instant import Answered, Instant
from .map_view import MapPainter, area_of, matched_identities
from .paint import (
    GAP,
    Array,
    Image,
    below,
    beside,
    blank,
    blend,
    corners,
    cross,
    dashes,
    disc,
    plate,
    polyline,
    text,
    text_width,
)
from .scoring import StepScore
from .worlds.world import World

HEIGHT = 728
"""Pixels of the map's side and of the stacked cameras."""
HEAD = 44


class Watched(Protocol):
    """What a picture needs of an environment; see `CollaborativeEnv`."""

    name: str
    world: World
    classes: tuple[str, ...]

    def answered(self) -> Answered | None: ...

    def now(self) -> Instant: ...

    def trail(self) -> Array: ...


class ScenePainter:
    """Draws one environment; keeps memory from picture to picture."""

    def __init__(self, env: Watched) -> None:
        self._map = MapPainter(env.world.meshes, HEIGHT)

    def compose(self, env: Watched) -> Image:
        """Every camera on the left, the scene from above on the right, the figures of the last step over them.

        After a step with claims the picture shows the instant they are about, else the present one. Boxes in a vivid
        colour are objects matched right, one colour per object in all cameras and on the map; red ones are matched
        wrong, corners are detections left alone. On the map dots are fused estimates with their 1-sigma circle and a
        line to the truth.
        """
        answered = env.answered()
        if answered is not None and not any(claims.filled().any() for claims in answered.claims):
            answered = None
        instant = env.now() if answered is None else answered.instant
        trail = env.trail()[: None if answered is None else -1]
        cameras = _cameras(instant, answered)
        seen = np.any(instant.truth.visible(), axis=0)
        area = area_of(instant.snapshot, seen, trail, HEIGHT)
        fov = env.world.horizontal_fov_rad
        plan = self._map.draw(instant.snapshot, fov, env.classes, area, trail, answered)
        body = beside([cameras, plan])
        head = _head(env.name, instant.snapshot.time, answered, body.shape[1])
        return _framed(np.concatenate([head, body]))


def compose(env: Watched) -> Image:
    """The picture of `ScenePainter`, once."""
    return ScenePainter(env).compose(env)


def _framed(picture: Image) -> Image:
    return cv2.copyMakeBorder(picture, 0, GAP, GAP, GAP, cv2.BORDER_CONSTANT, value=CANVAS).astype(np.uint8)


def _head(name: str, time: float, answered: Answered | None, width: int) -> Image:
    """Scene and time on the left, figures of the claims on the right."""
    picture = blank(width, HEAD)
    u = 2 + text(picture, name, (2, 29), 21, INK, True)
    text(picture, f"t = {time:.1f} s", (u + 14, 29), 15, FAINT)
    if answered is None:
        return picture
    score = answered.score
    counts = score.counts
    parts = [("right", f"{counts.correct}", RIGHT), ("wrong", f"{counts.retrieved - counts.correct}", WRONG)]
    parts.append(("of", f"{score.n_visible} covisible", INK))
    single, fused = score.error_single, score.error_fused
    if np.isfinite(fused).any():
        parts.append(("alone", _length(float(np.nanmean(single))), INK))
        parts.append(("fused", _length(float(np.nanmean(fused))), INK))
    u = width - sum(text_width(words, 15) + text_width(value, 17, True) + 24 for words, value, _ in parts)
    for words, value, color in parts:
        u += text(picture, words, (u, 29), 15, FAINT) + 6
        u += text(picture, value, (u, 29), 17, color, True) + 18
    return picture


def _cameras(instant: Instant, answered: Answered | None) -> Image:
    """All cameras in one or two columns, together HEIGHT high."""
    n = len(instant.frames)
    columns = 1 if n <= 2 else 2
    rows = -(-n // columns)
    edges = np.round(np.arange(rows + 1) * (HEIGHT + GAP) / rows).astype(int)
    height, width = instant.frames[0].rgb.shape[:2]
    across = round((HEIGHT + GAP) / rows - GAP) * width // height
    cells = [
        _camera(instant, i, answered, (across, int(edges[i // columns + 1] - edges[i // columns]) - GAP))
        for i in range(n)
    ]
    while len(cells) % columns:
        cells.append(_key(cells[-1].shape[1], cells[-1].shape[0]))
    return below([beside(cells[k : k + columns]) for k in range(0, len(cells), columns)])


def _key(width: int, height: int) -> Image:
    """What the marks mean, where a camera's place is free."""
    picture = blank(width, height)
    example = IDENTITY_COLORS[1]
    step = min(34, height // 8)
    v = (height - 6 * step) // 2 + step // 2
    for words in (
        "matched right, one colour per object",
        "matched wrong",
        "detected, not matched",
        "fused estimate, 1 sigma, error",
        "estimate of a wrong match",
        "object, motion; colour of its class",
    ):
        centre = np.array([30.0, v])
        box = np.concatenate([centre - (11, 8), centre + (11, 8)])
        outline = box[[0, 1, 2, 1, 2, 3, 0, 3]].reshape(4, 2)
        if words.startswith("matched right"):
            polyline(picture, outline, example, 2, closed=True)
        elif words.startswith(("matched wrong", "detected")):
            corners(picture, box, *((INK, 1) if words.startswith("detected") else (WRONG, 2)))
        elif words.startswith("fused"):
            polyline(picture, centre + [[-13, 7], [3, -1]], example, 1)
            disc(picture, centre + (3, -1), 7, example, 1)
            disc(picture, centre + (3, -1), 3.2, example)
        elif words.startswith("estimate"):
            cross(picture, centre, WRONG)
        else:
            polyline(picture, outline - (4, 0), INK, 1, closed=True)
            polyline(picture, centre + [[7, 0], [17, 0]], INK, 1)
        text(picture, words, (58, v + 5), 14, FAINT)
        v += step
    return picture


def _camera(instant: Instant, i: int, answered: Answered | None, size: tuple[int, int]) -> Image:
    rgb = instant.frames[i].rgb
    scale = np.array(size) / rgb.shape[1::-1]
    method = cv2.INTER_CUBIC if scale[0] > 1 else cv2.INTER_AREA
    picture: Image = cv2.resize(rgb, size, interpolation=method).astype(np.uint8)
    if answered is not None:
        _claimed(picture, i, answered, scale)
    cv2.rectangle(picture, (0, 0), (size[0] - 1, size[1] - 1), robot_color(i), 2)
    plate(picture, f"robot_{i}", (8, 8), robot_color(i))
    return picture


def _claimed(picture: Image, i: int, answered: Answered, scale: Array) -> None:
    """Boxes of one robot's claims, and the outlines of the objects it matched right."""
    claims, tied = answered.claims[i], answered.score.tied[i]
    right, wrong = matched_slots(i, answered.score)
    instances = answered.instant.frames[i].instances
    size = picture.shape[1::-1]
    identity = answered.instant.truth.identity
    colors = identity_colors(matched_identities(answered))
    filled = np.flatnonzero(claims.filled())
    for k in filled:
        box = claims.boxes[k] * np.tile(scale, 2)
        if k in right:
            mask = cv2.resize((instances == tied[k]).astype(np.float32), size, interpolation=cv2.INTER_LINEAR)
            _tint(picture, cv2.GaussianBlur(mask, (0, 0), 0.7 * scale[0]), colors[int(identity[tied[k]])])
        else:
            corners(picture, box, WRONG if k in wrong else INK, 2 if k in wrong else 1)
    for k in filled:
        if k in right:
            u0, v0, u1, v1 = claims.boxes[k] * np.tile(scale, 2)
            outline = np.array([[u0, v0], [u1, v0], [u1, v1], [u0, v1]])
            polyline(picture, outline, colors[int(identity[tied[k]])], 2, closed=True)


def _tint(picture: Image, mask: NDArray[Any], color: Color) -> None:
    """A veil of colour over a soft mask (H, W), stronger along its outline."""
    rim = np.clip(1.6 - 4 * np.abs(mask - 0.5), 0, 1)
    blend(picture, np.clip(4 * mask - 1.5, 0, 1), color, 0.22)
    blend(picture, rim, color, 0.5)


def matched_slots(robot: int, score: StepScore) -> tuple[set[int], set[int]]:
    """Slots of one robot that are in some right match, and those that are only in wrong ones."""
    right: set[int] = set()
    wrong: set[int] = set()
    for pair in score.pairs:
        if robot in (pair.a, pair.b):
            slots = pair.assertions[:, 0 if robot == pair.a else 1]
            right |= set(slots[pair.hits].tolist())
            wrong |= set(slots[~pair.hits].tolist())
    return right, wrong - right


def draw_correspondences(images: Sequence[Image], claims: Sequence[Claims], result: StepScore, title: str) -> Image:
    """The paper's Fig. 6: two cameras side by side, boxes, right matches in green, wrong ones in dashed red.

    Args:
        images: RGB of the first two robots, (H, W, 3).
        claims: their claims, in the same order.
        result: the scores of these claims; the pair (0, 1) is drawn.
        title: words above the picture.
    """
    (pair,) = [p for p in result.pairs if (p.a, p.b) == (0, 1)]
    scale = 2
    panels = [cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC) for image in images[:2]]
    offset = panels[0].shape[1] + GAP
    picture = beside(panels)
    matched = [set(pair.assertions[:, side].tolist()) for side in (0, 1)]
    centres: list[Array] = []
    for side, claim in enumerate(claims[:2]):
        boxes = claim.boxes * scale + np.array([side * offset, 0, side * offset, 0])
        centres.append(0.5 * (boxes[:, :2] + boxes[:, 2:]))
        for k in np.flatnonzero(claim.filled()):
            if k in matched[side]:
                u0, v0, u1, v1 = boxes[k]
                outline = np.array([[u0, v0], [u1, v0], [u1, v1], [u0, v1]])
                polyline(picture, outline, robot_color(side), 2, closed=True)
            else:
                corners(picture, boxes[k], INK)
        plate(picture, f"robot_{side}", (side * offset + 8, 8), robot_color(side))
    for (k, j), hit in sorted(zip(pair.assertions.tolist(), pair.hits.tolist(), strict=True), key=lambda x: x[1]):
        start, end = centres[0][k], centres[1][j]
        if hit:
            polyline(picture, np.stack([start, end]), RIGHT, 2)
        else:
            dashes(picture, start, end, WRONG)
        for point in (start, end):
            disc(picture, point, 4, RIGHT if hit else WRONG)
    counts = pair.counts
    head = blank(picture.shape[1], 36)
    u = 2 + text(head, title, (2, 25), 18, INK, True)
    words = f"{counts.correct} right of {counts.retrieved} matched, {counts.common} objects detected by both"
    text(head, words, (u + 14, 25), 15, FAINT)
    return _framed(np.concatenate([head, picture]))


def _length(metres: float) -> str:
    return f"{1000 * metres:.0f} mm" if metres < 0.0995 else f"{metres:.2f} m"


class Window:
    """A pygame window that shows pictures."""

    def __init__(self, size: tuple[int, int], title: str) -> None:
        import os

        os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
        import pygame

        self._pygame = pygame
        pygame.display.init()
        pygame.display.set_caption(title)
        self._surface = pygame.display.set_mode(size)

    def draw(self, picture: Image) -> None:
        """Show the picture now."""
        self._surface.blit(self._pygame.surfarray.make_surface(picture.swapaxes(0, 1)), (0, 0))
        self._pygame.display.flip()
        self._pygame.event.pump()

    def close(self) -> None:
        """Close the window."""
        self._pygame.display.quit()


def show(picture: Image, window: Window | None, title: str) -> Window:
    """Show the picture, in the window given or in a new one."""
    window = window or Window((picture.shape[1], picture.shape[0]), title)
    window.draw(picture)
    return window
