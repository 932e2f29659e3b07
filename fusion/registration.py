"""Relative pose of two robots from the objects they have in common: weighted rigid registration.

The matched positions of both robots, each with its full covariance, give the pose that maps one onto the other and
that pose's covariance. With gravity known on both sides four degrees of freedom are estimated (translation and
heading), else six.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..matching.checks import check_count, check_interval
from ..matching.graph import Matching, ObjectGraph
from ..matching.pose import Array, RelativePose, exp_se3, invert, rotation_from_vector, skews

VARIANCE_FLOOR = 1e-12
"""m^2 added to every residual's covariance, so that exact measurements can be registered."""

SPREAD_TOLERANCE = 1e-6
"""Smallest extent of the matched objects, over the largest distance between any two, that still fixes a rotation."""


class RegistrationError(ValueError):
    """The matches do not determine the relative pose: too few, or the objects stand in one point or line."""


@dataclass(frozen=True, eq=False)
class Registered:
    """Outcome of a registration.

    Attributes:
        pose: pose of the target's sensor in the source's frame; covariance from the matches (and the prior).
        residuals: (k, 3) m, source minus mapped target, source axes.
        squared_distances: (k,) squared Mahalanobis distances of the residuals, without the pose's own uncertainty.
        weights: (k,) in [0, 1]: 1 = fully trusted, below = an outlier's influence was reduced.
    """

    pose: RelativePose
    residuals: Array
    squared_distances: Array
    weights: Array


def register(
    source: ObjectGraph,
    target: ObjectGraph,
    matching: Matching | NDArray[np.int64],
    *,
    prior: RelativePose | None = None,
    huber: float | None = None,
    iterations: int = 20,
) -> RelativePose:
    """The relative pose that brings matched objects together, with its covariance.

    Args:
        source, target: the two robots' graphs; `up` in both reduces the pose to four degrees of freedom.
        matching: a Matching, or its pairs (k, 2).
        prior: what is known of the pose already; with it any number of matches will do.
        huber: Mahalanobis distance beyond which a match's influence stops growing; None = least squares.
        iterations: most Gauss-Newton steps.

    Raises:
        RegistrationError: without a prior, fewer than two matches (gravity known) or three, or objects that leave a
            rotation open (one vertical, one line).
    """
    return registered(source, target, matching, prior=prior, huber=huber, iterations=iterations).pose


def registered(
    source: ObjectGraph,
    target: ObjectGraph,
    matching: Matching | NDArray[np.int64],
    *,
    prior: RelativePose | None = None,
    huber: float | None = None,
    iterations: int = 20,
) -> Registered:
    """As `register`, with residuals and weights."""
    pairs = np.asarray(matching.pairs if isinstance(matching, Matching) else matching, dtype=np.int64).reshape(-1, 2)
    index_s, index_t = pairs[:, 0], pairs[:, 1]
    up = None if source.up is None or target.up is None else (source.up, target.up)
    return register_points(
        source.positions[index_s],
        source.full_covariances()[index_s],
        target.positions[index_t],
        target.full_covariances()[index_t],
        up=up,
        prior=prior,
        huber=huber,
        iterations=iterations,
    )


