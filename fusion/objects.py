"""Fused objects of a team whose poses are given: the measurements of each group in one robot's frame, weighed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from ..matching.checks import check_interval
from ..matching.graph import ObjectGraph
from ..matching.pose import Array, RelativePose, skews
from .gaussian import covariance_intersection
from .groups import Groups
from .kernels import fuse_groups, gate_groups

Gain = Literal["covariance", "intersection", "joint", "paper"]
GAINS: tuple[Gain, ...] = ("covariance", "intersection", "joint", "paper")

UNKNOWN_VARIANCE = 1e6
"""m^2 in place of an infinite variance."""


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


def fuse_given(
    graphs: Sequence[ObjectGraph],
    poses: Mapping[tuple[int, int], RelativePose],
    groups: Groups,
    *,
    frame: int = 0,
    gain: Gain = "covariance",
    gate: float | None = None,
    trust_own: bool = False,
    frame_covariance: Array | None = None,
) -> FusedObjects:
    """Fused objects with the poses as they are, any `gain` but "joint"; arguments as in `gains.fuse`."""
    threshold = _threshold(gate)
    positions, covariances, located = _in_frame(graphs, poses, frame, gain)
    offsets = np.concatenate([[0], np.cumsum([len(g) for g in graphs])])[:-1]
    used = (groups.members >= 0) & located
    keep = used.any(axis=1)
    used, members = used[keep], groups.members[keep]
    rows = np.where(used, members + offsets, -1)
    if np.isfinite(threshold):
        gate_groups(rows, positions, covariances, threshold, frame if trust_own else -1)
        used = rows >= 0
    if gain == "intersection":
        fused, fused_covariances = _intersect_groups(rows, positions, covariances)
    elif frame_covariance is None or gain == "paper":
        fused, fused_covariances = fuse_groups(rows, positions, covariances)
    else:
        fused, fused_covariances = _fuse_sharing(rows, positions, covariances, frame, frame_covariance)
    return FusedObjects(frame, fused, fused_covariances, members, used, groups.scores[keep])


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


@lru_cache(maxsize=16)
def _threshold(gate: float | None) -> float:
    """Squared Mahalanobis distance that a share `gate` of honest differences in three dimensions stays below."""
    if gate is None:
        return float("inf")
    check_interval("gate", gate, "(0, 1)")
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


def _intersect_groups(rows: NDArray[np.int64], positions: Array, covariances: Array) -> tuple[Array, Array]:
    """As `fuse_groups`, consistent however the measurements' errors are correlated; the weights minimise the trace."""
    fused, fused_covariances = np.zeros((len(rows), 3)), np.zeros((len(rows), 3, 3))
    for k, row in enumerate(rows):
        members = row[row >= 0]
        if len(members) == 1:
            fused[k], fused_covariances[k] = positions[members[0]], covariances[members[0]]
        else:
            both = covariance_intersection(positions[members], covariances[members])
            fused[k], fused_covariances[k] = both.mean, both.covariance
    return fused, fused_covariances


def _fuse_sharing(
    rows: NDArray[np.int64], positions: Array, covariances: Array, frame: int, frame_covariance: Array
) -> tuple[Array, Array]:
    """As `fuse_groups`, where all but the frame robot's measurements share the error of that robot's own pose.

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
    theirs, theirs_covariances = fuse_groups(partners[some], positions, unshared)
    theirs_covariances = theirs_covariances + shared[partners[some].max(axis=1)]
    both = np.full((m, 2), -1, dtype=np.int64)
    both[:, 0] = rows[:, frame]
    both[some, 1] = n + np.arange(int(some.sum()))
    return fuse_groups(both, np.concatenate([positions, theirs]), np.concatenate([covariances, theirs_covariances]))
