"""Sequence mode: a tracker per method and pair of robots, a map per robot, forgotten where the episode changes."""

from __future__ import annotations

from collections.abc import Mapping

from ..fusion.localmap import LocalMap
from ..fusion.sequence import PairTracker
from ..matching.graph import ObjectGraph
from ..matching.pose import Array

Pair = tuple[str, str]


class PairTrackers:
    """Trackers of all methods and pairs of robots, and maps of all robots, through one episode after another."""

    def __init__(self) -> None:
        self._episode: int | None = None
        self._trackers: dict[tuple[str, Pair], PairTracker] = {}
        self._maps: dict[str, LocalMap] = {}
        self._remembered: dict[str, ObjectGraph] = {}

    def begin(
        self, episode: int, odometry: Mapping[str, Array | None], graphs: Mapping[str, ObjectGraph] | None = None
    ) -> None:
        """A new frame: forget everything where the episode is new, else carry every pair on by the robots' own motion.

        Pairs that are not matched in this frame are carried on all the same. Unknown odometry is None. `graphs` are
        what every robot sees; where a robot's odometry is known, its local map remembers them. Not so for cameras:
        their positions are of the visible faces, which differ from place to place.
        """
        if episode != self._episode:
            self._episode = episode
            self._trackers, self._maps = {}, {}
        else:
            for (_, (source, target)), tracker in self._trackers.items():
                tracker.predict(odometry.get(source), odometry.get(target))
        self._remembered = {}
        for robot, graph in (graphs or {}).items():
            motion = odometry.get(robot)
            if motion is None or graph.up is None or graph.intrinsics is not None:
                self._maps.pop(robot, None)
                continue
            own = self._maps.setdefault(robot, LocalMap())
            own.predict(motion, graph.up)
            self._remembered[robot] = own.see(graph)

    def of(self, method: str, source: str, target: str) -> PairTracker:
        return self._trackers.setdefault((method, (source, target)), PairTracker())

    def maps(self, source: str, target: str) -> tuple[ObjectGraph, ObjectGraph] | None:
        """All that both robots remember in this frame, or None where one of them keeps no map."""
        if source in self._remembered and target in self._remembered:
            return self._remembered[source], self._remembered[target]
        return None
