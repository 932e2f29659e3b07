"""Fits how far `bayes` trusts its evidence: the weights of `covis.matching.bayes_calibration`, from pairs of views.

The solver is run once on every pair. What it found, the modes' features and match probabilities, is kept beside the
truth; weights are then fitted to that by gradient, since only the mixing of the modes depends on them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatch
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linprog, minimize
from scipy.sparse import block_diag, csr_array

from ..matching import bayes
from ..matching.bayes_calibration import CALIBRATIONS, Calibration, Evidence, calibrated
from ..matching.bayes_solve import decode
from ..matching.metrics import expected_calibration_error
from ..matching.pose import Array
from .datasets import Frame, View, load_dataset
from .progress import Progress, silent
from .run_dataset import pairs as pairs_of
from .synthetic import PREFIX, problem_names
from .synthetic import frames as generated

"""Before the name of a generated problem, as in the suites."""
LEAST = 1e-3
"""Probabilities closer to 0 or 1 count as so close, so that one error of a certain match does not decide a fit."""
RIDGE = 1e-4
"""Penalty on half the squared weights, nats a pair: weights that the pairs say nothing of stay near 0."""
LEAST_SCORE = 0.05
"""Of the matches that are read off; no threshold is below."""


@dataclass(frozen=True, eq=False)
class PairEvidence:
    """One pair of views after the solve.

    Attributes:
        target: name of the set that it is of.
        group: what halves keep together: the episode, or the frame where there are none.
        kind: entry of CALIBRATIONS.
        evidence: what is weighed.
        marginals: (k, n, m) probability of every match under every mode.
        truth: (n, m) whether both are the same object.
    """

    target: str
    group: int
    kind: str
    evidence: Evidence
    marginals: Array
    truth: NDArray[np.bool_]


def fittable() -> list[str]:
    """The kinds of pairs whose evidence is damped, and with it weighed by fitted weights."""
    return [kind for kind, x in CALIBRATIONS.items() if x.damping.any()]


def collect(
    target: str,
    kind: str,
    *,
    frames: int | None = None,
    seed: int = 0,
    progress: Progress = silent,
) -> list[PairEvidence]:
    """The evidence of all pairs of views of a dataset folder, or of generated pairs.

    Args:
        target: a folder, or "synthetic-" and a name of `problem_names`.
        kind: entry of CALIBRATIONS that is wanted; for "unseen" the fields of view of generated pairs are hidden.
        frames: at most so many frames, evenly spread; of generated pairs their number, 100 by default.
        seed: of the detections' order; of generated pairs.
        progress: called with frames done and frames in all.

    Raises:
        DatasetError: a folder that cannot be read.
    """
    problem = target.removeprefix(PREFIX)
    if target != problem and problem in problem_names():
        every = list(generated(problem, seed, range(100 if frames is None else frames)))
        every = [_hidden(frame) for frame in every] if kind == "unseen" else every
    else:
        every = load_dataset(target, seed).spread(frames)
    found = []
    for done, frame in enumerate(every):
        progress(done, len(every))
        found += [_solved(target.rstrip("/").rpartition("/")[2], frame.episode, a, b) for _, a, b in pairs_of(frame)]
    return found


def _hidden(frame: Frame) -> Frame:
    """The frame without its fields of view."""
    views = (replace(view, graph=replace(view.graph, horizontal_fov_rad=None)) for view in frame.views)
    return replace(frame, views=tuple(views))


def _solved(target: str, group: int, a: View, b: View) -> PairEvidence:
    solved = bayes(a.graph, b.graph).diagnostics
    truth = (a.identity[:, None] == b.identity) & (a.identity[:, None] >= 0)
    return PairEvidence(target, group, solved["calibration"], solved["evidence"], solved["marginals"], truth)


class Entries(NamedTuple):
    """All possible matches e of many pairs p, and all their modes k.

    Attributes:
        marginals: sparse (e, k) probability of each match under each mode of its pair.
        truth, weight: (e,) whether a match is right, and how much it counts.
        pair_of_match, pair_of_mode: (e,), (k,) in ascending order.
        modes, pairs: features (k, f) of the modes and (p, g) of the pairs.
    """

    marginals: csr_array
    truth: Array
    weight: Array
    pair_of_match: NDArray[np.int64]
    pair_of_mode: NDArray[np.int64]
    modes: Array
    pairs: Array


def entries(pairs: Sequence[PairEvidence], weights: Mapping[str, float]) -> Entries:
    """Pairs as arrays; matches that no mode holds possible say nothing of the weights and are left out."""
    held = [(p.marginals > LEAST).any(axis=0) for p in pairs]
    own = [weights.get(p.target, 1.0) for p in pairs]
    matches, modes = [int(x.sum()) for x in held], [len(p.marginals) for p in pairs]
    numbers = np.arange(len(pairs))
    return Entries(
        csr_array(block_diag([csr_array(p.marginals[:, x].T) for p, x in zip(pairs, held, strict=True)], format="csr")),
        np.concatenate([p.truth[x] for p, x in zip(pairs, held, strict=True)]).astype(float),
        np.repeat(own, matches) / sum(own),
        np.repeat(numbers, matches),
        np.repeat(numbers, modes),
        np.concatenate([p.evidence.modes for p in pairs]),
        np.stack([p.evidence.pair for p in pairs]),
    )


def objective(theta: Array, x: Entries) -> tuple[float, Array]:
    """Log score of all possible matches, nats a pair, and its gradient; theta is [terms, damping, offset]."""
    f, g = x.modes.shape[1], x.pairs.shape[1]
    terms, damping, offset = theta[:f], theta[f : f + g], theta[f + g :]
    factor = np.exp(x.pairs @ damping)[x.pair_of_mode]
    scaled = factor * (x.modes @ terms)
    share = _shares(scaled + (x.pairs @ offset)[x.pair_of_mode], x.pair_of_mode, len(x.pairs))
    P = x.marginals @ share
    inside = (P > LEAST) & (P < 1 - LEAST)
    Q = np.clip(P, LEAST, 1 - LEAST)
    value = -(x.weight * (x.truth * np.log(Q) + (1 - x.truth) * np.log1p(-Q))).sum()
    slope = np.where(inside, x.weight * (Q - x.truth) / (Q * (1 - Q)), 0.0)
    # d P / d log evidence of a mode = its share (its own marginal - P).
    all_matches = np.bincount(x.pair_of_match, slope * P, len(x.pairs))
    by_mode = share * (x.marginals.T @ slope - all_matches[x.pair_of_mode])
    per_pair = [np.bincount(x.pair_of_mode, y, len(x.pairs)) for y in (by_mode * scaled, by_mode)]
    gradient = np.concatenate([x.modes.T @ (by_mode * factor), x.pairs.T @ per_pair[0], x.pairs.T @ per_pair[1]])
    return float(value), gradient


def _shares(log: Array, pair_of_mode: NDArray[np.int64], n_pairs: int) -> Array:
    """Posterior (k,) of modes of log evidence (k,), each against its pair's others and "nothing in common"."""
    top = np.zeros(n_pairs)
    np.maximum.at(top, pair_of_mode, log)
    share = np.exp(log - top[pair_of_mode])
    total = np.bincount(pair_of_mode, share, n_pairs) + np.exp(-top)
    result: Array = share / total[pair_of_mode]
    return result


