"""Frames to learn from: scenes generated, moved and rendered on the fly, in a random but reproducible variety.

Chunk number k of a seed is always the same few frames, whoever renders it and when. Training, validation and test draw
from streams with different keys, so no scene of one is ever a scene of another.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...envs.camera.raster import Rasterizer, intrinsics_from_fov
from ...envs.scenes import SCENES
from ...envs.sensing import up_in_camera
from ...envs.worlds import driving
from ...envs.worlds.lighting import TIMES_OF_DAY, sample_light
from ...envs.worlds.world import Snapshot, World
from ...matching.pose import Array, invert, transform
from .targets import ObjectTable, object_table

TRAINING_KEY, VALIDATION_KEY, TEST_KEY = 7_100_001, 7_200_001, 7_300_001
"""First words of the seeds of the three splits; nothing else in covis seeds with them."""

HELD_OUT_MAP = "racetrack"
HELD_OUT_PRESET = ("target_localization", "hard")
"""Never trained on: out of distribution."""

PRESETS = ("easy", "paper", "hard")


@dataclass(frozen=True)
class Variant:
    """A scene at one difficulty (and on one map); `weight` is its share of the frames before normalisation."""

    scene: str
    preset: str
    map: str | None = None
    weight: float = 1.0

    @property
    def held_out(self) -> bool:
        return self.map == HELD_OUT_MAP or (self.scene, self.preset) == HELD_OUT_PRESET

    def params(self) -> Any:
        """Parameters of the world's generator."""
        if self.scene == "connected_driving":
            return driving.preset(self.preset, self.map or "intersection")
        return SCENES[self.scene].preset(self.preset)

    def world(self, n_robots: int) -> World:
        return SCENES[self.scene].world(n_robots, self.params())


def training_variants(scenes: tuple[str, ...] = tuple(SCENES)) -> tuple[Variant, ...]:
    """What is trained on: every preset and map but those held out, `paper` most often, as the benchmark does."""
    share = {"easy": 1.0, "paper": 4.0, "hard": 1.0}
    scene_weight = {"connected_driving": 2.2}
    maps: dict[str | None, float] = {"intersection": 5.0, "roundabout": 1.5, "highway": 1.0, "merge": 1.0}
    out = []
    for scene in scenes:
        total = scene_weight.get(scene, 1.0)
        places: dict[str | None, float] = maps if scene == "connected_driving" else {None: 1.0}
        items = [
            Variant(scene, p, m, share[p] * w)
            for p in PRESETS
            for m, w in places.items()
            if not Variant(scene, p, m).held_out
        ]
        norm = sum(v.weight for v in items)
        out += [replace(v, weight=total * v.weight / norm) for v in items]
    return tuple(out)


@cache
def joint_classes() -> tuple[str, ...]:
    """Names of all scenes' classes, each once, in the order of the scenes."""
    names: dict[str, None] = {}
    for scene, spec in SCENES.items():
        world = spec.world(2, Variant(scene, "paper").params())
        names.update(dict.fromkeys(c.name for c in world.classes))
        world.close()
    return tuple(names)


@dataclass(frozen=True, eq=False)
class Frame:
    """One camera's image with its truth.

    Attributes:
        image: (H, W, 3) uint8.
        instances: (H, W) int32, row in `objects`; -1 for everything else.
        objects: what is visible of each object; rows of objects without visible pixels are empty.
        object_class: (m,) index into the joint classes.
        centres: (m, 3) m, true centres in the camera frame.
        identity: (m,) the same object has the same number in all frames of one snapshot.
        intrinsics: (3, 3).
        up: (3,) against gravity, camera frame.
        camera_height_m: true height of the camera above the ground (the world's z = 0).
        height_sigma_m: how well robots of this scene know it.
    """

    image: NDArray[np.uint8]
    instances: NDArray[np.int32]
    objects: ObjectTable
    object_class: NDArray[np.int64]
    centres: Array
    identity: NDArray[np.int64]
    intrinsics: Array
    up: Array
    camera_height_m: float
    height_sigma_m: float

    def mirrored(self) -> Frame:
        """The frame of the mirrored world."""
        width = self.image.shape[1]
        K = self.intrinsics.copy()
        K[0, 2] = width - K[0, 2]
        flip = np.array([-1.0, 1.0, 1.0])
        return replace(
            self,
            image=np.ascontiguousarray(self.image[:, ::-1]),
            instances=np.ascontiguousarray(self.instances[:, ::-1]),
            objects=self.objects.mirrored(width),
            centres=self.centres * flip,
            intrinsics=K,
            up=self.up * flip,
        )


