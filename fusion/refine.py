"""Joint estimate of all robots' poses and all objects from everything that was matched: a small bundle adjustment.

Unknowns are the poses of the other robots in the frame robot's sensor frame, and the objects. What is minimised is the
sum of squared Mahalanobis distances of all measurements and of all given relative poses. Objects are eliminated (they
are linear given the poses), so that Gauss-Newton runs on a handful of pose parameters; their covariances include what
the poses leave open.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..matching.checks import check_count, check_interval
from ..matching.graph import Matching, ObjectGraph
from ..matching.pose import Array, RelativePose, adjoint, exp_se3, invert, skews
from .groups import Groups, group_detections
from .objects import FusedObjects, fuse_given, relative_pose
from .registration import RegistrationError, free_directions, log_se3, orthonormal, register_points, upright

FLOOR = 1e-10
"""m^2 added to every covariance before it is inverted."""
HUBER_ROUNDS = 4
"""Times the objects are weighed anew, given the poses."""


@dataclass(frozen=True, eq=False)
class Refined:
    """Outcome of a joint estimate.

    Attributes:
        poses: (frame, j) -> pose of robot j's sensor in the frame robot's, for every robot that could be placed.
        objects: every group seen by a placed robot.
        cost: half the sum of squared Mahalanobis distances at the optimum.
        iterations: Gauss-Newton steps taken.
    """

    poses: Mapping[tuple[int, int], RelativePose]
    objects: FusedObjects
    cost: float
    iterations: int


def refine(
    graphs: Sequence[ObjectGraph],
    poses: Mapping[tuple[int, int], RelativePose],
    matchings: Mapping[tuple[int, int], Matching] | Groups,
    *,
    frame: int = 0,
    gate: float | None = None,
    trust_own: bool = False,
    huber: float | None = None,
    iterations: int = 30,
) -> Refined:
    """Poses and objects that explain all measurements and relative poses best.

    Args:
        graphs: one per robot; `up` in all of them fixes every robot's tilt.
        poses: (i, j) -> what is known of the relative pose, any pairs; may be empty, then the matches alone count.
        matchings: (i, j) -> Matching, or groups.
        frame: the robot in whose sensor frame everything is expressed.
        gate, trust_own: as in `fuse`, applied with the given poses before the joint estimate.
        huber: Mahalanobis distance beyond which a measurement's influence stops growing; None = least squares.
        iterations: most Gauss-Newton steps.

    Raises:
        ValueError: a robot that does not exist, or an option out of its range.
    """
    if huber is not None:
        check_interval("huber", huber, "(0, inf)")
    check_count("iterations", iterations)
    groups = matchings if isinstance(matchings, Groups) else group_detections([len(g) for g in graphs], matchings)
    if not 0 <= frame < len(graphs):
        raise ValueError(f"frame must be a robot in 0..{len(graphs) - 1}, got {frame}")
    T = _initial_poses(graphs, poses, groups, frame)
    placed = sorted(T)
    problem = _Problem.build(graphs, groups, placed, frame)
    if gate is not None:
        start = {(frame, j): RelativePose(T[j], _known_covariance(poses, frame, j)) for j in placed if j != frame}
        kept = fuse_given(graphs, start, groups, frame=frame, gate=gate, trust_own=trust_own)
        problem = _Problem.build(graphs, _only(kept, groups), placed, frame)
    factors = [(i, j, pose) for (i, j), pose in poses.items() if i in T and j in T]
    solver = _Solver(problem, factors, huber)
    state = np.stack([T[j] for j in placed])
    taken = 0
    for _ in range(iterations):
        H, g, _ = solver.linearise(state)
        step = _inverse(H) @ g
        state = solver.moved(state, step)
        taken += 1
        if np.abs(step).max(initial=0.0) < 1e-10:
            break
    H, _, cost = solver.linearise(state)
    covariance = _inverse(H)
    objects = solver.objects(state, covariance, groups, frame)
    return Refined(solver.relative_poses(state, covariance, frame), objects, cost, taken)


@dataclass(frozen=True, eq=False)
class _Problem:
    """Measurements padded to groups x placed robots.

    Attributes:
        placed: (P,) robots with a pose; `fixed` is the frame's place among them.
        q: (m, P, 3) m, sensor frames; C: (m, P, 3, 3); present: (m, P).
        free: (P, 6, d) directions in which each pose may move.
    """

    placed: list[int]
    fixed: int
    q: Array
    C: Array
    present: NDArray[np.bool_]
    free: Array

    @classmethod
    def build(cls, graphs: Sequence[ObjectGraph], groups: Groups, placed: list[int], frame: int) -> _Problem:
        m, P = len(groups), len(placed)
        q, C = np.zeros((m, P, 3)), np.tile(np.eye(3), (m, P, 1, 1))
        present = groups.members[:, placed] >= 0
        level = all(graphs[r].up is not None for r in placed)
        free = np.zeros((P, 6, 4 if level else 6))
        for k, robot in enumerate(placed):
            graph = graphs[robot]
            index = groups.members[present[:, k], robot]
            q[present[:, k], k] = graph.positions[index]
            C[present[:, k], k] = graph.full_covariances()[index]
            free[k] = free_directions(graph.up if level else None)
        return cls(placed, placed.index(frame), q, C, present, free)


class _Solver:
    """Normal equations of the poses, objects eliminated. State: (P, 4, 4) poses in the frame robot's frame."""

    def __init__(
        self, problem: _Problem, factors: list[tuple[int, int, RelativePose]], huber: float | None = None
    ) -> None:
        self.problem = problem
        self.huber = huber
        self.factors = [
            (
                problem.placed.index(i),
                problem.placed.index(j),
                p.T_source_target,
                _inverse(p.covariance + 1e-12 * np.eye(6)),
            )
            for i, j, p in factors
        ]
        self.moving = [k for k in range(len(problem.placed)) if k != problem.fixed]

    def _given_poses(self, state: Array) -> tuple[Array, Array, Array, Array, Array]:
        """World positions, informations (m, P, 3, 3), objects (m, 3), covariances (m, 3, 3), residuals (m, P, 3)."""
        p = self.problem
        R, t = state[:, :3, :3], state[:, :3, 3]
        world = np.einsum("pij,mpj->mpi", R, p.q) + t
        S = R @ p.C @ R.transpose(0, 2, 1) + FLOOR * np.eye(3)
        full = np.linalg.inv(S)
        weight = p.present.astype(np.float64)
        seen = p.present.any(axis=1)
        for _ in range(HUBER_ROUNDS if self.huber is not None else 1):
            W = np.asarray(full * weight[..., None, None], dtype=np.float64)
            total = W.sum(axis=1) + 1e-300 * np.eye(3)
            total[~seen] = np.eye(3)
            objects_covariance = np.linalg.inv(total)
            objects = np.einsum("mij,mj->mi", objects_covariance, np.einsum("mpij,mpj->mi", W, world))
            residual = (world - objects[:, None]) * p.present[..., None]
            if self.huber is not None:
                distance = np.sqrt(np.einsum("mpi,mpij,mpj->mp", residual, full, residual))
                weight = np.minimum(1.0, self.huber / np.maximum(distance, 1e-12)) * p.present
        return world, W, objects, np.asarray(objects_covariance, dtype=np.float64), residual

    def _jacobians(self, state: Array, objects: Array) -> Array:
        """d world / d pose (m, P, 3, 6), at the objects: that makes the gradient exact."""
        R, t = state[:, :3, :3], state[:, :3, 3]
        local = np.einsum("pji,mpj->mpi", R, objects[:, None] - t)
        m, P = local.shape[:2]
        turns = -R @ skews(local.reshape(-1, 3)).reshape(m, P, 3, 3)
        return np.concatenate([np.broadcast_to(R, (m, P, 3, 3)), turns], axis=-1)

    def linearise(self, state: Array) -> tuple[Array, Array, float]:
        """Gauss-Newton's H and g over the moving poses' free directions, and the cost."""
        p = self.problem
        _, W, objects, objects_covariance, residual = self._given_poses(state)
        A = self._jacobians(state, objects)
        A = np.einsum("mpij,pjd->mpid", A, p.free)
        WA = W @ A
        P, d = A.shape[1], A.shape[3]
        H = -np.einsum("mpid,mij,mqje->pdqe", WA, objects_covariance, WA)
        own = np.einsum("mpid,mpie->pde", A, WA)
        for k in range(P):
            H[k, :, k, :] += own[k]
        g = -np.einsum("mpid,mpi->pd", WA, residual)
        cost = 0.5 * float(np.einsum("mpi,mpij,mpj->", residual, W, residual))
        for i, j, T_measured, information in self.factors:
            xi = log_se3(invert(T_measured) @ invert(state[i]) @ state[j])
            J_j = np.eye(6)
            J_j[:3, :3] = T_measured[:3, :3].T @ state[i][:3, :3].T @ state[j][:3, :3]
            J_i = -J_j @ adjoint(invert(state[j]) @ state[i])
            blocks = {i: J_i @ p.free[i], j: J_j @ p.free[j]}
            for a, J_a in blocks.items():
                g[a] -= J_a.T @ information @ xi
                for b, J_b in blocks.items():
                    H[a, :, b, :] += J_a.T @ information @ J_b
            cost += 0.5 * float(xi @ information @ xi)
        H, g = H[self.moving][:, :, self.moving], g[self.moving]
        size = len(self.moving) * d
        return H.reshape(size, size), g.ravel(), cost

    def moved(self, state: Array, step: Array) -> Array:
        """The poses after a step over the moving poses' free directions."""
        out = state.copy()
        for k, part in zip(self.moving, step.reshape(len(self.moving), self.problem.free.shape[2]), strict=True):
            out[k] = state[k] @ exp_se3(self.problem.free[k] @ part)
        return out

    def objects(self, state: Array, covariance: Array, groups: Groups, frame: int) -> FusedObjects:
        """Fused objects with marginal covariances: given the poses, plus what the poses leave open."""
        p = self.problem
        _, W, objects, given, _ = self._given_poses(state)
        A = np.einsum("mpij,pjd->mpid", self._jacobians(state, objects), p.free)
        G = np.einsum("mij,mpjd->mipd", given, W @ A)[:, :, self.moving]
        G = G.reshape(len(objects), 3, len(covariance))
        C = given + G @ covariance @ G.transpose(0, 2, 1)
        keep = p.present.any(axis=1)
        used = np.zeros(groups.members.shape, dtype=np.bool_)
        used[:, p.placed] = p.present
        return FusedObjects(frame, objects[keep], C[keep], groups.members[keep], used[keep], groups.scores[keep])

    def relative_poses(self, state: Array, covariance: Array, frame: int) -> dict[tuple[int, int], RelativePose]:
        """(frame, j) -> pose of robot j, with its block of the poses' joint covariance."""
        p = self.problem
        d = p.free.shape[2]
        out = {}
        for n, k in enumerate(self.moving):
            block = covariance[n * d : (n + 1) * d, n * d : (n + 1) * d]
            C = p.free[k] @ block @ p.free[k].T
            out[frame, p.placed[k]] = RelativePose(orthonormal(state[k]), 0.5 * (C + C.T))
        return out


