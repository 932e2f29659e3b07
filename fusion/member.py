"""One robot of a team over time: its own pose filtered, partners' reports fused at their own time, objects tracked.

Every robot reports what it sees and where it believes to be. Whoever gets a report matches it with what it saw itself
at that time, fuses the two, and takes the result into its tracks, however late the report comes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from ..matching.checks import check_interval
from ..matching.graph import Matching, ObjectGraph
from ..matching.pose import (
    Array,
    RelativePose,
    adjoint,
    check_covariance,
    check_pose,
    exp_se3,
    invert,
    transform,
)
from .channel import BYTES_PER_NUMBER, message_size
from .gains import fuse
from .objects import GAINS, FusedObjects, Gain, OwnObjects, agreement, own_objects
from .registration import log_se3
from .tracking import Batch, Tracker, TrackerOptions

MIN_VARIANCE = 1e-8
"""m^2 and rad^2 added to a pose's covariance before it is inverted."""
SAME_TIME_S = 1e-6
NEAR = 9.0
"""Squared Mahalanobis distance below which a partner's unmatched object could be one of the own."""
AGREEMENT_RATE = 0.2
"""Weight of the newest frame in a partner's agreement."""
MEMORY_S = 2.0
"""How long own views wait for reports where there is no tracker, s."""


@dataclass(frozen=True, eq=False)
class Report:
    """What a robot tells its partners about one instant.

    Attributes:
        robot: index in the team.
        time: s, when it was seen.
        graph: its detections.
        steadied: the same detections at the positions of their tracks, from this robot's measurements alone: good for
            matching; not to be fused, because successive ones rest on the same measurements.
        T_world_sensor: (4, 4) where it believes to be; covariance (6, 6), right perturbation.
    """

    robot: int
    time: float
    graph: ObjectGraph
    steadied: ObjectGraph
    T_world_sensor: Array
    covariance: Array

    @property
    def size_bytes(self) -> int:
        """On the air: the detections twice, the pose (16 numbers) and its covariance (21)."""
        return message_size(self.graph) + message_size(self.steadied) + 37 * BYTES_PER_NUMBER

    def relative(self, partner: Report) -> RelativePose:
        """Pose of the partner's sensor in this robot's, from both beliefs."""
        return RelativePose.between(self.T_world_sensor, self.covariance, partner.T_world_sensor, partner.covariance)


Match = Callable[[Report, Report], Matching]
Names = Callable[[Report], NDArray[np.int64]]
"""Identity (n,) of each detection of a report, where detections carry one: no track takes measurements of two."""


@dataclass(frozen=True)
class OdometryNoise:
    """1 sigma of one step: translation per metre of it, heading, and floors that keep a filter awake."""

    position_per_m: float = 0.02
    heading_rad: float = 0.002
    position_m: float = 0.001

    def __post_init__(self) -> None:
        for name in ("position_per_m", "heading_rad", "position_m"):
            check_interval(name, getattr(self, name), "[0, inf)")

    def covariance(self, motion: Array, up: Array) -> Array:
        """(6, 6), right perturbation."""
        out = np.zeros((6, 6))
        distance = float(np.linalg.norm(motion[:3, 3]))
        out[:3, :3] = (self.position_m**2 + (self.position_per_m * distance) ** 2) * np.eye(3)
        out[3:, 3:] = self.heading_rad**2 * np.outer(up, up)
        return out


@dataclass(frozen=True)
class MemberOptions:
    """How a robot localises with its team.

    Attributes:
        gain: how measurements are weighed, see `fuse`.
        gate: share of honest measurements to keep in each group; None = keep all.
        least_agreement: a partner whose measurements pass the gate less often than this, over the last frames, is left
            out altogether; 0 = never.
        own_time: fuse a report with what was seen at its own time; False = with what is seen when it arrives.
        filter_pose: filter the robot's own pose by its odometry; False = report it as it comes.
        tracker: of the objects; None = every frame stands alone.
        repeated: share of a measurement's variance that the next measurement of the object repeats (an object's centre
            lies as far from its surface as before, a network misjudges it as before), which no averaging takes away.
        odometry: errors of the robot's own motion.

    Raises:
        ValueError: a value out of its range.
    """

    gain: Gain = "covariance"
    gate: float | None = 0.999
    least_agreement: float = 0.6
    own_time: bool = True
    filter_pose: bool = True
    tracker: TrackerOptions | None = field(default_factory=TrackerOptions)
    repeated: float = 0.0
    odometry: OdometryNoise = OdometryNoise()

    def __post_init__(self) -> None:
        if self.gain not in GAINS:
            raise ValueError(f"gain must be one of {', '.join(GAINS)}, got {self.gain!r}")
        if self.gate is not None:
            check_interval("gate", self.gate, "(0, 1)")
        check_interval("least_agreement", self.least_agreement, "[0, 1]")
        check_interval("repeated", self.repeated, "[0, inf)")


