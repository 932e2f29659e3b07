"""The five maps of connected driving: highway-env's own roads, and where on them things start.

Everything here is in highway-env's road frame (x right, y down on its screen, headings clockwise); `driving.py` turns
it into the world frame in one place.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
try:
    from highway_env.envs.highway_env import HighwayEnv
    from highway_env.envs.intersection_env import IntersectionEnv
    from highway_env.envs.merge_env import MergeEnv
    from highway_env.envs.racetrack_env import RacetrackEnv
    from highway_env.envs.roundabout_env import RoundaboutEnv
except ImportError as error:  # pragma: no cover - depends on the installation
    raise ImportError("connected_driving needs highway-env: pip install 'covis[envs]'") from error

Array = NDArray[np.float64]
LaneIndex = tuple[str, str, int]


@dataclass(frozen=True)
class Start:
    """Where a connected vehicle may start: a lane, a range along it (m), and where it is going (a node, or None)."""

    lane: LaneIndex
    longitudinal: tuple[float, float]
    destinations: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class RoadMap:
    """One of highway-env's roads and its use.

    Attributes:
        name: key in `MAPS`.
        network: highway-env's RoadNetwork.
        regulated: whether highway-env's right-of-way rules act.
        obstacles: (k, 2) m, highway-env's own obstacles.
        entries: lanes on which traffic appears, each with the nodes it may go to (empty: it follows the road).
        populated: lanes that carry traffic at the start, each with its range along the lane (m).
        starts: where connected vehicles may start; several at one start follow each other, up to `queue_gap_m` apart.
        speed: (m/s) of connected vehicles at the start.
        traffic_speed: (m/s) that the others drive at and aim for.
        cruise_speed: (m/s) that the IDM does not exceed when it drives a connected vehicle.
        driving_style: IDM constants that highway-env's own environment of this name sets.
        view: (x0, y0, x1, y1) m, the part of the map that is furnished and drawn.
        crossings: pedestrian crossings, (c, 2, 2) m, from pavement to pavement; crossing k lies on the arm of entry k.
        focus: (x, y) m, where the street is busiest.
    """

    name: str
    network: Any
    regulated: bool
    obstacles: Array
    entries: tuple[tuple[LaneIndex, tuple[str, ...]], ...]
    populated: tuple[tuple[LaneIndex, tuple[float, float]], ...]
    starts: tuple[Start, ...]
    speed: tuple[float, float]
    traffic_speed: tuple[float, float]
    cruise_speed: float
    driving_style: dict[str, float]
    view: tuple[float, float, float, float]
    crossings: Array
    focus: tuple[float, float]
    queue_gap_m: float = 14.0

    @property
    def goals(self) -> tuple[str, ...]:
        """Every node that some entry leads to."""
        return tuple(sorted({goal for _, goals in self.entries for goal in goals}))


def _road_of(environment: Any, make: str = "_make_road", **config: Any) -> Any:
    """The road that a highway-env environment class builds, without building the environment."""
    stub = SimpleNamespace(
        np_random=np.random.default_rng(0),
        config={"show_trajectories": False, "neighbour_vehicles_connected_lanes": False, **config},
    )
    getattr(environment, make)(stub)
    return stub.road


def intersection() -> RoadMap:
    """Four arms with right-of-way rules; 100 m of straight approach each."""
    road = _road_of(IntersectionEnv)
    arms = range(4)
    approach = [(f"o{k}", f"ir{k}", 0) for k in arms]
    away = [tuple(f"o{j}" for j in arms if j != k) for k in arms]
    crossings = []
    for k in arms:
        c, s = np.cos(np.pi / 2 * k), np.sin(np.pi / 2 * k)
        crossings.append(np.array([[-8.0, 14.5], [8.0, 14.5]]) @ np.array([[c, s], [-s, c]]))
    return RoadMap(
        name="intersection",
        network=road.network,
        regulated=True,
        obstacles=np.zeros((0, 2)),
        entries=tuple(zip(approach, away, strict=True)),
        populated=tuple((lane, (20.0, 100.0)) for lane in approach),
        starts=tuple(Start(lane, (66.0, 86.0), goals) for lane, goals in zip(approach, away, strict=True)),
        speed=(1.0, 4.0),
        traffic_speed=(6.0, 9.0),
        cruise_speed=4.0,
        driving_style={"DISTANCE_WANTED": 9.0, "COMFORT_ACC_MAX": 6.0, "COMFORT_ACC_MIN": -3.0},
        view=(-75.0, -75.0, 75.0, 75.0),
        crossings=np.array(crossings),
        focus=(0.0, 0.0),
        queue_gap_m=10.0,
    )


def roundabout() -> RoadMap:
    """A two-lane ring of 20 m radius with four arms."""
    road = _road_of(RoundaboutEnv)
    arms = "senw"
    away = [tuple(f"{b}xr" for b in arms if b != a) for a in arms]
    entries = [((f"{a}er", f"{a}es", 0), goals) for a, goals in zip(arms, away, strict=True)]
    ring = [
        ("se", "ex"),
        ("ex", "ee"),
        ("ee", "nx"),
        ("nx", "ne"),
        ("ne", "wx"),
        ("wx", "we"),
        ("we", "sx"),
        ("sx", "se"),
    ]
    on_ring = [((a, b, lane), (2.0, 14.0)) for a, b in ring for lane in (0, 1)]
    y = 47.0
    crossings = np.array(
        [[[-8.0, y], [8.0, y]], [[y, -8.0], [y, 8.0]], [[-8.0, -y], [8.0, -y]], [[-y, -8.0], [-y, 8.0]]]
    )
    return RoadMap(
        name="roundabout",
        network=road.network,
        regulated=False,
        obstacles=np.zeros((0, 2)),
        entries=tuple(entries),
        populated=tuple(on_ring) + tuple((lane, (70.0, 127.0)) for lane, _ in entries),
        starts=tuple(Start((f"{a}es", f"{a}e", 0), (-2.0, 8.0), goals) for a, goals in zip(arms, away, strict=True)),
        speed=(3.0, 8.0),
        traffic_speed=(7.0, 11.0),
        cruise_speed=5.0,
        driving_style={},
        view=(-85.0, -85.0, 85.0, 85.0),
        crossings=crossings,
        focus=(0.0, 0.0),
    )


def highway() -> RoadMap:
    """Four lanes in one direction in dense, slow traffic; the furnished stretch is 600 m long."""
    road = _road_of(HighwayEnv, "_create_road", lanes_count=4)
    lanes: list[LaneIndex] = [("0", "1", k) for k in range(4)]
    return RoadMap(
        name="highway",
        network=road.network,
        regulated=False,
        obstacles=np.zeros((0, 2)),
        entries=(),
        populated=tuple((lane, (95.0, 215.0)) for lane in lanes),
        starts=tuple(Start(lanes[k], (118.0, 138.0)) for k in (3, 1, 2, 0)),
        speed=(8.0, 11.0),
        traffic_speed=(8.0, 13.0),
        cruise_speed=11.0,
        driving_style={"DISTANCE_WANTED": 8.5, "TIME_WANTED": 0.8},
        view=(40.0, -30.0, 640.0, 42.0),
        crossings=np.zeros((0, 2, 2)),
        focus=(158.0, 6.0),
        queue_gap_m=18.0,
    )


def merge() -> RoadMap:
    """A two-lane road that a ramp joins, in dense traffic."""
    road = _road_of(MergeEnv)
    lanes: list[LaneIndex] = [("a", "b", 0), ("a", "b", 1), ("j", "k", 0)]
    return RoadMap(
        name="merge",
        network=road.network,
        regulated=False,
        obstacles=np.array([o.position for o in road.objects]),
        entries=tuple((lane, ()) for lane in lanes),
        populated=((lanes[0], (110.0, 215.0)), (lanes[1], (110.0, 215.0)), (lanes[2], (100.0, 148.0))),
        starts=(
            Start(lanes[2], (122.0, 136.0)),
            Start(lanes[1], (128.0, 142.0)),
            Start(lanes[0], (118.0, 132.0)),
        ),
        speed=(7.0, 10.0),
        traffic_speed=(7.0, 12.0),
        cruise_speed=10.0,
        driving_style={"DISTANCE_WANTED": 8.5, "TIME_WANTED": 0.8},
        view=(40.0, -30.0, 460.0, 45.0),
        crossings=np.zeros((0, 2, 2)),
        focus=(165.0, 6.0),
        queue_gap_m=16.0,
    )


def racetrack() -> RoadMap:
    """A closed two-lane track."""
    road = _road_of(RacetrackEnv, speed_limit=10.0)
    populated = []
    for a, b in zip("abcdefghi", "bcdefghia", strict=True):
        for k in (0, 1):
            length = float(road.network.get_lane((a, b, k)).length)
            populated.append(((a, b, k), (0.0, length)))
    return RoadMap(
        name="racetrack",
        network=road.network,
        regulated=False,
        obstacles=np.zeros((0, 2)),
        entries=(),
        populated=tuple(populated),
        starts=(Start(("a", "b", 0), (14.0, 26.0)), Start(("a", "b", 1), (6.0, 18.0))),
        speed=(5.0, 8.0),
        traffic_speed=(6.0, 9.0),
        cruise_speed=7.0,
        driving_style={},
        view=(-45.0, -75.0, 145.0, 45.0),
        crossings=np.zeros((0, 2, 2)),
        focus=(88.0, 2.5),
        queue_gap_m=16.0,
    )


MAPS: dict[str, Callable[[], RoadMap]] = {
    "intersection": intersection,
    "roundabout": roundabout,
    "highway": highway,
    "merge": merge,
    "racetrack": racetrack,
}


def road_map(name: str) -> RoadMap:
    """The map of that name.

    Raises:
        ValueError: no such map.
    """
    if name not in MAPS:
        raise ValueError(f"map must be one of {', '.join(sorted(MAPS))}, got {name!r}")
    return MAPS[name]()
