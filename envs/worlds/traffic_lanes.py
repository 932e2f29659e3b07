"""A road network's lanes as a table, and the network that looks vehicles up in it.

Everything here is in highway-env's frame (x right, y down on its screen).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from .driving_maps import MAPS  # noqa: F401 - first: it says what to install when highway-env is missing
from .lane_kernels import (
    CIRCULAR,
    L_AMPLITUDE,
    L_DX,
    L_DY,
    L_HEADING,
    L_KIND,
    L_LENGTH,
    L_PHASE,
    L_PULSATION,
    L_RADIUS,
    L_SPEED_LIMIT,
    L_START_PHASE,
    L_TURN,
    L_WIDTH,
    L_X,
    L_Y,
    LANE_COLUMNS,
    SINE,
    V_X,
    V_Y,
    closest_lane,
)

# isort: split
from highway_env.road.lane import AbstractLane, CircularLane, SineLane, StraightLane
from highway_env.road.road import RoadNetwork

Array = NDArray[np.float64]
LaneIndex = tuple[str, str, int]


class LaneTable:
    """A road network's lanes as arrays, in highway-env's own order.

    Attributes:
        rows: (L, 16) geometry, columns L_*.
        indices: lane index of each row; `row_of` is its inverse.
        connected: (L, c) rows searched for neighbours of a vehicle on that lane, itself first, -1 padded.
        offsets: (L, c) m added to the longitudinal coordinate on each of them.
    """

    def __init__(self, network: RoadNetwork, connected_lanes: bool = False) -> None:
        lanes = network.lanes_dict()
        self.indices: list[LaneIndex] = list(lanes)
        self.lanes: list[AbstractLane] = list(lanes.values())
        self.row_of = {index: row for row, index in enumerate(self.indices)}
        self.rows = np.array([_lane_row(lane) for lane in self.lanes])
        found = [_connections(network, self.row_of, index, connected_lanes) for index in self.indices]
        width = max(len(f) for f in found)
        self.connected = np.full((len(found), width), -1, dtype=np.int64)
        self.offsets = np.zeros((len(found), width))
        for row, links in enumerate(found):
            for k, (other, offset) in enumerate(links):
                self.connected[row, k], self.offsets[row, k] = other, offset
        self._circular = np.flatnonzero(self.rows[:, L_KIND] == CIRCULAR)

    def angles(self, bodies: Array) -> Array:
        """Direction (rad) of each body from the centre of each circular lane, (n, L); 0 for other lanes."""
        out = np.zeros((len(bodies), len(self.rows)))
        lanes = self.rows[self._circular]
        out[:, self._circular] = np.arctan2(bodies[:, V_Y, None] - lanes[:, L_Y], bodies[:, V_X, None] - lanes[:, L_X])
        return out


def _lane_row(lane: AbstractLane) -> Array:
    row = np.zeros(LANE_COLUMNS)
    row[L_LENGTH], row[L_WIDTH] = lane.length, lane.width_at(0.0)
    row[L_SPEED_LIMIT] = np.nan if lane.speed_limit is None else lane.speed_limit
    if type(lane) is CircularLane:
        row[L_KIND] = CIRCULAR
        row[[L_X, L_Y]] = lane.center
        row[L_RADIUS], row[L_START_PHASE], row[L_TURN] = lane.radius, lane.start_phase, lane.direction
        return row
    if type(lane) not in (StraightLane, SineLane):
        raise TypeError(f"no fast geometry for lanes of type {type(lane).__name__}")
    row[[L_X, L_Y]], row[[L_DX, L_DY]], row[L_HEADING] = lane.start, lane.direction, lane.heading
    if type(lane) is SineLane:
        row[L_KIND] = SINE
        row[L_AMPLITUDE], row[L_PULSATION], row[L_PHASE] = lane.amplitude, lane.pulsation, lane.phase
    return row


def _connections(
    network: RoadNetwork, row_of: dict[LaneIndex, int], index: LaneIndex, connected_lanes: bool
) -> list[tuple[int, float]]:
    """Lanes (row, offset m) that highway-env's `neighbour_vehicles` searches for `index`, in its order."""
    start, end, lane_id = index
    found = [(row_of[index], 0.0)]
    if not connected_lanes:
        return found
    own_length = float(network.get_lane(index).length)
    for after, lanes in network.graph.get(end, {}).items():
        found.append((row_of[end, after, lane_id if lane_id < len(lanes) else 0], own_length))
    for before, roads in network.graph.items():
        if start in roads:
            chosen = (before, start, lane_id if lane_id < len(roads[start]) else 0)
            found.append((row_of[chosen], -float(network.get_lane(chosen).length)))
    return found


class FastNetwork(RoadNetwork):
    """highway-env's road network with a compiled closest-lane search."""

    def __init__(self, network: RoadNetwork, connected_lanes: bool = False) -> None:
        super().__init__()
        self.graph = network.graph
        self.connected_lanes = connected_lanes
        self.table = LaneTable(network, connected_lanes)

    def get_closest_lane_index(self, position: Array, heading: float | None = None) -> LaneIndex:
        row = closest_lane(self.table.rows, position[0], position[1], math.nan if heading is None else heading)
        return self.table.indices[row]