UNPROTECTED = MemberOptions(gate=None, least_agreement=0.0, own_time=False)
"""Nothing that guards against wrong or late partners."""


@dataclass(frozen=True, eq=False)
class Localized:
    """A robot's own detections of one instant.

    Attributes:
        own: alone, and from everything known.
        tracks: (n,) int64 id of each detection's track, -1 without a tracker.
    """

    own: OwnObjects
    tracks: NDArray[np.int64]


class PoseBelief:
    """A robot's own pose in the world: odometry carries it on, a noisy absolute pose corrects it (an EKF)."""

    def __init__(self, noise: OdometryNoise) -> None:
        self.noise = noise
        self.T: Array | None = None
        self.P = np.zeros((6, 6))

    def update(self, measured: Array, covariance: Array, odometry: Array | None, up: Array | None) -> None:
        """One step: own motion (4, 4) since the last, None = unknown; measured pose (4, 4) with covariance (6, 6)."""
        if self.T is None or odometry is None:
            self.T, self.P = measured.copy(), covariance.copy()
            return
        back = adjoint(invert(odometry))
        axis = np.array([0.0, 0.0, 1.0]) if up is None else up
        P = back @ self.P @ back.T + self.noise.covariance(odometry, axis)
        T = self.T @ odometry
        innovation = log_se3(invert(T) @ measured)
        gain = P @ np.linalg.inv(P + covariance + MIN_VARIANCE * np.eye(6))
        self.T = T @ exp_se3(gain @ innovation)
        keep = np.eye(6) - gain
        P = keep @ P @ keep.T + gain @ covariance @ gain.T
        self.P = 0.5 * (P + P.T)


@dataclass
class _Moment:
    """What this robot saw at one time, what it has heard of it since, and what it makes of both (None = to be done)."""

    own: Report
    T_odometry_sensor: Array
    reports: dict[int, Report] = field(default_factory=dict)
    fused: FusedObjects | None = None


