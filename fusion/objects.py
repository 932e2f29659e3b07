"""From graphs, relative poses and pairwise matchings to fused objects (section 3.5 of the paper).

Detections that matchings connect form a group: one object. The measurements of a group are brought into one robot's
sensor frame and fused. `gain="covariance"` weighs them by full covariances, the relative pose's covariance added to
the partner's measurement; `gain="joint"` also lets the matches correct the poses (see `refine`); `gain="paper"` is eq.
20-22 to the letter: isotropic u, poses taken as exact.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.stats import chi2

from ..matching.graph import Matching, ObjectGraph
from ..matching.pose import Array, RelativePose, skews

Gain = Literal["covariance", "joint", "paper"]
GAINS: tuple[Gain, ...] = ("covariance", "joint", "paper")

MAX_ROBOTS = 62
"""A group's robots are a bit mask in one signed integer."""

UNKNOWN_VARIANCE = 1e6
"""m^2 in place of an infinite variance."""


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


@dataclass(frozen=True, eq=False)
class FusedObjects:
    """Objects in one robot's sensor frame.

    Attributes:
        frame: the robot whose sensor frame it is.
        positions: (m, 3) m.
        covariances: (m, 3, 3) m^2.
        members: (m, N) int64, index of the object's detection in each robot's graph, -1 for none.
        used: (m, N) bool, detections that entered the position; a member is left out when its robot's pose is unknown
            or when it was gated.
        scores: (m,) lowest score of the matches that hold the group together; 1 for a detection alone.
    """

    frame: int
    positions: Array
    covariances: Array
    members: NDArray[np.int64]
    used: NDArray[np.bool_]
    scores: Array

    def __len__(self) -> int:
        return len(self.positions)


@dataclass(frozen=True, eq=False)
class OwnObjects:
    """One robot's own detections, alone and fused, in its sensor frame and in the order of its graph.

    Attributes:
        positions: (n, 3) m, fused. covariances: (n, 3, 3) m^2.
        positions_single: (n, 3) m, this robot's measurement. covariances_single: (n, 3, 3) m^2.
        n_robots: (n,) int64, robots whose measurement entered, this one included.
    """

    positions: Array
    covariances: Array
    positions_single: Array
    covariances_single: Array
    n_robots: NDArray[np.int64]

    @property
    def position_variance(self) -> Array:
        """Mean over axes of the fused variance (n,) m^2."""
        return np.asarray(np.trace(self.covariances, axis1=1, axis2=2) / 3.0)


