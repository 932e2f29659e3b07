"""Intervals and comparisons: the episode is the unit, because frames of one episode are near copies."""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..matching.metrics import Counts

Array = NDArray[np.float64]
SAMPLES = 2000
EXACT_UP_TO = 12
"""Episodes up to which the permutation test goes through every exchange."""
PERMUTATIONS = 10_000
LEVEL = 0.95


def bootstrap_f1(
    episodes: Sequence[Hashable], counts: Sequence[Counts], samples: int = SAMPLES, level: float = LEVEL, seed: int = 0
) -> tuple[float, float]:
    """Percentile interval of the pooled F1 over resampled episodes; (0, 0) without data."""
    return bootstrap_interval(episode_sums(episodes, counts), samples, level, seed)


def bootstrap_interval(
    sums: Mapping[Hashable, Array], samples: int = SAMPLES, level: float = LEVEL, seed: int = 0
) -> tuple[float, float]:
    """The same from `episode_sums`."""
    if not sums:
        return 0.0, 0.0
    f1 = _f1(_resamples(len(sums), samples, seed) @ np.array(list(sums.values())))
    low, high = np.quantile(f1, [(1 - level) / 2, (1 + level) / 2])
    return float(low), float(high)


def bootstrap_mean(
    values: ArrayLike, samples: int = SAMPLES, level: float = LEVEL, seed: int = 0
) -> tuple[float, float]:
    """Percentile interval of the mean of one value per episode (n,)."""
    x = np.asarray(values, dtype=np.float64)
    means = _resamples(len(x), samples, seed) @ x / len(x)
    low, high = np.quantile(means, [(1 - level) / 2, (1 + level) / 2])
    return float(low), float(high)


def episode_sums(episodes: Sequence[Hashable], counts: Sequence[Counts]) -> dict[Hashable, Array]:
    """Correct, retrieved and common (3,) of each episode."""
    sums: dict[Hashable, Array] = {}
    for episode, c in zip(episodes, counts, strict=True):
        sums[episode] = sums.get(episode, np.zeros(3)) + (c.correct, c.retrieved, c.common)
    return sums


@dataclass(frozen=True)
class Difference:
    """Pooled F1 of one method less that of another on the same episodes.

    Attributes:
        value: the difference.
        low, high: 95 % interval, by a paired bootstrap over episodes.
        p_value: two-sided, of a permutation test that exchanges the two methods within episodes; it cannot fall below
            2 / 2^n with n episodes, so that five episodes or fewer never make a winner.
        episodes: n.
    """

    value: float
    low: float
    high: float
    p_value: float
    episodes: int

    @property
    def noise(self) -> bool:
        """Neither is ahead of the other by more than chance explains."""
        return self.p_value >= 1 - LEVEL or self.low <= 0.0 <= self.high


def paired_difference(
    own: Mapping[Hashable, Array], other: Mapping[Hashable, Array], samples: int = SAMPLES, seed: int = 0
) -> Difference:
    """F1 of `own` less that of `other`, both as `episode_sums` of the same episodes.

    Raises:
        ValueError: different episodes, or none.
    """
    if own.keys() != other.keys() or not own:
        raise ValueError(f"need the same episodes of both, got {len(own)} and {len(other)}")
    a, b = np.array(list(own.values())), np.array([other[episode] for episode in own])
    weights = _resamples(len(a), samples, seed)
    low, high = np.quantile(_f1(weights @ a) - _f1(weights @ b), [(1 - LEVEL) / 2, (1 + LEVEL) / 2])
    value = float(_f1(a.sum(axis=0)) - _f1(b.sum(axis=0)))
    return Difference(value, float(low), float(high), _permutation_p(a, b, seed), len(a))


def _permutation_p(a: Array, b: Array, seed: int) -> float:
    """How often exchanging the methods within episodes makes a difference at least as large; a, b (n, 3)."""
    n = len(a)
    if n <= EXACT_UP_TO:
        swaps = (np.arange(2**n)[:, None] >> np.arange(n)) & 1
    else:
        # The first is the identity: the observed difference is one of the possible ones.
        swaps = np.random.default_rng(seed).integers(0, 2, (PERMUTATIONS, n))
        swaps[0] = 0
    moved = swaps @ (b - a)
    differences = np.abs(_f1(a.sum(axis=0) + moved) - _f1(b.sum(axis=0) - moved))
    return float(np.mean(differences >= differences[0] - 1e-12))


def _resamples(n: int, samples: int, seed: int) -> Array:
    """(samples, n) how often each of n episodes is drawn."""
    return np.random.default_rng(seed).multinomial(n, np.full(n, 1.0 / n), size=samples).astype(np.float64)


def _f1(sums: Array) -> Array:
    """F1 of correct, retrieved and common (..., 3); 0 where there is nothing."""
    total = sums[..., 1] + sums[..., 2]
    return np.divide(2 * sums[..., 0], total, out=np.zeros_like(total), where=total > 0)
