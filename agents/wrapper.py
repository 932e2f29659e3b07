"""A policy that only moves: the localizer fills the claims."""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
from gymnasium import spaces
from pettingzoo.utils import BaseParallelWrapper

from ..envs.claims import Claims, claims_to_action
from ..envs.seeding import EpisodeSeeds, Seed
from .localizer import Localizer

STREAM_KEY = 101
"""Last word of the localizer's spawn key within an episode's seed."""


class LocalizeWrapper(BaseParallelWrapper):
    """Actions shrink to `control` (a Box); the localizer's claims about the last observation go with them.

    What is random in the localizer's eyes and matcher is seeded with the episodes: same seed, same episode.

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
        self._control_spaces = {a: env.action_space(a)["control"] for a in env.possible_agents}
        self._seeds = EpisodeSeeds.start(None)
        self._rng: np.random.Generator | None = None
        self._claims: list[Claims] = []

    @property
    def claims(self) -> dict[str, Claims]:
        """What every robot is about to claim of the last observation: a policy may look at it. Empty before a reset."""
        return dict(zip(self.env.possible_agents, self._claims, strict=False))

    def action_space(self, agent: str) -> spaces.Space:
        return self._control_spaces[agent]

    def reset(self, seed: Seed | None = None, options: dict[str, Any] | None = None) -> Any:
        """Like the environment's; `options={"state": saved}` takes a state of this wrapper's `save_state`."""
        if options and "state" in options:
            if seed is not None:
                raise ValueError(f"a saved state goes on with its own random numbers: seed must be None, got {seed!r}")
            return self.restore_state(options["state"])
        observations, infos = self.env.reset(seed=seed, options=options)
        if seed is not None:
            self._seeds = EpisodeSeeds.start(seed)
        episode, self._seeds = self._seeds.next()
        # The environment spawns from the episode's seed itself: a key of our own keeps the two streams apart.
        self._rng = np.random.default_rng(
            np.random.SeedSequence(episode.entropy, spawn_key=(*episode.spawn_key, STREAM_KEY))
        )
        self._localize(observations)
        return observations, infos

    def _localize(self, observations: dict[str, Any]) -> None:
        assert self._rng is not None
        self._claims = self.localizer.localize([observations[a] for a in self.env.possible_agents], self._rng)

    def step(self, actions: dict[str, Any]) -> Any:
        """Claim what the localizer made of the last observation, move, and localize on the next.

        Raises:
            ValueError: a control is missing or does not fit; the message names the agent.
            RuntimeError: before the first reset, or the episode is over.
        """
        agents = list(self.env.agents)
        if self._rng is None or not agents:
            return self.env.step(actions)  # which says what is wrong
        missing = [a for a in agents if a not in actions]
        if missing:
            raise ValueError(f"{missing[0]}: no action given")
        # The control goes through as it came: the environment says what is wrong with it.
        full = {a: claims_to_action(c, ()) | {"control": actions[a]} for a, c in zip(agents, self._claims, strict=True)}
        result = self.env.step(full)
        self._localize(result[0])
        return result

    def save_state(self) -> Any:
        """The environment's state, the localizer's random numbers and claims; see `CollaborativeEnv.save_state`."""
        return self.env.save_state(), copy.deepcopy(self._rng), self._seeds, list(self._claims)

    def restore_state(self, saved: Any) -> Any:
        """Go back to a state of `save_state`; returns observations and infos as they were returned then.

        Raises:
            ValueError: not a state that this wrapper saved.
        """
        if not (isinstance(saved, tuple) and len(saved) == 4):
            raise ValueError(f"a state from this wrapper's save_state() is needed, got {type(saved).__name__}")
        state, rng, self._seeds, claims = saved
        observations, infos = self.env.restore_state(state)
        self._rng, self._claims = copy.deepcopy(rng), list(claims)
        return observations, infos
