"""What is known of two robots' relative pose over time: a Gaussian mixture over alternatives, gravity known.

A matcher that does not know the poses proposes several; one frame often cannot tell which is right, a few frames can.
Each component is one alternative, carried forward by the robots' odometry, or by persistence where there is none; "none
of them" is always an alternative too, so that a wrong belief can be given up.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..matching.checks import check_count, check_interval
from ..matching.pose import Array, RelativePose
from .registration import rotation_between

UP = np.array([0.0, 0.0, 1.0])
TILT_STD_RAD = 1e-3
NEWBORN = np.diag([1e-6, 1e-6, 1e-4, 1e-8])
"""m^2 and rad^2 added to a proposed pose."""
LOG_2PI = float(np.log(2 * np.pi))


@dataclass(frozen=True)
class PoseFilterOptions:
    """How fast a relative pose is believed, and forgotten.

    Attributes:
        walk_std_m, walk_std_rad: change of the relative pose per frame where a robot gives no odometry.
        odometry_std_m, odometry_std_per_m: translation error of one step, and per metre of it.
        odometry_std_rad, odometry_std_per_rad: heading error of one step, and per radian of its turn.
        lost: probability per frame that the pose is none of the components any more.
        overlooked: least probability that none of a frame's hypotheses is right.
        extent_m: side of the square in which the partner may be when nothing is known.
        independence: share of a frame's evidence that is new, not a copy of the last frame's.
        max_components: of more, the least likely are dropped.

    Raises:
        ValueError: a value out of its range.
    """

    walk_std_m: float = 0.2
    walk_std_rad: float = 0.03
    odometry_std_m: float = 0.01
    odometry_std_per_m: float = 0.05
    odometry_std_rad: float = 0.012
    odometry_std_per_rad: float = 0.1
    lost: float = 0.005
    overlooked: float = 0.1
    extent_m: float = 60.0
    independence: float = 0.2
    max_components: int = 6

    def __post_init__(self) -> None:
        for name in ("walk_std_m", "walk_std_rad"):
            check_interval(name, getattr(self, name), "[0, inf)")
        for name in ("odometry_std_m", "odometry_std_per_m", "odometry_std_rad", "odometry_std_per_rad"):
            check_interval(name, getattr(self, name), "[0, inf)")
        for name in ("lost", "overlooked"):
            check_interval(name, getattr(self, name), "(0, 1)")
        check_interval("extent_m", self.extent_m, "(0, inf)")
        check_interval("independence", self.independence, "(0, 1]")
        check_count("max_components", self.max_components)


@dataclass(frozen=True, eq=False)
class Choice:
    """What a frame's hypotheses did to the belief.

    Attributes:
        probability: of the most likely component.
        component: its index before the update, -1 where it came with this frame.
        hypothesis: index of the hypothesis it agrees with, -1 for none.
    """

    probability: float
    component: int
    hypothesis: int


@dataclass(frozen=True, eq=False)
class Explained:
    """A frame as one component explains it.

    Attributes:
        component: its index.
        mean, covariance: (4,), (4, 4) of the pose after the frame, levelled.
        log_evidence: of the frame given that the component is right.
    """

    component: int
    mean: Array
    covariance: Array
    log_evidence: float


class PoseFilter:
    """The mixture, in levelled axes: means (k, 4) x, y, z m, heading rad of the target in the source's frame.

    Attributes:
        means: (k, 4). covariances: (k, 4, 4). weights: (k,); `unknown` is the rest to 1.
    """

    def __init__(self, options: PoseFilterOptions | None = None) -> None:
        self.options = options or PoseFilterOptions()
        self.means: Array = np.zeros((0, 4))
        self.covariances: Array = np.zeros((0, 4, 4))
        self.weights: Array = np.zeros(0)
        self.unknown = 1.0

    def predict(self, odometry_source: Array | None, odometry_target: Array | None) -> None:
        """Carry the belief one frame on by levelled motions (4, 4); None = unknown, the pose persists."""
        o = self.options
        self.weights = self.weights * (1 - o.lost)
        self.unknown = 1.0 - float(self.weights.sum())
        if len(self.weights) == 0:
            return
        Q = np.zeros(4)
        shift_t, turn_t = np.zeros(3), 0.0
        if odometry_target is not None:
            shift_t, turn_t = odometry_target[:3, 3], heading(odometry_target)
        yaw = self.means[:, 3]
        moved = _turned(yaw, shift_t)
        F = np.tile(np.eye(4), (len(yaw), 1, 1))
        F[:, 0, 3], F[:, 1, 3] = -moved[:, 1], moved[:, 0]
        self.means = self.means + np.column_stack([moved, np.full(len(yaw), turn_t)])
        self.covariances = F @ self.covariances @ F.transpose(0, 2, 1)
        if odometry_source is not None:
            turn_s = heading(odometry_source)
            back = np.full(len(yaw), -turn_s)
            self.means[:, :3] = _turned(back, self.means[:, :3] - odometry_source[:3, 3])
            self.means[:, 3] -= turn_s
            G = np.tile(np.eye(4), (len(yaw), 1, 1))
            c, s = np.cos(turn_s), np.sin(turn_s)
            G[:, :2, :2] = [[c, s], [-s, c]]
            self.covariances = G @ self.covariances @ G.transpose(0, 2, 1)
        for motion in (odometry_source, odometry_target):
            if motion is None:
                Q += np.array([o.walk_std_m, o.walk_std_m, 0.2 * o.walk_std_m, o.walk_std_rad]) ** 2 / 2
            else:
                std = o.odometry_std_m + o.odometry_std_per_m * float(np.linalg.norm(motion[:3, 3]))
                turn_std = o.odometry_std_rad + o.odometry_std_per_rad * abs(heading(motion))
                Q += np.array([std, std, 0.2 * std, turn_std]) ** 2
        self.covariances = self.covariances + np.diag(Q)
        if odometry_source is not None:
            # The source's heading error swings the target about it.
            turn_std = o.odometry_std_rad + o.odometry_std_per_rad * abs(heading(odometry_source))
            lever = np.zeros((len(yaw), 4))
            lever[:, 0], lever[:, 1] = self.means[:, 1], -self.means[:, 0]
            lever[:, 3] = -1.0
            swing = turn_std**2 * lever[:, :, None] * lever[:, None, :]
            swing[:, 3, 3] = 0.0  # counted in Q
            self.covariances = self.covariances + swing
        self.means[:, 3] = wrap(self.means[:, 3])

    def update(
        self, means: Array, covariances: Array, probabilities: Array, independence: float | None = None
    ) -> Choice:
        """Take in one frame's hypotheses.

        Args:
            means: (h, 4), covariances: (h, 4, 4): proposed poses, levelled.
            probabilities: (h,) of each under a flat prior; what is missing to 1 stands for "none of these".
            independence: share of this evidence that is new; None = as in the options.
        """
        o = self.options
        share = o.independence if independence is None else independence
        k, h = len(self.weights), len(means)
        p = np.asarray(probabilities, dtype=np.float64) * (1 - o.overlooked)
        none = max(1.0 - float(p.sum()), o.overlooked)
        p, none = p**share, none**share
        C_new = covariances / share + NEWBORN
        if k == 0 and h == 0:
            return Choice(0.0, -1, -1)
        log_volume = float(np.log(o.extent_m**2 * 2.0 * 2 * np.pi))
        # Every component with every hypothesis: overlap of the two Gaussians against a flat density.
        innovation = means[None] - self.means[:, None]
        innovation[..., 3] = wrap(innovation[..., 3])
        S = self.covariances[:, None] + C_new[None] + 1e-9 * np.eye(4)
        W = np.linalg.inv(S)
        squared = np.einsum("khi,khij,khj->kh", innovation, W, innovation)
        log_overlap = -0.5 * (squared + np.linalg.slogdet(S)[1]) - 2.0 * LOG_2PI + log_volume
        both = self.weights[:, None] * p[None] * np.exp(np.minimum(log_overlap, 500.0) * share)
        kept = self.weights * none
        born = self.unknown * p
        still_unknown = self.unknown * none
        gain = self.covariances[:, None] @ W
        fused = self.means[:, None] + np.einsum("khij,khj->khi", gain, innovation)
        fused_covariances = self.covariances[:, None] - gain @ self.covariances[:, None]
        all_means = np.concatenate([fused.reshape(-1, 4), self.means, means])
        all_covariances = np.concatenate([fused_covariances.reshape(-1, 4, 4), self.covariances, C_new])
        weights = np.concatenate([both.ravel(), kept, born])
        origin = np.concatenate(
            [
                np.stack(np.meshgrid(np.arange(k), np.arange(h), indexing="ij"), axis=-1).reshape(-1, 2),
                np.stack([np.arange(k), np.full(k, -1)], axis=1),
                np.stack([np.full(h, -1), np.arange(h)], axis=1),
            ]
        )
        total = float(weights.sum()) + still_unknown
        weights = weights / total
        self.unknown = still_unknown / total
        top = int(np.argmax(weights))
        self._merge(all_means, 0.5 * (all_covariances + all_covariances.transpose(0, 2, 1)), weights)
        return Choice(float(self.weights[0]), int(origin[top, 0]), int(origin[top, 1]))

    def reweigh(
        self,
        explained: Sequence[Explained],
        log_evidence: float,
        means: Array,
        covariances: Array,
        probabilities: Array,
    ) -> None:
        """Take in a frame that was matched once with every likely component as prior, and once with none.

        Components that were not asked join the unknown.

        Args:
            explained: what the frame says under the components.
            log_evidence: of the frame where none of them is right.
            means, covariances, probabilities: (h, 4), (h, 4, 4), (h,) of the poses proposed in that case.
        """
        o = self.options
        share = o.independence
        known = float(sum(self.weights[e.component] for e in explained))
        log_unknown = np.log(max(1.0 - known, 1e-12)) + share * log_evidence
        p = np.asarray(probabilities, dtype=np.float64)
        none = max(1.0 - float(p.sum()), o.overlooked) ** share
        born = (p * (1 - o.overlooked)) ** share
        logs = np.array(
            [np.log(max(self.weights[e.component], 1e-12)) + share * e.log_evidence for e in explained]
            + [log_unknown + np.log(x / (none + born.sum())) for x in born]
        )
        log_none = log_unknown + np.log(none / (none + born.sum()))
        top = max(log_none, logs.max(initial=-np.inf))
        weights = np.exp(logs - top)
        total = float(weights.sum()) + float(np.exp(log_none - top))
        self.unknown = float(np.exp(log_none - top)) / total
        self._merge(
            np.concatenate([np.array([e.mean for e in explained]).reshape(-1, 4), means]),
            np.concatenate(
                [np.array([e.covariance for e in explained]).reshape(-1, 4, 4), covariances / share + NEWBORN]
            ),
            weights / total,
        )

    def best(self) -> tuple[Array, Array, float] | None:
        """Mean (4,), covariance (4, 4) and probability of the most likely component."""
        if len(self.weights) == 0:
            return None
        i = int(np.argmax(self.weights))
        return self.means[i], self.covariances[i], float(self.weights[i])

    def _merge(self, means: Array, covariances: Array, weights: Array) -> None:
        """Join components that say the same, strongest first; keep the most likely."""
        order = np.argsort(-weights)
        order = order[weights[order] > 1e-5 * weights.max(initial=0.0)]
        means, covariances, weights = means[order], covariances[order], weights[order]
        open_ = np.ones(len(order), dtype=np.bool_)
        out: list[tuple[Array, Array, float]] = []
        while open_.any() and len(out) < self.options.max_components:
            i = int(np.argmax(open_))
            off = means - means[i]
            off[:, 3] = wrap(off[:, 3])
            near = open_ & (np.einsum("ni,ij,nj->n", off, np.linalg.inv(covariances[i]), off) < 9.0)
            near[i] = True
            open_ &= ~near
            w = weights[near] / weights[near].sum()
            mean_off = w @ off[near]
            spread = off[near] - mean_off
            mean = means[i] + mean_off
            mean[3] = wrap(mean[3])
            covariance = np.tensordot(w, covariances[near], axes=1) + (spread * w[:, None]).T @ spread
            out.append((mean, covariance, float(weights[near].sum())))
        out.sort(key=lambda c: -c[2])
        self.means = np.array([c[0] for c in out]).reshape(-1, 4)
        self.covariances = np.array([c[1] for c in out]).reshape(-1, 4, 4)
        self.weights = np.array([c[2] for c in out])
        self.unknown = max(1.0 - float(self.weights.sum()), 1e-9)


def wrap(angle: NDArray[np.float64]) -> Array:
    """Angles in (-pi, pi]."""
    return np.asarray((angle + np.pi) % (2 * np.pi) - np.pi)


def heading(T: Array) -> float:
    """Rotation about z of a levelled pose (4, 4), rad."""
    return float(np.arctan2(T[1, 0] - T[0, 1], T[0, 0] + T[1, 1]))


def levelling(up: Array) -> Array:
    """Rotation (3, 3) from a sensor's axes to axes whose z is up."""
    return rotation_between(up, UP)


