"""A contract test that anyone can run on a matcher of their own.

from covis.matching.testing import check_matcher

def test_contract():
    check_matcher(my_matcher, invariant=True)
"""

from __future__ import annotations

import copy
import inspect
from collections.abc import Iterator
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from .graph import Matcher, Matching, ObjectGraph, PriorRequiredError
from .pose import Array, RelativePose, invert


@dataclass(frozen=True, eq=False)
class MatchingProblem:
    """Two graphs; `truth` (n,) is the target object of each source object, -1 = none, or None if undefined."""

    name: str
    source: ObjectGraph
    target: ObjectGraph
    truth: Array | None = None
    prior: RelativePose | None = None


def scene(
    rng: np.random.Generator, common: int = 6, source_only: int = 2, target_only: int = 3, noise_m: float = 0.02
) -> MatchingProblem:
    """An easy problem: two views of random objects, some seen by one robot only, poses known and unknown."""
    heading, shift = 1.1, np.array([3.0, -2.0, 0.2])
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("z", heading).as_matrix()
    T[:3, 3] = shift
    world = rng.uniform(-15, 15, (common + source_only + target_only, 3)) * [1, 1, 0.1]
    kinds = rng.dirichlet(np.full(4, 0.3), len(world)) + 1e-3
    in_source = np.arange(common + source_only)
    in_target = np.r_[np.arange(common), np.arange(common + source_only, len(world))]
    in_source, in_target = rng.permutation(in_source), rng.permutation(in_target)
    T_target_source = invert(T)
    p = world[in_source] + rng.normal(0, noise_m, (len(in_source), 3))
    q = world[in_target] @ T_target_source[:3, :3].T + T_target_source[:3, 3]
    q = q + rng.normal(0, noise_m, q.shape)
    options: dict[str, Any] = {
        "position_variance": 4 * noise_m**2,
        "attribute_variance": 0.01,
        "up": np.array([0.0, 0, 1]),
    }
    truth = np.array([np.flatnonzero(in_target == k)[0] if k in in_target else -1 for k in in_source])
    return MatchingProblem(
        "scene",
        ObjectGraph.from_positions(p, attributes=kinds[in_source], **options),
        ObjectGraph.from_positions(q, attributes=kinds[in_target], **options),
        truth,
        RelativePose(T, np.diag([0.1, 0.1, 0.1, 1e-4, 1e-4, 1e-4])),
    )


def degenerate_problems() -> Iterator[MatchingProblem]:
    """Problems with no good answer, which every matcher must survive with a well-formed one."""
    rng = np.random.default_rng(12)
    up = np.array([0.0, 0, 1])

    def graph(positions: Any, **options: Any) -> ObjectGraph:
        return ObjectGraph.from_positions(np.array(positions, dtype=float).reshape(-1, 3), up=up, **options)

    cloud = rng.uniform(-10, 10, (6, 3))
    other = rng.uniform(-10, 10, (5, 3))
    line = np.outer(np.arange(5.0), [1.0, 2.0, 0.5])
    yield MatchingProblem("empty and empty", graph([]), graph([]))
    yield MatchingProblem("empty source", graph([]), graph(cloud))
    yield MatchingProblem("empty target", graph(cloud), graph([]))
    yield MatchingProblem("one and one", graph(cloud[:1]), graph(other[:1]))
    yield MatchingProblem("one and many", graph(cloud[:1]), graph(other))
    yield MatchingProblem("two and two", graph(cloud[:2]), graph(other[:2]))
    yield MatchingProblem("two and many", graph(cloud[:2]), graph(other))
    yield MatchingProblem("many and two", graph(cloud), graph(other[:2]))
    yield MatchingProblem("collinear", graph(line), graph(line[::-1] + 1.0))
    yield MatchingProblem("coincident", graph(np.ones((4, 3))), graph(np.ones((5, 3))))
    yield MatchingProblem("coincident at the origin", graph(np.zeros((4, 3))), graph(np.zeros((3, 3))))
    yield MatchingProblem("all identical", graph(cloud), graph(cloud))
    yield MatchingProblem("mirror image", graph(cloud), graph(cloud * [1, -1, 1]))
    yield MatchingProblem("nothing in common", graph(cloud), graph(other))
    yield MatchingProblem("sizes far apart", graph(cloud[:3]), graph(rng.uniform(-10, 10, (12, 3))))
    yield MatchingProblem("a grid", graph(np.indices((3, 3, 1)).reshape(3, -1).T), graph(_grid()))
    yield MatchingProblem("zero variance", graph(cloud, position_variance=0.0), graph(cloud, position_variance=0.0))
    huge = {"position_variance": 1e12, "attribute_variance": 1.0}
    yield MatchingProblem("huge variance", graph(cloud, **huge), graph(other, **huge))
    unknown = {"position_variance": np.inf, "attribute_variance": np.inf}
    yield MatchingProblem("infinite variance", graph(cloud, **unknown), graph(other, **unknown))
    partly = np.array([0.01, np.inf, 0.01, 0.01, np.inf, 0.01])
    yield MatchingProblem("partly infinite variance", graph(cloud, position_variance=partly), graph(cloud))
    far = cloud * 1e6
    yield MatchingProblem("far away", graph(far), graph(far))
    yield MatchingProblem("far from both robots", graph(cloud + 1e8), graph(other + 1e8))
    faint = np.full((6, 3), 1e-300)
    yield MatchingProblem("faint attributes", graph(cloud, attributes=faint), graph(other, attributes=faint[1:].copy()))
    nobody = np.zeros((6, 3))
    yield MatchingProblem(
        "attributes all zero", graph(cloud, attributes=nobody), graph(other, attributes=nobody[1:].copy())
    )
    opposed = (np.tile([1.0, 0.0], (6, 1)), np.tile([0.0, 1.0], (5, 1)))
    yield MatchingProblem("no common class", graph(cloud, attributes=opposed[0]), graph(other, attributes=opposed[1]))


