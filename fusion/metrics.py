"""How well objects are localised: displacement error, GOSPA, NEES, identity switches."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import linear_sum_assignment
from scipy.stats import chi2

from ..matching.checks import check_count, check_interval, numbers
from ..matching.pose import Array
from .gaussian import information_matrix


@dataclass(frozen=True)
class Displacement:
    """Displacement error in metres over `n` objects; NaN where n is 0."""

    mean: float
    median: float
    p95: float
    n: int


def displacement_errors(estimates: ArrayLike, truths: ArrayLike) -> Array:
    """Euclidean errors (n,) m of estimates (n, d) against truths (n, d), in one frame.

    Raises:
        ValueError: shapes that do not fit.
    """
    x, t = numbers(estimates, "estimates"), numbers(truths, "truths")
    if x.shape != t.shape or x.ndim != 2:
        raise ValueError(f"estimates and truths must both be (n, d), got {x.shape} and {t.shape}")
    return np.asarray(np.linalg.norm(x - t, axis=1))


def displacement(errors: ArrayLike) -> Displacement:
    """Mean, median and 95th percentile of errors (n,) m."""
    e = np.asarray(errors, dtype=np.float64).ravel()
    if len(e) == 0:
        return Displacement(float("nan"), float("nan"), float("nan"), 0)
    return Displacement(float(e.mean()), float(np.median(e)), float(np.percentile(e, 95)), len(e))


@dataclass(frozen=True)
class Gospa:
    """GOSPA and its parts: distance^p = localisation + (cutoff^p / 2)(missed + false).

    Attributes:
        distance: m.
        localisation: m^p, sum over assigned pairs.
        n_assigned, n_missed, n_false: counts.
    """

    distance: float
    localisation: float
    n_assigned: int
    n_missed: int
    n_false: int


def gospa(estimates: ArrayLike, truths: ArrayLike, *, cutoff: float = 2.0, p: float = 2.0) -> Gospa:
    """Generalised optimal sub-pattern assignment with alpha = 2 (Rahmathullah et al. 2017).

    Args:
        estimates: (n, d) m; truths: (m, d) m, one frame; either may be empty.
        cutoff: m, error beyond which an estimate does not belong to a truth.
        p: exponent of the errors, at least 1.

    Raises:
        ValueError: cutoff or p out of range, or shapes that do not fit.
    """
    check_interval("cutoff", cutoff, "(0, inf)")
    check_interval("p", p, "[1, inf)")
    x, t = numbers(estimates, "estimates"), numbers(truths, "truths")
    given = [a for a in (x, t) if a.size]
    if any(a.ndim != 2 or a.shape[1] != given[0].shape[1] for a in given):
        raise ValueError(f"estimates must be (n, d) and truths (m, d), got {x.shape} and {t.shape}")
    n, m = len(x), len(t)
    localisation, assigned = 0.0, 0
    if n and m:
        cost = np.minimum(np.linalg.norm(x[:, None] - t[None], axis=2), cutoff) ** p
        rows, columns = linear_sum_assignment(cost)
        near = cost[rows, columns] < cutoff**p
        localisation, assigned = float(cost[rows, columns][near].sum()), int(near.sum())
    missed, false = m - assigned, n - assigned
    total = localisation + cutoff**p / 2 * (missed + false)
    return Gospa(float(total ** (1 / p)), localisation, assigned, missed, false)


def nees(errors: ArrayLike, covariances: ArrayLike) -> Array:
    """Normalised estimation error squared (n,): e^T P^-1 e; its mean is d where the covariances are honest.

    Args:
        errors: (n, d); covariances: (n, d, d).

    Raises:
        ValueError: shapes that do not fit.
    """
    e, C = numbers(errors, "errors"), numbers(covariances, "covariances")
    if e.ndim != 2 or C.shape != (*e.shape, e.shape[1]):
        raise ValueError(f"errors must be (n, d) with covariances (n, d, d), got {e.shape} and {C.shape}")
    return np.array([float(x @ information_matrix(c) @ x) for x, c in zip(e, C, strict=True)])


def nees_per_dof(errors: ArrayLike, covariances: ArrayLike) -> float:
    """Average NEES per degree of freedom: 1 = consistent, above = overconfident; NaN without estimates."""
    values = nees(errors, covariances)
    return float(values.mean() / np.asarray(errors).shape[1]) if len(values) else float("nan")


def nees_interval(n: int, dof: int, confidence: float = 0.95) -> tuple[float, float]:
    """Where honest covariances put `nees_per_dof` over n independent estimates of `dof` degrees of freedom.

    Raises:
        ValueError: no estimates, no degree of freedom, or a confidence outside (0, 1).
    """
    check_count("n", n)
    check_count("dof", dof)
    check_interval("confidence", confidence, "(0, 1)")
    tail = (1 - confidence) / 2
    low, high = chi2.ppf([tail, 1 - tail], n * dof) / (n * dof)
    return float(low), float(high)


def identity_switches(frames: Iterable[Mapping[int, int]]) -> int:
    """How often a true object changes its track: each frame maps true identity to the track that follows it.

    Frames where an object has no track do not count, whatever they are followed by a different track or not.
    """
    last: dict[int, int] = {}
    switches = 0
    for frame in frames:
        for identity, track in frame.items():
            switches += identity in last and last[identity] != track
            last[identity] = track
    return switches
