"""One matcher on one pair of views: what every runner does at its core."""

from __future__ import annotations

import sys
import zlib
from contextlib import redirect_stdout
from copy import deepcopy
from dataclasses import dataclass
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..fusion.sequence import PairTracker
from ..matching import METHODS, Matching, ObjectGraph, PriorRequiredError, RelativePose
from ..matching.pose import Array
from .methods import Method, oracle, random_matching

EXACT_POSE_STD = 1e-3
"""What stands for a pose without error: m and rad."""


class MatcherFailedError(RuntimeError):
    """A matcher raised on a pair; the message says which method, where, and why."""


@dataclass(frozen=True, eq=False)
class PairTruth:
    """What is true of a pair of views: for the evaluation-only baselines.

    Attributes:
        identities: true object of each detection of source and target; negative = none.
        T_source_target: (4, 4), None where unknown.
    """

    identities: tuple[NDArray[np.int64], NDArray[np.int64]]
    T_source_target: Array | None


def attempt(*pair: Any) -> tuple[Matching, float, str | None]:
    """`match_pair`, and None; where the method fails, no match at all, the time until then, and what it failed of."""
    start = perf_counter()
    try:
        return *match_pair(*pair), None
    except MatcherFailedError as error:
        return Matching.empty(), 1e3 * (perf_counter() - start), str(error)


def match_pair(
    method: Method,
    source: ObjectGraph,
    target: ObjectGraph,
    truth: PairTruth,
    prior: RelativePose | None,
    stream: tuple[int, ...],
    where: str,
    tracker: PairTracker | None = None,
    maps: tuple[ObjectGraph, ObjectGraph] | None = None,
) -> tuple[Matching, float]:
    """The matching and the time it took, ms.

    `truth` serves the evaluation-only baselines alone. `stream` seeds the matcher's generator, together with the
    method's name, so that results depend on neither the order of methods nor the number of workers. A `tracker`, after
    its `predict`, calls the matcher itself and hands it what it knows of the relative pose; `maps` are what both robots
    remember, not used where the method sees disturbed graphs. What the matcher prints goes to standard error.

    Raises:
        PriorRequiredError: the method needs a prior.
        ValueError: `oracle-pose` where the true poses are not known.
        MatcherFailedError: anything else the method raised, or a result that does not fit the graphs.
    """
    if method.name == "oracle":
        return oracle(*truth.identities), 0.0
    rng = np.random.default_rng([*stream, zlib.crc32(method.label.encode())])
    if method.name == "random":
        return random_matching(len(source), len(target), rng), 0.0
    matcher = method.load()
    assert matcher is not None
    if method.name == "oracle-pose":
        prior, tracker = _exact(truth, where), None
    if method.disturbance.rates():
        source, target = disturbed(method, source, target, stream)
        maps = None
    if method.name not in METHODS:  # it may write into what it is given, and others come after it
        source, target, prior, maps = deepcopy((source, target, prior, maps))
    start = perf_counter()
    try:
        with redirect_stdout(sys.stderr):  # standard output may be the rows'
            if tracker is None:
                matching = matcher(source, target, prior=prior, rng=rng, **method.options)
            else:
                matching = tracker.match(matcher, source, target, maps=maps, rng=rng, **method.options)
    except PriorRequiredError:
        raise
    except (Exception, SystemExit) as error:
        raise MatcherFailedError(f"method {method.label!r} on {where}: {type(error).__name__}: {error}") from error
    elapsed = 1e3 * (perf_counter() - start)
    if not isinstance(matching, Matching):
        raise MatcherFailedError(
            f"method {method.label!r} on {where}: it returned {type(matching).__name__}, not a Matching"
        )
    if len(matching) and (matching.pairs.max(axis=0) >= (len(source), len(target))).any():
        raise MatcherFailedError(
            f"method {method.label!r} on {where}: pairs name index {matching.pairs.max(axis=0).tolist()}, "
            f"the graphs have {len(source)} and {len(target)} objects"
        )
    return matching, elapsed


def _exact(truth: PairTruth, where: str) -> RelativePose:
    if truth.T_source_target is None:
        raise ValueError(f"oracle-pose needs the true poses, which are not known on {where}")
    return RelativePose(truth.T_source_target, EXACT_POSE_STD**2 * np.eye(6))


def disturbed(
    method: Method, source: ObjectGraph, target: ObjectGraph, stream: tuple[int, ...]
) -> tuple[ObjectGraph, ObjectGraph]:
    """The graphs under the method's disturbance, drawn alike for all methods."""
    rngs = np.random.default_rng([*stream, zlib.crc32(b"disturbance")]).spawn(2)
    return method.disturbance.apply(source, rngs[0]), method.disturbance.apply(target, rngs[1])