def probabilities(pair: PairEvidence, calibration: Calibration) -> Array:
    """Match probabilities (n, m), as `bayes` mixes them with its default prior of sharing anything."""
    log = calibrated(pair.evidence, calibration)
    share = _shares(log, np.zeros(len(log), dtype=np.int64), 1)
    P: Array = np.minimum(np.tensordot(share, pair.marginals, axes=1), 1.0)
    return P


def emitted(pairs: Sequence[PairEvidence], calibration: Calibration) -> tuple[Array, NDArray[np.bool_], int]:
    """Scores (e,) of all matches that any threshold of at least LEAST_SCORE keeps, which are right, and common ones.

    Matches are read off in falling order, so a higher threshold keeps those of a higher score.
    """
    scores, right, common = [np.empty(0)], [np.empty(0, dtype=bool)], 0
    for pair in pairs:
        matches, score = decode(probabilities(pair, calibration), LEAST_SCORE)
        scores.append(score)
        right.append(pair.truth[matches[:, 0], matches[:, 1]])
        common += int(pair.truth.any(axis=1).sum())
    return np.concatenate(scores), np.concatenate(right), common


def fit(pairs: Sequence[PairEvidence], weights: Mapping[str, float] | None = None, ridge: float = RIDGE) -> Calibration:
    """The calibration of least log score over all possible matches, its threshold half the F1 that it reaches.

    Args:
        pairs: evidence beside the truth.
        weights: how much a pair of a target counts; 1 where none is named.
        ridge: penalty on half the squared weights, nats a pair.

    Raises:
        ValueError: no pairs.
    """
    if not pairs:
        raise ValueError("there is no pair of views to fit to")
    x = entries(pairs, weights or {})
    f, g = x.modes.shape[1], x.pairs.shape[1]
    free = np.ones(f + 2 * g, dtype=bool)
    free[f] = False  # A constant factor of all evidence is in the terms already.
    theta = np.zeros(f + 2 * g)
    theta[0] = 0.5

    def penalised(values: Array) -> tuple[float, Array]:
        theta[free] = values
        value, gradient = objective(theta, x)
        return value + 0.5 * ridge * float(values @ values), gradient[free] + ridge * values

    theta[free] = minimize(penalised, theta[free], jac=True, method="L-BFGS-B", options={"maxiter": 1000}).x
    fitted = Calibration(theta[:f].copy(), theta[f : f + g].copy(), theta[f + g :].copy(), 0.0)
    return fitted._replace(min_score=_threshold(pairs, fitted))


