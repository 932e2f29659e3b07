"""One instant of a whole team: every robot's detections, fused with what its partners measured."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations

from ..matching.graph import Matching, ObjectGraph
from ..matching.multiway import consistent
from ..matching.pose import Array, RelativePose
from .gains import fuse_own
from .groups import group_detections
from .objects import Gain, OwnObjects

GATE = 0.999
"""Share of honest differences between two robots' measurements that stays; the others are wrong matches."""


def fuse_team(
    graphs: Sequence[ObjectGraph],
    poses: Sequence[Array | None],
    pose_covariances: Sequence[Array | None],
    matchings: Mapping[tuple[int, int], Matching],
    *,
    gain: Gain = "covariance",
) -> list[OwnObjects | None]:
    """What every robot knows of the objects it detected, in its own sensor frame.

    Args:
        graphs: one per robot.
        poses: noisy T_world_sensor (4, 4) of each robot. A robot without one helps nobody, and nothing comes out for
            it: None.
        pose_covariances: (6, 6) of each pose.
        matchings: (i, j) -> Matching, i < j. Of more than two robots only consistent groups are fused.
        gain: as in `fuse`, see `covis.fusion.objects`; what the poses contradict is left out, but
            for "paper".

    Raises:
        ValueError: other numbers of poses or covariances than of graphs; as `fuse`.
    """
    if not len(graphs) == len(poses) == len(pose_covariances):
        raise ValueError(
            f"every robot has a graph, a pose and a covariance, "
            f"got {len(graphs)}, {len(poses)} and {len(pose_covariances)}"
        )
    sizes = [len(graph) for graph in graphs]
    groups = group_detections(sizes, consistent(matchings, sizes) if len(graphs) > 2 else matchings)
    relative = {
        (i, j): RelativePose.between(T_i, C_i, T_j, C_j)
        for (i, (T_i, C_i)), (j, (T_j, C_j)) in combinations(enumerate(zip(poses, pose_covariances, strict=True)), 2)
        if T_i is not None and C_i is not None and T_j is not None and C_j is not None
    }
    gate = None if gain == "paper" else GATE
    return [
        None
        if T is None
        else fuse_own(graphs, relative, groups, i, gain=gain, gate=gate, trust_own=True, frame_covariance=C)
        for i, (T, C) in enumerate(zip(poses, pose_covariances, strict=True))
    ]
