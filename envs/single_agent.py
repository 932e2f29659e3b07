"""Gymnasium views of a team: one robot learns among the others, or one policy moves them all."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

from .seeding import Seed
from .worlds.world import Array, World

Others = str | Callable[[World], Array]


class _View(gymnasium.Env):
    """What both views share: one Gymnasium environment around a ParallelEnv."""

    def __init__(self, env: Any) -> None:
        self.env = env
        base = env.unwrapped
        self.metadata = {"render_modes": base.metadata["render_modes"], "render_fps": base.metadata["render_fps"]}
        self.render_mode = base.render_mode
        self.robots = tuple(env.possible_agents)

    @property
    def parallel(self) -> Any:
        """The innermost ParallelEnv, with the world and the truth."""
        return self.env.unwrapped

    def reset(self, *, seed: Seed | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Start an episode; seeds and options are those of `CollaborativeEnv.reset`."""
        super().reset(seed=int(seed) if isinstance(seed, (int, np.integer)) else None)
        observations, infos = self.env.reset(seed=seed, options=options or None)
        return self._seen(observations), self._told(infos)

    def _stepped(self, actions: dict[str, Any]) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        observations, rewards, terminated, truncated, infos = self.env.step(actions)
        reward = float(np.mean([rewards[a] for a in self._learners()]))
        first = self._learners()[0]
        return self._seen(observations), reward, terminated[first], truncated[first], self._told(infos)

    def _learners(self) -> tuple[str, ...]:
        raise NotImplementedError

    def _seen(self, observations: dict[str, Any]) -> Any:
        raise NotImplementedError

    def _told(self, infos: dict[str, Any]) -> dict[str, Any]:
        raise NotImplementedError

    def render(self) -> Any:
        return self.env.render()

    def close(self) -> None:
        self.env.close()


class RobotView(_View):
    """One robot learns; the others follow a script.

    Args:
        env: a ParallelEnv of this package; its observations and actions are those of the learner.
        robot: the learner.
        others: `"repeat"` the learner's action, `"idle"`, or a function of the world that gives the controls (N, d) of
            all robots. Idle and scripted robots claim nothing, unless a `LocalizeWrapper` claims for all.

    Raises:
        ValueError: no such robot; others that are none of these, or a script where actions are not controls.
    """

    def __init__(self, env: Any, robot: str = "robot_0", others: Others = "idle") -> None:
        super().__init__(env)
        if robot not in self.robots:
            raise ValueError(f"there is no robot {robot!r}; there are {', '.join(self.robots)}")
        if others not in ("repeat", "idle") and not callable(others):
            raise ValueError(f"others must be 'repeat', 'idle' or a function of the world, got {others!r}")
        self.robot, self.others = robot, others
        self.observation_space = env.observation_space(robot)
        self.action_space = env.action_space(robot)
        self._nothing = None if others == "repeat" else _nothing(env.action_space(robot))

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """The learner's action and the others' own. Raises as `CollaborativeEnv.step`."""
        return self._stepped(self._others(action) | {self.robot: action})

    def _others(self, action: Any) -> dict[str, Any]:
        names = [a for a in self.robots if a != self.robot]
        if self.others == "repeat":
            return dict.fromkeys(names, action)
        if not callable(self.others):
            return dict.fromkeys(names, self._nothing)
        controls = np.clip(self.others(self.parallel.world), -1, 1).astype(np.float32)
        rows = {a: controls[self.robots.index(a)] for a in names}
        if isinstance(self._nothing, dict):
            return {a: self._nothing | {"control": row} for a, row in rows.items()}
        return rows

    def _learners(self) -> tuple[str, ...]:
        return (self.robot,)

    def _seen(self, observations: dict[str, Any]) -> Any:
        return observations[self.robot]

    def _told(self, infos: dict[str, Any]) -> dict[str, Any]:
        return infos[self.robot]


class TeamView(_View):
    """One policy moves the whole team: actions end to end in one Box, observations of all robots stacked.

    Observations are the robots' own with one axis more in front, (N, ...), leaf by leaf; infos are flat,
    `robot_0/n_correct` and so on.

    Args:
        env: a ParallelEnv of this package whose actions are flat (of `LocalizeWrapper`, `FlattenActions`, ...).

    Raises:
        ValueError: the actions are not flat.
    """

    def __init__(self, env: Any) -> None:
        super().__init__(env)
        self.observation_space = _stacked_space(env.observation_space(self.robots[0]), len(self.robots))
        one, n = env.action_space(self.robots[0]), len(self.robots)
        if isinstance(one, spaces.Box) and one.shape and len(one.shape) == 1:
            self.action_space: spaces.Space = spaces.Box(np.tile(one.low, n), np.tile(one.high, n), dtype=np.float32)
        elif isinstance(one, spaces.MultiDiscrete):
            self.action_space = spaces.MultiDiscrete(np.tile(one.nvec, n))
        else:
            raise ValueError(f"a team's actions must be flat: wrap with LocalizeWrapper or FlattenActions; got {one}")

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """The actions of all robots, end to end. Raises as `CollaborativeEnv.step`."""
        joint = np.asarray(action)
        if joint.shape != self.action_space.shape:
            raise ValueError(f"the team's action must have shape {self.action_space.shape}, got {joint.shape}")
        return self._stepped(dict(zip(self.robots, np.split(joint, len(self.robots)), strict=True)))

    def _learners(self) -> tuple[str, ...]:
        return self.robots

    def _seen(self, observations: dict[str, Any]) -> Any:
        return _stacked([observations[a] for a in self.robots])

    def _told(self, infos: dict[str, Any]) -> dict[str, Any]:
        return {f"{a}/{key}": value for a in self.robots for key, value in infos[a].items()}


def _nothing(space: spaces.Space) -> Any:
    """The action of a robot that stands still and claims nothing."""
    if isinstance(space, spaces.Dict):
        K = space["position_variance"].shape[0]
        zeros = {name: np.zeros(leaf.shape or (), leaf.dtype) for name, leaf in space.items()}
        return zeros | {"matches": np.full(space["matches"].shape or (), K, dtype=np.int64)}
    if isinstance(space, spaces.Box):
        return np.zeros(space.shape, np.float32)
    raise ValueError(f"others cannot stand still with actions {space}: let them repeat, or give them Box controls")


def _stacked_space(space: spaces.Space, n: int) -> spaces.Space:
    if isinstance(space, spaces.Dict):
        return spaces.Dict([(name, _stacked_space(leaf, n)) for name, leaf in space.items()])
    assert isinstance(space, spaces.Box)
    low, high = (np.repeat(bound[None], n, axis=0) for bound in (space.low, space.high))
    return spaces.Box(low, high, dtype=space.dtype.type)


def _stacked(observations: list[Any]) -> Any:
    if isinstance(observations[0], dict):
        return {name: np.stack([o[name] for o in observations]) for name in observations[0]}
    return np.stack(observations)
