"""Kerbs: where the roadway ends and the street begins, found from highway-env's lanes, in the world frame."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from .driving_maps import RoadMap
from .lane_kernels import L_LENGTH, L_WIDTH, projected
from .traffic_lanes import LaneTable

Array = NDArray[np.float64]

BAY_M = 2.4
"""Width of the parking bay between the roadway and the pavement."""
PAVEMENT_M = 3.2
WALK_M = BAY_M + PAVEMENT_M / 2
"""Distance from the kerb at which people walk."""
POST_M = BAY_M + 0.7
"""Distance from the kerb at which signs and signals stand."""
REACHES_M = np.array([1.0, 2.6, 4.0, 5.8, 8.0, 11.0, 14.0, 17.0, 21.0])


@dataclass(frozen=True, eq=False)
class KerbRun:
    """An unbroken stretch of kerb, sampled every metre in the direction of traffic.

    Attributes:
        points: (k, 2) m on the edge of the roadway.
        outward: (k, 2) unit vectors away from it.
        headings: (k,) rad, direction of traffic along it.
        room: (k,) m free beyond it before another roadway.
        roadside: whether it is the side with parking and pavement (else a central reservation or island).
    """

    points: Array
    outward: Array
    headings: Array
    room: Array
    roadside: bool

    def offset(self, distance_m: float) -> Array:
        """(k, 2) m, the run moved outwards."""
        return self.points + distance_m * self.outward


def to_world(points: Array) -> Array:
    """Points (..., 2) of highway-env's road in our world: y mirrored (headings change sign too)."""
    return points * np.array([1.0, -1.0])


@njit(cache=True)
def road_clearance(lanes: Array, points: Array) -> Array:
    """(n,) m from each point (n, 2) to the nearest lane's edge or end, negative inside; highway-env's frame."""
    out = np.empty(len(points))
    for k in range(len(points)):
        nearest = np.inf
        for row in range(len(lanes)):
            s, lateral = projected(lanes[row], points[k, 0], points[k, 1])
            beside = abs(lateral) - lanes[row, L_WIDTH] / 2
            beyond = max(s - lanes[row, L_LENGTH], -s)
            distance = math.sqrt(beside**2 + beyond**2) if beside > 0 and beyond > 0 else max(beside, beyond)
            nearest = min(nearest, distance)
        out[k] = nearest
    return out


def clearance(table: LaneTable, points: Array) -> Array:
    """(n,) m from points (n, 2) of the world to the roadway, negative on it."""
    return road_clearance(table.rows, np.ascontiguousarray(to_world(points)))


def kerb_runs(roads: RoadMap, table: LaneTable, shortest_m: int = 3) -> list[KerbRun]:
    """All kerbs inside the map's view, right-hand sides first along each lane."""
    runs = []
    for lane in table.lanes:
        s = np.arange(0.0, min(float(lane.length), 800.0) + 0.5, 1.0)
        heading = np.array([lane.heading_at(x) for x in s])
        for side in (1.0, -1.0):
            border = np.array([lane.position(x, side * lane.width_at(x) / 2) for x in s])
            outward = side * np.column_stack([-np.sin(heading), np.cos(heading)])
            runs += _split(roads, table, to_world(border), to_world(outward), -heading, side > 0, shortest_m)
    return runs


def _split(
    roads: RoadMap, table: LaneTable, points: Array, outward: Array, headings: Array, right: bool, shortest: int
) -> list[KerbRun]:
    room = np.zeros(len(points))
    free = np.ones(len(points), dtype=bool)
    for reach in (0.5, *REACHES_M):
        free &= clearance(table, points + reach * outward) > 0.85 * reach - 0.3
        room[free] = reach
    x0, y0, x1, y1 = roads.view
    inside = (points[:, 0] >= x0) & (points[:, 0] <= x1) & (-points[:, 1] >= y0) & (-points[:, 1] <= y1)
    kept = np.flatnonzero(inside & (room > 0))
    runs = []
    for part in np.split(kept, np.flatnonzero(np.diff(kept) > 1) + 1):
        if len(part) >= shortest:
            roadside = right and float(np.median(room[part])) >= BAY_M + PAVEMENT_M
            runs.append(KerbRun(points[part], outward[part], headings[part], room[part], roadside))
    return runs


