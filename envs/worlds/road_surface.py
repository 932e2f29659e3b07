"""The ground of a map as thin flat triangles: roadway, parking bays, pavements, lane markings and crossings."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..camera.shapes import Color, merge
from .driving_maps import RoadMap
from .kerbs import BAY_M, PAVEMENT_M, KerbRun, to_world
from .street_meshes import strip
from .world import Array, Mesh

ASPHALT: Color = (84, 86, 92)
BAY: Color = (100, 101, 104)
KERB: Color = (176, 174, 168)
PAVEMENT: Color = (158, 154, 146)
PAINT: Color = (226, 226, 220)
ASPHALT_Z, BAY_Z, PAVEMENT_Z, KERB_Z, PAINT_Z = 0.012, 0.008, 0.02, 0.03, 0.03
LINE_M, DASH_M, DASH_PERIOD_M = 0.16, 3.0, 9.0
NONE, STRIPED = 0, 1  # highway-env's LineType; the others are unbroken


def road_surface(roads: RoadMap, runs: list[KerbRun]) -> Mesh:
    """The whole ground of a map as one mesh in the world frame."""
    parts: list[Mesh] = []
    for lane in roads.network.lanes_list():
        s = _samples(lane, roads)
        if len(s) > 1:
            parts.append(_ribbon(lane, s, -lane.width_at(0) / 2, lane.width_at(0) / 2, ASPHALT_Z, ASPHALT))
            parts += _lines(lane, s)
    for run in runs:
        if run.roadside:
            parts += _roadside(run)
    for crossing in roads.crossings:
        parts += _zebra(to_world(crossing))
    return merge(*parts)


def _samples(lane: Any, roads: RoadMap) -> Array:
    """Stations (m) that draw the visible part of a lane: few where it is straight."""
    s = np.linspace(0.0, float(lane.length), max(int(min(lane.length, 4000.0) // 2.0), 2) + 1)
    points = np.array([lane.position(x, 0.0) for x in s])
    x0, y0, x1, y1 = roads.view
    seen = (points[:, 0] >= x0) & (points[:, 0] <= x1) & (points[:, 1] >= y0) & (points[:, 1] <= y1)
    s = s[seen]
    if len(s) > 2 and np.ptp([lane.heading_at(x) for x in s]) < 1e-6:
        return np.linspace(s[0], s[-1], max(int((s[-1] - s[0]) // 40.0), 1) + 1)
    return s


def _ribbon(lane: Any, s: Array, left: float, right: float, z: float, color: Color) -> Mesh:
    borders = [to_world(np.array([lane.position(x, lateral) for x in s])) for lateral in (left, right)]
    return strip(borders[0], borders[1], z, color)


def _lines(lane: Any, s: Array) -> list[Mesh]:
    parts = []
    kinds = lane.line_types or (NONE, NONE)
    for side, kind in zip((-1.0, 1.0), kinds, strict=True):
        lateral = side * (lane.width_at(0) / 2 - (0.0 if kind == STRIPED else LINE_M))
        pieces = (
            [s] if kind != STRIPED else [np.array([a, a + DASH_M]) for a in np.arange(s[0], s[-1] - 3, DASH_PERIOD_M)]
        )
        if kind != NONE:
            parts += [_ribbon(lane, p, lateral - LINE_M / 2, lateral + LINE_M / 2, PAINT_Z, PAINT) for p in pieces]
    return parts


def _roadside(run: KerbRun) -> list[Mesh]:
    keep = np.arange(len(run.points))
    if np.ptp(run.headings) < 1e-6:
        keep = keep[[0, -1]]
    rows = [
        (0.0, BAY_M, BAY_Z, BAY),
        (BAY_M, BAY_M + 0.3, KERB_Z, KERB),
        (BAY_M + 0.3, BAY_M + PAVEMENT_M, PAVEMENT_Z, PAVEMENT),
    ]
    return [strip(run.offset(near)[keep], run.offset(far)[keep], z, color) for near, far, z, color in rows]


def _zebra(ends: Array) -> list[Mesh]:
    """Stripes across the roadway between two points (2, 2) m, 3 m wide."""
    along = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
    across = np.array([-along[1], along[0]])
    middle = ends.mean(axis=0)
    parts = []
    for t in np.arange(-3.5, 3.6, 1.0):
        a, b = middle + (t - 0.25) * along, middle + (t + 0.25) * along
        left, right = np.array([a, b]) + 1.5 * across, np.array([a, b]) - 1.5 * across
        parts.append(strip(left, right, PAINT_Z + 0.004, PAINT))
    return parts