def register_points(
    p: Array,
    C_p: Array,
    q: Array,
    C_q: Array,
    *,
    up: tuple[Array, Array] | None = None,
    prior: RelativePose | None = None,
    huber: float | None = None,
    iterations: int = 20,
) -> Registered:
    """Registration of corresponding positions: T q ~ p.

    Args:
        p, C_p: (k, 3) m and (k, 3, 3) m^2, source frame.
        q, C_q: the same in the target frame.
        up: gravity's opposite in the source's and in the target's frame, unit vectors (3,) each.
        prior, huber, iterations: as in `register`.

    Raises:
        RegistrationError: as `register`.
        ValueError: huber or iterations out of range.
    """
    if huber is not None:
        check_interval("huber", huber, "(0, inf)")
    check_count("iterations", iterations)
    T = _start(p, q, up) if prior is None else upright(prior.T_source_target, up)
    free = free_directions(None if up is None else up[1])
    believed: tuple[Array, Array] | None = None
    if prior is not None:
        information: Array = np.linalg.inv(prior.covariance + 1e-12 * np.eye(6)).astype(np.float64)
        believed = (prior.T_source_target, information)
    for _ in range(iterations):
        H, g = _normal_equations(T, p, C_p, q, C_q, huber)[:2]
        if believed is not None:
            H_prior, g_prior = _prior_equations(T, *believed)
            H, g = H + H_prior, g + g_prior
        step = free @ np.linalg.solve(free.T @ H @ free, free.T @ g)
        T = T @ exp_se3(step)
        if np.abs(step).max(initial=0.0) < 1e-12:
            break
    H, _, residuals, squared, weights = _normal_equations(T, p, C_p, q, C_q, huber)
    if believed is not None:
        H = H + _prior_equations(T, *believed)[0]
    covariance = free @ np.linalg.inv(free.T @ H @ free) @ free.T
    pose = RelativePose(orthonormal(T), 0.5 * (covariance + covariance.T))
    return Registered(pose, residuals, squared, weights)


def log_se3(T: Array) -> Array:
    """Twist (6,) of a pose (4, 4), the inverse of `exp_se3`: translation and rotation apart."""
    return np.concatenate([T[:3, 3], _rotation_vector(T[:3, :3])])


def _prior_equations(T: Array, T_prior: Array, information: Array) -> tuple[Array, Array]:
    """H (6, 6) and g (6,) at T of a prior about T_prior, whose right perturbation has `information`."""
    xi = log_se3(invert(T_prior) @ T)
    J = np.eye(6)
    J[:3, :3] = T_prior[:3, :3].T @ T[:3, :3]
    weighted = J.T @ information
    return weighted @ J, -weighted @ xi


def _normal_equations(
    T: Array, p: Array, C_p: Array, q: Array, C_q: Array, huber: float | None
) -> tuple[Array, Array, Array, Array, Array]:
    """Gauss-Newton's H (6, 6) and g (6,), residuals (k, 3), squared Mahalanobis distances (k,), weights (k,)."""
    R = T[:3, :3]
    residuals = p - q @ R.T - T[:3, 3]
    S = C_p + R @ C_q @ R.T
    S += (VARIANCE_FLOOR + 1e-12 * np.trace(S, axis1=1, axis2=2))[:, None, None] * np.eye(3)
    W = np.linalg.inv(S)
    squared = np.einsum("ni,nij,nj->n", residuals, W, residuals)
    weights = np.ones(len(p))
    if huber is not None:
        weights = np.minimum(1.0, huber / np.sqrt(np.maximum(squared, 1e-300)))
    # Linearised at the objects' fused positions, not at q: that makes g the exact gradient although S turns with R,
    # and the estimate the same whichever robot is called the source.
    fused_q = q + np.einsum("nij,nj->ni", C_q @ R.T @ W, residuals)
    J = np.zeros((len(p), 3, 6))  # d(T q) / d(right perturbation)
    J[:, :, :3] = R
    J[:, :, 3:] = -R @ skews(fused_q)
    JtW = J.transpose(0, 2, 1) @ (W * weights[:, None, None])
    H = (JtW @ J).sum(axis=0)
    g = np.einsum("nij,nj->i", JtW, residuals)
    return H, g, residuals, squared, weights


def _start(p: Array, q: Array, up: tuple[Array, Array] | None) -> Array:
    """Closed-form pose (4, 4) of unweighted least squares."""
    needed = 3 if up is None else 2
    if len(p) < needed:
        raise RegistrationError(
            f"{len(p)} matches do not determine a pose: {needed} are needed "
            + ("without gravity" if up is None else "with gravity known")
        )
    p0, q0 = p - p.mean(axis=0), q - q.mean(axis=0)
    R = _kabsch(p0, q0) if up is None else _heading(p0, q0, up)
    T = np.eye(4)
    T[:3, :3] = R
    T[:3, 3] = p.mean(axis=0) - R @ q.mean(axis=0)
    return T