class Member:
    """One robot's side of a team.

        report = member.look(time, graph, pose, pose_covariance, odometry)   # to be sent to the partners
        here = member.localize(reports_that_arrived)

    Args:
        robot: its index in a team of `n_robots`.
        match: matcher of two reports, the lower robot's first.
        names: identities of a report's detections; None = they carry none.
    """

    def __init__(
        self,
        robot: int,
        n_robots: int,
        match: Match,
        options: MemberOptions | None = None,
        names: Names | None = None,
    ) -> None:
        self.robot, self.n_robots, self.match, self.names = robot, n_robots, match, names
        self.options = options or MemberOptions()
        self.belief = PoseBelief(self.options.odometry)
        self.tracker = None if self.options.tracker is None else Tracker(self.options.tracker)
        self.alone = None if self.options.tracker is None else Tracker(self.options.tracker)
        self.agreement = np.ones(n_robots)
        self.dropped = 0
        self._moments: list[_Moment] = []

    def look(
        self, time: float, graph: ObjectGraph, pose: Array, pose_covariance: Array, odometry: Array | None
    ) -> Report:
        """Take in an own observation, of a later time than the last; the report for the partners.

        Args:
            time: s.
            pose: (4, 4) noisy T_world_sensor, with covariance (6, 6), right perturbation.
            odometry: (4, 4) own motion since the last observation; None = unknown.

        Raises:
            ValueError: the time is not later than the last; no pose, or no covariance. Nothing is taken in then.
        """
        if not np.isfinite(time):
            raise ValueError(f"time must be finite, got {time}")
        if self._moments and time <= self._moments[-1].own.time:
            raise ValueError(f"time {time} is not later than the last, {self._moments[-1].own.time}")
        pose, pose_covariance = check_pose(pose, "pose"), check_covariance(pose_covariance, "pose_covariance")
        odometry = None if odometry is None else check_pose(odometry, "odometry")
        step = odometry if self.options.filter_pose else None
        self.belief.update(pose, pose_covariance, step, graph.up)
        assert self.belief.T is not None
        last = self._moments[-1].T_odometry_sensor if self._moments else np.eye(4)
        T_odometry_sensor = last if odometry is None else last @ odometry
        steadied = self._steadied(time, graph, T_odometry_sensor)
        own = Report(self.robot, time, graph, steadied, self.belief.T, self.belief.P)
        moment = _Moment(own, T_odometry_sensor)
        self._moments.append(moment)
        self._forget(time)
        if self.tracker is not None:
            self.tracker.update(self._batch(moment, self._fuse(moment, {})))
        return own

    def localize(self, arrived: Iterable[Report]) -> Localized:
        """Take in reports; the own detections of the last `look`, as known now.

        Raises:
            ValueError: a report of this robot itself, or of none of the team. No report is taken in then.
        """
        arrived = list(arrived)
        for report in arrived:
            if report.robot == self.robot or not 0 <= report.robot < self.n_robots:
                raise ValueError(f"robot {self.robot} of {self.n_robots} got a report of robot {report.robot}")
        touched = {}
        for report in arrived:
            moment = self._moment_of(report.time)
            if moment is None:
                self.dropped += 1
            else:
                moment.reports[report.robot] = report
                moment.fused = None
                touched[moment.own.time] = moment
        for moment in touched.values():
            self._judge(moment)
            if self.tracker is not None:
                self.tracker.revise(self._batch(moment, self._fused(moment)), len(moment.own.graph))
        return self._alone() if self.tracker is None else self._together(self.tracker)

    def matches(self, report: Report) -> NDArray[np.int64]:
        """Own detections and the partner's (k, 2) that are one object, of those that are believed; after `localize`."""
        moment = self._moment_of(report.time)
        if moment is None:
            return np.zeros((0, 2), dtype=np.int64)
        fused = self._fused(moment)
        both = [self.robot, report.robot]
        return fused.members[:, both][fused.used[:, both].all(axis=1)]

    def _steadied(self, time: float, graph: ObjectGraph, T_odometry_sensor: Array) -> ObjectGraph:
        """The detections at the positions of their tracks, from this robot's measurements alone."""
        if self.alone is None:
            return graph
        R = T_odometry_sensor[:3, :3]
        positions, covariances = transform(T_odometry_sensor, graph.positions), R @ graph.full_covariances() @ R.T
        labels = self.alone.update(Batch(time, positions, covariances))
        positions, covariances = _tracked(self.alone, labels, T_odometry_sensor)
        return replace(graph, positions=positions, covariances=covariances)

    def _moment_of(self, time: float) -> _Moment | None:
        """The moment with which a report of that time is fused; None when that is too long ago."""
        if not self.options.own_time:
            return self._moments[-1]
        return next((m for m in self._moments if abs(m.own.time - time) < SAME_TIME_S), None)

    def _judge(self, moment: _Moment) -> None:
        """Which partners' measurements pass the gate: an average over the last frames."""
        if self.options.gate is None:
            return
        share = agreement(self._fuse(moment, moment.reports))
        seen = np.isfinite(share)
        self.agreement[seen] += AGREEMENT_RATE * (share[seen] - self.agreement[seen])

    def _fused(self, moment: _Moment) -> FusedObjects:
        """All objects of a moment from the partners that are believed, made once."""
        if moment.fused is None:
            trusted = self.agreement >= self.options.least_agreement
            moment.fused = self._fuse(moment, {j: report for j, report in moment.reports.items() if trusted[j]})
        return moment.fused

    def _fuse(self, moment: _Moment, reports: Mapping[int, Report]) -> FusedObjects:
        """All objects of a moment in this robot's sensor frame."""
        me, own = self.robot, moment.own
        nothing = own.graph.take(np.zeros(0, dtype=np.int64))
        graphs = [reports[j].graph if j in reports else nothing for j in range(self.n_robots)]
        graphs[me] = own.graph
        matchings = {}
        for j, report in reports.items():
            first, second = (own, report) if me < j else (report, own)
            matchings[min(me, j), max(me, j)] = self.match(first, second)
        poses = {(me, j): own.relative(report) for j, report in reports.items()}
        o = self.options
        return fuse(
            graphs,
            poses,
            matchings,
            frame=me,
            gain=o.gain,
            gate=o.gate,
            frame_covariance=own.covariance,
        )

    def _own(self, moment: _Moment, fused: FusedObjects) -> OwnObjects:
        """The own detections of a moment."""
        nothing = moment.own.graph.take(np.zeros(0, dtype=np.int64))
        graphs = [nothing] * self.n_robots
        graphs[self.robot] = moment.own.graph
        return own_objects(graphs, fused, gain=self.options.gain)

    def _batch(self, moment: _Moment, fused: FusedObjects) -> Batch:
        """All objects in the odometry frame, for the tracker: the own detections in their order, then the partners'."""
        own, T = self._own(moment, fused), moment.T_odometry_sensor
        theirs = np.flatnonzero(fused.members[:, self.robot] < 0)
        classes = None
        if self.names is None:
            theirs = theirs[~_near(fused.positions[theirs], fused.covariances[theirs], own)]
        else:
            mine, others = self.names(moment.own), self._others_names(moment, fused.members[theirs])
            new = ~np.isin(others, mine)
            theirs, classes = theirs[new], np.concatenate([mine, others[new]])
        positions = np.concatenate([own.positions, fused.positions[theirs]])
        covariances = np.concatenate([own.covariances, fused.covariances[theirs]])
        R = T[:3, :3]
        return Batch(moment.own.time, transform(T, positions), R @ covariances @ R.T, classes)

    def _others_names(self, moment: _Moment, members: NDArray[np.int64]) -> NDArray[np.int64]:
        """Names (k,) of groups with members (k, N) of partners alone: that of the first partner."""
        assert self.names is not None
        names = {j: self.names(report) for j, report in moment.reports.items()}
        first = (members >= 0).argmax(axis=1)
        return np.array([names[j][row[j]] for j, row in zip(first.tolist(), members, strict=True)], dtype=np.int64)

    def _alone(self) -> Localized:
        """The last moment's detections without tracks."""
        now = self._moments[-1]
        own = self._own(now, self._fused(now))
        return Localized(own, np.full(len(own.positions), -1, dtype=np.int64))

    def _together(self, tracker: Tracker) -> Localized:
        """The last moment's detections at the positions of their tracks."""
        now = self._moments[-1]
        own = self._own(now, self._fused(now))
        labels = tracker.labels(now.own.time)[: len(now.own.graph)]
        positions, covariances = _tracked(tracker, labels, now.T_odometry_sensor)
        covariances = covariances + self.options.repeated * own.covariances
        return Localized(replace(own, positions=positions, covariances=covariances), labels)

    def _forget(self, time: float) -> None:
        history = MEMORY_S if self.tracker is None else self.tracker.options.history_s
        while self._moments[0].own.time < time - history:
            self._moments.pop(0)


def _near(positions: Array, covariances: Array, own: OwnObjects) -> NDArray[np.bool_]:
    """Which of positions (n, 3) could be one of the own objects: a second track of it would only confuse."""
    if len(positions) == 0 or len(own.positions) == 0:
        return np.zeros(len(positions), dtype=np.bool_)
    offset = positions[:, None] - own.positions[None]
    W = np.linalg.inv(covariances[:, None] + own.covariances[None] + MIN_VARIANCE * np.eye(3))
    squared = np.einsum("nmi,nmij,nmj->nm", offset, W, offset)
    return np.asarray((squared < NEAR).any(axis=1))


def _tracked(tracker: Tracker, labels: NDArray[np.int64], T_odometry_sensor: Array) -> tuple[Array, Array]:
    """Positions (n, 3) and covariances (n, 3, 3) of the tracks `labels` (n,), in the sensor frame."""
    row = {track: k for k, track in enumerate(tracker.tracks.ids.tolist())}
    rows = [row[track] for track in labels.tolist()]
    T = invert(T_odometry_sensor)
    R = T[:3, :3]
    return transform(T, tracker.tracks.positions[rows]), R @ tracker.tracks.position_covariances[rows] @ R.T
