"""Matching over time: what earlier frames say about the relative pose becomes the prior of the next matching."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ..matching.bayes import bayes
from ..matching.bayes_solve import decode
from ..matching.checks import check_count, check_interval
from ..matching.graph import Matcher, Matching, ObjectGraph
from ..matching.pose import Array, RelativePose
from .posefilter import Choice, Explained, PoseFilter, PoseFilterOptions, from_levelled, level_motion, to_levelled
from .registration import RegistrationError, register

MAX_SPREAD = 1e4
"""Trace of a pose's covariance (m^2 and rad^2) beyond which a hypothesis is no information."""


FOLLOW_FLOOR = np.diag([0.05**2, 0.05**2, 0.05**2, 0.003**2])
"""m^2 and rad^2 added to a pose that was followed: successive views share part of their errors."""


@dataclass(frozen=True)
class PairOptions:
    """How a pair's matcher is used over time.

    Attributes:
        filter: of the relative pose.
        trust: probability of a pose from which it is handed to the matcher as prior.
        refuse: while none is trusted, matches whose score times the best pose's probability is lower are not made.
        widen: factor on the covariance of a prior without odometry; above 1 because errors of successive views are
            alike, and because cars turn faster than persistence expects.
        asked: components less likely than this are not handed to the matcher as priors; at most `max_asked` are.
        common: probability that views of a pair whose pose is known share any object.
        least_score: matches of a lower averaged probability are not made, unless the matcher's `min_score` is given.
        min_registered: matches a matcher without poses must give for one to be estimated.
        map_independence: share of what matching the local maps says in a frame that is new.
        beside_maps: in place of the filter's `independence` for views matched beside maps, which hold them too.

    Raises:
        ValueError: a value out of its range.
    """

    filter: PoseFilterOptions = field(default_factory=PoseFilterOptions)
    trust: float = 0.7
    refuse: float = 0.3
    widen: float = 4.0
    asked: float = 0.02
    max_asked: int = 3
    common: float = 0.9
    least_score: float = 0.42
    min_registered: int = 4
    map_independence: float = 0.05
    beside_maps: float = 0.1

    def __post_init__(self) -> None:
        for name in ("trust", "refuse", "asked", "least_score"):
            check_interval(name, getattr(self, name), "[0, 1]")
        check_interval("widen", self.widen, "(0, inf)")
        check_interval("common", self.common, "(0, 1)")
        check_count("max_asked", self.max_asked, 0)
        check_count("min_registered", self.min_registered, 0)
        for name in ("map_independence", "beside_maps"):
            check_interval(name, getattr(self, name), "(0, 1]")


