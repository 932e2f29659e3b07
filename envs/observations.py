"""What a robot observes and what its partners tell it, with the space of both; and the global state."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from .camera.frame import Memory
from .claims import Claims
from .instant import Instant
from .sensing import MAX_DEPTH_M, PoseNoise, permuted_instances, up_in_camera
from .worlds.world import Array, Snapshot, World

SENSORS = ("image", "depth", "instances")
OBJECT_COLUMNS = 13


class Observer:
    """Makes the observations of a world's robots.

    Args:
        world: what is observed.
        intrinsics: (N, 3, 3) of the cameras.
        width, height: of the images, pixels.
        max_detections: K, slots of a partner's claims.
        sensors: parts of `SENSORS`.
        messages: add the partners' claims.
        noise: errors of poses and odometry.

    Attributes:
        space: of one robot's observation; the leaves are listed in docs/reference/environments.md.
    """

    def __init__(
        self,
        world: World,
        intrinsics: Array,
        width: int,
        height: int,
        max_detections: int,
        *,
        sensors: Sequence[str],
        messages: bool,
        noise: PoseNoise,
    ) -> None:
        self.space = _space(world, width, height, max_detections, sensors, messages=messages)
        self._intrinsics = intrinsics.astype(np.float32)
        self._max_objects = world.max_objects
        self._sensors, self._messages, self._noise = tuple(sensors), messages, noise
        self._images = Memory(3 * width * height)

    def observe(
        self,
        i: int,
        now: Instant,
        before: Instant | None,
        claims: Sequence[Claims],
        noise_rng: np.random.Generator,
        id_rng: np.random.Generator,
    ) -> dict[str, NDArray[Any]]:
        """Robot i's observation, fresh arrays; `claims` are those of all robots about the instant before."""
        snapshot, frame = now.snapshot, now.frames[i]
        T = snapshot.T_world_camera[i]
        last = T if before is None else before.snapshot.T_world_camera[i]
        up = up_in_camera(T)
        out: dict[str, NDArray[Any]] = {}
        if "image" in self._sensors:
            out["image"] = self._images.take().reshape(frame.rgb.shape)
            out["image"][:] = frame.rgb
        out["intrinsics"] = self._intrinsics[i].copy()
        out["pose"] = self._noise.pose(T, noise_rng).astype(np.float32)
        out["pose_covariance"] = self._noise.covariance(up).astype(np.float32)
        out["up"] = up.astype(np.float32)
        out["odometry"] = self._noise.odometry(last, T, noise_rng).astype(np.float32)
        out["state"] = snapshot.robot_state[i].astype(np.float32)
        if "depth" in self._sensors:
            out["depth"] = np.minimum(frame.depth, np.float32(MAX_DEPTH_M))
        if "instances" in self._sensors:
            out["instances"], out["instance_classes"] = permuted_instances(
                frame.instances, snapshot.object_class, self._max_objects, id_rng
            )
        if self._messages:
            out |= _message_leaves(i, claims)
        return out


def state_size(world: World) -> int:
    """Length of `state_vector`."""
    return OBJECT_COLUMNS * world.max_objects + world.n_robots * (16 + world.state_size)


def state_vector(snapshot: Snapshot, max_objects: int) -> Array:
    """Per object [present, class, x, y, z, vx, vy, vz, heading, length, width, height, identity], zero-padded to
    `max_objects`; then per robot T_world_camera row by row and its own state."""
    m, n = len(snapshot.identity), len(snapshot.T_world_camera)
    table = np.zeros((max_objects, OBJECT_COLUMNS))
    table[:m, 0] = 1
    table[:m, 1] = snapshot.object_class
    table[:m, 2:5] = snapshot.positions
    table[:m, 5:8] = snapshot.velocities
    table[:m, 8] = snapshot.headings
    table[:m, 9:12] = snapshot.sizes
    table[:m, 12] = snapshot.identity
    robots = np.concatenate([snapshot.T_world_camera.reshape(n, 16), snapshot.robot_state], axis=1)
    return np.concatenate([table.ravel(), robots.ravel()])


def _space(
    world: World, width: int, height: int, max_detections: int, sensors: Sequence[str], *, messages: bool
) -> spaces.Dict:
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


def _message_leaves(i: int, claims: Sequence[Claims]) -> dict[str, NDArray[Any]]:
    """The partners' claims as leaves of robot i's observation."""
    partners = [c for j, c in enumerate(claims) if j != i]
    return {
        "message_boxes": np.stack([c.boxes for c in partners]).astype(np.float32),
        "message_positions": np.stack([c.positions for c in partners]).astype(np.float32),
        "message_position_variance": np.stack([c.position_variance for c in partners]).astype(np.float32),
        "message_matches": np.stack([c.matches for c in partners]),
        "message_match_scores": np.stack([c.match_scores for c in partners]).astype(np.float32),
    }
