"""The one ParallelEnv: a world, cameras, claims and scoring behind PettingZoo's interface.

A step scores the claims about the observation they answer, then moves the world and renders the next observation.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Literal

import numpy as np
from gymnasium import spaces
from gymnasium.utils import EzPickle
from numpy.typing import NDArray
from pettingzoo import ParallelEnv

from .camera.raster import Frame as CameraFrame
from .camera.raster import Rasterizer, intrinsics_from_fov
from .claims import Claims, action_space, decode
from .scoring import LocalizationReward, Reward, StepScore, Truth, score, tight_boxes
from .sensing import MAX_DEPTH_M, PoseNoise, permuted_instances, up_in_camera
from .worlds.world import Snapshot, World

SENSORS = ("image", "depth", "instances")


class CollaborativeEnv(ParallelEnv, EzPickle):
    """Robots with cameras look at one scene, claim what they see and who is who, and are scored.

    Args:
        make_world: builds the world; called once, at construction.
        name: of the scene, for metadata.
        width, height: of every image, pixels.
        max_detections: K, slots per robot.
        max_cycles: steps per episode; then all robots are truncated together.
        pose_noise: errors of the reported poses.
        reward: scores of a step -> the team's reward.
        min_pixels: an object with fewer visible pixels does not count as visible.
        sensors: parts of `("image", "depth", "instances")`; the last two are privileged.
        messages: add the partners' claims of the last step to the observation.
        seed: of the first reset that brings none; later ones go on from it. None draws one.
        render_mode: `rgb_array`, `human` or None.

    Raises:
        ValueError: a size, sensor or mode that does not exist.
    """

    def __init__(
        self,
        make_world: Callable[[], World],
        *,
        name: str,
        width: int = 320,
        height: int = 240,
        max_detections: int = 32,
        max_cycles: int = 25,
        pose_noise: PoseNoise | None = None,
        reward: Reward | None = None,
        min_pixels: int = 60,
        sensors: Sequence[str] = ("image",),
        messages: bool = False,
        seed: int | None = None,
        render_mode: Literal["rgb_array", "human"] | None = None,
    ) -> None:
        EzPickle.__init__(
            self,
            make_world,
            name=name,
            width=width,
            height=height,
            max_detections=max_detections,
            max_cycles=max_cycles,
            pose_noise=pose_noise,
            reward=reward,
            min_pixels=min_pixels,
            sensors=sensors,
            messages=messages,
            seed=seed,
            render_mode=render_mode,
        )
        for label, value, least in (
            ("width", width, 8),
            ("height", height, 8),
            ("max_detections", max_detections, 1),
            ("max_cycles", max_cycles, 1),
            ("min_pixels", min_pixels, 1),
        ):
            if int(value) != value or value < least:
                raise ValueError(f"{label} must be a whole number >= {least}, got {value}")
        unknown = [s for s in sensors if s not in SENSORS]
        if unknown:
            raise ValueError(f"unknown sensor {unknown[0]!r}; there are {', '.join(SENSORS)}")
        if render_mode not in (None, "rgb_array", "human"):
            raise ValueError(f"render_mode must be 'rgb_array', 'human' or None, got {render_mode!r}")
        self.world = make_world()
        self.metadata = {
            "name": name,
            "render_modes": ["rgb_array", "human"],
            "is_parallelizable": True,
            "render_fps": round(1 / self.world.step_seconds),
        }
        self.name = name
        self.width, self.height = int(width), int(height)
        self.max_detections = int(max_detections)
        self.max_cycles = int(max_cycles)
        self.pose_noise = PoseNoise() if pose_noise is None else pose_noise
        self.reward = LocalizationReward() if reward is None else reward
        self.min_pixels = int(min_pixels)
        self.sensors = tuple(sensors)
        self.messages = bool(messages)
        self.render_mode = render_mode
        n = self.world.n_robots
        self.possible_agents = [f"robot_{i}" for i in range(n)]
        self.agents: list[str] = []
        self.classes = tuple(c.name for c in self.world.classes)
        self.intrinsics = np.stack(
            [intrinsics_from_fov(self.width, self.height, float(f)) for f in self.world.horizontal_fov_rad]
        )
        self._entropy = np.random.SeedSequence(seed)
        self._rasterizer: Rasterizer | None = None
        self._window: Any = None
        self._snapshot: Snapshot | None = None
        self._frames: list[CameraFrame] = []
        self._claims: list[Claims] = []
        self._last_score: StepScore | None = None
        space = action_space(self.world.control_size, self.max_detections, n - 1, self.width, self.height)
        self.action_spaces = dict.fromkeys(self.possible_agents, space)
        observation = self._make_observation_space()
        self.observation_spaces = dict.fromkeys(self.possible_agents, observation)
        self.state_space = spaces.Box(-np.inf, np.inf, (self._state_size(),), np.float64)

    # Spaces

    def observation_space(self, agent: str) -> spaces.Space:
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> spaces.Space:
        return self.action_spaces[agent]

    def _make_observation_space(self) -> spaces.Dict:
        inf = np.inf
        leaves: dict[str, spaces.Space] = {}
        if "image" in self.sensors:
            leaves["image"] = spaces.Box(0, 255, (self.height, self.width, 3), np.uint8)
        leaves |= {
            "intrinsics": spaces.Box(-inf, inf, (3, 3), np.float32),
            "pose": spaces.Box(-inf, inf, (4, 4), np.float32),
            "pose_covariance": spaces.Box(-inf, inf, (6, 6), np.float32),
            "up": spaces.Box(-1.01, 1.01, (3,), np.float32),
            "odometry": spaces.Box(-inf, inf, (4, 4), np.float32),
            "state": spaces.Box(-inf, inf, (self.world.state_size,), np.float32),
        }
        if "depth" in self.sensors:
            leaves["depth"] = spaces.Box(0, MAX_DEPTH_M, (self.height, self.width), np.float32)
        if "instances" in self.sensors:
            m = self.world.max_objects
            leaves["instances"] = spaces.Box(0, m, (self.height, self.width), np.int32)
            leaves["instance_classes"] = spaces.Box(-1, len(self.classes) - 1, (m + 1,), np.int64)
        if self.messages:
            partners, K = self.world.n_robots - 1, self.max_detections
            leaves |= {
                "message_boxes": spaces.Box(0, inf, (partners, K, 4), np.float32),
                "message_positions": spaces.Box(-inf, inf, (partners, K, 3), np.float32),
                "message_position_variance": spaces.Box(0, inf, (partners, K), np.float32),
                "message_matches": spaces.Box(0, K, (partners, partners, K), np.int64),
                "message_match_scores": spaces.Box(0, 1, (partners, partners, K), np.float32),
            }
        return spaces.Dict(leaves)

    # The episode

    def reset(
        self, seed: int | Sequence[int] | np.random.SeedSequence | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Start an episode.

        Args:
            seed: the same seed gives the same episode, bit for bit; None goes on with the next of the present seed.
            options: none are known.

        Raises:
            ValueError: an unknown option.
        """
        if options:
            raise ValueError(f"unknown reset option {next(iter(options))!r}")
        if seed is not None:
            self._entropy = seed if isinstance(seed, np.random.SeedSequence) else np.random.SeedSequence(seed)
        (episode,) = self._entropy.spawn(1)
        world_rng, self._noise_rng, self._id_rng = (np.random.default_rng(s) for s in episode.spawn(3))
        self.world.reset(world_rng)
        self.agents = list(self.possible_agents)
        self._steps = 0
        self._claims = [Claims.empty(self.max_detections, len(self.agents) - 1) for _ in self.possible_agents]
        self._last_score = None
        self._totals = np.zeros((len(self.agents), N_SUMS))
        self._look(previous=None)
        return self._observe(), self._infos(np.zeros_like(self._totals))

    def step(
        self, actions: dict[str, Any]
    ) -> tuple[dict[str, Any], dict[str, float], dict[str, bool], dict[str, bool], dict[str, Any]]:
        """Score the claims, move the world, observe.

        Raises:
            ValueError: an agent's action is missing or does not fit its space; the message names agent and leaf.
            RuntimeError: the episode is over or was never begun.
        """
        if self._snapshot is None:
            raise RuntimeError("reset() must be called before step()")
        if not self.agents:
            raise RuntimeError("the episode is over: call reset()")
        missing = [a for a in self.agents if a not in actions]
        if missing:
            raise ValueError(f"{missing[0]}: no action given")
        decoded = [decode(a, actions[a], self.action_spaces[a]) for a in self.agents]
        self._claims = [claims for _, claims in decoded]
        result = score(self._claims, self._truth)
        self._last_score = result
        reward = float(self.reward(result))
        before = self._snapshot
        self.world.step(np.stack([control for control, _ in decoded]))
        self._steps += 1
        self._look(previous=before)
        agents = self.agents
        crashed = bool(self.world.ends_on_collision and self._snapshot.collided.any())
        over = self._steps >= self.max_cycles
        observations = self._observe()
        sums = _sums(result)
        self._totals += sums
        infos = self._infos(sums)
        if crashed or over:
            self.agents = []
        if self.render_mode == "human":
            self.render()
        return (
            observations,
            dict.fromkeys(agents, reward),
            dict.fromkeys(agents, crashed),
            dict.fromkeys(agents, over and not crashed),
            infos,
        )

    def _look(self, previous: Snapshot | None) -> None:
        """Render the present instant and note what is true."""
        if self._rasterizer is None:
            self._rasterizer = Rasterizer(self.world.meshes, self.width, self.height)
        snapshot = self.world.snapshot()
        n, m = self.world.n_robots, len(snapshot.identity)
        self._previous = snapshot if previous is None else previous
        self._snapshot = snapshot
        self._frames = [self._rasterizer.render(snapshot, i, self.intrinsics[i]) for i in range(n)]
        tight = [tight_boxes(frame.instances, m) for frame in self._frames]
        self._truth = Truth(
            identity=snapshot.identity,
            object_class=snapshot.object_class,
            positions=snapshot.positions,
            T_world_camera=snapshot.T_world_camera,
            boxes=np.stack([boxes for boxes, _ in tight]),
            pixels=np.stack([pixels for _, pixels in tight]),
            min_pixels=self.min_pixels,
        )

    def _observe(self) -> dict[str, Any]:
        assert self._snapshot is not None
        return {agent: self._observe_one(i, self._snapshot) for i, agent in enumerate(self.possible_agents)}

    def _observe_one(self, i: int, snapshot: Snapshot) -> dict[str, NDArray[Any]]:
        frame, T = self._frames[i], snapshot.T_world_camera[i]
        up = up_in_camera(T)
        out: dict[str, NDArray[Any]] = {}
        if "image" in self.sensors:
            out["image"] = frame.rgb.copy()
        out["intrinsics"] = self.intrinsics[i].astype(np.float32)
        out["pose"] = self.pose_noise.pose(T, self._noise_rng).astype(np.float32)
        out["pose_covariance"] = self.pose_noise.covariance(up).astype(np.float32)
        out["up"] = up.astype(np.float32)
        last = self._previous.T_world_camera[i]
        out["odometry"] = self.pose_noise.odometry(last, T, self._noise_rng).astype(np.float32)
        out["state"] = snapshot.robot_state[i].astype(np.float32)
        if "depth" in self.sensors:
            out["depth"] = np.minimum(frame.depth, np.float32(MAX_DEPTH_M))
        if "instances" in self.sensors:
            out["instances"], out["instance_classes"] = permuted_instances(
                frame.instances, snapshot.object_class, self.world.max_objects, self._id_rng
            )
        if self.messages:
            out |= self._messages(i)
        return out

    def _messages(self, i: int) -> dict[str, NDArray[Any]]:
        partners = [claims for j, claims in enumerate(self._claims) if j != i]
        return {
            "message_boxes": np.stack([c.boxes for c in partners]).astype(np.float32),
            "message_positions": np.stack([c.positions for c in partners]).astype(np.float32),
            "message_position_variance": np.stack([c.position_variance for c in partners]).astype(np.float32),
            "message_matches": np.stack([c.matches for c in partners]),
            "message_match_scores": np.stack([c.match_scores for c in partners]).astype(np.float32),
        }

    def _infos(self, sums: NDArray[np.float64]) -> dict[str, dict[str, float]]:
        """Figures of the last step's claims, and `episode_*` over the episode so far; undefined errors are NaN."""
        collided = self.snapshot().collided
        return {
            agent: {
                **_figures(sums[i], ""),
                **_figures(self._totals[i], "episode_"),
                "collided": float(collided[i]),
            }
            for i, agent in enumerate(self.possible_agents)
        }

    # The truth, for evaluation

    def ground_truth(self) -> Truth:
        """What is true at the instant of the last observation. For evaluation: agents never see it.

        Raises:
            RuntimeError: before the first reset.
        """
        if self._snapshot is None:
            raise RuntimeError("reset() must be called before ground_truth()")
        return self._truth

    def last_score(self) -> StepScore | None:
        """Scores of the claims of the last step; None before it."""
        return self._last_score

    def snapshot(self) -> Snapshot:
        """The world at the instant of the last observation."""
        if self._snapshot is None:
            raise RuntimeError("reset() must be called before snapshot()")
        return self._snapshot

    def camera_frames(self) -> list[CameraFrame]:
        """Rendered frames of the last observation, one per robot, instances by object index."""
        return self._frames

    def _state_size(self) -> int:
        return 13 * self.world.max_objects + self.world.n_robots * (16 + self.world.state_size)

    def state(self) -> NDArray[np.float64]:
        """Global state: per object [present, class, x, y, z, vx, vy, vz, heading, length, width, height, identity],
        zero-padded to `max_objects`; then per robot T_world_camera row by row and its own state."""
        snapshot = self.snapshot()
        m = len(snapshot.identity)
        table = np.zeros((self.world.max_objects, 13))
        table[:m, 0] = 1
        table[:m, 1] = snapshot.object_class
        table[:m, 2:5] = snapshot.positions
        table[:m, 5:8] = snapshot.velocities
        table[:m, 8] = snapshot.headings
        table[:m, 9:12] = snapshot.sizes
        table[:m, 12] = snapshot.identity
        n = self.world.n_robots
        robots = np.concatenate([snapshot.T_world_camera.reshape(n, 16), snapshot.robot_state], axis=1)
        return np.concatenate([table.ravel(), robots.ravel()])

    # Pictures

    def render(self) -> NDArray[np.uint8] | None:
        """All cameras and a map (H, W, 3); `human` shows it in a window instead."""
        if self.render_mode is None:
            return None
        from .render import compose, show

        picture = compose(self)
        if self.render_mode == "human":
            self._window = show(picture, self._window, self.name)
            return None
        return picture

    def close(self) -> None:
        self.world.close()
        if self._window is not None:
            self._window.close()
            self._window = None