def _kabsch(p: Array, q: Array) -> Array:
    """Rotation (3, 3) that brings q (k, 3) nearest to p (k, 3), both centred (Kabsch 1976)."""
    spread = np.linalg.svd(q, compute_uv=False)
    if spread[1] <= SPREAD_TOLERANCE * max(spread[0], 1e-300):
        raise RegistrationError("the matched objects stand in one line: a rotation about it stays open")
    U, _, Vt = np.linalg.svd(p.T @ q)
    return np.asarray(U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt)


def _heading(p: Array, q: Array, up: tuple[Array, Array]) -> Array:
    """Rotation (3, 3) that takes target up to source up and brings q (k, 3) nearest to p (k, 3), both centred."""
    align = rotation_between(up[1], up[0])
    u = up[0]
    q = q @ align.T
    flat_p, flat_q = p - np.outer(p @ u, u), q - np.outer(q @ u, u)
    size = max(float(np.abs(q).max()), 1e-300)
    if np.linalg.norm(flat_q) <= SPREAD_TOLERANCE * size or np.linalg.norm(flat_p) <= SPREAD_TOLERANCE * size:
        raise RegistrationError("the matched objects stand on one vertical: the heading stays open")
    sine = float((np.cross(flat_q, flat_p) @ u).sum())
    cosine = float((flat_q * flat_p).sum())
    return rotation_from_vector(np.arctan2(sine, cosine) * u) @ align


def upright(T: Array, up: tuple[Array, Array] | None) -> Array:
    """The pose (4, 4), tilted so that gravity agrees; `up` in the source's and the target's frame, None = unknown."""
    out = T.copy()
    if up is not None:
        out[:3, :3] = rotation_between(T[:3, :3] @ up[1], up[0]) @ T[:3, :3]
    return out


def free_directions(up: Array | None) -> Array:
    """Basis (6, d) of the right perturbations that are estimated: all, or translation and rotation about target up."""
    if up is None:
        return np.eye(6)
    free = np.zeros((6, 4))
    free[:3, :3] = np.eye(3)
    free[3:, 3] = up
    return free


def rotation_between(a: Array, b: Array) -> Array:
    """Smallest rotation (3, 3) that takes unit vector a (3,) to unit vector b (3,)."""
    axis = np.cross(a, b)
    sine, cosine = float(np.linalg.norm(axis)), float(a @ b)
    if sine < 1e-12:
        if cosine > 0:
            return np.eye(3)
        axis = np.cross(a, np.eye(3)[int(np.argmin(np.abs(a)))])
        return rotation_from_vector(np.pi * axis / np.linalg.norm(axis))
    return rotation_from_vector(axis / sine * np.arctan2(sine, cosine))


def _rotation_vector(R: Array) -> Array:
    """Axis times angle (3,) of a rotation (3, 3)."""
    w = 0.5 * np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    sine, cosine = float(np.linalg.norm(w)), 0.5 * (float(np.trace(R)) - 1.0)
    if sine > 1e-9:
        return w / sine * np.arctan2(sine, cosine)
    if cosine > 0:
        return w
    axis = np.sqrt(np.maximum(np.diag(R) + 1.0, 0.0) / 2.0)
    k = int(np.argmax(axis))
    signs = np.sign(R[k] + (np.arange(3) == k))
    return np.pi * axis * np.where(signs == 0, 1.0, signs)


def orthonormal(T: Array) -> Array:
    """The pose (4, 4) with the nearest rotation in place of one that has drifted."""
    U, _, Vt = np.linalg.svd(T[:3, :3])
    out = T.copy()
    out[:3, :3] = U @ Vt
    return out
