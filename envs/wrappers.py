"""Environments in the forms that trainers want: flat observations and actions, discrete control, channels first.

All wrap a PettingZoo ParallelEnv of this package, or one another, and leave the agents, rewards and ends alone.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from pettingzoo.utils import BaseParallelWrapper

from .scoring import Truth

Observation = Any
Transform = Callable[[Observation], Observation]


class _Observations(BaseParallelWrapper):
    """Observations through a function, the same for every robot."""

    def __init__(self, env: Any, space: Callable[[spaces.Space], spaces.Space], transform: Transform) -> None:
        super().__init__(env)
        # Robots share one space; equal spaces stay one object.
        made: dict[int, spaces.Space] = {}
        given = {a: env.observation_space(a) for a in env.possible_agents}
        self._spaces = {a: made.setdefault(id(s), space(s)) for a, s in given.items()}
        self._transform = transform

    def observation_space(self, agent: str) -> spaces.Space:
        return self._spaces[agent]

    def reset(self, seed: Any = None, options: dict[str, Any] | None = None) -> Any:
        return self._changed(*self.env.reset(seed=seed, options=options))

    def restore_state(self, saved: Any) -> Any:
        """Go back to a state of `save_state`; see `CollaborativeEnv.restore_state`."""
        return self._changed(*self.env.restore_state(saved))

    def step(self, actions: dict[str, Any]) -> Any:
        return self._changed(*self.env.step(actions))

    def _changed(self, observations: dict[str, Any], *rest: Any) -> tuple[Any, ...]:
        return {a: self._transform(o) for a, o in observations.items()}, *rest


class SelectObservations(_Observations):
    """Only some leaves of the observations, e.g. without the privileged images that simulated eyes needed.

    Args:
        env: a ParallelEnv with Dict observations.
        keep: leaves to keep, in this order; None = all.
        drop: leaves to leave out.

    Raises:
        ValueError: a leaf that the observations do not have.
    """

    def __init__(self, env: Any, keep: Sequence[str] | None = None, drop: Sequence[str] = ()) -> None:
        there = _leaves(env)
        for name in [*(keep or ()), *drop]:
            if name not in there:
                raise ValueError(f"the observations have no leaf {name!r}; they have {', '.join(there)}")
        kept = tuple(name for name in (there if keep is None else keep) if name not in drop)
        super().__init__(
            env,
            lambda space: spaces.Dict([(name, space[name]) for name in kept]),
            lambda observation: {name: observation[name] for name in kept},
        )


class FlattenObservations(_Observations):
    """Observations as one float32 vector, leaves in the order of the space; or each leaf flat.

    Args:
        env: a ParallelEnv with Dict observations.
        single: one Box of all leaves; otherwise a Dict of one-dimensional leaves.
    """

    def __init__(self, env: Any, single: bool = True) -> None:
        names = tuple(_leaves(env))

        def flat(space: spaces.Box) -> spaces.Box:
            dtype = np.dtype(np.float32) if single else space.dtype
            return spaces.Box(space.low.ravel().astype(dtype), space.high.ravel().astype(dtype), dtype=dtype.type)

        def vector_space(space: Any) -> spaces.Box:
            parts = [flat(space[name]) for name in names]
            return spaces.Box(np.concatenate([p.low for p in parts]), np.concatenate([p.high for p in parts]))

        def vector(observation: Any) -> NDArray[np.float32]:
            return np.concatenate([np.ravel(observation[name]).astype(np.float32) for name in names])

        if single:
            super().__init__(env, vector_space, vector)
        else:
            super().__init__(
                env,
                lambda space: spaces.Dict([(name, flat(space[name])) for name in names]),
                lambda observation: {name: observation[name].ravel() for name in names},
            )


class ChannelFirst(_Observations):
    """Colour images as (3, H, W), as most networks want them. Raises ValueError where there is no image."""

    def __init__(self, env: Any) -> None:
        if "image" not in _leaves(env):
            raise ValueError(f"the observations have no 'image'; they have {', '.join(_leaves(env))}")

        def turned(space: Any) -> spaces.Dict:
            height, width, channels = space["image"].shape
            image = spaces.Box(0, 255, (channels, height, width), np.uint8)
            return spaces.Dict([(name, image if name == "image" else leaf) for name, leaf in space.items()])

        super().__init__(
            env,
            turned,
            lambda o: o | {"image": np.ascontiguousarray(np.moveaxis(o["image"], -1, 0))},
        )


class _Actions(BaseParallelWrapper):
    """Actions through a function that gets (agent, action), the same for every robot."""

    def __init__(self, env: Any, space: Callable[[Any], spaces.Space], transform: Callable[[str, Any], Any]) -> None:
        super().__init__(env)
        # Every robot has a space object of its own, as trainers seed them one by one.
        self._spaces = {a: space(env.action_space(a)) for a in env.possible_agents}
        self._transform = transform

    def action_space(self, agent: str) -> spaces.Space:
        return self._spaces[agent]

    def step(self, actions: dict[str, Any]) -> Any:
        return self.env.step({a: self._transform(a, action) for a, action in actions.items()})


class FlattenActions(_Actions):
    """A Dict action as one Box in [-1, 1]: numbers scaled to their bounds, choices cut into equal intervals.

    Claims can be learned this way in principle; `covis.agents.LocalizeWrapper` is for policies that only move.
    """

    def __init__(self, env: Any) -> None:
        first = env.action_space(env.possible_agents[0])
        if not isinstance(first, spaces.Dict):
            raise ValueError(f"only Dict actions can be flattened, these are {type(first).__name__}")
        sizes = [int(np.prod(leaf.shape or ())) for leaf in first.values()]
        ends = np.cumsum(sizes)
        box = spaces.Box(-1.0, 1.0, (int(ends[-1]),), np.float32)

        def unflat(agent: str, action: Any) -> dict[str, Any]:
            value = _vector(agent, action, box)
            parts = np.split(value, ends[:-1])
            return {name: _scaled(part, leaf) for part, (name, leaf) in zip(parts, first.items(), strict=True)}

        super().__init__(env, lambda _: spaces.Box(-1.0, 1.0, box.shape, np.float32), unflat)


class DiscreteControl(_Actions):
    """Each control out of `levels` values evenly spaced over [-1, 1].

    Args:
        env: a ParallelEnv whose actions are controls (a Box), or Dicts with a leaf `control`.
        levels: values per control; an odd number has zero among them.
        joint: one number for all controls together (Discrete, as Q-learning needs) instead of one each (MultiDiscrete).

    Raises:
        ValueError: fewer than two levels, or actions without controls.
    """

    def __init__(self, env: Any, levels: int = 3, joint: bool = False) -> None:
        if not isinstance(levels, (int, np.integer)) or levels < 2:
            raise ValueError(f"levels must be a whole number >= 2, got {levels}")
        first = env.action_space(env.possible_agents[0])
        within_dict = isinstance(first, spaces.Dict)
        control = first["control"] if within_dict else first
        if not (isinstance(control, spaces.Box) and control.shape and len(control.shape) == 1):
            raise ValueError(f"the actions hold no controls to choose from: {first}")
        d = control.shape[0]
        values = np.linspace(-1, 1, levels).astype(np.float32)

        def choice() -> spaces.Space:
            return spaces.Discrete(int(levels) ** d) if joint else spaces.MultiDiscrete(np.full(d, levels))

        known = choice()

        def chosen(agent: str, action: Any) -> NDArray[np.float32]:
            picks = np.asarray(action)
            if picks.dtype.kind not in "iu" or picks.shape != known.shape or not known.contains(picks.astype(np.int64)):
                raise ValueError(f"{agent}: leaf 'control' must be in {known}, got {action!r}")
            return values[np.array(np.unravel_index(int(picks), (levels,) * d))] if joint else values[picks]

        def space(given: Any) -> spaces.Space:
            if not within_dict:
                return choice()
            return spaces.Dict([(name, choice() if name == "control" else leaf) for name, leaf in given.items()])

        def transform(agent: str, action: Any) -> Any:
            if not within_dict:
                return chosen(agent, action)
            if not isinstance(action, dict) or "control" not in action:
                raise ValueError(f"{agent}: leaf 'control' is missing")
            return action | {"control": chosen(agent, action["control"])}

        super().__init__(env, space, transform)


class GroundTruthInfo(BaseParallelWrapper):
    """The truth in `infos`, in arrays of fixed shape; for training on privileged knowledge and for evaluation.

    Added to every robot's info, m = the scene's `max_objects`, rows of absent objects zero:
    `truth_present (m,)`, `truth_identity (m,)`, `truth_class (m,)`, `truth_positions (m, 3)` m in this robot's camera
    frame, `truth_boxes (m, 4)` and `truth_pixels (m,)` in its image, `truth_pose (4, 4)` T_world_camera.
    """

    def reset(self, seed: Any = None, options: dict[str, Any] | None = None) -> Any:
        return self._told(*self.env.reset(seed=seed, options=options))

    def restore_state(self, saved: Any) -> Any:
        """Go back to a state of `save_state`; see `CollaborativeEnv.restore_state`."""
        return self._told(*self.env.restore_state(saved))

    def step(self, actions: dict[str, Any]) -> Any:
        return self._told(*self.env.step(actions))

    def _told(self, *results: Any) -> tuple[Any, ...]:
        *rest, infos = results
        env: Any = self.env.unwrapped
        truth, size = env.ground_truth(), env.world.max_objects
        told = {a: infos[a] | truth_info(truth, i, size) for i, a in enumerate(env.possible_agents)}
        return *rest, infos | told


def truth_info(truth: Truth, robot: int, size: int) -> dict[str, NDArray[Any]]:
    """What `GroundTruthInfo` adds for one robot, padded to `size` objects."""
    m = len(truth.identity)

    def padded(values: NDArray[Any]) -> NDArray[Any]:
        out = np.zeros((size, *values.shape[1:]), values.dtype)
        out[:m] = values
        return out

    return {
        "truth_present": padded(np.ones(m, dtype=np.int64)),
        "truth_identity": padded(truth.identity),
        "truth_class": padded(truth.object_class),
        "truth_positions": padded(truth.positions_in_camera(robot)),
        "truth_boxes": padded(truth.boxes[robot]),
        "truth_pixels": padded(truth.pixels[robot]),
        "truth_pose": truth.T_world_camera[robot].copy(),
    }


def _leaves(env: Any) -> dict[str, spaces.Space]:
    space = env.observation_space(env.possible_agents[0])
    if not isinstance(space, spaces.Dict):
        raise ValueError(f"Dict observations are needed, these are {type(space).__name__}")
    return dict(space.items())


def _vector(agent: str, action: Any, box: spaces.Box) -> NDArray[np.float64]:
    value = np.asarray(action)
    if value.dtype.kind not in "fiu" or value.shape != box.shape:
        raise ValueError(f"{agent}: the action must be numbers of shape {box.shape}, got {value.dtype} {value.shape}")
    inside = (value >= -1) & (value <= 1)  # which NaN is not
    if not inside.all():
        bad = int(np.argmin(inside))
        raise ValueError(f"{agent}: the action holds {value[bad]} at {bad}, outside [-1, 1]")
    return value.astype(np.float64)


def _scaled(part: NDArray[np.float64], leaf: Any) -> NDArray[Any]:
    share = 0.5 * (part + 1)
    if isinstance(leaf, spaces.MultiDiscrete):
        return np.minimum((share * leaf.nvec).astype(np.int64), leaf.nvec - 1)
    low, high = leaf.low.astype(np.float64), leaf.high.astype(np.float64)
    return np.clip((low + share * (high - low)).astype(np.float32), leaf.low, leaf.high)