def _initial_poses(
    graphs: Sequence[ObjectGraph], poses: Mapping[tuple[int, int], RelativePose], groups: Groups, frame: int
) -> dict[int, Array]:
    """T_frame_robot (4, 4) of every robot that a chain of known poses, else of matches, links to the frame robot."""
    T = {frame: np.eye(4)}
    waiting = [frame]
    while waiting:
        i = waiting.pop(0)
        for j in range(len(graphs)):
            if j not in T and (pose := relative_pose(poses, i, j)) is not None:
                T[j] = T[i] @ pose.T_source_target
                waiting.append(j)
    grown = True
    while grown:
        grown = False
        for j in [r for r in range(len(graphs)) if r not in T]:
            best = max(T, key=lambda i: int(((groups.members[:, i] >= 0) & (groups.members[:, j] >= 0)).sum()))
            relative = _registered(graphs, groups, best, j)
            if relative is not None:
                T[j] = T[best] @ relative
                grown = True
    return {j: pose if j == frame else upright(pose, _ups(graphs[frame], graphs[j])) for j, pose in T.items()}


def _ups(source: ObjectGraph, target: ObjectGraph) -> tuple[Array, Array] | None:
    """Gravity's opposite in both frames, None unless both know it."""
    return None if source.up is None or target.up is None else (source.up, target.up)


