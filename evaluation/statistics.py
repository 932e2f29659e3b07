"""Intervals: the episode is the unit, because frames of one episode are near copies."""

from __future__ import annotations

from collections.abc import Hashable, Sequence

import numpy as np

from ..matching.metrics import Counts


def bootstrap_f1(
    episodes: Sequence[Hashable], counts: Sequence[Counts], samples: int = 2000, level: float = 0.95, seed: int = 0
) -> tuple[float, float]:
    """Percentile interval of the pooled F1 over resampled episodes; (0, 0) without data."""
    if not counts:
        return 0.0, 0.0
    numbers: dict[Hashable, int] = {}
    group = [numbers.setdefault(episode, len(numbers)) for episode in episodes]
    n = len(numbers)
    sums = np.zeros((n, 3))
    np.add.at(sums, group, np.array([(c.correct, c.retrieved, c.common) for c in counts], dtype=float))
    rng = np.random.default_rng(seed)
    weights = rng.multinomial(n, np.full(n, 1.0 / n), size=samples)
    correct, retrieved, common = (weights @ sums).T
    total = retrieved + common
    f1 = np.divide(2 * correct, total, out=np.zeros(samples), where=total > 0)
    low, high = np.quantile(f1, [(1 - level) / 2, (1 + level) / 2])
    return float(low), float(high)
