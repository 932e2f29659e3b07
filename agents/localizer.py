"""Perceptor + matcher + fuser: observations of all robots in, claims of all robots out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations
from typing import Any, Literal

import numpy as np

from ..envs.claims import Claims
from ..fusion.objects import GAINS, Gain
from ..fusion.team import fuse_team
from ..matching import Matcher, Matching, RelativePose, load_matcher
from .perception.detections import Detections, Perceptor

Matchings = dict[tuple[int, int], Matching]


@dataclass(frozen=True, eq=False)
class View:
    """What one robot brings to the exchange: its detections and its noisy pose, in the world."""

    detections: Detections
    T_world_camera: np.ndarray
    pose_covariance: np.ndarray


@dataclass(frozen=True)
class Localizer:
    """The whole pipeline of a team.

    Attributes:
        perceive: eyes, the same for every robot.
        match: a matcher, or its name.
        pose: `known` hands the robots' noisy relative pose to the matcher as prior. Fusion uses the poses either way,
            as the paper does (section 3.5).
        gain: one of `covis.fusion.objects.GAINS`.
        max_detections: K; of more detections the largest boxes are kept.
        options: passed on to the matcher.
    """

    perceive: Perceptor
    match: Matcher | str
    pose: Literal["known", "unknown"] = "unknown"
    gain: Gain = "covariance"
    max_detections: int = 32
    options: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if isinstance(self.match, str):
            object.__setattr__(self, "match", load_matcher(self.match))
        if self.pose not in ("known", "unknown"):
            raise ValueError(f"pose must be 'known' or 'unknown', got {self.pose!r}")
        if self.gain not in GAINS:
            raise ValueError(f"gain must be one of {', '.join(GAINS)}, got {self.gain!r}")

    def localize(self, observations: Sequence[Mapping[str, Any]], rng: np.random.Generator) -> list[Claims]:
        """Claims of all robots, in the order of their observations."""
        views = self.look(observations, rng)
        return self.claims(views, self.correspond(views, rng))

    def look(self, observations: Sequence[Mapping[str, Any]], rng: np.random.Generator) -> list[View]:
        return [look(self.perceive, o, self.max_detections, rng) for o in observations]

    def correspond(self, views: Sequence[View], rng: np.random.Generator) -> Matchings:
        """Matchings of all unordered pairs of robots, source < target."""
        assert callable(self.match)
        matchings = {}
        for i, j in combinations(range(len(views)), 2):
            prior = relative_pose(views[i], views[j]) if self.pose == "known" else None
            source, target = views[i].detections.graph, views[j].detections.graph
            matchings[i, j] = self.match(source, target, prior=prior, rng=rng, **self.options)
        return matchings

    def claims(self, views: Sequence[View], matchings: Matchings) -> list[Claims]:
        return claims(views, matchings, self.max_detections, self.gain)


def look(perceive: Perceptor, observation: Mapping[str, Any], max_detections: int, rng: np.random.Generator) -> View:
    """One robot's view, of its largest `max_detections` detections."""
    found = perceive(observation, rng)
    if len(found) > max_detections:
        area = np.prod(found.boxes[:, 2:] - found.boxes[:, :2], axis=1)
        keep = np.sort(np.argsort(-area, kind="stable")[:max_detections])
        masks = None if found.masks is None else found.masks[keep]
        found = Detections(found.graph.take(keep), found.boxes[keep], masks)
    pose = np.asarray(observation["pose"], dtype=np.float64)
    return View(found, pose, np.asarray(observation["pose_covariance"], dtype=np.float64))


def relative_pose(source: View, target: View) -> RelativePose:
    """Noisy pose of the target's camera in the source's, with covariance."""
    return RelativePose.between(
        source.T_world_camera, source.pose_covariance, target.T_world_camera, target.pose_covariance
    )


def claims(views: Sequence[View], matchings: Matchings, max_detections: int, gain: Gain = "covariance") -> list[Claims]:
    """What every robot asserts: its boxes, its matches, its detections' positions alone and fused."""
    team = fuse_team(
        [view.detections.graph for view in views],
        [view.T_world_camera for view in views],
        [view.pose_covariance for view in views],
        matchings,
        gain=gain,
    )
    out = []
    for i, (view, own) in enumerate(zip(views, team, strict=True)):
        assert own is not None
        n = len(view.detections)
        claim = Claims.empty(max_detections, len(views) - 1)
        claim.boxes[:n] = view.detections.boxes
        claim.positions[:n] = own.positions
        claim.positions_single[:n] = own.positions_single
        claim.position_variance[:n] = own.position_variance
        for (a, b), matching in matchings.items():
            if i not in (a, b):
                continue
            # Partners in ascending order without self.
            mine, theirs, partner = (0, 1, b - 1) if i == a else (1, 0, a)
            claim.matches[partner, matching.pairs[:, mine]] = matching.pairs[:, theirs]
            claim.match_scores[partner, matching.pairs[:, mine]] = matching.scores
        out.append(claim)
    return out
