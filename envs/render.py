"""Pictures for people: a map seen from above, and what every camera sees."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from .scoring import StepScore
from .worlds.world import Array, Snapshot

if TYPE_CHECKING:
    from .collaborative import CollaborativeEnv

Image = NDArray[np.uint8]
Color = tuple[int, int, int]

ROBOT_COLORS: tuple[Color, ...] = (
    (0, 114, 178),
    (213, 94, 0),
    (0, 158, 115),
    (204, 121, 167),
    (86, 180, 233),
    (230, 159, 0),
    (120, 94, 240),
    (60, 60, 60),
)
"""One per robot, distinguishable with colour-blind eyes (after Okabe and Ito)."""
RIGHT: Color = (30, 190, 80)
WRONG: Color = (225, 45, 45)
INK: Color = (45, 48, 56)
FAINT: Color = (200, 204, 210)
PAPER: Color = (250, 250, 247)
FONT = cv2.FONT_HERSHEY_SIMPLEX
GAP = 6


def robot_color(i: int) -> Color:
    return ROBOT_COLORS[i % len(ROBOT_COLORS)]


def text(picture: Image, words: str, at: tuple[int, int], size: float = 0.42, color: Color = INK) -> None:
    cv2.putText(picture, words, at, FONT, size, color, 1, cv2.LINE_AA)


def label(picture: Image, words: str, at: tuple[int, int], color: Color) -> None:
    """White words on a plate of `color`; `at` is the plate's upper left corner."""
    (width, height), base = cv2.getTextSize(words, FONT, 0.4, 1)
    u, v = at
    cv2.rectangle(picture, (u, v), (u + width + 8, v + height + base + 4), color, -1)
    cv2.putText(picture, words, (u + 4, v + height + 3), FONT, 0.4, (255, 255, 255), 1, cv2.LINE_AA)


def compose(env: CollaborativeEnv) -> Image:
    """Every camera on the left, two in a row, the map on the right."""
    frames = env.camera_frames()
    columns = 1 if len(frames) <= 2 else 2
    cells = [_camera(frame.rgb, i) for i, frame in enumerate(frames)]
    while len(cells) % columns:
        cells.append(np.full_like(cells[0], PAPER))
    rows = [_beside(cells[k : k + columns]) for k in range(0, len(cells), columns)]
    cameras = _below(rows)
    plan = draw_map(env.snapshot(), env.world.horizontal_fov_rad, cameras.shape[0])
    return _beside([cameras, plan])


def _camera(rgb: Image, i: int) -> Image:
    picture = rgb.copy()
    label(picture, f"robot_{i}", (0, 0), robot_color(i))
    return picture


def draw_map(snapshot: Snapshot, fov: Array, size: int) -> Image:
    """The scene from above (size, size, 3): objects as oriented boxes, robots with their fields of view, a scale."""
    picture = np.full((size, size, 3), PAPER, dtype=np.uint8)
    cameras = snapshot.T_world_camera[:, :2, 3]
    points = np.concatenate([snapshot.positions[:, :2], cameras])
    centre = 0.5 * (points.min(axis=0) + points.max(axis=0))
    metres = max(float(np.ptp(points, axis=0).max()) * 1.15, 4.0)
    scale = size / metres

    def pixel(xy: Array) -> Array:
        return np.stack([(xy[..., 0] - centre[0]) * scale, (centre[1] - xy[..., 1]) * scale], axis=-1) + size / 2

    fields = picture.copy()
    for i, T in enumerate(snapshot.T_world_camera):
        cv2.fillPoly(fields, [_fixed(pixel(_field_of_view(T, float(fov[i]), metres)))], robot_color(i), cv2.LINE_AA, 4)
    cv2.addWeighted(fields, 0.16, picture, 0.84, 0, picture)
    own = {int(j): i for i, j in enumerate(snapshot.robot_object) if j >= 0}
    for j, (position, heading, extent) in enumerate(
        zip(snapshot.positions, snapshot.headings, snapshot.sizes, strict=True)
    ):
        outline = _fixed(pixel(_rectangle(position[:2], float(heading), extent)))
        color = robot_color(own[j]) if j in own else (120, 126, 136)
        cv2.fillPoly(picture, [outline], color, cv2.LINE_AA, 4)
    for i, camera in enumerate(cameras):
        u, v = pixel(camera)
        cv2.circle(picture, (round(u), round(v)), 4, robot_color(i), -1, cv2.LINE_AA)
        cv2.circle(picture, (round(u), round(v)), 4, (255, 255, 255), 1, cv2.LINE_AA)
    bar = _round_length(metres / 5)
    cv2.line(picture, (12, size - 12), (12 + round(bar * scale), size - 12), INK, 2)
    text(picture, f"{bar:g} m", (14, size - 18))
    text(picture, f"t = {snapshot.time:.1f} s", (size - 80, size - 12))
    return picture


