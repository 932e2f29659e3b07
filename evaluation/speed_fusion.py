"""Fusion's rates on one thread: many objects at once, and the whole loop over time."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..fusion.gains import fuse
from ..fusion.sequence import PairTracker
from ..fusion.tracking import Batch, Tracker
from ..matching import METHODS, Matching, ObjectGraph, RelativePose
from ..matching.pose import Array, exp_se3, invert, transform
from .progress import Progress, silent
from .timing import rates, row

UP = np.array([0.0, 0.0, 1.0])


def rows(progress: Progress = silent) -> list[dict[str, Any]]:
    """`fuse_8x50`: 8 robots, 50 objects each; `sequence_loop`: match, fuse, track, two robots of 15 objects."""
    progress(0, 2)
    fused = fuse_many()
    progress(1, 2)
    loop = sequence_loop()
    progress(2, 2)
    return [fused, loop]


def fuse_many(robots: int = 8, objects: int = 50) -> dict[str, Any]:
    views, poses = team(np.random.default_rng(0), robots, objects)
    identity = np.stack([np.arange(objects)] * 2, axis=1)
    matchings = {(0, j): Matching(identity, np.full(objects, 0.9)) for j in range(1, robots)}
    relative = {(0, j): RelativePose(invert(poses[0]) @ poses[j], 1e-3 * np.eye(6)) for j in range(1, robots)}
    rate, _ = rates(lambda: fuse(views, relative, matchings))
    return row("fusion", f"fuse_{robots}x{objects}", objects, rate, None, None)


def sequence_loop(objects: int = 15) -> dict[str, Any]:
    """Frames per second of the causal loop: prior from the last frames, matching by bayes, fusion, tracks."""
    rng = np.random.default_rng(1)
    frames = [team(rng, 2, objects, seed_of_world=2)[0] for _ in range(20)]
    pair, tracker, clock = PairTracker(), Tracker(), [0.0]

    def loop() -> None:
        for source, target in frames:
            clock[0] += 0.2
            pair.predict(np.eye(4), np.eye(4))
            matching = pair.match(METHODS["bayes"], source, target)
            known = {} if matching.pose is None else {(0, 1): matching.pose}
            fused = fuse([source, target], known, {(0, 1): matching})
            tracker.update(Batch(clock[0], fused.positions, fused.covariances))

    rate, _ = rates(loop)
    return row("fusion", "sequence_loop", objects, rate * len(frames), None, None)


def team(
    rng: np.random.Generator, robots: int, objects: int, seed_of_world: int = 0
) -> tuple[list[ObjectGraph], list[Array]]:
    """Views of the same objects by robots around them, 2 % depth noise; and the robots' true poses."""
    world_rng = np.random.default_rng(seed_of_world)
    world = np.column_stack([world_rng.uniform(-15, 15, (objects, 2)), world_rng.uniform(0, 2, objects)])
    poses = [
        exp_se3(np.array([18 * np.cos(a), 18 * np.sin(a), 0, 0, 0, a + np.pi])) for a in np.linspace(0, 1.5, robots)
    ]
    views = []
    for T in poses:
        seen = transform(invert(T), world)
        noisy = seen * (1 + 0.02 * rng.standard_normal((objects, 1)))
        variance = (0.02 * np.linalg.norm(seen, axis=1)) ** 2
        views.append(ObjectGraph.from_positions(noisy, position_variance=variance, up=UP))
    return views, poses