class Ground:
    """What a map offers to the street: sites along kerbs, pavements, crossings and posts for signals.

    Attributes:
        focus: (2,) m, where the street is busiest.
        pavements: polylines (k, 2) m of samples about a metre apart.
        crossings: polylines (k, 2) m across the roadway, from pavement to pavement.
        posts: (crossing, position (2,) m, heading rad) of the signals that guard the crossings.
    """

    def __init__(self, roads: RoadMap, table: LaneTable) -> None:
        self.runs = kerb_runs(roads, table)
        self.focus = to_world(np.array(roads.focus))
        self._points = np.vstack([run.points for run in self.runs])
        self._outward = np.vstack([run.outward for run in self.runs])
        self._headings = np.concatenate([run.headings for run in self.runs])
        self._room = np.concatenate([run.room for run in self.runs])
        self._roadside = np.concatenate([np.full(len(run.points), run.roadside) for run in self.runs])
        self.crossings = [_polyline(*to_world(ends)) for ends in roads.crossings]
        self._parking = self._roadside & self._parking_allowed(table)
        self.pavements = [_resampled(run.offset(WALK_M)) for run in self.runs if run.roadside and len(run.points) >= 8]
        self.pavements = [path for path in self.pavements if len(path) >= 4]
        self.posts = [post for k, path in enumerate(self.crossings) for post in self._posts(k, path)]

    def sites(self, outward_m: float, room_m: float, *, parking: bool = False, islands: bool = False) -> Array:
        """(k, 3) x, y, heading of traffic, `outward_m` from kerbs with at least `room_m` behind them."""
        chosen = (self._room >= room_m) & (self._parking if parking else (self._roadside | islands))
        places = self._points[chosen] + outward_m * self._outward[chosen]
        return np.column_stack([places, self._headings[chosen]])

    def _parking_allowed(self, table: LaneTable) -> NDArray[np.bool_]:
        along = np.column_stack([np.cos(self._headings), np.sin(self._headings)])
        centre = self._points + BAY_M / 2 * self._outward
        allowed = np.ones(len(centre), dtype=bool)
        for ahead in (-3.2, 0.0, 3.2):
            allowed &= clearance(table, centre + ahead * along) > BAY_M / 2 - 0.3
        for path in self.crossings:
            for end in (path[0], path[-1]):
                allowed &= np.hypot(*(centre - end).T) > 7.0
        return allowed

    def _posts(self, index: int, path: Array) -> list[tuple[int, Array, float]]:
        """Before each crossing of an approach: one signal on the right and one on the left."""
        middle = path.mean(axis=0)
        away = (middle - self.focus) / np.linalg.norm(middle - self.focus)
        right = np.array([-away[1], away[0]])  # of traffic that comes in against `away`
        half_road = np.linalg.norm(path[-1] - path[0]) / 2 - WALK_M
        heading = float(np.arctan2(away[1], away[0]))
        return [(index, middle + side * right * (half_road + POST_M) + 2.4 * away, heading) for side in (1.0, -1.0)]


def _resampled(path: Array) -> Array:
    """The polyline (k, 2) with samples a metre apart along it, its last shorter piece dropped."""
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(path, axis=0).T))])
    at = np.arange(0.0, along[-1], 1.0)
    return np.column_stack([np.interp(at, along, path[:, 0]), np.interp(at, along, path[:, 1])])


def _polyline(start: Array, end: Array) -> Array:
    """Samples about a metre apart, ends included."""
    count = max(round(float(np.linalg.norm(end - start))), 1) + 1
    return np.linspace(start, end, count)