def _grid() -> Array:
    return np.asarray(np.indices((3, 3, 1)).reshape(3, -1).T, dtype=np.float64) + 0.5


def check_well_formed(matching: Matching, source: ObjectGraph, target: ObjectGraph, name: str = "") -> None:
    """AssertionError unless `matching` is one-to-one, in range, and scored in [0, 1]; likewise its hypotheses."""
    assert isinstance(matching, Matching), f"{name}: a matcher returns a Matching, got {type(matching).__name__}"
    _check_pairs(matching.pairs, matching.scores, source, target, name)
    pose = matching.pose
    assert pose is None or isinstance(pose, RelativePose), f"{name}: pose is no RelativePose but {pose!r}"
    for h in matching.hypotheses:
        assert 0 <= h.probability <= 1, f"{name}: a hypothesis has probability {h.probability}"
        _check_pairs(h.pairs, h.scores, source, target, f"{name}, a hypothesis")


def _check_pairs(pairs: NDArray[np.int64], scores: Array, source: ObjectGraph, target: ObjectGraph, name: str) -> None:
    k = len(pairs)
    assert pairs.shape == (k, 2), f"{name}: pairs have shape {pairs.shape}"
    assert scores.shape == (k,), f"{name}: scores have shape {scores.shape}"
    assert np.isfinite(scores).all(), f"{name}: a score is not finite"
    assert ((scores >= 0) & (scores <= 1)).all(), f"{name}: a score is outside [0, 1]: {scores.tolist()}"
    assert k <= min(len(source), len(target)), f"{name}: more matches than objects"
    if k:
        assert pairs.min() >= 0, f"{name}: a match of no object, {pairs.tolist()}"
        assert (pairs.max(axis=0) < (len(source), len(target))).all(), f"{name}: a match of no object, {pairs.tolist()}"
        assert all(len(np.unique(column)) == k for column in pairs.T), f"{name}: an object is matched twice"


def check_matcher(
    matcher: Matcher,
    *,
    invariant: bool = True,
    min_f1: float | None = 0.5,
    needs_prior: bool = False,
    options: dict[str, Any] | None = None,
) -> None:
    """Raises AssertionError, saying what is wrong, unless `matcher` keeps the contract of this library.

    It must take the arguments of `Matcher`, with and without a prior and a random stream; answer every degenerate
    problem with a well-formed `Matching`; leave its inputs and NumPy's global random stream alone; give the same answer
    for the same `rng`; and, on an easy scene, find the objects.

    Args:
        matcher: the callable under test.
        invariant: also require the same matches when the objects are given in another order. Leave it on for
            deterministic methods.
        min_f1: least F1, pooled over a few easy scenes; None = do not ask.
        needs_prior: whether it works with known poses only; without one it must raise PriorRequiredError.
        options: passed to every call.
    """
    options = options or {}
    _check_signature(matcher, options)
    for problem in degenerate_problems():
        prior = RelativePose(np.eye(4), np.eye(6)) if needs_prior else None
        _call(matcher, problem, prior, np.random.default_rng(0), options)
    scenes = [scene(np.random.default_rng(seed)) for seed in range(4)]
    _call(matcher, scenes[0], scenes[0].prior, np.random.default_rng(7), options)
    if needs_prior:
        _check_refuses_without_prior(matcher, options)
    _check_repeatable(matcher, scenes[0], needs_prior, options)
    if invariant:
        _check_permutations(matcher, scenes[0], needs_prior, options)
    if min_f1 is not None:
        f1 = _pooled_f1(matcher, scenes, needs_prior, options)
        assert f1 >= min_f1, f"F1 on easy scenes is {f1:.2f}, expected at least {min_f1}"


