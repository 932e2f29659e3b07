"""Matching problems without a simulator: two robots' graphs of one place, by difficulty, generated on the spot.

Sensor frame: levelled, x forward, y left, z up. Both robots look at the middle of the place, from directions that
differ by 40 to 130 degrees. Objects are common to both, or seen by one of them only: hidden from the other, or outside
its view. Distances err by a share of the range that differs from object to object and is reported; bearings by 0.4
degrees; classes are confused.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..matching import ObjectGraph
from ..matching.pose import Array, invert, transform
from .datasets import Frame, View, pose_covariance

Ints = NDArray[np.int64]

PREFIX = "synthetic-"
"""Of the names of problems, where a target may be something else."""

BEARING_STD_RAD = 0.007
POSE_STD = (0.3, 0.0175)
"""Noise of the robots' poses: m per axis, rad of heading."""


@dataclass(frozen=True)
class Place:
    """One kind of scene.

    Attributes:
        classes: share of each object class.
        decided: concentration of the class confidences; the higher, the less confusion.
        radius_m: objects lie in a disc so large.
        distance_m: of each robot from the disc's middle, least and most.
        sensor_height_m: of the first and of the second robot.
        half_view_rad: half the field of view, sideways.
        common: objects that both see, least and most.
    """

    classes: tuple[float, ...]
    decided: float
    radius_m: float
    distance_m: tuple[float, float]
    sensor_height_m: tuple[float, float]
    half_view_rad: float
    common: tuple[int, int]


@dataclass(frozen=True)
class Difficulty:
    """What makes a problem hard.

    Attributes:
        noncovisible: objects seen by one robot only, per common object (half of them by each).
        depth_noise: share of the range that is one sigma of the distance: least and most over the objects.
        empty_share: share of the pairs that show two places with nothing in common.
    """

    noncovisible: float
    depth_noise: tuple[float, float]
    empty_share: float = 0.0


PLACES = {
    "cad": Place(
        (0.5, 0.15, 0.1, 0.07, 0.06, 0.05, 0.04, 0.03), 3.0, 22.0, (24.0, 36.0), (1.5, 1.5), np.radians(50), (4, 8)
    ),
    "smrc": Place((0.97, 0.01, 0.01, 0.01), 6.0, 9.0, (10.0, 16.0), (0.6, 0.6), np.radians(45), (4, 7)),
    "rmrc": Place((0.7, 0.15, 0.05, 0.05, 0.03, 0.02), 3.5, 4.0, (2.0, 8.0), (6.0, 0.6), np.radians(45), (4, 7)),
}
DIFFICULTIES = {
    "hard": Difficulty(2.0, (0.02, 0.08)),
    "mid": Difficulty(2.0, (0.01, 0.04)),
    "moderate": Difficulty(0.5, (0.01, 0.04)),
    "mixed": Difficulty(2.0, (0.01, 0.04), empty_share=0.5),
}
RUNTIME_OBJECTS, RUNTIME_COMMON = 15, 8
"""Objects a view, and in both, in the problems called `n15`, the size at which the paper states its speed."""


def problem_names() -> list[str]:
    return [f"{place}-{difficulty}" for place in PLACES for difficulty in DIFFICULTIES] + ["n15"]


def frames(name: str, seed: int, numbers: Sequence[int]) -> Iterator[Frame]:
    """The problems of these numbers; each is an episode of its own and depends on name, seed and number alone.

    Raises:
        ValueError: an unknown name.
    """
    if name not in problem_names():
        raise ValueError(f"no synthetic problem is called {name!r}; there are {', '.join(problem_names())}")
    for number in numbers:
        rng = np.random.default_rng([seed, *name.encode(), number])
        yield _n15(rng, number) if name == "n15" else _pair(name, rng, number)


def _n15(rng: np.random.Generator, number: int) -> Frame:
    alone = RUNTIME_OBJECTS - RUNTIME_COMMON
    return _frame(PLACES["cad"], DIFFICULTIES["mid"], RUNTIME_COMMON, (alone, alone), rng, number)


def _pair(name: str, rng: np.random.Generator, number: int) -> Frame:
    place_name, _, difficulty_name = name.partition("-")
    place, difficulty = PLACES[place_name], DIFFICULTIES[difficulty_name]
    common = int(rng.integers(place.common[0], place.common[1], endpoint=True))
    alone = rng.binomial(2 * round(difficulty.noncovisible * common), 0.25, size=2)
    # Every so many-th pair, not by chance: the share is exact in any run of pairs.
    if difficulty.empty_share and (number + 1) * difficulty.empty_share % 1 < difficulty.empty_share:
        return _frame(place, difficulty, 0, (common + int(alone[0]), common + int(alone[1])), rng, number)
    return _frame(place, difficulty, common, (int(alone[0]), int(alone[1])), rng, number)