def _threshold(pairs: Sequence[PairEvidence], calibration: Calibration) -> float:
    """Half the F1 that it leads to, the mean over targets; found by iteration."""
    found = [emitted(own, calibration) for own in _by_target(pairs).values()]
    least = 0.4
    for _ in range(10):
        least = 0.5 * float(np.mean([_f1(*x, least) for x in found]))
    return max(round(least, 2), LEAST_SCORE)


def _f1(scores: Array, right: NDArray[np.bool_], common: int, least: float) -> float:
    kept = scores >= least
    return 2 * int(right[kept].sum()) / max(int(kept.sum()) + common, 1)


def _by_target(pairs: Sequence[PairEvidence]) -> dict[str, list[PairEvidence]]:
    groups: dict[str, list[PairEvidence]] = {}
    for pair in pairs:
        groups.setdefault(pair.target, []).append(pair)
    return groups


def halves(pairs: Sequence[PairEvidence], seed: int) -> tuple[list[PairEvidence], list[PairEvidence]]:
    """Every target's pairs in two parts, whole episodes in either."""
    rng = np.random.default_rng(seed)
    parts: tuple[list[PairEvidence], list[PairEvidence]] = ([], [])
    for own in _by_target(pairs).values():
        groups = rng.permutation(sorted({pair.group for pair in own}))
        first = set(groups[: len(groups) // 2].tolist())
        for pair in own:
            parts[pair.group not in first].append(pair)
    return parts


@dataclass(frozen=True, eq=False)
class Refit:
    """A calibration fitted anew, and how it compares.

    Attributes:
        kind: entry of CALIBRATIONS.
        fitted: on all pairs.
        rows: for each target its pairs, and F1, ECE and number of emitted matches of evidence that counts whole
            (`whole_f1` ...), of the calibration that the package holds (`held_...`), of the one fitted (`fitted_...`),
            and of those fitted to one half of the pairs on the other half (`halves_...`).
        left_out: pairs that another calibration is for.
        bound: `monotone_bound` of what the package's calibration emits of the targets.
    """

    kind: str
    fitted: Calibration
    rows: list[dict[str, Any]]
    left_out: int
    bound: float


def refit(
    kind: str,
    collected: Sequence[PairEvidence],
    weights: Mapping[str, float] | None = None,
    *,
    ridge: float = RIDGE,
    seed: int = 0,
) -> Refit:
    """Fit a calibration to all pairs that it is for, and to halves of them.

    Args:
        kind: entry of CALIBRATIONS.
        collected: of `collect`.
        weights: as for `fit`; names may be patterns such as "synthetic-*".
        ridge: as for `fit`.
        seed: of the halves.

    Raises:
        ValueError: no pairs of this kind, or a weight for a target that is not there.
    """
    pairs = [pair for pair in collected if pair.kind == kind]
    if not pairs:
        raise ValueError(f"no pair of views is of the kind {kind!r}; there are {sorted({p.kind for p in collected})}")
    targets = _by_target(pairs)
    weights = _spelt_out(weights or {}, list(targets))
    fitted, parts = fit(pairs, weights, ridge), halves(pairs, seed)
    compared = {"whole": [(pairs, CALIBRATIONS["whole"])], "held": [(pairs, CALIBRATIONS[kind])]}
    compared |= {"fitted": [(pairs, fitted)]}
    compared |= {"halves": [(parts[1 - i], fit(parts[i], weights, ridge)) for i in (0, 1)]} if all(parts) else {}
    rows: list[dict[str, Any]] = []
    for target, own in targets.items():
        row: dict[str, Any] = {"target": target, "pairs": len(own)}
        for name, parts_of in compared.items():
            row |= {f"{name}_{key}": value for key, value in _measured(target, parts_of).items()}
        rows.append(row)
    bound = monotone_bound([_kept(own, CALIBRATIONS[kind])[:2] for own in targets.values()])
    return Refit(kind, fitted, rows, len(collected) - len(pairs), bound)


def _spelt_out(weights: Mapping[str, float], targets: Sequence[str]) -> dict[str, float]:
    """Weight of each target named, by patterns; the last that fits counts."""
    for pattern in weights:
        if not any(fnmatch(target, pattern) for target in targets):
            raise ValueError(f"a weight for {pattern!r}, which is none of {', '.join(targets)}")
    return {target: weight for pattern, weight in weights.items() for target in targets if fnmatch(target, pattern)}


def _measured(target: str, parts: Sequence[tuple[Sequence[PairEvidence], Calibration]]) -> dict[str, Any]:
    """F1, ECE and number of what is emitted of one target, parts with their own calibrations pooled."""
    scores, right, common = [], [], 0
    for pairs, calibration in parts:
        s, r, c = _kept([pair for pair in pairs if pair.target == target], calibration)
        scores.append(s)
        right.append(r)
        common += c
    s, r = np.concatenate(scores), np.concatenate(right)
    ece = expected_calibration_error(s, r) if len(s) else None
    return {"f1": _f1(s, r, common, 0.0), "ece": ece, "emitted": len(s)}


def _kept(pairs: Sequence[PairEvidence], calibration: Calibration) -> tuple[Array, NDArray[np.bool_], int]:
    """What `bayes` would emit: scores, which are right, and the number of common objects."""
    scores, right, common = emitted(pairs, calibration)
    kept = scores >= calibration.min_score
    return scores[kept], right[kept], common


def monotone_bound(sets: Sequence[tuple[Array, NDArray[np.bool_]]], levels: int = 40, bins: int = 10) -> float:
    """What the largest debiased ECE of the sets is at least, whatever monotone map the scores of all go through.

    A linear program over step functions of `levels` steps, with the truth at hand; a gap of the size that chance makes
    likely (one standard deviation of a bin) costs nothing, as in `expected_calibration_error`.

    Args:
        sets: scores (k,) of emitted matches, and which are right (k,).
        levels: steps, at quantiles of all scores together.
        bins: of equal mass, per set.
    """
    sets = [(scores, right) for scores, right in sets if len(scores)]
    if not sets:
        return 0.0
    edges = np.quantile(np.concatenate([scores for scores, _ in sets]), np.linspace(0, 1, levels + 1)[1:-1])
    # Unknown: the map's levels, the gap of every bin, the largest ECE.
    size = levels + len(sets) * bins + 1
    rows = [np.eye(size)[k] - np.eye(size)[k + 1] for k in range(levels - 1)]
    limits = [0.0] * (levels - 1)
    for s, (scores, right) in enumerate(sets):
        level = np.searchsorted(edges, scores, side="right")
        error = -np.eye(size)[-1]
        for b, own in enumerate(np.array_split(np.argsort(scores, kind="stable"), bins)):
            if not len(own):
                continue
            at, accuracy = levels + s * bins + b, float(right[own].mean())
            chance = np.sqrt(accuracy * (1 - accuracy) / (len(own) - 1)) if len(own) > 1 else 0.0
            error[at] = len(own) / len(scores)
            mean = np.bincount(level[own], minlength=size) / len(own)
            rows += [sign * mean - np.eye(size)[at] for sign in (1, -1)]
            limits += [sign * accuracy + chance for sign in (1, -1)]
        rows.append(error)
        limits.append(0.0)
    bounds = [(0, 1)] * levels + [(0, None)] * (size - levels)
    return float(linprog(np.eye(size)[-1], A_ub=np.array(rows), b_ub=limits, bounds=bounds).fun)
