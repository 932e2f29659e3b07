"""What a connected-driving scene contains: classes, kinds of vehicles, generator parameters and presets."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from .checks import check_fields, check_names, require
from .driving_maps import MAPS
from .lighting import TIMES_OF_DAY
from .world import ObjectClass

Size = tuple[float, float, float]
Tint = tuple[float, float, float]

CAR, VAN, TRUCK, BUS, PEDESTRIAN, SIGNAL, SIGN = range(7)
CLASSES = (
    ObjectClass("car", 1.1),
    ObjectClass("van", 1.45),
    ObjectClass("truck", 2.1),
    ObjectClass("bus", 3.0),
    ObjectClass("pedestrian", 0.1),
    ObjectClass("traffic light", 0.1),
    ObjectClass("road sign", 0.05),
)
PERSON_SIZE: Size = (0.66, 0.66, 1.76)
SIGNAL_SIZE: Size = (0.36, 0.6, 1.18)
SIGN_SIZE: Size = (0.14, 0.92, 0.92)
SIGNAL_HEIGHT_M, SIGN_HEIGHT_M = 2.85, 2.24
"""Of the middle of what detectors call a signal or a sign; the post below is scenery."""

WHITE: Tint = (1.0, 1.0, 1.0)
COMMON_PAINTS: tuple[Tint, ...] = ((0.95, 0.95, 0.95), (0.62, 0.63, 0.66))
RARE_PAINTS: tuple[Tint, ...] = (
    (0.75, 0.12, 0.1),
    (0.12, 0.25, 0.6),
    (0.1, 0.35, 0.2),
    (0.85, 0.65, 0.1),
    (0.14, 0.14, 0.16),
    (0.5, 0.3, 0.18),
)
COMMON_COATS: tuple[Tint, ...] = ((0.32, 0.36, 0.46), (0.55, 0.5, 0.45))
RARE_COATS: tuple[Tint, ...] = (
    (0.85, 0.2, 0.18),
    (0.95, 0.8, 0.2),
    (0.2, 0.6, 0.4),
    (0.9, 0.9, 0.92),
    (0.5, 0.25, 0.6),
)
DAYTIME = ("morning", "noon", "afternoon", "evening", "overcast")


@dataclass(frozen=True)
class VehicleKind:
    """A kind of vehicle: class, meshes (indices into the world's), size (m), share of the traffic and of the parked."""

    object_class: int
    meshes: tuple[int, ...]
    size: Size
    traffic_share: float
    parked_share: float


KINDS = (
    VehicleKind(CAR, (0, 1, 2), (4.54, 1.88, 1.5), 0.68, 0.86),
    VehicleKind(VAN, (3,), (5.36, 2.0, 2.25), 0.14, 0.14),
    VehicleKind(TRUCK, (4,), (7.68, 2.3, 3.12), 0.1, 0.0),
    VehicleKind(BUS, (5,), (8.7, 2.4, 3.15), 0.08, 0.0),
)


@dataclass(frozen=True)
class DrivingParams:
    """Parameters of the connected-driving generator; counts are of what finds a place.

    Attributes:
        map: "intersection", "roundabout", "highway", "merge" or "racetrack".
        n_vehicles: other vehicles in traffic at the start.
        max_vehicles: other vehicles in traffic at any time.
        spawn_probability: chance per step that another one enters.
        prewarm_s: traffic runs this long before the connected vehicles appear (s).
        n_parked, n_pedestrians, n_signals, n_signs: other objects.
        n_buildings, n_trees: scenery that hides objects.
        same_approach_share: chance that a connected vehicle follows another one instead of coming from elsewhere.
        crossing_share: share of pedestrians that want to cross the road, on maps with crossings.
        look_alike_fraction: share of objects whose look is drawn from the few common ones.
        street_spread_m: standard deviation of street objects' distance from the map's focus.
        times_of_day: names of `lighting.TIMES_OF_DAY`, one drawn per scene.
        horizontal_fov_rad: full field of view of the cameras.
        camera_height_m, camera_forward_m: mounting, from the ground below the vehicle's centre.
        max_acceleration: m/s^2 at control 1.
        max_steering_rad: steering angle at control 1.
    """

    map: str = "intersection"
    n_vehicles: int = 14
    max_vehicles: int = 18
    spawn_probability: float = 0.3
    prewarm_s: float = 3.0
    n_parked: int = 18
    n_pedestrians: int = 40
    n_signals: int = 8
    n_signs: int = 10
    n_buildings: int = 14
    n_trees: int = 16
    same_approach_share: float = 0.8
    crossing_share: float = 0.4
    look_alike_fraction: float = 0.97
    street_spread_m: float = 17.0
    times_of_day: tuple[str, ...] = DAYTIME
    horizontal_fov_rad: float = 1.3
    camera_height_m: float = 2.0
    camera_forward_m: float = 0.3
    max_acceleration: float = 5.0
    max_steering_rad: float = 0.6

    def __post_init__(self) -> None:
        """Raise ValueError naming the first impossible value."""
        check_fields(self)
        require(isinstance(self.map, str) and self.map in MAPS, "map", self.map, f"one of {', '.join(sorted(MAPS))}")
        if self.n_vehicles > self.max_vehicles:
            raise ValueError(f"n_vehicles {self.n_vehicles} exceeds max_vehicles {self.max_vehicles}")
        for name in ("spawn_probability", "look_alike_fraction", "crossing_share", "same_approach_share"):
            require(0 <= getattr(self, name) <= 1, name, getattr(self, name), "in [0, 1]")
        require(0 <= self.prewarm_s <= 60, "prewarm_s", self.prewarm_s, "in [0, 60]")
        require(0 < self.horizontal_fov_rad < np.pi, "horizontal_fov_rad", self.horizontal_fov_rad, "in (0, pi)")
        require(0 < self.max_steering_rad < np.pi / 2, "max_steering_rad", self.max_steering_rad, "in (0, pi / 2)")
        for name in ("camera_height_m", "max_acceleration", "street_spread_m"):
            require(getattr(self, name) > 0, name, getattr(self, name), "positive")
        check_names("times_of_day", self.times_of_day, TIMES_OF_DAY)

    @property
    def max_objects(self) -> int:
        """Most objects in a scene, connected vehicles excepted."""
        return self.max_vehicles + self.n_parked + self.n_pedestrians + self.n_signals + self.n_signs


def draw_kind(rng: np.random.Generator, parked: bool = False) -> int:
    """Index into `KINDS` of a vehicle of the traffic, or of a parked one."""
    shares = np.array([kind.parked_share if parked else kind.traffic_share for kind in KINDS])
    return int(rng.choice(len(KINDS), p=shares / shares.sum()))


def draw_paint(rng: np.random.Generator, kind: int, look_alike_fraction: float) -> tuple[int, Tint]:
    """Mesh and tint of a vehicle: a common one with that probability, else any mesh of its kind in a rare paint."""
    meshes = KINDS[kind].meshes
    if rng.uniform() < look_alike_fraction:
        return meshes[0], draw(rng, COMMON_PAINTS if kind == CAR else COMMON_PAINTS[:1])
    return int(rng.choice(meshes)), draw(rng, RARE_PAINTS)


def draw_coat(rng: np.random.Generator, look_alike_fraction: float) -> Tint:
    """Tint of a pedestrian's coat."""
    return draw(rng, COMMON_COATS if rng.uniform() < look_alike_fraction else RARE_COATS)


def draw(rng: np.random.Generator, tints: tuple[Tint, ...]) -> Tint:
    """One of several tints."""
    return tints[int(rng.integers(len(tints)))]


PRESETS: dict[str, dict[str, float]] = {
    "easy": {
        "n_vehicles": 8,
        "n_parked": 6,
        "n_pedestrians": 16,
        "n_buildings": 6,
        "n_trees": 8,
        "same_approach_share": 1.0,
        "look_alike_fraction": 0.4,
    },
    "paper": {},
    "hard": {
        "n_vehicles": 18,
        "max_vehicles": 22,
        "n_parked": 24,
        "n_pedestrians": 50,
        "same_approach_share": 0.3,
        "look_alike_fraction": 1.0,
        "camera_height_m": 1.5,
    },
}
"""What each preset changes of the defaults, which are the paper's."""

MAP_COUNTS: dict[str, dict[str, float]] = {
    "highway": {
        "n_vehicles": 34,
        "max_vehicles": 36,
        "n_parked": 14,
        "n_pedestrians": 14,
        "n_signals": 4,
        "n_signs": 14,
        "street_spread_m": 35.0,
    },
    "merge": {"n_vehicles": 24, "max_vehicles": 28, "n_pedestrians": 18, "n_signs": 14, "street_spread_m": 30.0},
    "racetrack": {"n_vehicles": 18, "max_vehicles": 22, "n_pedestrians": 26, "n_signals": 4, "street_spread_m": 26.0},
}
"""Roads with one pavement get less street and more traffic, for as many objects a view; not applied by `easy`."""


def preset(name: str, map: str = "intersection", **changes: Any) -> DrivingParams:
    """The parameters called `name` (easy, paper or hard) on a map, some of them changed.

    Raises:
        ValueError: no such preset or map.
    """
    if name not in PRESETS:
        raise ValueError(f"unknown preset {name!r}; connected_driving has {', '.join(PRESETS)}")
    counts = {} if name == "easy" else MAP_COUNTS.get(map, {})
    return DrivingParams(map=map, **{**PRESETS[name], **counts, **changes})
