"""Precision, recall and calibration of matchings (section 4.1)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .graph import Matching
from .pose import Array


@dataclass(frozen=True)
class Counts:
    """Counts pool over pairs of views; ratios do not.

    `correct` matches of two detections with the same identity; `retrieved` matches in all; `common` objects that both
    views detected.
    """

    correct: int = 0
    retrieved: int = 0
    common: int = 0

    def __add__(self, other: Counts) -> Counts:
        return Counts(self.correct + other.correct, self.retrieved + other.retrieved, self.common + other.common)

    @property
    def precision(self) -> float:
        """0 when nothing was retrieved."""
        return self.correct / self.retrieved if self.retrieved else 0.0

    @property
    def recall(self) -> float:
        """0 when there was nothing to find."""
        return self.correct / self.common if self.common else 0.0

    @property
    def f1(self) -> float:
        """Harmonic mean of precision and recall; 0 when there was nothing on either side."""
        total = self.retrieved + self.common
        return 2 * self.correct / total if total else 0.0


def f1_per_pair(counts: NDArray[np.int64]) -> float:
    """F1 of each pair of views, averaged; counts (pairs, 3) of correct, retrieved and common matches.

    Unlike pooled F1, a pair of few objects weighs as much as one of many. Pairs that share nothing and of which nothing
    was claimed say nothing about F1 and are left out; NaN if there is no other.
    """
    total = counts[:, 1] + counts[:, 2]
    said = total > 0
    return float((2 * counts[said, 0] / total[said]).mean()) if said.any() else float("nan")


def is_correct(
    matching: Matching, source_identity: NDArray[np.int64], target_identity: NDArray[np.int64]
) -> NDArray[np.bool_]:
    """For each match (k,), whether both detections are the same true object; a negative identity is never correct."""
    a = source_identity[matching.pairs[:, 0]]
    b = target_identity[matching.pairs[:, 1]]
    return (a == b) & (a >= 0)


def count(matching: Matching, source_identity: NDArray[np.int64], target_identity: NDArray[np.int64]) -> Counts:
    """Counts of one pair of views; identities (n,), (n',), negative = not a true object."""
    source, target = np.unique(source_identity), np.unique(target_identity)
    common = np.intersect1d(source[source >= 0], target[target >= 0])
    correct = is_correct(matching, source_identity, target_identity)
    return Counts(int(correct.sum()), len(matching), len(common))


@dataclass(frozen=True)
class ReliabilityBin:
    """One bin of a reliability curve: mean score, share that was correct, number of matches."""

    score: float
    accuracy: float
    n: int


def reliability(scores: Array, correct: NDArray[np.bool_], bins: int = 10) -> list[ReliabilityBin]:
    """Reliability curve over bins of equal mass, by ascending score; scores (k,) in [0, 1], correct (k,)."""
    order = np.argsort(scores, kind="stable")
    chunks = [chunk for chunk in np.array_split(order, bins) if len(chunk)]
    return [ReliabilityBin(float(scores[c].mean()), float(correct[c].mean()), len(c)) for c in chunks]


def expected_calibration_error(scores: Array, correct: NDArray[np.bool_], bins: int = 10) -> float:
    """Expected calibration error over bins of equal mass, debiased; NaN without matches.

    The gap of a bin is the square root of its squared gap less the variance that `n` draws would show by chance
    (after Kumar, Liang and Ma 2019), so that a calibrated matcher with few matches is not punished.
    """
    if len(scores) == 0:
        return float("nan")
    total = 0.0
    for b in reliability(scores, correct, bins):
        chance = b.accuracy * (1 - b.accuracy) / (b.n - 1) if b.n > 1 else 0.0
        total += b.n * np.sqrt(max(0.0, (b.score - b.accuracy) ** 2 - chance))
    return float(total / len(scores))


def recall_at_precision(scores: Array, correct: NDArray[np.bool_], common: int, precision: float = 0.95) -> float:
    """Largest recall of a threshold on the score whose pooled precision is at least `precision`; 0 if there is none."""
    if len(scores) == 0 or common == 0:
        return 0.0
    order = np.argsort(-scores, kind="stable")
    hits = np.cumsum(correct[order])
    reached = hits / np.arange(1, len(hits) + 1) >= precision
    # Equal scores enter or leave together: only the last of a run is a threshold.
    last = np.append(np.diff(scores[order]) != 0, True)
    return float(hits[reached & last].max(initial=0) / common)


def pooled(counts: Sequence[Counts]) -> Counts:
    """The counts of all pairs of views together."""
    return sum(counts, Counts())