def level_motion(T: Array, up_before: Array, up_after: Array) -> Array:
    """A motion (4, 4) between sensor frames, in levelled axes."""
    before, after = levelling(up_before), levelling(up_after)
    out = np.eye(4)
    out[:3, :3] = before @ T[:3, :3] @ after.T
    out[:3, 3] = before @ T[:3, 3]
    return out


def to_levelled(pose: RelativePose, up_source: Array, up_target: Array) -> tuple[Array, Array]:
    """Mean (4,) x, y, z, heading and covariance (4, 4) of a relative pose, in levelled axes."""
    T = pose.T_source_target
    level = levelling(up_source)
    flat = level_motion(T, up_source, up_target)
    J = np.zeros((4, 6))
    J[:3, :3] = level @ T[:3, :3]
    J[3, 3:] = up_target
    return np.array([*flat[:3, 3], heading(flat)]), J @ pose.covariance @ J.T


def from_levelled(mean: Array, covariance: Array, up_source: Array, up_target: Array) -> RelativePose:
    """The relative pose of a levelled mean (4,) and covariance (4, 4); tilt is known to TILT_STD_RAD."""
    level_s, level_t = levelling(up_source), levelling(up_target)
    c, s = np.cos(mean[3]), np.sin(mean[3])
    T = np.eye(4)
    T[:3, :3] = level_s.T @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ level_t
    T[:3, 3] = level_s.T @ mean[:3]
    B = np.zeros((6, 4))
    B[:3, :3] = T[:3, :3].T @ level_s.T
    B[3:, 3] = up_target
    C = B @ covariance @ B.T
    C[3:, 3:] += TILT_STD_RAD**2 * np.eye(3)
    return RelativePose(T, 0.5 * (C + C.T))


def _turned(angles: Array, vectors: Array) -> Array:
    """Vectors (3,) or (k, 3) turned about z by angles (k,)."""
    v = np.broadcast_to(vectors, (len(angles), 3))
    c, s = np.cos(angles), np.sin(angles)
    return np.column_stack([c * v[:, 0] - s * v[:, 1], s * v[:, 0] + c * v[:, 1], v[:, 2]])
