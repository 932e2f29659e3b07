"""Seeds of episodes: a number, a sequence of numbers or a SeedSequence starts a reproducible series of episodes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

Seed = int | Sequence[int] | np.random.SeedSequence
"""What may seed an environment."""


@dataclass(frozen=True)
class EpisodeSeeds:
    """Where a series of episodes stands; equal values give equal episodes.

    Attributes:
        root: the seed as NumPy keeps it; never spawned from, so that the caller's own use of it stays independent.
        episode: number of the next episode of the series.
    """

    root: np.random.SeedSequence
    episode: int = 0

    @classmethod
    def start(cls, seed: Seed | None) -> EpisodeSeeds:
        """The series of `seed`; of None a new one every time.

        Raises:
            ValueError: not a seed.
        """
        if isinstance(seed, np.random.SeedSequence):
            return cls(seed)
        try:
            return cls(np.random.SeedSequence(seed))
        except (TypeError, ValueError) as error:
            message = f"a seed is a whole number >= 0, a sequence of such numbers or a SeedSequence, got {seed!r}"
            raise ValueError(message) from error

    def next(self) -> tuple[np.random.SeedSequence, EpisodeSeeds]:
        """The seed of the next episode, and where the series stands after it."""
        # What SeedSequence.spawn would give, without writing into the caller's sequence.
        child = np.random.SeedSequence(self.root.entropy, spawn_key=(*self.root.spawn_key, self.episode))
        return child, EpisodeSeeds(self.root, self.episode + 1)
