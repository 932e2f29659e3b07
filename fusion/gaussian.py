"""Fusing estimates of one quantity: the paper's gain (eq. 20-22), full covariances, unknown correlation.

A variance of 0 means "exact", an infinite one "knows nothing"; both have a defined result.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import minimize, minimize_scalar

from ..matching.checks import numbers
from ..matching.pose import Array

RELATIVE_FLOOR = 1e-12
"""Smallest eigenvalue of a covariance over its trace before it is inverted."""

ABSOLUTE_FLOOR = 1e-12
"""Smallest variance before a covariance is inverted, in the square of the estimate's unit: a micrometre in m."""


@dataclass(frozen=True, eq=False)
class Gaussian:
    """An estimate: mean (d,) and covariance (d, d); infinite diagonal elements where nothing is known."""

    mean: Array
    covariance: Array


def fusion_gains(variances: ArrayLike) -> Array:
    """Weight of each robot's measurement, eq. 20: the diagonal of M, which is a multiple of the identity.

    Args:
        variances: (N, ...) m^2, the paper's u of N robots; 0 = exact, inf = knows nothing.

    Returns:
        (N, ...) weights that sum to 1 over robots. Exact measurements share the weight among themselves; where every
        variance is infinite all robots weigh the same.

    Raises:
        ValueError: no robots, or a negative or NaN variance.
    """
    u = _check_variances(variances)
    exact = u == 0
    information = np.divide(1.0, u, out=np.zeros_like(u), where=~exact)
    information = np.where(exact.any(axis=0), exact.astype(np.float64), information)
    information = np.where((information == 0).all(axis=0), 1.0, information)
    return information / information.sum(axis=0)  # Eq. (20)


def fused_variance(variances: ArrayLike) -> Array:
    """Variance (...) of the fused position, eq. 22, from variances (N, ...); inf where all are infinite."""
    u = _check_variances(variances)
    with np.errstate(divide="ignore"):
        return np.asarray(1.0 / (1.0 / u).sum(axis=0))  # Eq. (22)


def fuse_isotropic(positions: ArrayLike, variances: ArrayLike) -> Gaussian:
    """The paper's fusion of one object, eq. 20-22.

    Args:
        positions: (N, d) m, every robot's measurement, already in one frame.
        variances: (N,) m^2.

    Raises:
        ValueError: shapes that do not fit, or a negative or NaN variance.
    """
    p = np.asarray(positions, dtype=np.float64)
    gains = fusion_gains(variances)
    if p.ndim != 2 or gains.shape != (len(p),):
        raise ValueError(f"positions must be (N, d) with variances (N,), got {p.shape} and {gains.shape}")
    variance = float(fused_variance(variances))
    d = p.shape[1]
    covariance = variance * np.eye(d) if np.isfinite(variance) else np.diag(np.full(d, np.inf))
    return Gaussian(gains @ p, covariance)  # Eq. (21)


def information_matrix(covariance: ArrayLike) -> Array:
    """Inverse (d, d) of a covariance (d, d); zero along axes of infinite variance, huge where it is zero.

    Raises:
        ValueError: not square, a NaN, or a negative variance.
    """
    C = np.asarray(covariance, dtype=np.float64)
    if C.ndim != 2 or C.shape[0] != C.shape[1]:
        raise ValueError(f"covariance must be square, got shape {C.shape}")
    diagonal = np.diag(C)
    if np.isnan(C).any() or (diagonal < 0).any():
        raise ValueError(f"covariance must have a non-negative diagonal and no NaN, got\n{C}")
    known = np.flatnonzero(np.isfinite(diagonal))
    information = np.zeros_like(C)
    if len(known):
        block = C[np.ix_(known, known)]
        values, vectors = np.linalg.eigh(0.5 * (block + block.T))
        values = np.maximum(values, max(ABSOLUTE_FLOOR, RELATIVE_FLOOR * float(values.sum())))
        information[np.ix_(known, known)] = (vectors / values) @ vectors.T
    return information


def fuse_gaussians(means: ArrayLike, covariances: ArrayLike) -> Gaussian:
    """Information fusion of independent estimates: eq. 20-22 with full covariances in place of u I.

    Args:
        means: (N, d), one frame.
        covariances: (N, d, d).

    Raises:
        ValueError: shapes that do not fit, a mean that is not finite, or a negative or NaN variance.
    """
    x, C = _check_estimates(means, covariances)
    return _from_information([information_matrix(c) for c in C], x, np.ones(len(x)))


