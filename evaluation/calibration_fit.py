"""Fits how far `bayes` trusts its evidence: the weights of `covis.matching.bayes_calibration`, from pairs of views.

The solver is run once on every pair. What it found, the modes' features and match probabilities, is kept beside the
truth; weights are then fitted to that by gradient, since only the mixing of the modes depends on them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from ..matching import bayes
from ..matching.bayes_calibration import CALIBRATIONS, Calibration, Evidence, calibrated
from ..matching.bayes_solve import decode
from ..matching.metrics import expected_calibration_error
from ..matching.pose import Array
from .datasets import Frame, View, load_dataset
from .synthetic import frames as generated
from .synthetic import problem_names

LEAST = 1e-3
"""Probabilities closer to 0 or 1 count as so close, so that one error of a certain match does not decide a fit."""
RIDGE = 1e-4
"""Of the weights, in nats a pair: weights that the pairs say nothing of stay near 0."""
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


def pairs_of(frame: Frame) -> list[tuple[View, View]]:
    """Pairs of robots with at least 3 detections each."""
    return [(a, b) for a, b in combinations(frame.views, 2) if min(len(a.graph), len(b.graph)) >= 3]


def collect(
    target: str, *, frames: int | None = None, seed: int = 0, progress: Callable[[int, int], None] = lambda d, n: None
) -> list[PairEvidence]:
    """The evidence of all pairs of views of a dataset folder, or of generated pairs (a name of `problem_names`).

    Args:
        target: folder or name.
        frames: at most so many frames, evenly spread; of generated pairs their number, 100 by default.
        seed: of the detections' order; of generated pairs.
        progress: called with frames done and frames in all.
    """
    if target in problem_names():
        every = list(generated(target, seed, range(100 if frames is None else frames)))
    else:
        data = load_dataset(target, seed)
        number = len(data) if frames is None else min(frames, len(data))
        every = [data.frame(i * len(data) // number) for i in range(number)]
    found = []
    for done, frame in enumerate(every):
        progress(done, len(every))
        found += [_solved(target.rstrip("/").rpartition("/")[2], frame.episode, a, b) for a, b in pairs_of(frame)]
    return found


def _solved(target: str, group: int, a: View, b: View) -> PairEvidence:
    solved = bayes(a.graph, b.graph).diagnostics
    truth = (a.identity[:, None] == b.identity) & (a.identity[:, None] >= 0)
    return PairEvidence(target, group, solved["calibration"], solved["evidence"], solved["marginals"], truth)


class Entries(NamedTuple):
    """All possible matches of many pairs: marginals (e, k), truth (e,), pair (e,) and weight (e,) of each.

    With the modes' features (p, k, f), which of them there are (p, k), and the pairs' features (p, g).
    """

    marginals: Array
    truth: Array
    pair: NDArray[np.int64]
    weight: Array
    modes: Array
    there: NDArray[np.bool_]
    pairs: Array


def entries(pairs: Sequence[PairEvidence], weights: Mapping[str, float]) -> Entries:
    """Pairs as arrays; matches that no mode holds possible say nothing of the weights and are left out."""
    most = max(len(p.marginals) for p in pairs)
    modes = np.zeros((len(pairs), most, pairs[0].evidence.modes.shape[1]))
    there = np.zeros((len(pairs), most), dtype=bool)
    marginals, truth, pair, weight = [], [], [], []
    for i, p in enumerate(pairs):
        k = len(p.marginals)
        modes[i, :k], there[i, :k] = p.evidence.modes, True
        held = (p.marginals > LEAST).any(axis=0)
        marginals.append(np.pad(p.marginals[:, held].T, ((0, 0), (0, most - k))))
        truth.append(p.truth[held].astype(float))
        pair.append(np.full(held.sum(), i))
        weight.append(np.full(held.sum(), weights.get(p.target, 1.0)))
    total = sum(weights.get(p.target, 1.0) for p in pairs)
    return Entries(
        np.concatenate(marginals),
        np.concatenate(truth),
        np.concatenate(pair),
        np.concatenate(weight) / total,
        modes,
        there,
        np.stack([p.evidence.pair for p in pairs]),
    )


def objective(theta: Array, x: Entries) -> tuple[float, Array]:
    """Log score of all possible matches, nats a pair, and its gradient; theta is [terms, damping, offset]."""
    f, g = x.modes.shape[2], x.pairs.shape[1]
    terms, damping, offset = theta[:f], theta[f : f + g], theta[f + g :]
    scale = np.exp(x.pairs @ damping)[:, None]
    linear = x.modes @ terms
    log = np.where(x.there, scale * linear + (x.pairs @ offset)[:, None], -np.inf)
    top = np.maximum(log.max(axis=1, initial=0.0), 0.0)[:, None]
    share = np.exp(log - top)
    share /= share.sum(axis=1, keepdims=True) + np.exp(-top)
    own = share[x.pair]
    P = (own * x.marginals).sum(axis=1)
    inside = (P > LEAST) & (P < 1 - LEAST)
    Q = np.clip(P, LEAST, 1 - LEAST)
    value = -(x.weight * (x.truth * np.log(Q) + (1 - x.truth) * np.log1p(-Q))).sum()
    slope = np.where(inside, x.weight * (Q - x.truth) / (Q * (1 - Q)), 0.0)
    # d P / d log evidence of a mode = its share (its own marginal - P).
    by_entry = slope[:, None] * own * (x.marginals - P[:, None])
    by_mode = np.stack([np.bincount(x.pair, column, len(x.pairs)) for column in by_entry.T], axis=1)
    by_scaled = by_mode * scale
    gradient = np.concatenate(
        [
            np.einsum("pk,pkf->f", by_scaled, x.modes),
            x.pairs.T @ (by_scaled * linear).sum(axis=1),
            x.pairs.T @ by_mode.sum(axis=1),
        ]
    )
    return float(value), gradient


def probabilities(pair: PairEvidence, calibration: Calibration) -> Array:
    """Match probabilities (n, m), as `bayes` mixes them with its default prior of sharing anything."""
    log = calibrated(pair.evidence, calibration)
    top = max(log.max(initial=0.0), 0.0)
    share = np.exp(log - top)
    share /= share.sum() + np.exp(-top)
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


def fit(pairs: Sequence[PairEvidence], weights: Mapping[str, float] | None = None) -> Calibration:
    """The calibration of least log score over all possible matches, its threshold half the F1 that it reaches.

    Args:
        pairs: evidence beside the truth.
        weights: how much a pair of a target counts; 1 where none is named.

    Raises:
        ValueError: no pairs.
    """
    if not pairs:
        raise ValueError("there is no pair of views to fit to")
    x = entries(pairs, weights or {})
    f, g = x.modes.shape[2], x.pairs.shape[1]
    free = np.ones(f + 2 * g, dtype=bool)
    free[f] = False  # A constant factor of all evidence is in the terms already.
    theta = np.zeros(f + 2 * g)
    theta[0] = 0.5

    def penalised(values: Array) -> tuple[float, Array]:
        theta[free] = values
        value, gradient = objective(theta, x)
        return value + 0.5 * RIDGE * float(values @ values), gradient[free] + RIDGE * values

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
    """

    kind: str
    fitted: Calibration
    rows: list[dict[str, Any]]
    left_out: int


