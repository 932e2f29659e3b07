"""The space of a robot's observation, and what its partners tell it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from .claims import Claims
from .sensing import MAX_DEPTH_M
from .worlds.world import World

SENSORS = ("image", "depth", "instances")


def observation_space(
    world: World, width: int, height: int, max_detections: int, sensors: Sequence[str], *, messages: bool
) -> spaces.Dict:
    """The observation space of one robot of a world; the leaves are listed in docs/reference/environments.md."""
    inf = np.inf
    leaves: dict[str, spaces.Space] = {}
    if "image" in sensors:
        leaves["image"] = spaces.Box(0, 255, (height, width, 3), np.uint8)
    leaves |= {
        "intrinsics": spaces.Box(-inf, inf, (3, 3), np.float32),
        "pose": spaces.Box(-inf, inf, (4, 4), np.float32),
        "pose_covariance": spaces.Box(-inf, inf, (6, 6), np.float32),
        "up": spaces.Box(-1.01, 1.01, (3,), np.float32),
        "odometry": spaces.Box(-inf, inf, (4, 4), np.float32),
        "state": spaces.Box(-inf, inf, (world.state_size,), np.float32),
    }
    if "depth" in sensors:
        leaves["depth"] = spaces.Box(0, MAX_DEPTH_M, (height, width), np.float32)
    if "instances" in sensors:
        m = world.max_objects
        leaves["instances"] = spaces.Box(0, m, (height, width), np.int32)
        leaves["instance_classes"] = spaces.Box(-1, len(world.classes) - 1, (m + 1,), np.int64)
    if messages:
        partners, K = world.n_robots - 1, max_detections
        leaves |= {
            "message_boxes": spaces.Box(0, inf, (partners, K, 4), np.float32),
            "message_positions": spaces.Box(-inf, inf, (partners, K, 3), np.float32),
            "message_position_variance": spaces.Box(0, inf, (partners, K), np.float32),
            "message_matches": spaces.Box(0, K, (partners, partners, K), np.int64),
            "message_match_scores": spaces.Box(0, 1, (partners, partners, K), np.float32),
        }
    return spaces.Dict(leaves)


def message_leaves(i: int, claims: Sequence[Claims]) -> dict[str, NDArray[Any]]:
    """The partners' claims as leaves of robot i's observation."""
    partners = [c for j, c in enumerate(claims) if j != i]
    return {
        "message_boxes": np.stack([c.boxes for c in partners]).astype(np.float32),
        "message_positions": np.stack([c.positions for c in partners]).astype(np.float32),
        "message_position_variance": np.stack([c.position_variance for c in partners]).astype(np.float32),
        "message_matches": np.stack([c.matches for c in partners]),
        "message_match_scores": np.stack([c.match_scores for c in partners]).astype(np.float32),
    }
