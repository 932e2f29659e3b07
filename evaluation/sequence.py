"""Sequence mode: one tracker per method and pair of robots, which forgets where the episode changes."""

from __future__ import annotations

from collections.abc import Mapping

from ..fusion.sequence import PairTracker
from ..matching.pose import Array

Pair = tuple[str, str]


class PairTrackers:
    """Trackers of all methods and pairs of robots through one episode after another."""

    def __init__(self) -> None:
        self._episode: int | None = None
        self._trackers: dict[tuple[str, Pair], PairTracker] = {}

    def begin(self, episode: int, odometry: Mapping[str, Array | None]) -> None:
        """A new frame: forget everything where the episode is new, else carry every pair on by the robots' own motion.

        Pairs that are not matched in this frame are carried on all the same. Unknown odometry is None.
        """
        if episode != self._episode:
            self._episode = episode
            self._trackers = {}
            return
        for (_, (source, target)), tracker in self._trackers.items():
            tracker.predict(odometry.get(source), odometry.get(target))

    def of(self, method: str, source: str, target: str) -> PairTracker:
        return self._trackers.setdefault((method, (source, target)), PairTracker())
