"""`covis localize`: how well a team localises, in scenes, under faults, and with its size.

Matching knows the robots' noisy poses, as in the paper's case study. Every row comes from `Member`s, one a robot, that
exchange reports; the rows differ in what a member makes of them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from ..fusion.gains import fuse_own
from ..fusion.member import UNPROTECTED, Match, MemberOptions, Names
from ..fusion.metrics import displacement, gospa, identity_switches, nees
from ..fusion.tracking import TrackerOptions
from ..matching import Matching, RelativePose
from ..matching.bayes import bayes
from ..matching.metrics import Counts, count, is_correct, pooled
from ..matching.multiway import Method, consistent, is_consistent
from ..matching.pose import Array
from .localization_team import FAULTS, BayesMatches, Fault, Instant, Sight, TrueMatches, instants, play
from .progress import Progress, silent
from .settings import Settings

Row = dict[str, Any]
Mask = NDArray[np.bool_]

PARTS = ("scenes", "faults", "team")
MIN_SCORE = 0.9
"""Probability from which a match is used: high, because a wrong one costs more than a missing one."""
TEAM_SCENE = "multi_robot"
MAX_ROBOTS = 8
CONSISTENT_ROBOTS = 4
GATE = 0.999
POSSIBLE = 0.3
"""Probability from which a pairwise match is shown to the other robots, which may support it."""
TEAM_EPISODES = 5
N_TARGETS = 2
"""The case study's targets; their identities follow the observers'."""


@dataclass(frozen=True)
class Motion:
    """How a scene's objects move, and which share of a measurement's variance the next one repeats.

    Chosen on seed 7003, for simulated eyes. Cars are long: their centre lies off the visible side by the same amount in
    every frame.
    """

    tracker: TrackerOptions
    repeated: float = 0.0


MOTIONS = {
    "target_localization": Motion(TrackerOptions(acceleration_std=0.5, initial_speed_std=0.3)),
    "multi_robot": Motion(TrackerOptions(acceleration_std=0.7, initial_speed_std=0.3, gate=12.0), repeated=0.05),
    "aerial_ground": Motion(TrackerOptions(acceleration_std=1.0, initial_speed_std=0.7), repeated=0.1),
    "connected_driving": Motion(TrackerOptions(acceleration_std=2.0, initial_speed_std=8.0), repeated=0.3),
}
NETWORK_REPEATED = 0.2
"""The share that learned eyes repeat beside it, in every scene. Chosen on seed 7003, as well."""

EPISODES = {"target_localization": 50}
DEFAULT_EPISODES = 10


def motion_of(scene: str, perception: str) -> Motion:
    """How a scene's objects are followed with these eyes."""
    motion = MOTIONS[scene]
    return motion if perception == "simulated" else replace(motion, repeated=motion.repeated + NETWORK_REPEATED)


def estimators(scene: str, perception: str = "simulated") -> dict[str, MemberOptions]:
    """What is compared: names and options."""
    motion = motion_of(scene, perception)
    frame = MemberOptions(tracker=None, filter_pose=False, gate=None, least_agreement=0.0)
    tracked = replace(frame, tracker=motion.tracker, repeated=motion.repeated)
    return {
        "paper": replace(frame, gain="paper"),
        "covariance": frame,
        "intersection": replace(frame, gain="intersection"),
        "joint": replace(frame, gain="joint"),
        "paper, tracked": replace(tracked, gain="paper"),
        "covariance, tracked": tracked,
        "covariance, tracked, own pose filtered": replace(tracked, filter_pose=True),
    }


def localization_rows(
    parts: Sequence[str] = PARTS,
    *,
    seed: int = 9001,
    episodes: int | None = None,
    perception: str = "simulated",
    min_score: float = MIN_SCORE,
    exact_poses: bool = False,
    progress: Progress = silent,
) -> list[Row]:
    """Rows of the parts: scenes x estimators, faults x protections, sizes of the team.

    Args:
        parts: of PARTS.
        seed: of the scenes; 7003 is the one on which constants were chosen.
        episodes: per scene; None = 50 of target_localization, 10 of the others, 5 of teams.
        perception: eyes of the robots.
        min_score: matches less probable than this are not used.
        exact_poses: in the scenes, robots know exactly where they are: what remains is the eyes' error.

    Raises:
        ValueError: an unknown part.
    """
    unknown = [part for part in parts if part not in PARTS]
    if unknown:
        raise ValueError(f"unknown part {unknown[0]!r}; there are {', '.join(PARTS)}")
    settings = Settings(pose="known", seed=seed, episodes=episodes, perception=perception)
    jobs: list[Callable[[], list[Row]]] = []
    if "scenes" in parts:
        jobs += [partial(scene_rows, scene, settings, min_score, exact_poses) for scene in MOTIONS]
    if "faults" in parts:
        jobs.append(lambda: fault_rows(settings, min_score))
    if "team" in parts:
        jobs.append(lambda: team_rows(settings))
    rows: list[Row] = []
    for done, job in enumerate(jobs):
        progress(done, len(jobs))
        rows += job()
    progress(len(jobs), len(jobs))
    return [row | {"seed": seed, "perception": perception} for row in rows]