def _field_of_view(T_world_camera: Array, fov: float, reach: float) -> Array:
    forward = T_world_camera[:2, 2]
    heading = np.arctan2(forward[1], forward[0]) + np.linspace(-fov / 2, fov / 2, 24)
    edge = T_world_camera[:2, 3] + reach * np.stack([np.cos(heading), np.sin(heading)], axis=1)
    return np.concatenate([T_world_camera[None, :2, 3], edge])


def _rectangle(position: Array, heading: float, extent: Array) -> Array:
    half = 0.5 * np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]]) * extent[:2]
    c, s = np.cos(heading), np.sin(heading)
    return position + half @ np.array([[c, s], [-s, c]])


def _fixed(points: Array) -> NDArray[np.int32]:
    """Pixels with four fractional bits, for smooth outlines."""
    return np.round(np.clip(points, -1e4, 1e4) * 16).astype(np.int32)


def _round_length(metres: float) -> float:
    power = 10.0 ** np.floor(np.log10(metres))
    return float(power * max(k for k in (1, 2, 5) if k * power <= metres))


def draw_correspondences(images: list[Image], claims: list[Any], result: StepScore, title: str) -> Image:
    """The paper's Fig. 6: two cameras side by side, boxes, right matches in green, wrong ones in dashed red.

    Args:
        images: RGB of the first two robots, (H, W, 3).
        claims: their claims, in the same order.
        result: the scores of these claims; the pair (0, 1) is drawn.
        title: words above the picture.
    """
    (pair,) = [p for p in result.pairs if (p.a, p.b) == (0, 1)]
    scale = 2
    panels = [cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_LINEAR) for image in images[:2]]
    offset = panels[0].shape[1] + GAP
    picture = _beside(panels)
    matched = [set(pair.assertions[:, side].tolist()) for side in (0, 1)]
    centres: list[Array] = []
    for side, claim in enumerate(claims[:2]):
        shift = np.array([side * offset, 0, side * offset, 0])
        boxes = claim.boxes * scale + shift
        centres.append(0.5 * (boxes[:, :2] + boxes[:, 2:]))
        for k in np.flatnonzero(claim.filled()):
            u0, v0, u1, v1 = np.round(boxes[k]).astype(int)
            cv2.rectangle(picture, (u0, v0), (u1, v1), robot_color(side) if k in matched[side] else FAINT, 2)
        label(picture, f"robot_{side}", (side * offset, 0), robot_color(side))
    for (k, j), hit in sorted(zip(pair.assertions.tolist(), pair.hits.tolist(), strict=True), key=lambda x: x[1]):
        start, end = centres[0][k], centres[1][j]
        if hit:
            cv2.line(picture, _point(start), _point(end), RIGHT, 2, cv2.LINE_AA)
        else:
            _dashed(picture, start, end, WRONG)
        for point in (start, end):
            cv2.circle(picture, _point(point), 4, RIGHT if hit else WRONG, -1, cv2.LINE_AA)
    counts = pair.counts
    caption = f"{title}: {counts.correct} right of {counts.retrieved} matched, {counts.common} objects detected by both"
    head = np.full((26, picture.shape[1], 3), PAPER, dtype=np.uint8)
    text(head, caption, (8, 18), 0.5)
    return np.concatenate([head, picture])


def _point(xy: Array) -> tuple[int, int]:
    return round(float(xy[0])), round(float(xy[1]))


def _dashed(picture: Image, start: Array, end: Array, color: Color) -> None:
    steps = max(int(np.linalg.norm(end - start) // 7), 1)
    for k in range(0, steps, 2):
        a = start + (end - start) * (k / steps)
        b = start + (end - start) * (min(k + 1, steps) / steps)
        cv2.line(picture, _point(a), _point(b), color, 2, cv2.LINE_AA)


def _beside(parts: list[Image]) -> Image:
    gap = np.full((parts[0].shape[0], GAP, 3), PAPER, dtype=np.uint8)
    return np.concatenate([x for part in parts for x in (part, gap)][:-1], axis=1)


def _below(parts: list[Image]) -> Image:
    gap = np.full((GAP, parts[0].shape[1], 3), PAPER, dtype=np.uint8)
    return np.concatenate([x for part in parts for x in (part, gap)][:-1], axis=0)


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
        self._surface.blit(self._pygame.surfarray.make_surface(picture.swapaxes(0, 1)), (0, 0))
        self._pygame.display.flip()
        self._pygame.event.pump()

    def close(self) -> None:
        self._pygame.display.quit()


def show(picture: Image, window: Window | None, title: str) -> Window:
    """Show the picture, in the window given or in a new one."""
    window = window or Window((picture.shape[1], picture.shape[0]), title)
    window.draw(picture)
    return window
