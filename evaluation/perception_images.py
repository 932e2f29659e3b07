"""What `covis benchmark perception` looks at: scenes at a difficulty, and their robots' views with what is true."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..matching.pose import Array, invert, transform

if TYPE_CHECKING:
    from ..envs.collaborative import CollaborativeEnv

STEPS_BETWEEN = 5
INSTANTS = 3
"""Of each episode that are looked at, so many steps apart."""


@dataclass(frozen=True)
class PerceptionTarget:
    """What is looked at: a scene at a difficulty (and on a map); `ood` = never trained on."""

    scene: str
    preset: str = "paper"
    map: str | None = None
    ood: bool = False

    @property
    def name(self) -> str:
        preset = self.preset if self.preset != "paper" else None
        return ":".join(filter(None, (self.scene, preset, self.map)))


def default_targets() -> tuple[PerceptionTarget, ...]:
    """The four scenes, and the map and the preset that are held out."""
    from ..agents.perception.frames import HELD_OUT_MAP, HELD_OUT_PRESET
    from ..envs.scenes import SCENES

    known = tuple(PerceptionTarget(scene) for scene in SCENES)
    held_out = (
        PerceptionTarget("connected_driving", map=HELD_OUT_MAP, ood=True),
        PerceptionTarget(*HELD_OUT_PRESET, ood=True),
    )
    return known + held_out


@dataclass(frozen=True, eq=False)
class Image:
    """One robot's observation with what is true of it.

    Attributes:
        observation: as agents get it.
        instances: (H, W) row of the object at each pixel; -1 for none.
        pixels: (m,) visible pixels.
        object_class: (m,).
        centres: (m, 3) m, camera frame.
    """

    observation: dict[str, Any]
    instances: NDArray[np.int32]
    pixels: NDArray[np.int64]
    object_class: NDArray[np.int64]
    centres: Array


def make_env(target: PerceptionTarget) -> CollaborativeEnv:
    """The scene of a target."""
    from ..agents.perception.frames import Variant
    from ..envs.scenes import parallel_env

    return parallel_env(target.scene, params=Variant(target.scene, target.preset, target.map).params())


def test_images(env: CollaborativeEnv, number: int, seed: tuple[int, int]) -> Iterator[Image]:
    """`number` images of a scene's episodes: every robot's view of a few instants of each."""
    given, episode = 0, 0
    while True:
        env_observations, _ = env.reset(seed=[*seed, episode])
        for instant in range(INSTANTS):
            for robot, agent in enumerate(env.possible_agents):
                if given == number:
                    return
                yield image_of(env, env_observations[agent], robot)
                given += 1
            if instant + 1 < INSTANTS and not _advance(env, env_observations):
                break
        episode += 1


def _advance(env: CollaborativeEnv, observations: dict[str, Any]) -> bool:
    """Let some steps pass, in place; False when the episode has ended."""
    from .run_scene import step_scripted

    for _ in range(STEPS_BETWEEN):
        if not env.agents:
            return False
        observations.update(step_scripted(env))
    return bool(env.agents)


def image_of(env: CollaborativeEnv, observation: dict[str, Any], robot: int) -> Image:
    """One robot's present view with its truth."""
    truth = env.ground_truth()
    return Image(
        observation=observation,
        instances=env.camera_frames()[robot].instances,
        pixels=truth.pixels[robot],
        object_class=truth.object_class,
        centres=transform(invert(truth.T_world_camera[robot]), truth.positions),
    )