class PairTracker:
    """State of one pair of robots through one episode.

    Either let it call the matcher, once without and once with the prior:

        tracker.predict(odometry_source, odometry_target)
        matching = tracker.match(matcher, source, target)

    where `match` also takes both robots' local maps, which it matches with each other first; or only ask for the prior
    and report what came of it:

        prior = tracker.prior(odometry_source, odometry_target)
        matching = matcher(source, target, prior=prior)
        tracker.update(source, target, matching)

    Both robots' graphs need `up`; without, every frame stands alone.
    """

    def __init__(self, options: PairOptions | None = None) -> None:
        self.options = options or PairOptions()
        self.reset()

    def reset(self) -> None:
        """Forget everything: a new episode."""
        self.filter = PoseFilter(self.options.filter)
        self._ups: tuple[Array, Array] | None = None
        self._given: RelativePose | None = None
        self._pending: list[tuple[Array | None, Array | None]] = []
        self._odometry = False

    def predict(self, odometry_source: Array | None = None, odometry_target: Array | None = None) -> None:
        """A frame has passed: each robot's own motion (4, 4) since the last, in sensor frames; None = unknown.

        To be called for every frame, also for those in which the pair is not matched.
        """
        self._pending.append((odometry_source, odometry_target))
        self._odometry = odometry_source is not None and odometry_target is not None

    def prior(self, odometry_source: Array | None = None, odometry_target: Array | None = None) -> RelativePose | None:
        """Prior for this frame, after `predict`; None while no pose is trusted."""
        self.predict(odometry_source, odometry_target)
        self._given = None
        if self._ups is not None:
            self._carry(*self._ups)
            self._pending.clear()
            best = self.filter.best()
            if best is not None and best[2] >= self.options.trust:
                self._given = from_levelled(best[0], best[1], *self._ups)
        return self._given

    def update(self, source: ObjectGraph, target: ObjectGraph, matching: Matching) -> None:
        """Take in the matching of this frame, made with or without the prior."""
        if source.up is None or target.up is None:
            return
        self._ups = (source.up, target.up)
        if self._given is not None:
            best = int(np.argmax(self.filter.weights))
            if len(matching) < 2 or matching.scores.mean() < 0.5:
                # Little is explained by the prior: trust it less, until the matcher is asked without one again.
                self.filter.weights[best] *= 0.5
                self.filter.unknown = 1.0 - float(self.filter.weights.sum())
            elif matching.pose is not None:
                # The matcher's pose contains the prior already: it replaces the component.
                mean, covariance = to_levelled(matching.pose, *self._ups)
                self.filter.means[best], self.filter.covariances[best] = mean, covariance
            return
        found = propose(source, target, matching, self.options.min_registered)
        self._absorb(found)

    def match(
        self,
        matcher: Matcher,
        source: ObjectGraph,
        target: ObjectGraph,
        *,
        maps: tuple[ObjectGraph, ObjectGraph] | None = None,
        rng: np.random.Generator | None = None,
        **options: Any,
    ) -> Matching:
        """This frame's matching, after `predict`; `maps` are all that either robot remembers (`LocalMap.see`).

        `bayes` is asked without its prior of right-angled headings, unless `right_angles` is given: the prior would
        count again with every frame.
        """
        if matcher is bayes:
            options = {"right_angles": 0.0} | options
        alone = matcher(source, target, prior=None, rng=rng, **options)
        if source.up is None or target.up is None:
            return alone
        if self._ups is not None:
            self._carry(source.up, target.up)
        self._pending.clear()
        self._ups = (source.up, target.up)
        if maps is None and not self._odometry and weighable(alone):
            return self._match_each(matcher, source, target, alone, rng, options)
        if maps is not None:
            found = propose(*maps, matcher(*maps, prior=None, rng=rng, **options), self.options.min_registered)
            self._absorb(found, self.options.map_independence)
        before = [(m, C) for m, C in zip(self.filter.means, self.filter.covariances, strict=True)]
        found = propose(source, target, alone, self.options.min_registered)
        choice = self._absorb(found, None if maps is None else self.options.beside_maps)
        if choice.probability < self.options.trust:
            return _believed(alone, choice.probability, self.options.refuse)
        if choice.component >= 0:
            mean, covariance = before[choice.component]
            covariance = covariance if self._odometry else covariance * self.options.widen
            prior = from_levelled(mean, covariance, *self._ups)
        elif choice.hypothesis > 0:
            prior = found[choice.hypothesis][0]
        else:
            return alone
        matching = matcher(source, target, prior=prior, rng=rng, **options)
        self._follow(matching)
        return matching

    def _match_each(
        self,
        matcher: Matcher,
        source: ObjectGraph,
        target: ObjectGraph,
        alone: Matching,
        rng: np.random.Generator | None,
        options: Mapping[str, Any],
    ) -> Matching:
        """The matcher is asked with every likely pose as prior; matches are averaged over what each makes of the frame.

        So no pose has to be trusted before the frames have decided between the poses.
        """
        assert self._ups is not None
        o, filter_ = self.options, self.filter
        likely = [k for k in np.argsort(-filter_.weights)[: o.max_asked] if filter_.weights[k] >= o.asked]
        answers: list[Matching] = []
        explained: list[Explained] = []
        for k in likely:
            prior = from_levelled(filter_.means[k], filter_.covariances[k] * o.widen, *self._ups)
            answers.append(matcher(source, target, prior=prior, rng=rng, **options))
            explained.append(self._explained(int(k), answers[-1]))
        log_unknown = log_evidence(alone)
        known = filter_.weights[likely]
        logs = np.log(np.maximum([1.0 - known.sum(), *known], 1e-12))
        logs += np.array([log_unknown, *(e.log_evidence for e in explained)])
        weights = np.exp(logs - logs.max())
        weights /= weights.sum()
        matching = average([alone, *answers], weights, options.get("min_score", o.least_score))
        found = propose(source, target, alone, o.min_registered)
        filter_.reweigh(explained, log_unknown, *_levelled(found, *self._ups))
        return matching

    def _explained(self, component: int, matching: Matching) -> Explained:
        """What a matching made with a component as prior says of the frame."""
        assert self._ups is not None
        mean, covariance = self.filter.means[component], self.filter.covariances[component]
        if matching.pose is not None and len(matching) >= 2:
            # The matcher's pose contains the prior already.
            mean, covariance = to_levelled(matching.pose, *self._ups)
            covariance = covariance + FOLLOW_FLOOR
        common = self.options.common
        evidence = np.logaddexp(np.log(common) + matching.diagnostics["log_evidence"], np.log1p(-common))
        return Explained(component, mean, covariance, float(evidence))

    def _follow(self, matching: Matching) -> None:
        """Without odometry: let the trusted component go where the matches made with it as prior put the pose."""
        if not self._odometry and matching.pose is not None and len(matching) >= 2:
            assert self._ups is not None
            best = int(np.argmax(self.filter.weights))
            mean, covariance = to_levelled(matching.pose, *self._ups)
            self.filter.means[best], self.filter.covariances[best] = mean, covariance + FOLLOW_FLOOR

    def _carry(self, up_source: Array, up_target: Array) -> None:
        """Apply the motions announced by `predict`; the tilt of frames in between is taken to be the last known one."""
        assert self._ups is not None
        before_s, before_t = self._ups
        for step, (source, target) in enumerate(self._pending, start=1):
            last = step == len(self._pending)
            after_s, after_t = (up_source, up_target) if last else (before_s, before_t)
            self.filter.predict(
                None if source is None else level_motion(source, before_s, after_s),
                None if target is None else level_motion(target, before_t, after_t),
            )

    def _absorb(self, found: list[tuple[RelativePose, float]], independence: float | None = None) -> Choice:
        """Give the filter the proposed poses of a frame."""
        assert self._ups is not None
        return self.filter.update(*_levelled(found, *self._ups), independence)


