"""What of an environment changes from step to step, and its saved states."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .camera.rig import Exposures
from .claims import Claims
from .instant import Instant
from .scoring import StepScore
from .seeding import EpisodeSeeds


@dataclass(eq=False)
class Episode:
    """Everything of the environment itself that changes; a deep copy of it is its saved state.

    `sums` and `totals` (N, N_SUMS) are those of the last step and of the episode, see `figures.sums`; `trail` holds the
    cameras' places (N, 2) at each instant, m.
    """

    noise_rng: np.random.Generator
    id_rng: np.random.Generator
    exposures: Exposures
    steps: int
    claims: list[Claims]
    score: StepScore | None
    sums: NDArray[np.float64]
    totals: NDArray[np.float64]
    now: Instant
    before: Instant | None
    trail: list[NDArray[np.float64]]
    marked: tuple[Any, Any] | None = None

    def mark(self) -> None:
        """Remember the random numbers with which the observations are about to be made."""
        self.marked = self.noise_rng.bit_generator.state, self.id_rng.bit_generator.state

    def rewind(self) -> None:
        """Go back to the mark, so that the same observations can be made again."""
        assert self.marked is not None
        self.noise_rng.bit_generator.state, self.id_rng.bit_generator.state = self.marked


@dataclass(frozen=True, eq=False)
class SavedState:
    """A state of `CollaborativeEnv.save_state`; it can be pickled. Its contents are no interface."""

    name: str
    world: Any
    episode: Episode
    agents: tuple[str, ...]
    seeds: EpisodeSeeds
