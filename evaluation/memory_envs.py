"""How an environment's process grows over many resets and steps, each scene in a process of its own (Linux)."""

from __future__ import annotations

import gc
import os
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

from ..envs.claims import silent_actions
from ..envs.scenes import SCENES, parallel_env
from .memory_matching import STATUS, resident_mib
from .progress import Progress, silent

RESETS, STEPS = 1_000, 100_000
FIRST = 100
"""Resets and steps before the first look."""
SIZE = (64, 48)
DESCRIPTORS = Path("/proc/self/fd")


@dataclass(frozen=True)
class Growth:
    """MiB and open file descriptors of a process after its first resets and steps, and at the end; steps between."""

    first_mib: float
    last_mib: float
    first_files: int
    last_files: int
    steps: int


def rows(
    progress: Progress = silent,
    *,
    resets: int = RESETS,
    steps: int = STEPS,
    scenes: Sequence[str] = tuple(SCENES),
) -> list[dict[str, Any]]:
    """One row `memory_<scene>` each: MiB after at least so many resets and steps, against MiB after the first 100.

    `n` is the number of steps; `files_left_open` counts file descriptors.

    Raises:
        ValueError: fewer than one reset or step, or a scene that does not exist.
        RuntimeError: the operating system does not tell a process's memory.
    """
    for name, value in (("resets", resets), ("steps", steps)):
        if value < 1:
            raise ValueError(f"{name} must be at least 1, got {value}")
    unknown = [scene for scene in scenes if scene not in SCENES]
    if unknown:
        raise ValueError(f"no scene is called {unknown[0]!r}; there are {', '.join(SCENES)}")
    if not STATUS.exists():
        raise RuntimeError("memory is measured on Linux only: there is no /proc here")
    out = []
    for i, scene in enumerate(scenes):
        progress(i, len(scenes))
        with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
            grown = pool.submit(growth, scene, resets, steps).result()
        out.append(_row(scene, grown))
    progress(len(scenes), len(scenes))
    return out


def growth(scene: str, resets: int, steps: int) -> Growth:
    """Play one scene in this process: 100 resets of a step each, then at least so many resets and steps."""
    width, height = SIZE
    env = parallel_env(scene, width=width, height=height, max_cycles=10**9)
    rng = np.random.default_rng(0)
    try:
        for seed in range(FIRST):
            env.reset(seed=seed)
            _play(env, rng, 1)
        first, first_files = resident_mib(), len(os.listdir(DESCRIPTORS))
        done = episodes = 0
        while done < steps or episodes < resets:
            env.reset(seed=FIRST + episodes)
            episodes += 1
            done += _play(env, rng, max(1, -(-steps // resets)))
        gc.collect()
        return Growth(first, resident_mib(), first_files, len(os.listdir(DESCRIPTORS)), done)
    finally:
        env.close()


def _play(env: Any, rng: np.random.Generator, steps: int) -> int:
    """Random controls that claim nothing, for so many steps or until a collision; how many there were."""
    done = 0
    while env.agents and done < steps:
        controls = rng.uniform(-1, 1, (len(env.agents), env.world.control_size))
        env.step(silent_actions(env.agents, controls, env.max_detections))
        done += 1
    return done


def _row(scene: str, grown: Growth) -> dict[str, Any]:
    return {
        "area": "envs",
        "what": f"memory_{scene}",
        "n": grown.steps,
        "ours": grown.last_mib,
        "peer": f"the same process after its first {FIRST} resets and steps",
        "peer_value": grown.first_mib,
        "ratio": grown.last_mib / grown.first_mib,
        "unit": "MiB",
        "files_left_open": grown.last_files - grown.first_files,
    }
