"""The scene from above: what stands there, who sees what, and where the robots believe the objects to be."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ..matching.pose import transform
from .camera.raster import Look, Rasterizer
from .colors import FAINT, INK, PLATE, WRONG, Color, class_color, identity_colors, robot_color
from .instant import Answered
from .paint import Array, Image, blend, cross, disc, polygon, polyline, round_length, rounded, text, text_width
from .worlds.world import Light, Mesh, Snapshot

FROM_ABOVE = Look(clouds=0.0, haze_m=1e9, samples=2)
LAMP = Light(sun_direction=(-0.45, 0.5, 0.74), ambient=0.62)
HEIGHTS = 5.0
"""Camera height over the map, in map widths: far enough for walls and trees to stand nearly upright."""
NEARBY_M = 25.0


@dataclass(frozen=True)
class Area:
    """A square of the ground on a picture: metres of its centre and side, pixels of the picture's side."""

    centre: tuple[float, float]
    metres: float
    size: int

    @property
    def scale(self) -> float:
        """Pixels per metre."""
        return self.size / self.metres

    def pixels(self, points: Array) -> Array:
        """Pixels (..., 2) of points (..., 2 or 3) in the world, seen from straight above."""
        x, y = points[..., 0] - self.centre[0], self.centre[1] - points[..., 1]
        return np.stack([x, y], axis=-1) * self.scale + self.size / 2

    def grid(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """World x (1, size) and y (size, 1) of the pixels' centres."""
        along = (np.arange(self.size, dtype=np.float32) + 0.5) / self.scale - self.metres / 2
        return (self.centre[0] + along)[None, :], (self.centre[1] - along)[:, None]


def area_of(snapshot: Snapshot, seen: NDArray[np.bool_], trail: Array, size: int) -> Area:
    """A square around the robots, their trails (t, N, 2) and the objects they see (m,) or that are near them.

    Its side is one of a series of steps, so that it seldom changes from one picture to the next.
    """
    robots = snapshot.T_world_camera[:, :2, 3]
    distance = np.linalg.norm(snapshot.positions[:, None, :2] - robots, axis=2).min(axis=1)
    objects = snapshot.positions[seen | (distance < NEARBY_M), :2]
    points = np.concatenate([robots, trail.reshape(-1, 2), objects])
    low, high = points.min(axis=0), points.max(axis=0)
    side = max(float((high - low).max()) * 1.12, 3.0)
    step = 1.12
    metres = step ** np.ceil(np.log(side) / np.log(step))
    x, y = 0.5 * (low + high)
    return Area((float(x), float(y)), float(metres), size)


class MapPainter:
    """Draws maps of one world; keeps the rasteriser's memory from picture to picture."""

    def __init__(self, meshes: Sequence[Mesh], size: int) -> None:
        self.size = size
        self._rasterizer = Rasterizer(meshes, size, size, look=FROM_ABOVE)

    def ground(self, snapshot: Snapshot, area: Area) -> Image:
        """The scene itself (size, size, 3), seen from high above."""
        height = HEIGHTS * area.metres
        T = np.eye(4)
        T[:3, :3] = [[1, 0, 0], [0, -1, 0], [0, 0, -1]]
        T[:3, 3] = *area.centre, height
        focal = HEIGHTS * self.size
        K = np.array([[focal, 0, self.size / 2], [0, focal, self.size / 2], [0, 0, 1.0]])
        light = Light(LAMP.sun_direction, LAMP.ambient, ground_color=snapshot.light.ground_color)
        frame = self._rasterizer.render_bodies(
            snapshot.body_mesh,
            snapshot.body_poses,
            snapshot.body_tints,
            snapshot.body_object,
            light,
            T,
            K,
        )
        return frame.rgb

    def draw(
        self,
        snapshot: Snapshot,
        fov: Array,
        classes: Sequence[str],
        area: Area,
        trail: Array,
        answered: Answered | None = None,
    ) -> Image:
        """The map (size, size, 3): scene, fields of view, trails (t, N, 2), objects, estimates, scale."""
        picture = self.ground(snapshot, area)
        _quieten(picture)
        for i, T in enumerate(snapshot.T_world_camera):
            field, rim = field_of_view(T, float(fov[i]), area)
            blend(picture, field, robot_color(i), 0.34)
            blend(picture, rim, robot_color(i), 0.85)
        for i in range(len(snapshot.T_world_camera)):
            if len(trail) > 1:
                polyline(picture, area.pixels(trail[:, i]), robot_color(i), 2)
        _objects(picture, snapshot, area)
        if answered is not None:
            _estimates(picture, answered, area)
        for i, T in enumerate(snapshot.T_world_camera):
            _observer(picture, T, i, area)
        _scale(picture, area)
        _legend(picture, snapshot, classes)
        return picture


def field_of_view(T_world_camera: Array, fov: float, area: Area) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """How strongly a camera's field of view, and its rim, show in each pixel of the map (size, size), in [0, 1].

    Level cameras see a sector that fades with distance; cameras that look down see their image's outline on the ground.
    """
    x, y = area.grid()
    origin = T_world_camera[:3, 3].astype(np.float32)
    offset = (x - origin[0], y - origin[1], -origin[2])
    right, down, forward = (
        sum((a * np.float32(b) for a, b in zip(offset, T_world_camera[:3, k], strict=True)), np.float32(0))
        for k in range(3)
    )
    slope = np.float32(np.tan(fov / 2))
    pixel = np.float32(1 / area.scale)
    inside = (slope * forward - np.abs(right)) / np.sqrt(1 + slope**2)  # metres from the side planes
    if T_world_camera[2, 2] < -0.5:
        inside = np.minimum(inside, slope * 0.75 * forward - np.abs(down))
        fade = np.float32(0.55)
    else:
        reach = np.float32(0.75 * area.metres)
        fade = np.clip(1 - np.hypot(offset[0], offset[1]) / reach, 0, 1)
    field = np.clip(inside / pixel + 0.5, 0, 1) * fade
    rim = np.clip(1.1 - np.abs(inside) / pixel, 0, 1) * (forward > 0) * fade**0.7
    return np.asarray(field, np.float32), np.asarray(rim, np.float32)


def _quieten(picture: Image) -> None:
    """The scene is the background here: less colour, less light."""
    grey = cv2.cvtColor(cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY), cv2.COLOR_GRAY2RGB)
    cv2.addWeighted(picture, 0.56, grey, 0.2, 0, dst=picture)


