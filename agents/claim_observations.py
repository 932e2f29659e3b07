"""What a policy that only moves needs to know, as one short vector: its partners, and what the team sees."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from pettingzoo.utils import BaseParallelWrapper

from ..envs.claims import Claims
from ..matching.pose import Array, invert, transform
from .wrapper import LocalizeWrapper

PARTNER_COLUMNS = 5
OBJECT_COLUMNS = 6
BOUND = 5.0


class ClaimObservations(BaseParallelWrapper):
    """Observations become vectors made of the robots' poses and of the localizer's claims; images are left out.

    Everything is in the robot's own level frame: x to where its camera's upper edge or, level, its view points, y to
    the left, z up. Lengths are divided by `scale_m`; every number is clipped to [-5, 5].

    - the robot's own `state`;
    - per partner, in ascending order: offset (3,), cosine and sine of its relative heading, from the reported poses;
    - per object, the nearest first: 1, offset (3,) of the fused estimate, its standard deviation, and whether it is
      matched with a detection of a partner; zeros where there are fewer.

    Args:
        env: a `LocalizeWrapper`.
        n_objects: objects in the vector.
        scale_m: unit of lengths.

    Raises:
        ValueError: another environment; fewer than one object; a scale that is not positive.
    """

    def __init__(self, env: LocalizeWrapper, n_objects: int = 8, scale_m: float = 10.0) -> None:
        if not isinstance(env, LocalizeWrapper):
            raise ValueError(f"claims come from a LocalizeWrapper, got {type(env).__name__}")
        if n_objects < 1 or not scale_m > 0:
            raise ValueError(f"n_objects must be at least 1 and scale_m positive, got {n_objects} and {scale_m}")
        super().__init__(env)
        self.n_objects, self.scale_m = n_objects, scale_m
        agents = env.possible_agents
        state = env.observation_space(agents[0])["state"].shape[0]
        size = state + PARTNER_COLUMNS * (len(agents) - 1) + OBJECT_COLUMNS * n_objects
        space = spaces.Box(-BOUND, BOUND, (size,), np.float32)
        self._spaces = dict.fromkeys(agents, space)

    def observation_space(self, agent: str) -> spaces.Space:
        return self._spaces[agent]

    def reset(self, seed: Any = None, options: dict[str, Any] | None = None) -> Any:
        observations, infos = self.env.reset(seed=seed, options=options)
        return self._vectors(observations), infos

    def restore_state(self, saved: Any) -> Any:
        """Go back to a state of `save_state`; see `LocalizeWrapper.restore_state`."""
        observations, infos = self.env.restore_state(saved)
        return self._vectors(observations), infos

    def step(self, actions: dict[str, Any]) -> Any:
        observations, *rest = self.env.step(actions)
        return self._vectors(observations), *rest

    def _vectors(self, observations: dict[str, Any]) -> dict[str, NDArray[np.float32]]:
        claims = self.env.claims
        frames = {a: level_frame(np.asarray(o["pose"], dtype=np.float64)) for a, o in observations.items()}
        out = {}
        for agent, observation in observations.items():
            partners = [frames[b] for b in observations if b != agent]
            pose = np.asarray(observation["pose"], dtype=np.float64)
            parts = [
                np.asarray(observation["state"], dtype=np.float64),
                self._partners(frames[agent], partners),
                self._objects(frames[agent], pose, claims[agent]),
            ]
            out[agent] = np.clip(np.concatenate(parts), -BOUND, BOUND).astype(np.float32)
        return out

    def _partners(self, own: Array, partners: list[Array]) -> Array:
        rows = np.zeros((len(partners), PARTNER_COLUMNS))
        for row, T in zip(rows, partners, strict=True):
            relative = invert(own) @ T
            row[:3] = relative[:3, 3] / self.scale_m
            row[3:] = relative[0, 0], relative[1, 0]
        return rows.ravel()

    def _objects(self, own: Array, pose: Array, claims: Claims) -> Array:
        seen = np.flatnonzero(claims.filled())
        nearest = seen[np.argsort(np.linalg.norm(claims.positions[seen], axis=1), kind="stable")][: self.n_objects]
        rows = np.zeros((self.n_objects, OBJECT_COLUMNS))
        n = len(nearest)
        rows[:n, 0] = 1.0
        rows[:n, 1:4] = transform(invert(own) @ pose, claims.positions[nearest]) / self.scale_m
        rows[:n, 4] = np.sqrt(claims.position_variance[nearest]) / self.scale_m
        rows[:n, 5] = (claims.matches[:, nearest] < claims.matches.shape[1]).any(axis=0)
        return rows.ravel()


def level_frame(T_world_camera: Array) -> Array:
    """T_world_level (4, 4): at the camera's place, x perpendicular to the camera's right in the ground plane, z up."""
    right = T_world_camera[:2, 0]
    x = np.array([-right[1], right[0]]) / max(float(np.hypot(*right)), 1e-9)
    T = np.eye(4)
    T[:2, 0], T[:2, 1] = x, (-x[1], x[0])
    T[:3, 3] = T_world_camera[:3, 3]
    return T