def _with_episodes(settings: Settings, scene: str) -> Settings:
    return replace(settings, episodes=settings.episodes or EPISODES.get(scene, DEFAULT_EPISODES))


# Scenes


def scene_rows(scene: str, settings: Settings, min_score: float, exact_poses: bool = False) -> list[Row]:
    """A row per estimator; on the case study a second one over its targets alone."""
    settings = _with_episodes(settings, scene)
    steps = list(instants(scene, settings, exact_poses=exact_poses))
    rows = []
    matches = [BayesMatches(min_score) for _ in range(settings.episodes or 1)]
    for name, options in estimators(scene, settings.perception).items():
        sights = list(play(steps, options, lambda episode: matches[episode], seed=settings.seed))
        head: Row = {"part": "scenes", "target": scene, "estimator": name, "episodes": settings.episodes}
        head |= {"frames": len(steps), "min_score": min_score}
        rows.append(head | {"objects": "all"} | accuracy(sights))
        if scene == "target_localization":
            n = len(steps[0].views)
            rows.append(head | {"objects": "targets"} | accuracy(sights, range(n, n + N_TARGETS)))
    return rows


def accuracy(sights: Sequence[Sight], wanted: Iterable[int] | None = None) -> Row:
    """Figures of what all robots localised: matched objects, and apart from them objects that nobody matched.

    `single_m` and `fused_m` are over the same detections, those rightly matched with a partner's. `wanted` identities
    restrict the errors, not the counts of matches.
    """
    counts = pooled([_matched(s)[0] for s in sights])
    matched = np.concatenate([_errors(s, _matched(s)[1], wanted) for s in sights])
    alone = np.concatenate([_errors(s, ~_asserted(s), wanted) for s in sights])
    row: Row = {"precision": counts.precision, "recall": counts.recall, "f1": counts.f1}
    row |= _figures("", matched) | _figures("alone_", alone)
    scores = [gospa(s.here.own.positions, s.instant.visible[s.robot]).distance for s in sights]
    row["gospa_m"] = float(np.mean(scores))
    if sights and (sights[0].here.tracks >= 0).any():
        row["identity_switches"] = sum(identity_switches(frames) for frames in _tracks(sights))
    return row


def _figures(prefix: str, errors: Array) -> Row:
    """Of errors (n, 3): single m, fused m, NEES per degree of freedom."""
    n = len(errors)
    out: Row = {f"{prefix}n": n}
    if n == 0:
        return out
    for name, column in (("single", errors[:, 0]), ("fused", errors[:, 1])):
        d = displacement(column)
        out |= {f"{prefix}{name}_m": d.mean, f"{prefix}{name}_median_m": d.median, f"{prefix}{name}_p95_m": d.p95}
    out[f"{prefix}ratio"] = out[f"{prefix}fused_m"] / out[f"{prefix}single_m"]
    out[f"{prefix}nees_per_dof"] = float(errors[:, 2].mean())
    return out


def _matched(sight: Sight) -> tuple[Counts, Mask]:
    """Counts over the partners, and which of the present detections are rightly matched with any of them (n,)."""
    right = np.zeros(len(sight.here.tracks), dtype=bool)
    counts = []
    for a in sight.asserted:
        own, other = a.mine.identity[sight.robot], a.theirs.identity[a.partner]
        matching = Matching(a.pairs, np.ones(len(a.pairs)))
        counts.append(count(matching, own, other))
        if a.mine is sight.instant:
            right[a.pairs[is_correct(matching, own, other), 0]] = True
    return pooled(counts), right


def _asserted(sight: Sight) -> Mask:
    """Present detections (n,) that are matched with anything."""
    out = np.zeros(len(sight.here.tracks), dtype=bool)
    for a in sight.asserted:
        if a.mine is sight.instant:
            out[a.pairs[:, 0]] = True
    return out


def _errors(sight: Sight, keep: Mask, wanted: Iterable[int] | None = None) -> Array:
    """Single m, fused m, NEES per degree of freedom (k, 3) of the kept true detections."""
    own, truth, names = sight.here.own, sight.instant.truth[sight.robot], sight.instant.identity[sight.robot]
    keep = keep & (names >= 0)
    if wanted is not None:
        keep = keep & np.isin(names, list(wanted))
    error = (own.positions - truth)[keep]
    single = np.linalg.norm((own.positions_single - truth)[keep], axis=1)
    return np.column_stack([single, np.linalg.norm(error, axis=1), nees(error, own.covariances[keep]) / 3])