def _objects(picture: Image, snapshot: Snapshot, area: Area) -> None:
    own = set(snapshot.robot_object.tolist())
    for j, (position, heading, extent) in enumerate(
        zip(snapshot.positions, snapshot.headings, snapshot.sizes, strict=True)
    ):
        if j in own:
            continue
        color = class_color(int(snapshot.object_class[j]))
        outline = area.pixels(_rectangle(position[:2], float(heading), extent))
        polyline(picture, outline, color, 1, closed=True)
        speed = float(np.linalg.norm(snapshot.velocities[j, :2]))
        if speed > 0.05:
            nose = position[:2] + 0.5 * extent[0] * np.array([np.cos(heading), np.sin(heading)])
            polyline(picture, area.pixels(np.stack([nose, nose + 0.8 * snapshot.velocities[j, :2]])), color, 1)


def _estimates(picture: Image, answered: Answered, area: Area) -> None:
    """Fused estimates of what was matched right, 1-sigma circles, a line to the truth; crosses for what was not."""
    truth, score = answered.instant.truth, answered.score
    colors = identity_colors(matched_identities(answered))
    wrong: set[tuple[int, int]] = set()
    for pair in score.pairs:
        for (k, j), hit in zip(pair.assertions.tolist(), pair.hits.tolist(), strict=True):
            if not hit:
                wrong |= {(pair.a, k), (pair.b, j)}
    for i, claims in enumerate(answered.claims):
        estimates = transform(truth.T_world_camera[i], claims.positions)
        pixels = area.pixels(estimates)
        for k in np.flatnonzero(claims.filled()):
            if np.isfinite(score.error_fused[i, k]):
                j = int(score.tied[i, k])
                color = colors[int(truth.identity[j])]
                polyline(picture, np.stack([area.pixels(truth.positions[j]), pixels[k]]), color, 1)
                spread = float(np.sqrt(claims.position_variance[k])) * area.scale
                _soft_disc(picture, pixels[k], min(spread, area.size / 4), color)
                disc(picture, pixels[k], 3.2, color)
            elif (i, int(k)) in wrong:
                cross(picture, pixels[k], WRONG)
            else:
                disc(picture, pixels[k], 1.6, FAINT)