def covariance_intersection(
    means: ArrayLike, covariances: ArrayLike, *, weights: ArrayLike | None = None, criterion: str = "trace"
) -> Gaussian:
    """Fusion that stays consistent whatever the correlation between the estimates (Julier and Uhlmann 1997).

    Args:
        means: (N, d), one frame.
        covariances: (N, d, d).
        weights: (N,) non-negative, sum 1; None = those that minimise `criterion` of the fused covariance.
        criterion: "trace" or "determinant".

    Raises:
        ValueError: weights that are negative or do not sum to 1, or an unknown criterion.
    """
    x, C = _check_estimates(means, covariances)
    information = [information_matrix(c) for c in C]
    if weights is None:
        w = _intersection_weights(information, criterion)
    else:
        w = np.asarray(weights, dtype=np.float64)
        if w.shape != (len(x),) or (w < 0).any() or abs(float(w.sum()) - 1.0) > 1e-9:
            raise ValueError(f"weights must be {len(x)} non-negative numbers of sum 1, got {w.tolist()}")
    return _from_information(information, x, w)


def _intersection_weights(information: list[Array], criterion: str) -> Array:
    """Weights (N,) on the simplex minimising the criterion; both criteria are convex in the weights."""
    if criterion not in ("trace", "determinant"):
        raise ValueError(f"criterion must be 'trace' or 'determinant', got {criterion!r}")
    stacked = np.stack(information)
    N, d = stacked.shape[:2]
    if N == 1:
        return np.ones(1)
    tiny = 1e-12 * max(float(np.trace(stacked, axis1=1, axis2=2).max()), 1e-300)

    def cost(w: Array) -> float:
        total = np.tensordot(w, stacked, axes=1) + tiny * np.eye(d)
        if criterion == "trace":
            return float(np.log(np.trace(np.linalg.inv(total))))
        return -float(np.linalg.slogdet(total)[1])

    if N == 2:
        best = minimize_scalar(
            lambda a: cost(np.array([a, 1.0 - a])), bounds=(0.0, 1.0), method="bounded", options={"xatol": 1e-9}
        )
        candidates = [np.array([a, 1.0 - a]) for a in (float(best.x), 0.0, 1.0)]
    else:
        found = minimize(
            cost,
            np.full(N, 1.0 / N),
            method="SLSQP",
            bounds=[(0.0, 1.0)] * N,
            constraints={"type": "eq", "fun": lambda w: w.sum() - 1.0},
        )
        w = np.clip(found.x, 0.0, None)
        candidates = [w / w.sum(), *np.eye(N)]
    return min(candidates, key=cost)


def _from_information(information: list[Array], means: Array, weights: Array) -> Gaussian:
    """Fusion of means (N, d) by weighted information; where none has any, their plain mean and infinite variance."""
    stacked = np.stack(information) * weights[:, None, None]
    total = stacked.sum(axis=0)
    vector = np.einsum("nij,nj->i", stacked, means)
    d = len(total)
    informed = np.flatnonzero(np.diag(total) > 0)
    mean = means.mean(axis=0)
    covariance = np.zeros((d, d))
    blind = np.setdiff1d(np.arange(d), informed)
    covariance[blind, blind] = np.inf
    if len(informed):
        block = np.ix_(informed, informed)
        covariance[block] = np.linalg.inv(total[block])
        mean[informed] = covariance[block] @ vector[informed]
    return Gaussian(mean, covariance)


def _check_variances(variances: ArrayLike) -> Array:
    u = numbers(variances, "variances")
    if u.ndim < 1 or len(u) == 0:
        raise ValueError(f"variances must have a leading axis of at least one robot, got shape {u.shape}")
    if not (u >= 0).all():
        raise ValueError(f"variances must be non-negative, got {u[~(u >= 0)][0]}")
    return u


def _check_estimates(means: ArrayLike, covariances: ArrayLike) -> tuple[Array, Array]:
    x, C = numbers(means, "means"), numbers(covariances, "covariances")
    if x.ndim != 2 or len(x) == 0:
        raise ValueError(f"means must have shape (N, d) with N >= 1, got {x.shape}")
    if C.shape != (*x.shape, x.shape[1]):
        raise ValueError(f"covariances must have shape {(*x.shape, x.shape[1])}, got {C.shape}")
    if not np.isfinite(x).all():
        raise ValueError(f"means must be finite, got {x[~np.isfinite(x)][0]}")
    return x, C