def group_detections(sizes: Sequence[int], matchings: Mapping[tuple[int, int], Matching]) -> Groups:
    """Groups of detections connected through matchings.

    A group holds at most one detection of each robot: matches are taken by descending score, and one that would join
    two detections of the same robot is dropped.

    Args:
        sizes: detections per robot.
        matchings: (source robot, target robot) -> Matching; each unordered pair of robots at most once.

    Raises:
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


def fuse(
    graphs: Sequence[ObjectGraph],
    poses: Mapping[tuple[int, int], RelativePose],
    matchings: Mapping[tuple[int, int], Matching] | Groups,
    *,
    frame: int = 0,
    gain: Gain = "covariance",
    gate: float | None = None,
    frame_covariance: Array | None = None,
) -> FusedObjects:
    """Fused objects of N robots in the sensor frame of robot `frame`.

    Args:
        graphs: one per robot.
        poses: (i, j) -> pose of robot j's sensor in robot i's frame; needed between `frame` and its partners, in
            either direction. A partner without one does not contribute.
        matchings: (i, j) -> Matching, or groups made by `group_detections`.
        gain: "covariance", "joint" or "paper".
        gate: share of honest measurements to keep, for example 0.999; what disagrees more with the rest of its group is
            left out (`used`), so that a robot that is wrong does not drag the estimate. None = keep all.
        frame_covariance: covariance (6, 6) of the frame robot's own pose in the world, where all the relative poses
            rest on it: the partners then share its error, and `gain="covariance"` counts it once. None = independent.

    Returns:
        Every group with a position in the frame; groups seen only by robots of unknown pose are left out.

    Raises:
        ValueError: a robot or gain that does not exist, or relative poses surer than `frame_covariance` allows.
    """
    _check(graphs, frame, gain)
    groups = matchings if isinstance(matchings, Groups) else group_detections([len(g) for g in graphs], matchings)
    threshold = _threshold(gate)
    if gain == "joint":
        from .refine import refine  # refine builds on this module

        # Poses between partners often rest on the same errors, one world pose per robot: only the frame's own count.
        partners = [j for j in range(len(graphs)) if j != frame]
        star = {(frame, j): pose for j in partners if (pose := relative_pose(poses, frame, j)) is not None}
        return refine(graphs, star, groups, frame=frame, gate=gate).objects
    positions, covariances, located = _in_frame(graphs, poses, frame, gain)
    offsets = np.concatenate([[0], np.cumsum([len(g) for g in graphs])])[:-1]
    used = (groups.members >= 0) & located
    keep = used.any(axis=1)
    used, members = used[keep], groups.members[keep]
    rows = np.where(used, members + offsets, -1)
    if np.isfinite(threshold):
        _gate(rows, positions, covariances, threshold)
        used = rows >= 0
    if frame_covariance is None or gain != "covariance":
        fused, fused_covariances = _fuse_groups(rows, positions, covariances)
    else:
        fused, fused_covariances = _fuse_sharing(rows, positions, covariances, frame, frame_covariance)
    return FusedObjects(frame, fused, fused_covariances, members, used, groups.scores[keep])


def fuse_own(
    graphs: Sequence[ObjectGraph],
    poses: Mapping[tuple[int, int], RelativePose],
    matchings: Mapping[tuple[int, int], Matching] | Groups,
    robot: int,
    *,
    gain: Gain = "covariance",
    gate: float | None = None,
    frame_covariance: Array | None = None,
) -> OwnObjects:
    """Every detection of `robot`, fused with what its partners measured; arguments as in `fuse`."""
    fused = fuse(graphs, poses, matchings, frame=robot, gain=gain, gate=gate, frame_covariance=frame_covariance)
    return own_objects(graphs, fused, gain=gain)


def agreement(fused: FusedObjects) -> Array:
    """Share (N,) of each robot's measurements that passed the gate, in groups of two robots or more; NaN without any.

    A robot far below the others is wrong about its pose or its measurements.
    """
    shared = (fused.members >= 0) & ((fused.members >= 0).sum(axis=1) > 1)[:, None]
    counts = shared.sum(axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray((fused.used & shared).sum(axis=0) / counts)


def own_objects(graphs: Sequence[ObjectGraph], fused: FusedObjects, *, gain: Gain = "covariance") -> OwnObjects:
    """The detections of the robot in whose frame `fused` is."""
    graph = graphs[fused.frame]
    index = fused.members[:, fused.frame]
    rows = np.flatnonzero(index >= 0)
    row = np.empty(len(graph), dtype=np.int64)
    row[index[rows]] = rows
    return OwnObjects(
        fused.positions[row],
        fused.covariances[row],
        graph.positions,
        _measured_covariances(graph, gain),
        fused.used[row].sum(axis=1),
    )


def relative_pose(poses: Mapping[tuple[int, int], RelativePose], source: int, target: int) -> RelativePose | None:
    """Pose of robot `target` in the frame of robot `source`, from whichever direction is known; None if neither."""
    if (source, target) in poses:
        return poses[source, target]
    if (target, source) in poses:
        return poses[target, source].inverse()
    return None


def _check(graphs: Sequence[ObjectGraph], frame: int, gain: str) -> None:
    if not 0 <= frame < len(graphs):
        raise ValueError(f"frame must be a robot in 0..{len(graphs) - 1}, got {frame}")
    if gain not in GAINS:
        raise ValueError(f"gain must be one of {', '.join(GAINS)}, got {gain!r}")


@lru_cache(maxsize=16)
def _threshold(gate: float | None) -> float:
    """Squared Mahalanobis distance that a share `gate` of honest differences in three dimensions stays below."""
    if gate is None:
        return float("inf")
    if not 0 < gate < 1:
        raise ValueError(f"gate must lie in (0, 1), got {gate}")
    return float(chi2.ppf(gate, 3))


def _measured_covariances(graph: ObjectGraph, gain: Gain) -> Array:
    """(n, 3, 3) m^2, sensor frame: full, or the paper's u I."""
    if gain != "paper":
        return graph.full_covariances(unknown_variance=UNKNOWN_VARIANCE)
    return np.minimum(graph.position_variance, UNKNOWN_VARIANCE)[:, None, None] * np.eye(3)