def _tracks(sights: Sequence[Sight]) -> list[list[dict[int, int]]]:
    """Per episode and robot: frame after frame, the track of each true object."""
    out: dict[tuple[int, int], list[dict[int, int]]] = {}
    for s in sights:
        names = s.instant.identity[s.robot].tolist()
        frame = {name: track for name, track in zip(names, s.here.tracks.tolist(), strict=True) if name >= 0}
        out.setdefault((s.instant.episode, s.robot), []).append(frame)
    return list(out.values())


# Faults


def fault_rows(settings: Settings, min_score: float) -> list[Row]:
    settings = replace(settings, episodes=settings.episodes or TEAM_EPISODES, n_robots=CONSISTENT_ROBOTS)
    steps = list(instants(TEAM_SCENE, settings))
    matches = [BayesMatches(min_score) for _ in range(settings.episodes or 1)]
    matchers: dict[str, Callable[[int], Match]] = {
        "bayes": lambda episode: matches[episode],
        "true": lambda episode: TrueMatches.of(steps, episode),
    }
    head = {"part": "faults", "target": TEAM_SCENE, "episodes": settings.episodes, "min_score": min_score}
    motion = motion_of(TEAM_SCENE, settings.perception)
    rows = [
        head | {"matches": name} | row
        for name, matcher in matchers.items()
        for row in faults_of(steps, matcher, motion, settings.seed)
    ]
    ideal = faults_of(
        steps, matchers["true"], motion, settings.seed, lambda episode: TrueMatches.of(steps, episode).names
    )
    return rows + [head | {"matches": "true, tracks too"} | row for row in ideal]


def faults_of(
    steps: Sequence[Instant],
    matcher: Callable[[int], Match],
    motion: Motion,
    seed: int = 0,
    names: Callable[[int], Names] | None = None,
) -> list[Row]:
    """Each fault with and without protections: the good robots' error, and F1 of the matches among them.

    With `names` tracks make no mistakes either, and protections alone are shown: what a fault costs at least.
    """
    guarded = MemberOptions(tracker=motion.tracker, repeated=motion.repeated)
    compared = {"with": guarded, "without": replace(UNPROTECTED, tracker=motion.tracker, repeated=motion.repeated)}
    rows: list[Row] = []
    for name, options in compared.items():
        if names is not None and name == "without":
            continue
        sound = None
        for fault in FAULTS:
            row = _fault_row(steps, options, matcher, fault, seed, names)
            sound = sound or row["fused_m"]
            head = {"robots": len(steps[0].views), "fault": fault.name, "protections": name}
            rows.append(head | row | {"growth": row["fused_m"] / sound - 1.0})
    return rows


def _fault_row(
    steps: Sequence[Instant],
    options: MemberOptions,
    matcher: Callable[[int], Match],
    fault: Fault,
    seed: int,
    names: Callable[[int], Names] | None,
) -> Row:
    bad = len(steps[0].views) - 1
    sights = [s for s in play(steps, options, matcher, fault, seed, names) if s.robot != bad]
    errors = np.concatenate([_errors(s, _common(s, bad)) for s in sights])
    found = pooled([_matched(_among_good(s, bad))[0] for s in sights])
    # Recall is over all there is to find, also where a message was lost.
    counts = Counts(found.correct, found.retrieved, sum(_common_pairs(s, bad) for s in sights))
    with_bad = sum(len(a.pairs) for s in sights for a in s.asserted if a.partner == bad)
    return _figures("", errors) | {
        "precision": counts.precision,
        "recall": counts.recall,
        "f1": counts.f1,
        "matches_with_last_per_frame": with_bad / len(steps),
    }


def _common(sight: Sight, bad: int) -> Mask:
    """Own detections (n,) of objects that another good robot detects at the same time, matched or not."""
    names = sight.instant.identity
    others = [x for j, x in enumerate(names) if j not in (sight.robot, bad)]
    return np.asarray(np.isin(names[sight.robot], np.concatenate(others)))


def _common_pairs(sight: Sight, bad: int) -> int:
    """Matches there are to be found with the good partners at this instant, were every message there."""
    names = sight.instant.identity
    own = names[sight.robot][names[sight.robot] >= 0]
    return sum(len(np.intersect1d(own, x)) for j, x in enumerate(names) if j not in (sight.robot, bad))


def _among_good(sight: Sight, bad: int) -> Sight:
    return replace(sight, asserted=[a for a in sight.asserted if a.partner != bad])


# Size of the team


