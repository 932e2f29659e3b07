"""The one ParallelEnv: a world, cameras, claims and scoring behind PettingZoo's interface.

A step scores the claims about the observation they answer, then moves the world and renders the next observation.
"""

from __future__ import annotations

import copy
import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal

import numpy as np
from gymnasium import spaces
from gymnasium.utils import EzPickle
from numpy.typing import NDArray
from pettingzoo import ParallelEnv

from .camera.effects import EffectRanges
from .camera.frame import Frame as CameraFrame
from .camera.mount import Mount, checked_mounts, kept_picture, with_mounts
from .camera.raster import Look, intrinsics_from_fov
from .camera.rig import CameraRig, Exposures
from .claims import Claims, action_space, decode
from .episode import Episode, SavedState
from .figures import N_SUMS, figures, sums
from .instant import Answered, Instant
from .observations import SENSORS, Observer, state_size, state_vector
from .scoring import LocalizationReward, Reward, StepScore, Truth, score, tight_boxes
from .seeding import EpisodeSeeds, Seed
from .sensing import PoseNoise
from .worlds.world import Snapshot, World, checked_world

LEAST = {"width": 8, "height": 8}
"""Smallest values of the arguments that are whole numbers; 1 unless it says otherwise."""


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
        backend: "raster" (our camera), "tiny" or "egl" (pybullet's renderers).
        look: shading, shadows and so on of our camera; None = all of it.
        mounts: one `Mount` per robot: where its camera sits, how wide it looks, how often it takes a picture; None
            instead of all or of one keeps the scene's.
        effects: ranges of exposure, noise, blur, lens and so on, from which every episode draws each camera's; None =
            ideal cameras. A lens that distorts bends all images alike; `intrinsics` stay those of the pinhole.
        seed: of the first reset that brings none; later ones go on from it. None draws one.
        render_mode: `rgb_array`, `human` or None.

    Raises:
        ValueError: a size, sensor or mode that does not exist; a world with a single robot; mounts for other robots.
        TypeError: pose noise, a reward, a look, effects, a mount or a world that is something else.
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
        backend: str = "raster",
        look: Look | None = None,
        mounts: Sequence[Mount | None] | None = None,
        effects: EffectRanges | None = None,
        seed: Seed | None = None,
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
            backend=backend,
            look=look,
            mounts=mounts,
            effects=effects,
            seed=seed,
            render_mode=render_mode,
        )
        _check_numbers(
            width=width, height=height, max_detections=max_detections, max_cycles=max_cycles, min_pixels=min_pixels
        )
        _check_parts(pose_noise=(pose_noise, PoseNoise), look=(look, Look), effects=(effects, EffectRanges))
        _check_choices(reward, sensors, render_mode)
        self.world = checked_world(make_world())
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
        if n < 2:
            raise ValueError(f"collaboration takes at least two robots, the world has {n}")
        self.possible_agents = [f"robot_{i}" for i in range(n)]
        self.agents: list[str] = []
        self.classes = tuple(c.name for c in self.world.classes)
        self.mounts = checked_mounts(mounts, n)
        views = [
            float(fov if mount is None else mount.horizontal_fov_rad)
            for mount, fov in zip(self.mounts, self.world.horizontal_fov_rad, strict=True)
        ]
        self.intrinsics = np.stack([intrinsics_from_fov(self.width, self.height, fov) for fov in views])
        self._seeds = EpisodeSeeds.start(seed)
        self._rig = CameraRig(
            self.world.meshes,
            self.width,
            self.height,
            self.intrinsics,
            backend=backend,
            look=look,
            effects=effects,
            own_body=[m is not None and m.own_body for m in self.mounts],
        )
        self._observer = Observer(
            self.world,
            self.intrinsics,
            self.width,
            self.height,
            self.max_detections,
            sensors=self.sensors,
            messages=self.messages,
            noise=self.pose_noise,
        )
        self._painter: Any = None
        self._window: Any = None
        self._episode: Episode | None = None
        space = action_space(self.world.control_size, self.max_detections, n - 1, self.width, self.height)
        self.action_spaces = dict.fromkeys(self.possible_agents, space)
        self.observation_spaces = dict.fromkeys(self.possible_agents, self._observer.space)
        self.state_space = spaces.Box(-np.inf, np.inf, (state_size(self.world),), np.float64)

    # Spaces

    def observation_space(self, agent: str) -> spaces.Space:
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> spaces.Space:
        return self.action_spaces[agent]

    # The episode

    def reset(
        self, seed: Seed | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Start an episode.

        Args:
            seed: a number, a sequence of numbers or a SeedSequence. The same seed gives the same series of episodes,
                bit for bit; None goes on with the next episode of the present series.
            options: `{"state": saved}` goes on from a state of `save_state` instead, see `restore_state`. Others are
                ignored with a warning.

        Raises:
            ValueError: not a seed; both a seed and a state; options that are no dict.
        """
        if not isinstance(options, Mapping | None):
            raise ValueError(f"options must be a dict or None, got {options!r}")
        options = dict(options or {})
        saved = options.pop("state", None)
        if options:
            warnings.warn(f"unknown reset option {next(iter(options))!r} is ignored; there is 'state'", stacklevel=2)
        if saved is not None:
            if seed is not None:
                raise ValueError(f"a saved state goes on with its own random numbers: seed must be None, got {seed!r}")
            return self.restore_state(saved)
        if seed is not None:
            self._seeds = EpisodeSeeds.start(seed)
        episode_seed, self._seeds = self._seeds.next()
        world_rng, noise_rng, id_rng, camera_rng = (np.random.default_rng(s) for s in episode_seed.spawn(4))
        self.world.reset(world_rng)
        self.agents = list(self.possible_agents)
        snapshot = self._take_snapshot()
        n = len(self.agents)
        exposures = self._rig.begin(camera_rng)
        self._episode = Episode(
            noise_rng=noise_rng,
            id_rng=id_rng,
            exposures=exposures,
            steps=0,
            claims=[Claims.empty(self.max_detections, n - 1) for _ in self.agents],
            score=None,
            sums=np.zeros((n, N_SUMS)),
            totals=np.zeros((n, N_SUMS)),
            now=self._look(snapshot, exposures),
            before=None,
            trail=[snapshot.T_world_camera[:, :2, 3].copy()],
        )
        return self._observe(self._episode), self._infos(self._episode)

    def step(
        self, actions: dict[str, Any]
    ) -> tuple[dict[str, Any], dict[str, float], dict[str, bool], dict[str, bool], dict[str, Any]]:
        """Score the claims, move the world, observe.

        Raises:
            ValueError: an agent's action is missing or does not fit its space; the message names agent and leaf, and
                nothing has moved.
            RuntimeError: the episode is over or was never begun.
        """
        episode = self._running("step()")
        agents = self.agents
        if not agents:
            raise RuntimeError("the episode is over: call reset()")
        if not isinstance(actions, Mapping):
            raise ValueError(f"actions must be a dict by agent, got {type(actions).__name__}")
        missing = [a for a in agents if a not in actions]
        if missing:
            raise ValueError(f"{missing[0]}: no action given")
        unknown = [a for a in actions if a not in agents]
        if unknown:
            raise ValueError(f"{unknown[0]}: there is no such agent; there are {', '.join(agents)}")
        decoded = [decode(a, actions[a], self.action_spaces[a]) for a in agents]
        episode.claims = [claims for _, claims in decoded]
        episode.score = score(episode.claims, episode.now.truth)
        episode.sums = sums(episode.score)
        episode.totals = episode.totals + episode.sums
        reward = float(self.reward(episode.score))
        self.world.step(np.stack([control for control, _ in decoded]))
        episode.steps += 1
        snapshot = self._take_snapshot()
        episode.before, episode.now = episode.now, self._look(snapshot, episode.exposures, episode.steps, episode.now)
        episode.trail.append(snapshot.T_world_camera[:, :2, 3].copy())
        crashed = bool(self.world.ends_on_collision and snapshot.collided.any())
        over = episode.steps >= self.max_cycles
        observations, infos = self._observe(episode), self._infos(episode)
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

    def save_state(self) -> SavedState:
        """A copy of everything that changes; `restore_state` goes on from it bit-identically, any number of times.

        Raises:
            RuntimeError: before the first reset.
            NotImplementedError: this world cannot save its state.
        """
        episode = self._running("save_state()")
        save = getattr(self.world, "save_state", None)
        if save is None:
            raise NotImplementedError(f"{type(self.world).__name__} has no save_state()")
        return SavedState(self.name, save(), copy.deepcopy(episode), tuple(self.agents), self._seeds)

    def restore_state(self, saved: SavedState) -> tuple[dict[str, Any], dict[str, Any]]:
        """Go back to a state of `save_state`, of this environment or of one made with the same arguments.

        Returns:
            Observations and infos as they were returned then, for all robots even when the episode is over.

        Raises:
            ValueError: not a saved state of this scene.
        """
        if not isinstance(saved, SavedState) or saved.name != self.name:
            what = repr(saved.name) if isinstance(saved, SavedState) else type(saved).__name__
            raise ValueError(f"a state of {self.name!r} is needed, from its save_state(); got {what}")
        restore: Any = self.world
        restore.restore_state(saved.world)
        self._episode = copy.deepcopy(saved.episode)
        self._episode.rewind()
        self.agents, self._seeds = list(saved.agents), saved.seeds
        return self._observe(self._episode), self._infos(self._episode)

    def _running(self, caller: str) -> Episode:
        if self._episode is None:
            raise RuntimeError(f"reset() must be called before {caller}")
        return self._episode

    def _take_snapshot(self) -> Snapshot:
        snapshot = with_mounts(self.world.snapshot(), self.mounts)
        if len(snapshot.identity) > self.world.max_objects:
            raise RuntimeError(
                f"{self.name}: {len(snapshot.identity)} objects, max_objects is {self.world.max_objects}"
            )
        return snapshot

    def _look(self, snapshot: Snapshot, exposures: Exposures, step: int = 0, before: Instant | None = None) -> Instant:
        """Render an instant and note what is true; a camera that is not due keeps its picture of the instant before."""
        m = len(snapshot.identity)
        frames = self._shoot(snapshot, exposures, step, before)
        tight = [tight_boxes(frame.instances, m) for frame in frames]
        truth = Truth(
            identity=snapshot.identity,
            object_class=snapshot.object_class,
            positions=snapshot.positions,
            T_world_camera=snapshot.T_world_camera,
            boxes=np.stack([boxes for boxes, _ in tight]),
            pixels=np.stack([pixels for _, pixels in tight]),
            min_pixels=self.min_pixels,
        )
        return Instant(snapshot, frames, truth)

    def _shoot(
        self, snapshot: Snapshot, exposures: Exposures, step: int, before: Instant | None
    ) -> tuple[CameraFrame, ...]:
        seconds = self.world.step_seconds
        due = [i for i, m in enumerate(self.mounts) if before is None or m is None or m.is_due(step, seconds)]
        if before is None or len(due) == len(self.mounts):
            return self._rig.shoot(snapshot, exposures)
        frames = [kept_picture(frame, before.snapshot, snapshot) for frame in before.frames]
        for i, frame in zip(due, self._rig.shoot(snapshot, exposures, due), strict=True):
            frames[i] = frame
        return tuple(frames)

    def _observe(self, episode: Episode) -> dict[str, Any]:
        episode.mark()
        e = episode
        return {
            agent: self._observer.observe(i, e.now, e.before, e.claims, e.noise_rng, e.id_rng)
            for i, agent in enumerate(self.possible_agents)
        }

    def _infos(self, episode: Episode) -> dict[str, dict[str, float]]:
        """Figures of the last step's claims, and `episode_*` over the episode so far.

        Ratios and means of nothing are 0: counts tell them from others. (NaN is not equal to itself: it would break
        comparisons and poison the means that trainers log.)
        """
        collided = episode.now.snapshot.collided
        return {
            agent: {
                **figures(episode.sums[i], ""),
                **figures(episode.totals[i], "episode_"),
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
        return self._running("ground_truth()").now.truth

    def last_score(self) -> StepScore | None:
        """Scores of the claims of the last step; None before it."""
        return None if self._episode is None else self._episode.score

    def answered(self) -> Answered | None:
        """The last step's claims with the instant they were about; None before the first step."""
        episode = self._episode
        if episode is None or episode.before is None or episode.score is None:
            return None
        return Answered(episode.before, tuple(episode.claims), episode.score)

    def now(self) -> Instant:
        """The instant of the last observation, for evaluation. Raises RuntimeError before the first reset."""
        return self._running("now()").now

    def trail(self) -> NDArray[np.float64]:
        """Where the cameras were at each instant of the episode (t, N, 2), m. Raises like `now`."""
        return np.stack(self._running("trail()").trail)

    def snapshot(self) -> Snapshot:
        """The world at the instant of the last observation. Raises RuntimeError before the first reset."""
        return self._running("snapshot()").now.snapshot

    def camera_frames(self) -> list[CameraFrame]:
        """Rendered frames of the last observation, one per robot, instances by object index. Raises like `snapshot`."""
        return list(self._running("camera_frames()").now.frames)

    def cameras(self) -> tuple[CameraRig, Exposures]:
        """The rig that takes the pictures, and this episode's exposures, for measuring it alone."""
        return self._rig, self._running("cameras()").exposures

    def state(self) -> NDArray[np.float64]:
        """Global state: per object [present, class, x, y, z, vx, vy, vz, heading, length, width, height, identity],
        zero-padded to `max_objects`; then per robot T_world_camera row by row and its own state."""
        return state_vector(self.snapshot(), self.world.max_objects)

    # Pictures

    def render(self) -> NDArray[np.uint8] | None:
        """All cameras and a map (H, W, 3), see `ScenePainter.compose`; `human` shows it in a window instead."""
        if self.render_mode is None:
            return None
        from .render import ScenePainter, show

        self._running("render()")
        if self._painter is None:
            self._painter = ScenePainter(self)
        picture = self._painter.compose(self)
        if self.render_mode == "human":
            self._window = show(picture, self._window, self.name)
            return None
        return picture

    def close(self) -> None:
        self.world.close()
        self._rig.close()
        if self._window is not None:
            self._window.close()
            self._window = None


def _check_numbers(**numbers: Any) -> None:
    """Raises ValueError for the first that is no whole number, or too small."""
    for name, value in numbers.items():
        least = LEAST.get(name, 1)
        if not isinstance(value, (int, np.integer)) or value < least:
            raise ValueError(f"{name} must be a whole number >= {least}, got {value!r}")


def _check_parts(**parts: tuple[Any, type]) -> None:
    """Raises TypeError for the first that is neither None nor of its type."""
    for name, (part, kind) in parts.items():
        if part is not None and not isinstance(part, kind):
            raise TypeError(f"{name} must be a {kind.__name__} or None, got {part!r}")


def _check_choices(reward: Any, sensors: Any, render_mode: Any) -> None:
    """Raises TypeError for a reward that cannot be called, ValueError for sensors or a mode that do not exist."""
    if reward is not None and not callable(reward):
        raise TypeError(f"reward must be a function of a StepScore, or None, got {reward!r}")
    if isinstance(sensors, str) or not isinstance(sensors, Sequence):
        raise ValueError(f"sensors must be a sequence of names, got {sensors!r}")
    unknown = [s for s in sensors if s not in SENSORS]
    if unknown:
        raise ValueError(f"unknown sensor {unknown[0]!r}; there are {', '.join(SENSORS)}")
    if render_mode not in (None, "rgb_array", "human"):
        raise ValueError(f"render_mode must be 'rgb_array', 'human' or None, got {render_mode!r}")
