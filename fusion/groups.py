"""Which detections are one object: groups of detections that pairwise matchings connect."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ..matching.graph import Matching
from ..matching.pose import Array

MAX_ROBOTS = 62
"""A group's robots are a bit mask in one signed integer."""


@dataclass(frozen=True, eq=False)
class Groups:
    """Which detections are one object. Every detection of every robot is in exactly one group.

    Attributes:
        members: (m, N) int64, index of the group's detection in each robot's graph, -1 for none.
        scores: (m,) lowest score of the matches that hold the group together; 1 for a detection alone.
    """

    members: NDArray[np.int64]
    scores: Array

    def __len__(self) -> int:
        return len(self.members)

    @property
    def sizes(self) -> NDArray[np.int64]:
        """Robots per group (m,)."""
        return np.asarray((self.members >= 0).sum(axis=1))

    def of(self, robot: int) -> NDArray[np.int64]:
        """Group (n,) of each of this robot's detections."""
        own = self.members[:, robot]
        group = np.empty(int(own.max(initial=-1)) + 1, dtype=np.int64)
        seen = np.flatnonzero(own >= 0)
        group[own[seen]] = seen
        return group


def group_detections(sizes: Sequence[int], matchings: Mapping[tuple[int, int], Matching]) -> Groups:
    """Groups of detections connected through matchings.

    A group holds at most one detection of each robot: matches are taken by descending score, and one that would join
    two detections of the same robot is dropped.

    Args:
        sizes: detections per robot.
        matchings: (source robot, target robot) -> Matching; each unordered pair of robots at most once.

    Raises:
        TypeError: something else than a Matching.
        ValueError: a robot or a detection that does not exist, a robot matched with itself, a pair given both ways.
    """
    N = len(sizes)
    if not 1 <= N <= MAX_ROBOTS:
        raise ValueError(f"groups need 1 to {MAX_ROBOTS} robots, got {N}")
    counts = np.asarray(sizes, dtype=np.int64)
    offsets = np.concatenate([[0], np.cumsum(counts)])
    edges, scores = _edges(counts, offsets, matchings)
    robot = np.repeat(np.arange(N), counts)
    order = np.argsort(-scores, kind="stable")
    label, weakest = _join(edges[order], scores[order], robot)
    m = int(label.max(initial=-1)) + 1
    members = np.full((m, N), -1, dtype=np.int64)
    members[label, robot] = np.arange(len(robot)) - offsets[robot]
    return Groups(members, weakest[:m])


def _edges(
    counts: NDArray[np.int64], offsets: NDArray[np.int64], matchings: Mapping[tuple[int, int], Matching]
) -> tuple[NDArray[np.int64], Array]:
    """All matches as edges (e, 2) between detections numbered through, and their scores (e,)."""
    N = len(counts)
    edges, scores = [np.zeros((0, 2), dtype=np.int64)], [np.zeros(0)]
    for (i, j), matching in matchings.items():
        if not isinstance(matching, Matching):
            raise TypeError(f"matchings[{i, j}] must be a Matching, got {type(matching).__name__}")
        if not (0 <= i < N and 0 <= j < N) or i == j:
            raise ValueError(f"matchings name robots ({i}, {j}), but there are {N} robots")
        if (j, i) in matchings:
            raise ValueError(f"matchings give the pair ({i}, {j}) in both directions")
        if len(matching):
            highest = matching.pairs.max(axis=0)
            if highest[0] >= counts[i] or highest[1] >= counts[j]:
                raise ValueError(
                    f"matching ({i}, {j}) names detections {highest.tolist()}, "
                    f"but the robots have {counts[i]} and {counts[j]}"
                )
            edges.append(matching.pairs + offsets[[i, j]])
            scores.append(matching.scores)
    return np.concatenate(edges), np.concatenate(scores)


@njit(cache=True)
def _root(parent: NDArray[np.int64], i: int) -> int:
    """Root of i in a forest of parents, with paths halved on the way."""
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i


@njit(cache=True)
def _join(edges: NDArray[np.int64], scores: Array, robot: NDArray[np.int64]) -> tuple[NDArray[np.int64], Array]:
    """Label (n,) of each detection's group, and each group's weakest link (padded to n); edges by descending score."""
    n = len(robot)
    parent = np.arange(n)
    mask = np.zeros(n, dtype=np.int64)
    weakest = np.ones(n)
    for i in range(n):
        mask[i] = 1 << robot[i]
    for e in range(len(edges)):
        a, b = _root(parent, edges[e, 0]), _root(parent, edges[e, 1])
        if a == b or mask[a] & mask[b]:
            continue
        parent[b] = a
        mask[a] |= mask[b]
        weakest[a] = min(weakest[a], weakest[b], scores[e])
    label = np.full(n, -1, dtype=np.int64)
    out = np.ones(n)
    count = 0
    for i in range(n):
        r = _root(parent, i)
        if label[r] < 0:
            label[r] = count
            out[count] = weakest[r]
            count += 1
        label[i] = label[r]
    return label, out