def team_rows(settings: Settings) -> list[Row]:
    settings = replace(settings, episodes=settings.episodes or TEAM_EPISODES, n_robots=MAX_ROBOTS)
    steps = list(instants(TEAM_SCENE, settings))
    head = {"part": "team", "target": TEAM_SCENE, "episodes": settings.episodes, "frames": len(steps)}
    return [head | row for row in sizes_of(steps)]


def sizes_of(steps: Sequence[Instant]) -> list[Row]:
    """Error of a robot on all it sees as partners are added; matches made consistent against pairwise ones."""
    matched = [_all_pairs(step) for step in steps]
    n_robots = len(steps[0].views)
    rows = [_size_row(steps, matched, n) for n in range(1, n_robots + 1)]
    return rows + [_consistency_row(steps, matched, n) for n in (CONSISTENT_ROBOTS, n_robots)]


def _relative(step: Instant, i: int, j: int) -> RelativePose:
    a, b = step.views[i], step.views[j]
    return RelativePose.between(a.T_world_camera, a.pose_covariance, b.T_world_camera, b.pose_covariance)


def _all_pairs(step: Instant) -> dict[tuple[int, int], Matching]:
    graphs = [v.detections.graph for v in step.views]
    pairs = combinations(range(len(graphs)), 2)
    return {(i, j): bayes(graphs[i], graphs[j], prior=_relative(step, i, j), min_score=POSSIBLE) for i, j in pairs}


def _within(matchings: dict[tuple[int, int], Matching], team: list[int]) -> dict[tuple[int, int], Matching]:
    """The matchings among a team, its robots numbered from 0."""
    return {(a, b): matchings[team[a], team[b]] for a, b in combinations(range(len(team)), 2)}


def _size_row(steps: Sequence[Instant], matched: Sequence[dict[tuple[int, int], Matching]], n: int) -> Row:
    """Every robot in turn with the n - 1 that follow it."""
    errors = []
    for step, matchings in zip(steps, matched, strict=True):
        robots = len(step.views)
        for first in range(robots):
            team = sorted((first + k) % robots for k in range(n))
            errors.append(_team_errors(step, matchings, team, first))
    return {"what": "size", "robots": n} | _figures("", np.concatenate(errors))


def _team_errors(step: Instant, matchings: dict[tuple[int, int], Matching], team: list[int], robot: int) -> Array:
    """Single m, fused m, NEES per degree of freedom (k, 3) of all true objects that `robot` of the team detects."""
    graphs = [step.views[r].detections.graph for r in team]
    me = team.index(robot)
    poses = {(me, k): _relative(step, robot, r) for k, r in enumerate(team) if r != robot}
    groups = consistent(_within(matchings, team), [len(g) for g in graphs])
    covariance = step.views[robot].pose_covariance
    own = fuse_own(graphs, poses, groups, me, gate=GATE, trust_own=True, frame_covariance=covariance)
    true = step.identity[robot] >= 0
    error = (own.positions - step.truth[robot])[true]
    single = np.linalg.norm((own.positions_single - step.truth[robot])[true], axis=1)
    return np.column_stack([single, np.linalg.norm(error, axis=1), nees(error, own.covariances[true]) / 3])


def _consistency_row(steps: Sequence[Instant], matched: Sequence[dict[tuple[int, int], Matching]], n: int) -> Row:
    """Every robot in turn with the n - 1 that follow it: pairwise matches as they are, and made consistent.

    `f1` is that of "joint"; `convex_f1` and `spectral_f1` are those of the other methods.
    """
    before, consistent_frames = [], []
    after: dict[Method, list[Counts]] = {method: [] for method in get_args(Method)}
    for step, matchings in zip(steps, matched, strict=True):
        robots = len(step.views)
        for first in range(robots if n < robots else 1):
            team = sorted((first + k) % robots for k in range(n))
            sizes = [len(step.views[r].detections) for r in team]
            possible = _within(matchings, team)
            names = [step.identity[r] for r in team]
            before += [count(_probable(m, 0.5), names[a], names[b]) for (a, b), m in possible.items()]
            for method, counts in after.items():
                joined = consistent(possible, sizes, method=method)
                consistent_frames.append(is_consistent(joined, sizes))
                counts += [count(m, names[a], names[b]) for (a, b), m in joined.items()]
    pairwise, made = pooled(before), pooled(after["joint"])
    row: Row = {"what": "consistency", "robots": n, "pairwise_f1": pairwise.f1, "f1": made.f1}
    row |= {"pairwise_precision": pairwise.precision, "pairwise_recall": pairwise.recall}
    row |= {f"{method}_f1": pooled(after[method]).f1 for method in ("convex", "spectral")}
    row |= {"precision": made.precision, "recall": made.recall, "consistent_frames": float(np.mean(consistent_frames))}
    return row


def _probable(matching: Matching, least: float) -> Matching:
    keep = matching.scores >= least
    return Matching(matching.pairs[keep], matching.scores[keep])