def look(
    rasterizer: Rasterizer,
    snapshot: Snapshot,
    robot: int,
    horizontal_fov_rad: float,
    class_index: NDArray[np.int64],
    height_sigma_m: float,
) -> Frame:
    """The frame of one robot's camera; `class_index` maps the world's classes to the joint ones."""
    K = intrinsics_from_fov(rasterizer.width, rasterizer.height, horizontal_fov_rad)
    rendered = rasterizer.render(snapshot, robot, K)
    T = snapshot.T_world_camera[robot]
    return Frame(
        image=rendered.rgb,
        instances=rendered.instances,
        objects=object_table(rendered.instances, len(snapshot.identity)),
        object_class=class_index[snapshot.object_class],
        centres=transform(invert(T), snapshot.positions),
        identity=snapshot.identity,
        intrinsics=K,
        up=up_in_camera(T),
        camera_height_m=float(T[2, 3]),
        height_sigma_m=height_sigma_m,
    )


@dataclass
class FrameSource:
    """Chunks of training frames by number.

    Attributes:
        seed: of the whole source.
        width, height: pixels.
        variants: what to draw scenes from.
        snapshots: instants per chunk.
        robots: cameras per instant; each instant gives two of their frames, as a pair.
    """

    seed: int = 0
    width: int = 320
    height: int = 240
    variants: tuple[Variant, ...] = field(default_factory=training_variants)
    snapshots: int = 4
    robots: int = 3
    key: int = TRAINING_KEY

    def __post_init__(self) -> None:
        self._worlds: dict[Variant, tuple[World, Rasterizer, NDArray[np.int64]]] = {}
        weights = np.array([v.weight for v in self.variants])
        self._cumulative = np.cumsum(weights / weights.sum())

    def chunk(self, number: int) -> list[tuple[Frame, Frame]]:
        """Pairs of frames of the same instant, `snapshots` of them, from one scene."""
        rng = np.random.default_rng([self.key, self.seed, number])
        variant = self.variants[min(int(np.searchsorted(self._cumulative, rng.random())), len(self.variants) - 1)]
        return list(self._pairs(variant, rng))

    def _pairs(self, variant: Variant, rng: np.random.Generator) -> Iterator[tuple[Frame, Frame]]:
        world, rasterizer, class_index = self._world(variant)
        world.reset(rng)
        for _ in range(int(rng.integers(0, 6))):
            world.step(_wandering(world, rng))
        for _ in range(self.snapshots):
            snapshot = world.snapshot()
            if rng.random() < 0.25:
                snapshot = replace(snapshot, light=sample_light(rng, tuple(TIMES_OF_DAY)))
            first, second = rng.permutation(world.n_robots)[:2]
            if rng.random() < 0.5:
                first = 0  # the robot that differs, where one does
                second = int(rng.integers(1, world.n_robots))
            stretch = math.exp(rng.uniform(-0.12, 0.12)) if rng.random() < 0.5 else 1.0
            fovs = [2 * math.atan(stretch * math.tan(0.5 * float(f))) for f in world.horizontal_fov_rad]
            sigma = SCENES[variant.scene].pose_noise.position_m
            a, b = (look(rasterizer, snapshot, int(r), fovs[int(r)], class_index, sigma) for r in (first, second))
            yield a, b
            for _ in range(int(rng.integers(2, 5))):
                world.step(_wandering(world, rng))

    def _world(self, variant: Variant) -> tuple[World, Rasterizer, NDArray[np.int64]]:
        if variant not in self._worlds:
            world = variant.world(self.robots)
            joint = {name: i for i, name in enumerate(joint_classes())}
            index = np.array([joint[c.name] for c in world.classes], dtype=np.int64)
            self._worlds[variant] = world, Rasterizer(world.meshes, self.width, self.height), index
        return self._worlds[variant]


def _wandering(world: World, rng: np.random.Generator) -> Array:
    """Controls (N, d) that move robots about: traffic drives as it should, others go roughly forward."""
    drivers = getattr(world, "idm_controls", None)
    if drivers is not None:
        return np.asarray(drivers())
    controls = rng.normal(0, 0.6, (world.n_robots, world.control_size))
    controls[:, 0] += 0.3
    return np.clip(controls, -1, 1)