N_SUMS = 7


def _sums(result: StepScore) -> NDArray[np.float64]:
    """Per robot (N, 7): the team's correct, retrieved, covisible, visible; own single and fused error (m), number."""
    counts = result.counts
    team = (counts.correct, counts.retrieved, counts.common, result.n_visible)
    localized = ~np.isnan(result.error_single)
    out = np.empty((len(localized), N_SUMS))
    out[:, :4] = team
    out[:, 4] = np.nansum(result.error_single, axis=1)
    out[:, 5] = np.nansum(result.error_fused, axis=1)
    out[:, 6] = localized.sum(axis=1)
    return out


def _figures(sums: NDArray[np.float64], prefix: str) -> dict[str, float]:
    correct, retrieved, common, visible, single, fused, localized = sums
    return {
        f"{prefix}n_correct": float(correct),
        f"{prefix}n_retrieved": float(retrieved),
        f"{prefix}n_covisible": float(common),
        f"{prefix}n_visible": float(visible),
        f"{prefix}precision": float(correct / retrieved) if retrieved else 0.0,
        f"{prefix}recall": float(correct / common) if common else 0.0,
        f"{prefix}scene_recall": float(correct / visible) if visible else 0.0,
        f"{prefix}n_localized": float(localized),
        f"{prefix}displacement_single_m": float(single / localized) if localized else float("nan"),
        f"{prefix}displacement_fused_m": float(fused / localized) if localized else float("nan"),
    }