def _in_frame(
    graphs: Sequence[ObjectGraph], poses: Mapping[tuple[int, int], RelativePose], frame: int, gain: Gain
) -> tuple[Array, Array, NDArray[np.bool_]]:
    """All detections, robot after robot, in one frame: positions, covariances, and which robots have a pose (N,)."""
    located = np.ones(len(graphs), dtype=np.bool_)
    positions, covariances = [], []
    for robot, graph in enumerate(graphs):
        p, C = graph.positions, _measured_covariances(graph, gain)
        if robot != frame:
            pose = relative_pose(poses, frame, robot)
            if pose is None:
                located[robot] = False
            else:
                p, C = _move(pose, p, C, gain)
        positions.append(p)
        covariances.append(C)
    return np.concatenate(positions), np.concatenate(covariances), located


def _move(pose: RelativePose, positions: Array, covariances: Array, gain: Gain) -> tuple[Array, Array]:
    """The paper's sigma: positions in the pose's source frame, and their covariances with the pose's error added."""
    T = pose.T_source_target
    R = T[:3, :3]
    moved = positions @ R.T + T[:3, 3]
    if gain == "paper":
        return moved, covariances
    return moved, R @ covariances @ R.T + pose.position_covariances(positions)


def _fuse_sharing(
    rows: NDArray[np.int64], positions: Array, covariances: Array, frame: int, frame_covariance: Array
) -> tuple[Array, Array]:
    """As `_fuse_groups`, where all but the frame robot's measurements share the error of that robot's own pose.

    Without that error they are independent: they are fused without it, it is added to the result, and that is fused
    with the frame robot's own measurement.
    """
    m, n = len(rows), len(positions)
    J = np.concatenate([np.broadcast_to(np.eye(3), (n, 3, 3)), -skews(positions)], axis=2)
    shared = J @ frame_covariance @ J.transpose(0, 2, 1)
    partners = rows.copy()
    partners[:, frame] = -1
    some = (partners >= 0).any(axis=1)
    unshared = covariances - shared
    used = np.unique(partners[partners >= 0])
    least = np.diagonal(unshared[used], axis1=1, axis2=2)
    if (least < -1e-9 * np.diagonal(covariances[used], axis1=1, axis2=2)).any():
        raise ValueError("frame_covariance is larger than the covariance of the relative poses that should contain it")
    theirs, theirs_covariances = _fuse_groups(partners[some], positions, unshared)
    theirs_covariances = theirs_covariances + shared[partners[some].max(axis=1)]
    both = np.full((m, 2), -1, dtype=np.int64)
    both[:, 0] = rows[:, frame]
    both[some, 1] = n + np.arange(int(some.sum()))
    return _fuse_groups(both, np.concatenate([positions, theirs]), np.concatenate([covariances, theirs_covariances]))


def _edges(
    counts: NDArray[np.int64], offsets: NDArray[np.int64], matchings: Mapping[tuple[int, int], Matching]
) -> tuple[NDArray[np.int64], Array]:
    """All matches as edges (e, 2) between detections numbered through, and their scores (e,)."""
    N = len(counts)
    edges, scores = [np.zeros((0, 2), dtype=np.int64)], [np.zeros(0)]
    for (i, j), matching in matchings.items():
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


@njit(cache=True)
def _invert_spd(A: Array, out: Array) -> None:
    """Inverse of a symmetric positive definite (3, 3) by its Cholesky factor, with a floor under the diagonal."""
    floor = 1e-12 * (A[0, 0] + A[1, 1] + A[2, 2]) + 1e-12
    a, b, c = A[0, 0] + floor, A[1, 1] + floor, A[2, 2] + floor
    l00 = np.sqrt(a)
    l10, l20 = A[1, 0] / l00, A[2, 0] / l00
    l11 = np.sqrt(max(b - l10 * l10, floor))
    l21 = (A[2, 1] - l20 * l10) / l11
    l22 = np.sqrt(max(c - l20 * l20 - l21 * l21, floor))
    i00, i11, i22 = 1.0 / l00, 1.0 / l11, 1.0 / l22
    i10 = -l10 * i00 * i11
    i21 = -l21 * i11 * i22
    i20 = (l10 * l21 - l20 * l11) * i00 * i11 * i22
    out[0, 0] = i00 * i00 + i10 * i10 + i20 * i20
    out[1, 1] = i11 * i11 + i21 * i21
    out[2, 2] = i22 * i22
    out[0, 1] = out[1, 0] = i10 * i11 + i20 * i21
    out[0, 2] = out[2, 0] = i20 * i22
    out[1, 2] = out[2, 1] = i21 * i22