def matched_identities(answered: Answered) -> list[int]:
    """Identities of the objects that are in some right match."""
    score, identity = answered.score, answered.instant.truth.identity
    return [int(identity[score.tied[p.a, k]]) for p in score.pairs for k in p.assertions[p.hits][:, 0]]


def _soft_disc(picture: Image, centre: Array, radius: float, color: Color) -> None:
    u, v = (round(float(x)) for x in centre)
    r = int(radius) + 2
    window = picture[max(v - r, 0) : v + r, max(u - r, 0) : u + r]
    if not window.size:
        return
    rows = np.arange(max(v - r, 0), max(v - r, 0) + window.shape[0])[:, None] + 0.5 - centre[1]
    columns = np.arange(max(u - r, 0), max(u - r, 0) + window.shape[1])[None, :] + 0.5 - centre[0]
    inside = np.clip(radius - np.hypot(rows, columns) + 0.5, 0, 1)
    rim = np.clip(1.2 - np.abs(radius - np.hypot(rows, columns)), 0, 1)
    blend(window, np.maximum(0.2 * inside, 0.8 * rim), color)


def _observer(picture: Image, T_world_camera: Array, i: int, area: Area) -> None:
    """An arrowhead where the camera is, pointing where it looks; its robot's number beside."""
    centre = area.pixels(T_world_camera[:3, 3])
    forward, up = T_world_camera[:2, 2], -T_world_camera[:2, 1]
    ahead = forward if np.linalg.norm(forward) > 0.05 else up
    ahead = ahead / np.linalg.norm(ahead) * np.array([1, -1])
    side = np.array([-ahead[1], ahead[0]])
    arrow = centre + 11 * np.array(
        [ahead * 1.15, -0.75 * ahead + 0.8 * side, -0.35 * ahead, -0.75 * ahead - 0.8 * side]
    )
    polygon(picture, arrow, robot_color(i))
    polyline(picture, arrow, (255, 255, 255), 1, closed=True)
    at = centre - 22 * ahead
    disc(picture, at, 8.5, robot_color(i))
    words = str(i)
    text(picture, words, (at[0] - text_width(words, 12, True) / 2 - 0.5, at[1] + 4), 12, (16, 18, 22), True)


def _scale(picture: Image, area: Area) -> None:
    bar = round_length(area.metres / 5)
    u, v = 16, area.size - 16
    width = round(bar * area.scale)
    rounded(picture, (u - 8, v - 24, u + max(width, 40) + 8, v + 8), PLATE, 6)
    text(picture, f"{bar:g} m", (u, v - 7), 13)
    polyline(picture, np.array([[u, v], [u + width, v]], dtype=np.float64), INK, 2)


def _legend(picture: Image, snapshot: Snapshot, classes: Sequence[str]) -> None:
    """Names of the classes present, in their colours, at the lower right."""
    own = set(snapshot.robot_object.tolist())
    present = sorted({int(c) for j, c in enumerate(snapshot.object_class) if j not in own})
    widths = [text_width(classes[c].replace("_", " "), 13) + 26 for c in present]
    size = picture.shape[0]
    u = size - sum(widths) - 12
    if not present or u < size // 3:
        return
    rounded(picture, (u - 4, size - 34, size - 8, size - 8), PLATE, 6)
    for c, width in zip(present, widths, strict=True):
        polyline(
            picture,
            np.array([[u + 4, -26], [u + 13, -26], [u + 13, -17], [u + 4, -17.0]]) + [0, size],
            class_color(c),
            2,
            True,
        )
        text(picture, classes[c].replace("_", " "), (u + 19, size - 16), 13)
        u += width


def _rectangle(position: Array, heading: float, extent: Array) -> Array:
    half = 0.5 * np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]]) * extent[:2]
    c, s = np.cos(heading), np.sin(heading)
    return position + half @ np.array([[c, s], [-s, c]])