def refit(
    kind: str, collected: Sequence[PairEvidence], weights: Mapping[str, float] | None = None, seed: int = 0
) -> Refit:
    """Fit a calibration to all pairs that it is for, and to halves of them.

    Args:
        kind: entry of CALIBRATIONS.
        collected: of `collect`.
        weights: as for `fit`.
        seed: of the halves.

    Raises:
        ValueError: no pairs of this kind, or a weight for a target that is not there.
    """
    pairs = [pair for pair in collected if pair.kind == kind]
    if not pairs:
        raise ValueError(f"no pair of views is of the kind {kind!r}; there are {sorted({p.kind for p in collected})}")
    targets = _by_target(pairs)
    unknown = set(weights or {}) - targets.keys()
    if unknown:
        raise ValueError(f"a weight for {sorted(unknown)[0]!r}, which is none of {', '.join(targets)}")
    fitted, parts = fit(pairs, weights), halves(pairs, seed)
    compared = {"whole": [(pairs, CALIBRATIONS["whole"])], "held": [(pairs, CALIBRATIONS[kind])]}
    compared |= {"fitted": [(pairs, fitted)]}
    compared |= {"halves": [(parts[1 - i], fit(parts[i], weights)) for i in (0, 1)]} if all(parts) else {}
    rows: list[dict[str, Any]] = []
    for target, own in targets.items():
        row: dict[str, Any] = {"target": target, "pairs": len(own)}
        for name, parts_of in compared.items():
            row |= {f"{name}_{key}": value for key, value in _measured(target, parts_of).items()}
        rows.append(row)
    return Refit(kind, fitted, rows, len(collected) - len(pairs))


def _measured(target: str, parts: Sequence[tuple[Sequence[PairEvidence], Calibration]]) -> dict[str, Any]:
    """F1, ECE and number of what is emitted of one target, parts with their own calibrations pooled."""
    scores, right, common = [], [], 0
    for pairs, calibration in parts:
        s, r, c = emitted([pair for pair in pairs if pair.target == target], calibration)
        kept = s >= calibration.min_score
        scores.append(s[kept])
        right.append(r[kept])
        common += c
    s, r = np.concatenate(scores), np.concatenate(right)
    ece = expected_calibration_error(s, r) if len(s) else None
    return {"f1": _f1(s, r, common, 0.0), "ece": ece, "emitted": len(s)}