@njit(cache=True)
def _fuse_groups(rows: NDArray[np.int64], positions: Array, covariances: Array) -> tuple[Array, Array]:
    """Information fusion of each group: rows (m, N) into positions (n, 3) and covariances (n, 3, 3), -1 = absent."""
    m, N = rows.shape
    fused, fused_covariances = np.zeros((m, 3)), np.zeros((m, 3, 3))
    W, total = np.zeros((3, 3)), np.zeros((3, 3))
    vector = np.zeros(3)
    for k in range(m):
        count, only = 0, 0
        for r in range(N):
            if rows[k, r] >= 0:
                count += 1
                only = rows[k, r]
        if count == 1:  # exactly the measurement, with no rounding and no floor
            fused[k] = positions[only]
            fused_covariances[k] = covariances[only]
            continue
        total[:] = 0.0
        vector[:] = 0.0
        for r in range(N):
            d = rows[k, r]
            if d < 0:
                continue
            _invert_spd(covariances[d], W)
            for i in range(3):
                for j in range(3):
                    total[i, j] += W[i, j]
                    vector[i] += W[i, j] * (positions[d, j] - positions[only, j])
        # The information is inverted without a floor of its own: its condition is bounded by the floors above.
        _invert_information(total, fused_covariances[k])
        for i in range(3):
            fused[k, i] = positions[only, i]  # relative to one member: large offsets lose digits
            for j in range(3):
                fused[k, i] += fused_covariances[k, i, j] * vector[j]
    return fused, fused_covariances


@njit(cache=True)
def _invert_information(A: Array, out: Array) -> None:
    scale = 3.0 / (A[0, 0] + A[1, 1] + A[2, 2])
    scaled = A * scale
    inverse = np.linalg.inv(scaled)
    for i in range(3):
        for j in range(3):
            out[i, j] = 0.5 * (inverse[i, j] + inverse[j, i]) * scale


@njit(cache=True)
def _gate(rows: NDArray[np.int64], positions: Array, covariances: Array, threshold: float) -> None:
    """Set to -1, in place, the members of each group that disagree with its largest consistent core.

    The core is the member that most others agree with (by the threshold on the squared Mahalanobis distance of their
    difference), and those others; among equals the more precise. Of two that disagree the more precise is kept.
    """
    m, N = rows.shape
    W, S = np.zeros((3, 3)), np.zeros((3, 3))
    agree = np.zeros((N, N), dtype=np.bool_)
    for k in range(m):
        for i in range(N):
            for j in range(i):
                a, b = rows[k, i], rows[k, j]
                agree[i, j] = agree[j, i] = False
                if a < 0 or b < 0:
                    continue
                for x in range(3):
                    for y in range(3):
                        S[x, y] = covariances[a, x, y] + covariances[b, x, y]
                _invert_spd(S, W)
                squared = 0.0
                for x in range(3):
                    for y in range(3):
                        squared += (positions[a, x] - positions[b, x]) * W[x, y] * (positions[a, y] - positions[b, y])
                agree[i, j] = agree[j, i] = squared <= threshold
        core, support, spread = -1, -1, np.inf
        for i in range(N):
            d = rows[k, i]
            if d < 0:
                continue
            count = 0
            for j in range(N):
                count += agree[i, j]
            trace = covariances[d, 0, 0] + covariances[d, 1, 1] + covariances[d, 2, 2]
            if count > support or (count == support and trace < spread):
                core, support, spread = i, count, trace
        for i in range(N):
            if i != core and not agree[core, i]:
                rows[k, i] = -1
