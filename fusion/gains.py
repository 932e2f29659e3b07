"""From graphs, relative poses and pairwise matchings to fused objects (section 3.5 of the paper).

Detections that matchings connect form a group: one object. The measurements of a group are brought into one robot's
sensor frame and fused. `gain="covariance"` weighs them by full covariances, the relative pose's covariance added to
the partner's measurement; `gain="intersection"` does not rely on their errors being independent; `gain="joint"` also
lets the matches correct the poses (see `refine`); `gain="paper"` is eq. 20-22 to the letter: isotropic u, poses taken
as exact.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from ..matching.graph import Matching, ObjectGraph
from ..matching.pose import Array, RelativePose
from .groups import Groups, group_detections
from .objects import GAINS, FusedObjects, Gain, OwnObjects, fuse_given, own_objects, relative_pose
from .refine import refine

HUBER = 2.0
"""Mahalanobis distance from which a measurement bends the poses no more."""


def fuse(
    graphs: Sequence[ObjectGraph],
    poses: Mapping[tuple[int, int], RelativePose],
    matchings: Mapping[tuple[int, int], Matching] | Groups,
    *,
    frame: int = 0,
    gain: Gain = "covariance",
    gate: float | None = None,
    trust_own: bool = False,
    frame_covariance: Array | None = None,
) -> FusedObjects:
    """Fused objects of N robots in the sensor frame of robot `frame`.

    Args:
        graphs: one per robot.
        poses: (i, j) -> pose of robot j's sensor in robot i's frame; needed between `frame` and its partners, in
            either direction. A partner without one does not contribute.
        matchings: (i, j) -> Matching, or groups made by `group_detections`.
        gain: "covariance", "intersection", "joint" or "paper".
        gate: share of honest measurements to keep, for example 0.999; what disagrees more with the rest of its group is
            left out (`used`), so that a robot that is wrong does not drag the estimate. None = keep all.
        trust_own: what disagrees with the frame robot's own measurement is left out, instead of what disagrees with
            most of the group: right where a wrong match is likelier than an own measurement that is wrong.
        frame_covariance: covariance (6, 6) of the frame robot's own pose in the world, where all the relative poses
            rest on it: the partners then share its error, and `gain="covariance"` counts it once. None = independent.

    Returns:
        Every group with a position in the frame; groups seen only by robots of unknown pose are left out.

    Raises:
        TypeError: something else than graphs, relative poses and matchings.
        ValueError: a robot or gain that does not exist, or relative poses surer than `frame_covariance` allows.
    """
    _check(graphs, poses, frame, gain)
    groups = matchings if isinstance(matchings, Groups) else group_detections([len(g) for g in graphs], matchings)
    if gain == "joint":
        # Poses between partners often rest on the same errors, one world pose per robot: only the frame's own count.
        partners = [j for j in range(len(graphs)) if j != frame]
        star = {(frame, j): pose for j in partners if (pose := relative_pose(poses, frame, j)) is not None}
        return refine(graphs, star, groups, frame=frame, gate=gate, trust_own=trust_own, huber=HUBER).objects
    return fuse_given(
        graphs,
        poses,
        groups,
        frame=frame,
        gain=gain,
        gate=gate,
        trust_own=trust_own,
        frame_covariance=frame_covariance,
    )


def fuse_own(
    graphs: Sequence[ObjectGraph],
    poses: Mapping[tuple[int, int], RelativePose],
    matchings: Mapping[tuple[int, int], Matching] | Groups,
    robot: int,
    *,
    gain: Gain = "covariance",
    gate: float | None = None,
    trust_own: bool = False,
    frame_covariance: Array | None = None,
) -> OwnObjects:
    """Every detection of `robot`, fused with what its partners measured; arguments as in `fuse`."""
    fused = fuse(
        graphs,
        poses,
        matchings,
        frame=robot,
        gain=gain,
        gate=gate,
        trust_own=trust_own,
        frame_covariance=frame_covariance,
    )
    return own_objects(graphs, fused, gain=gain)


def _check(graphs: Sequence[ObjectGraph], poses: Mapping[tuple[int, int], RelativePose], frame: int, gain: str) -> None:
    for robot, graph in enumerate(graphs):
        if not isinstance(graph, ObjectGraph):
            raise TypeError(f"graphs[{robot}] must be an ObjectGraph, got {type(graph).__name__}")
    for pair, pose in poses.items():
        if not isinstance(pose, RelativePose):
            raise TypeError(f"poses[{pair}] must be a RelativePose, got {type(pose).__name__}")
    if not 0 <= frame < len(graphs):
        raise ValueError(f"frame must be a robot in 0..{len(graphs) - 1}, got {frame}")
    if gain not in GAINS:
        raise ValueError(f"gain must be one of {', '.join(GAINS)}, got {gain!r}")