def _frame(
    place: Place,
    difficulty: Difficulty,
    common: int,
    alone: tuple[int, int],
    rng: np.random.Generator,
    number: int,
) -> Frame:
    """Objects 0 ... common - 1 are seen by both robots, then come those of the first alone, then of the second."""
    poses = _poses(place, rng)
    world = np.concatenate(
        [_objects(place, poses, common, rng), *(_objects(place, poses[r : r + 1], alone[r], rng) for r in (0, 1))]
    )
    kinds = rng.choice(len(place.classes), size=len(world), p=np.array(place.classes) / sum(place.classes))
    ids = np.arange(len(world))
    own = [ids < common + alone[0], (ids < common) | (ids >= common + alone[0])]
    views = tuple(_view(place, difficulty, f"robot_{r}", poses[r], world, kinds, ids[own[r]], rng) for r in (0, 1))
    return Frame(number, number, None, views)


def _poses(place: Place, rng: np.random.Generator) -> list[Array]:
    """True T_world_sensor of both robots, each looking about the middle of the place."""
    first = rng.uniform(-np.pi, np.pi)
    poses = []
    for r, angle in enumerate((first, first + rng.choice([-1, 1]) * rng.uniform(np.radians(40), np.radians(130)))):
        distance = rng.uniform(*place.distance_m)
        heading = angle + np.pi + rng.normal(0, 0.1)
        T = np.eye(4)
        T[:2, :2] = [[np.cos(heading), -np.sin(heading)], [np.sin(heading), np.cos(heading)]]
        T[:3, 3] = [distance * np.cos(angle), distance * np.sin(angle), place.sensor_height_m[r]]
        poses.append(T)
    return poses


def _objects(place: Place, poses: Sequence[Array], n: int, rng: np.random.Generator) -> Array:
    """n objects (n, 3) in the disc, within the field of view of all the given robots."""
    found: list[Array] = []
    while len(found) < n:
        radius, angle = place.radius_m * np.sqrt(rng.random()), rng.uniform(-np.pi, np.pi)
        point = np.array([radius * np.cos(angle), radius * np.sin(angle), rng.uniform(0.2, 0.8)])
        if all(_in_view(place, transform(invert(T), point[None])[0]) for T in poses):
            found.append(point)
    return np.array(found).reshape(-1, 3)


def _in_view(place: Place, point: Array) -> bool:
    return bool(point[0] > 1.0 and abs(np.arctan2(point[1], point[0])) < place.half_view_rad)


def _view(
    place: Place,
    difficulty: Difficulty,
    robot: str,
    T: Array,
    world: Array,
    kinds: Ints,
    own: Ints,
    rng: np.random.Generator,
) -> View:
    own = rng.permutation(own)
    positions, variance = _measured(transform(invert(T), world[own]), difficulty, rng)
    attributes = _confidences(kinds[own], place, rng)
    up = np.array([0.0, 0.0, 1.0])
    graph = ObjectGraph(
        positions=positions,
        attributes=attributes,
        position_variance=variance,
        attribute_variance=(attributes * (1 - attributes)).mean(axis=1) / (1 + place.decided),
        up=up,
        forward=np.array([1.0, 0.0, 0.0]),
        horizontal_fov_rad=2 * place.half_view_rad,
    )
    return View(
        robot=robot,
        graph=graph,
        identity=own.astype(np.int64),
        truth=world[own],
        pose=_noisy(T, rng),
        pose_covariance=pose_covariance(POSE_STD, up),
        pose_truth=T,
        odometry=None,
        order=np.arange(len(own)),
    )


def _measured(true: Array, difficulty: Difficulty, rng: np.random.Generator) -> tuple[Array, Array]:
    """Positions (n, 3) and the reported variance (n,) of their distances."""
    n = len(true)
    distance = np.linalg.norm(true, axis=1)
    std = rng.uniform(*difficulty.depth_noise, n) * distance
    ray = true / distance[:, None] + BEARING_STD_RAD * rng.standard_normal((n, 3))
    ray /= np.linalg.norm(ray, axis=1)[:, None]
    return ray * np.maximum(distance + std * rng.standard_normal(n), 0.1)[:, None], std**2


def _confidences(kinds: Ints, place: Place, rng: np.random.Generator) -> Array:
    """Class distributions (n, c): softmax of noisy logits that favour the true class."""
    logits = rng.standard_normal((len(kinds), len(place.classes)))
    logits[np.arange(len(kinds)), kinds] += 0.5 * place.decided
    exponent = np.exp(logits - logits.max(axis=1, keepdims=True))
    return exponent / exponent.sum(axis=1, keepdims=True)


def _noisy(T: Array, rng: np.random.Generator) -> Array:
    turn = POSE_STD[1] * rng.standard_normal()
    noisy = T.copy()
    noisy[:2, :2] = T[:2, :2] @ [[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]
    noisy[:2, 3] += POSE_STD[0] * rng.standard_normal(2)
    return noisy
