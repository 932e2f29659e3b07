"""A policy that only moves: the localizer fills the claims."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import spaces
from pettingzoo.utils import BaseParallelWrapper

from ..envs.claims import claims_to_action
from .localizer import Localizer


class LocalizeWrapper(BaseParallelWrapper):
    """Actions shrink to `control` (a Box); the localizer's claims about the last observation go with them.

    Args:
        env: a `CollaborativeEnv`, with the sensors that the localizer's perceptor reads.
        localizer: perceptor, matcher and fuser of the team.

    Raises:
        ValueError: the localizer's `max_detections` is not the environment's.
    """

    def __init__(self, env: Any, localizer: Localizer) -> None:
        super().__init__(env)
        slots = env.unwrapped.max_detections
        if localizer.max_detections != slots:
            raise ValueError(f"the localizer has {localizer.max_detections} slots, the environment {slots}")
        self.localizer = localizer
        self._control_spaces = {a: self._control_space(env.action_space(a)) for a in env.possible_agents}

    @staticmethod
    def _control_space(space: spaces.Dict) -> spaces.Space:
        return space["control"]

    def action_space(self, agent: str) -> spaces.Space:
        return self._control_spaces[agent]

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        observations, infos = self.env.reset(seed=seed, options=options)
        self._rng = np.random.default_rng(seed)
        self._observations = observations
        return observations, infos

    def step(self, actions: dict[str, Any]) -> Any:
        agents = list(self.env.agents)
        claims = self.localizer.localize([self._observations[a] for a in agents], self._rng)
        full = {a: claims_to_action(c, actions[a]) for a, c in zip(agents, claims, strict=True)}
        result = self.env.step(full)
        self._observations = result[0]
        return result