def _registered(graphs: Sequence[ObjectGraph], groups: Groups, i: int, j: int) -> Array | None:
    """Pose (4, 4) of robot j in robot i's frame from the objects that both see; None where these do not fix it."""
    both = groups.members[(groups.members[:, i] >= 0) & (groups.members[:, j] >= 0)]
    a, b = both[:, i], both[:, j]
    source, target = graphs[i], graphs[j]
    C_a, C_b = source.full_covariances()[a], target.full_covariances()[b]
    p, q = source.positions[a], target.positions[b]
    try:
        return register_points(p, C_a, q, C_b, up=_ups(source, target)).pose.T_source_target
    except RegistrationError:
        return None


def _known_covariance(poses: Mapping[tuple[int, int], RelativePose], i: int, j: int) -> Array:
    pose = relative_pose(poses, i, j)
    return np.zeros((6, 6)) if pose is None else pose.covariance


def _only(kept: FusedObjects, groups: Groups) -> Groups:
    """Groups whose members are those that were used; the rows of `kept` come first, in their order, then the rest."""
    members = np.where(kept.used, kept.members, -1)
    lookup = {tuple(row): k for k, row in enumerate(kept.members.tolist())}
    out = np.full(groups.members.shape, -1, dtype=np.int64)
    for k, row in enumerate(groups.members.tolist()):
        if tuple(row) in lookup:
            out[k] = members[lookup[tuple(row)]]
    return Groups(out, groups.scores)


def _inverse(H: Array) -> Array:
    """Pseudo-inverse of a symmetric positive semidefinite matrix, scaled so that metres and radians compare."""
    if len(H) == 0:
        return H
    scale = 1.0 / np.sqrt(np.maximum(np.diag(H), 1e-300))
    scaled = H * scale[:, None] * scale[None, :]
    return np.asarray(np.linalg.pinv(scaled, rcond=1e-12, hermitian=True) * scale[:, None] * scale[None, :])