def _check_signature(matcher: Matcher, options: dict[str, Any]) -> None:
    assert callable(matcher), f"a matcher is callable, got {matcher!r}"
    try:
        signature = inspect.signature(matcher)
    except ValueError:  # some builtins have none
        return
    for given in ({}, {"prior": None}, {"prior": None, "rng": None}):
        try:
            signature.bind(None, None, **given, **options)
        except TypeError as error:
            wanted = "(source, target, *, prior=None, rng=None, **options)"
            raise AssertionError(f"a matcher takes {wanted}, not {signature}: {error}") from None


def _call(
    matcher: Matcher,
    problem: MatchingProblem,
    prior: RelativePose | None,
    rng: np.random.Generator | None,
    options: dict[str, Any],
) -> Matching:
    """The matcher's answer, well-formed and without side effects."""
    source, target, name = problem.source, problem.target, problem.name
    before = copy.deepcopy((source, target, prior))
    global_stream = _global_stream()
    try:
        found = matcher(source, target, prior=prior, rng=rng, **options)
    except PriorRequiredError as error:
        raise AssertionError(f"{name}: a matcher that needs poses is checked with needs_prior=True") from error
    except Exception as error:
        raise AssertionError(f"{name}: the matcher raised {type(error).__name__}: {error}") from error
    check_well_formed(found, source, target, name)
    for side, was, now in zip(("source", "target", "prior"), before, (source, target, prior), strict=True):
        changed = _changed_field(was, now)
        assert changed is None, f"{name}: the matcher changed its input, {side}.{changed}"
    assert global_stream == _global_stream(), f"{name}: the matcher uses NumPy's global random stream, not rng"
    return found


def _global_stream() -> str:
    return repr(np.random.get_state())  # noqa: NPY002


def _changed_field(before: Any, after: Any) -> str | None:
    """The name of the first array that differs between two dataclasses, or None."""
    if before is None:
        return None
    for field in fields(before):
        one, other = getattr(before, field.name), getattr(after, field.name)
        if isinstance(one, np.ndarray) and not np.array_equal(one, other, equal_nan=True):
            return field.name
    return None


def _solve(matcher: Matcher, problem: MatchingProblem, needs_prior: bool, options: dict[str, Any]) -> Matching:
    return _call(matcher, problem, problem.prior if needs_prior else None, np.random.default_rng(7), options)


def _check_refuses_without_prior(matcher: Matcher, options: dict[str, Any]) -> None:
    problem = scene(np.random.default_rng(0))
    try:
        matcher(problem.source, problem.target, prior=None, **options)
    except PriorRequiredError:
        return
    raise AssertionError("a matcher that needs a prior must raise PriorRequiredError without one")


def _check_repeatable(matcher: Matcher, problem: MatchingProblem, needs_prior: bool, options: dict[str, Any]) -> None:
    prior = problem.prior if needs_prior else None
    for seed in (7, None):
        first, second = (
            _call(matcher, problem, prior, None if seed is None else np.random.default_rng(seed), options)
            for _ in range(2)
        )
        stream = "no rng" if seed is None else "the same rng"
        same = np.array_equal(first.pairs, second.pairs)
        assert same, f"{stream} gives different matches from call to call"
        assert (first.scores == second.scores).all(), f"{stream} gives different scores from call to call"


def _check_permutations(matcher: Matcher, problem: MatchingProblem, needs_prior: bool, options: dict[str, Any]) -> None:
    rng = np.random.default_rng(3)
    p, q = rng.permutation(len(problem.source)), rng.permutation(len(problem.target))
    shuffled = MatchingProblem("shuffled", problem.source.take(p), problem.target.take(q), None, problem.prior)
    straight = {(int(a), int(b)) for a, b in _solve(matcher, problem, needs_prior, options).pairs}
    found = {(int(p[a]), int(q[b])) for a, b in _solve(matcher, shuffled, needs_prior, options).pairs}
    assert straight == found, f"another order of objects gives other matches: {sorted(straight ^ found)}"


def _pooled_f1(matcher: Matcher, problems: list[MatchingProblem], needs_prior: bool, options: dict[str, Any]) -> float:
    correct = total = 0
    for problem in problems:
        assert problem.truth is not None
        found = _solve(matcher, problem, needs_prior, options)
        correct += int((problem.truth[found.pairs[:, 0]] == found.pairs[:, 1]).sum())
        total += len(found) + int((problem.truth >= 0).sum())
    return 2 * correct / total