def _levelled(
    found: list[tuple[RelativePose, float]], up_source: Array, up_target: Array
) -> tuple[Array, Array, Array]:
    """Means (h, 4), covariances (h, 4, 4) and probabilities (h,) of poses with probabilities."""
    levelled = [to_levelled(pose, up_source, up_target) for pose, _ in found]
    means = np.array([m for m, _ in levelled]).reshape(-1, 4)
    covariances = np.array([C for _, C in levelled]).reshape(-1, 4, 4)
    return means, covariances, np.array([p for _, p in found])


def weighable(matching: Matching) -> bool:
    """Whether a matching says how well the views fit together, and how probable every single match is."""
    return {"log_evidence", "probabilities"} <= matching.diagnostics.keys()


def log_evidence(matching: Matching) -> float:
    """Of two views whose pose is not known, over that of views that share nothing; those are as likely beforehand."""
    return float(np.logaddexp(0.0, matching.diagnostics["log_evidence"]) + np.log(0.5))


def average(matchings: Sequence[Matching], weights: Array, least_score: float) -> Matching:
    """One-to-one matches by probabilities averaged over alternatives, with the likeliest alternative's pose."""
    P = np.tensordot(weights, np.stack([m.diagnostics["probabilities"] for m in matchings]), axes=1)
    pairs, scores = decode(np.minimum(P, 1.0), least_score)
    likeliest = matchings[int(np.argmax(weights))]
    return replace(likeliest, pairs=pairs, scores=scores, diagnostics={**likeliest.diagnostics, "probabilities": P})


def _believed(matching: Matching, probability: float, refuse: float) -> Matching:
    """The matches that remain when the pose behind them is only so probable."""
    scores = matching.scores * probability
    keep = scores >= refuse
    return replace(matching, pairs=matching.pairs[keep], scores=scores[keep]) if refuse > 0 else matching


def propose(
    source: ObjectGraph, target: ObjectGraph, matching: Matching, min_registered: int = 4
) -> list[tuple[RelativePose, float]]:
    """Poses a matching stands for, with probabilities, the first most probable: hypotheses, pose, or one registered."""
    if matching.hypotheses:
        # A pose that the matches leave open says nothing.
        return [(h.pose, h.probability) for h in matching.hypotheses if np.trace(h.pose.covariance) < MAX_SPREAD]
    if len(matching) == 0:
        return []
    probability = float(matching.scores.mean())
    if matching.pose is not None:
        return [(matching.pose, probability)]
    if len(matching) < min_registered:
        return []
    try:
        return [(register(source, target, matching, huber=2.0), 0.5 * probability)]
    except RegistrationError:
        return []
