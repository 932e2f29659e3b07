"""Teams of `covis.fusion.Member`s on a scene's episodes: what they localise, when all is well and under faults."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from ..agents.localizer import View
from ..agents.perception import make_perceptor
from ..envs.collaborative import CollaborativeEnv
from ..fusion.channel import Channel, ChannelOptions
from ..fusion.member import SAME_TIME_S, Localized, Match, Member, MemberOptions, Names, Report
from ..matching import Matching, ObjectGraph
from ..matching.bayes import bayes
from ..matching.pose import Array
from .methods import oracle
from .run_scene import identity, look_around, make_env, step_scripted
from .settings import Settings

WRONG_POSE_M = 5.0
EXACT = 1e-10
"""m^2 and rad^2: variances of a pose that is known exactly."""
FALSE_NAME = 1_000_000
"""From here on, names of detections that are of no object."""


@dataclass(frozen=True, eq=False)
class Instant:
    """What N robots bring at one step, and the truth about it.

    Attributes:
        time: s since the episode began.
        views: N. odometry: N own motions (4, 4) since the last step.
        identity: N times (n,) true object of each detection, -1 = none. truth: N times (n, 3) m its true position in
            the robot's true sensor frame, NaN where there is none.
        visible: N times (m, 3) m of all objects in the robot's image, likewise.
    """

    episode: int
    time: float
    views: list[View]
    odometry: list[Array]
    identity: list[NDArray[np.int64]]
    truth: list[Array]
    visible: list[Array]


def instants(scene: str, settings: Settings, *, exact_poses: bool = False) -> Iterator[Instant]:
    """All steps of a scene's episodes, driven by its scripted controllers.

    With `exact_poses` the robots report where they truly are, and know that.
    """
    env = make_env(scene, settings)
    perceive = make_perceptor(settings.perception, env)
    try:
        for episode in range(settings.episodes or 1):
            observations, _ = env.reset(seed=[settings.seed, episode])
            step = 0
            while env.agents:
                views = look_around(env, perceive, observations, (settings.seed, episode, step))
                odometry = [np.asarray(o["odometry"], dtype=np.float64) for o in observations.values()]
                if exact_poses:
                    views = [
                        replace(view, T_world_camera=T, pose_covariance=EXACT * np.eye(6))
                        for view, T in zip(views, env.ground_truth().T_world_camera, strict=True)
                    ]
                yield _instant(env, episode, step * env.world.step_seconds, views, odometry)
                observations = step_scripted(env)
                step += 1
    finally:
        env.close()


def _instant(env: CollaborativeEnv, episode: int, time: float, views: list[View], odometry: list[Array]) -> Instant:
    truth = env.ground_truth()
    index = {int(name): row for row, name in enumerate(truth.identity)}
    names, positions, visible = [], [], []
    for robot, view in enumerate(views):
        in_camera = np.vstack([truth.positions_in_camera(robot), np.full((1, 3), np.nan)])
        own = identity(view, robot, env)
        names.append(own)
        positions.append(in_camera[[index.get(int(name), -1) for name in own]])
        visible.append(in_camera[:-1][truth.visible()[robot]])
    return Instant(episode, time, views, odometry, names, positions, visible)


class BayesMatches:
    """Matches of reports by `bayes`, poses known; it remembers: robots of a team, and teams that differ in what they
    make of their reports, ask for the same pairs."""

    def __init__(self, min_score: float) -> None:
        self.min_score = min_score
        self._known: dict[tuple[Hashable, Hashable], Matching] = {}

    def __call__(self, source: Report, target: Report) -> Matching:
        key = _content(source), _content(target)
        if key not in self._known:
            prior = source.relative(target)
            self._known[key] = bayes(source.steadied, target.steadied, prior=prior, min_score=self.min_score)
        return self._known[key]


def _content(report: Report) -> Hashable:
    graph = report.steadied
    covariances = b"" if graph.covariances is None else graph.covariances.tobytes()
    arrays = (graph.positions, graph.attributes, report.T_world_sensor, report.covariance)
    return report.robot, report.time, covariances, *(x.tobytes() for x in arrays)


@dataclass(frozen=True)
class TrueMatches:
    """The true matches, of one episode: what fusion alone does with a fault."""

    identity: dict[tuple[int, float], NDArray[np.int64]]

    @classmethod
    def of(cls, steps: Sequence[Instant], episode: int) -> TrueMatches:
        own = [step for step in steps if step.episode == episode]
        return cls({(robot, step.time): names for step in own for robot, names in enumerate(step.identity)})

    def __call__(self, source: Report, target: Report) -> Matching:
        return oracle(self.identity[source.robot, source.time], self.identity[target.robot, target.time])

    def names(self, report: Report) -> NDArray[np.int64]:
        """True identity of each detection; one of its own for what is no object."""
        names = self.identity[report.robot, report.time]
        return np.where(names >= 0, names, FALSE_NAME + np.arange(len(names)))


@dataclass(frozen=True)
class Fault:
    """What is wrong with the last robot of a team, and with the channel.

    Attributes:
        channel: between all robots.
        wrong_pose_m: constant error of the last robot's reported position.
        random_positions: the last robot reports its detections at random places of its view.
    """

    name: str
    channel: ChannelOptions = field(default_factory=ChannelOptions)
    wrong_pose_m: float = 0.0
    random_positions: bool = False


FAULTS = (
    Fault("none"),
    Fault("30 % of messages lost", ChannelOptions(loss=0.3)),
    Fault("0.4 s delay", ChannelOptions(latency_s=0.4)),
    Fault("one robot's pose off by 5 m", wrong_pose_m=WRONG_POSE_M),
    Fault("one robot reports random positions", random_positions=True),
)


@dataclass(frozen=True, eq=False)
class Asserted:
    """Own detections and a partner's (k, 2) that a robot takes for one object.

    `mine` is the instant of the own detections, `theirs` that of the partner's.
    """

    partner: int
    mine: Instant
    theirs: Instant
    pairs: NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Sight:
    """One robot at one instant: what it localised, and what it made of the reports that came in."""

    instant: Instant
    robot: int
    here: Localized
    asserted: list[Asserted]


def play(
    steps: Sequence[Instant],
    options: MemberOptions,
    matcher: Callable[[int], Match],
    fault: Fault = FAULTS[0],
    seed: int = 0,
    names: Callable[[int], Names] | None = None,
) -> Iterator[Sight]:
    """A team through the steps, every robot once per step.

    `matcher` gives an episode's matcher of reports, `names` its identities where tracks are to know them too.
    """
    episode = None
    for number, step in enumerate(steps):
        if step.episode != episode:
            episode = step.episode
            rng = np.random.default_rng([seed, episode])
            n, match, known = len(step.views), matcher(episode), names and names(episode)
            members = [Member(i, n, match, options, known) for i in range(n)]
            channel: Channel[tuple[Report, int]] = Channel(rng, fault.channel)
            offset = _horizontal(rng) * fault.wrong_pose_m
        for i, member in enumerate(members):
            view = _faulty(step.views[i], fault, offset, rng) if i == n - 1 else step.views[i]
            report = member.look(
                step.time, view.detections.graph, view.T_world_camera, view.pose_covariance, step.odometry[i]
            )
            for j in range(n):
                if j != i:
                    channel.send(f"{i}", f"{j}", (report, number), time=step.time, size_bytes=report.size_bytes)
        inbox: list[list[tuple[Report, int]]] = [[] for _ in members]
        for message in channel.receive(time=step.time + SAME_TIME_S):
            inbox[int(message.receiver)].append(message.payload)
        for i, member in enumerate(members):
            here = member.localize([report for report, _ in inbox[i]])
            asserted = [
                Asserted(r.robot, steps[sent] if options.own_time else step, steps[sent], member.matches(r))
                for r, sent in inbox[i]
            ]
            yield Sight(step, i, here, asserted)


def _horizontal(rng: np.random.Generator) -> Array:
    angle = rng.uniform(-np.pi, np.pi)
    return np.array([np.cos(angle), np.sin(angle), 0.0])


def _faulty(view: View, fault: Fault, offset: Array, rng: np.random.Generator) -> View:
    """The last robot's view as it reports it."""
    T = view.T_world_camera.copy()
    T[:3, 3] += offset
    found = view.detections
    if fault.random_positions and len(found):
        found = replace(found, graph=_scattered(found.graph, rng))
    return replace(view, detections=found, T_world_camera=T)


def _scattered(graph: ObjectGraph, rng: np.random.Generator) -> ObjectGraph:
    """The graph with its objects anywhere within the same distances and the same 60 degrees, as sure as before."""
    distance = np.linalg.norm(graph.positions, axis=1)
    bearing = rng.uniform(-np.pi / 6, np.pi / 6, len(graph))
    placed = rng.uniform(distance.min(), distance.max(), len(graph))
    positions = placed[:, None] * np.stack([np.sin(bearing), np.zeros(len(graph)), np.cos(bearing)], axis=1)
    return replace(graph, positions=positions, covariances=None)
