"""Iterative closest points (Besl and McKay 1992), from many initial rotations."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from .candidates import check_size, distance_variance_m2
from .checks import check_count, check_interval
from .graph import Matching, ObjectGraph, check_comparable
from .pose import Array, RelativePose
from .similarity import distances

MAX_CANDIDATES = 1024
"""Most pairs of objects from which `translations="objects"` starts."""


def icp(
    source: ObjectGraph,
    target: ObjectGraph,
    *,
    prior: RelativePose | None = None,
    rng: np.random.Generator | None = None,
    restarts: int = 24,
    translations: str = "objects",
    iterations: int = 50,
    tolerance: float = 1e-6,
    gate_m: float | None = None,
    gate_sigmas: float = 2.0,
    gate_shrink: float = 0.7,
) -> Matching:
    """Align the target to the source by closest points, keep the best of all restarts, and match what is left close.

    Args:
        source, target: the two robots' graphs.
        prior: if given, the only start; otherwise `restarts` rotations are tried.
        rng: not used.
        restarts: initial rotations: about `up` if both graphs have it, else spread over all rotations.
        translations: initial translations for each rotation: "objects" lays in turn every target object on every source
            object (at most 1024 pairs), as the views may overlap only in part, and lets only points within a shrinking
            gate pull; "centroids" lays the centroids on each other and follows the published algorithm, which expects
            overlap throughout.
        iterations: most iterations of each start.
        tolerance: a start ends when its mean squared error changes by less than this share.
        gate_m: largest distance of a match after alignment, m. None: `gate_sigmas` times the root of the median
            variance of a candidate.
        gate_sigmas: see above.
        gate_shrink: factor of the gate per iteration, until it is the final one; 0 = the final one at once.

    Returns:
        Objects that are each other's closest within the gate; score 1 - distance / gate.

    Raises:
        ValueError: a parameter out of range, or different attribute classes.
    """
    check_comparable(source, target, prior)
    check_count("restarts", restarts)
    check_count("iterations", iterations)
    check_interval("tolerance", tolerance, "[0, inf)")
    check_interval("gate_sigmas", gate_sigmas, "(0, inf)")
    check_interval("gate_shrink", gate_shrink, "[0, 1)")
    if translations not in ("centroids", "objects"):
        raise ValueError(f"translations must be 'centroids' or 'objects', got {translations!r}")
    n, m = len(source), len(target)
    if n == 0 or m == 0:
        return Matching.empty()
    if translations == "objects" and prior is None:
        check_size("icp with translations='objects'", source, target, MAX_CANDIDATES)
    p, q = source.positions, target.positions
    if gate_m is None:
        variance = distance_variance_m2(source, target, distances(p), distances(q))
        gate_m = gate_sigmas * float(np.sqrt(variance))
    check_interval("gate_m", gate_m, "(0, inf)")
    R, t = _starts(source, target, prior, restarts, translations)
    final_gate = np.inf if translations == "centroids" and prior is None else gate_m
    # At first, what an initial rotation half-way between two starts displaces may still pull.
    level = source.up is not None and target.up is not None
    spacing = np.pi / restarts if level else (np.pi**2 / restarts) ** (1 / 3)
    first_gate = max(final_gate, spacing * float(np.sqrt(((q - q.mean(axis=0)) ** 2).sum(axis=1).mean())))
    first_gate = first_gate if gate_shrink > 0 else final_gate
    R_best, t_best = align(p, q, R, t, iterations, tolerance, first_gate, final_gate, gate_shrink)
    distance = np.linalg.norm(p[:, None] - (q @ R_best.T + t_best)[None], axis=2)
    rows = np.arange(n)
    cols = distance.argmin(axis=1)
    mutual = (distance.argmin(axis=0)[cols] == rows) & (distance[rows, cols] <= gate_m)
    rows, cols = rows[mutual], cols[mutual]
    return Matching(np.stack([rows, cols], axis=1), 1.0 - distance[rows, cols] / gate_m)


def _starts(
    source: ObjectGraph, target: ObjectGraph, prior: RelativePose | None, restarts: int, translations: str
) -> tuple[Array, Array]:
    """Initial rotations (k, 3, 3) and translations (k, 3)."""
    if prior is not None:
        return prior.T_source_target[None, :3, :3].copy(), prior.T_source_target[None, :3, 3].copy()
    if source.up is not None and target.up is not None:
        turns = np.arange(restarts)[:, None] * (2 * np.pi / restarts) * source.up
        level = Rotation.align_vectors(source.up[None], target.up[None])[0]
        R = (Rotation.from_rotvec(turns) * level).as_matrix()
    else:
        R = spread_rotations(restarts)
    p, q = source.positions, target.positions
    if translations == "centroids":
        return R, p.mean(axis=0) - R @ q.mean(axis=0)
    t = p[None, :, None] - (q @ R.transpose(0, 2, 1))[:, None]
    return np.repeat(R, len(p) * len(q), axis=0), t.reshape(-1, 3)


def spread_rotations(count: int) -> Array:
    """(count, 3, 3) rotations that cover all orientations evenly, a super-Fibonacci spiral from the identity."""
    k = np.arange(count) + 0.5
    r, s = np.sqrt(k / count), np.sqrt(1 - k / count)
    alpha = 2 * np.pi * k / np.sqrt(2.0)
    beta = 2 * np.pi * k / 1.533751168755204288118041
    rotations = Rotation.from_quat(
        np.stack([r * np.sin(alpha), r * np.cos(alpha), s * np.sin(beta), s * np.cos(beta)], axis=1)
    )
    return np.asarray((rotations[0].inv() * rotations).as_matrix())


@njit(cache=True)
def align(
    p: Array,
    q: Array,
    rotations: Array,
    translations: Array,
    iterations: int,
    tolerance: float,
    first_gate: float,
    final_gate: float,
    shrink: float,
) -> tuple[Array, Array]:
    """Rotation (3, 3) and translation (3,) of target points q (m, 3) to source points p (n, 3) with the least error.

    The error is the mean squared distance of every target point to its closest source point, each cut off at the
    square of the final gate. Points beyond a gate, which shrinks from first to final, do not pull. Infinite gates are
    the published algorithm.
    """
    best = np.inf
    best_R, best_t = rotations[0].copy(), translations[0].copy()
    for start in range(len(rotations)):
        R, t = rotations[start].copy(), translations[start].copy()
        error, gate = np.inf, first_gate
        for _ in range(iterations):
            moved = q @ R.T + t
            closest, squared = _closest(p, moved)
            new_error = np.minimum(squared, final_gate * final_gate).mean()
            if new_error < best:
                best = new_error
                best_R[:], best_t[:] = R, t
            if gate == final_gate and error < np.inf and abs(error - new_error) <= tolerance * max(error, 1e-12):
                break
            error = new_error
            gate = max(final_gate, shrink * gate)
            pulled = squared <= gate * gate
            if pulled.sum() < 2:
                break
            R, t = rigid(p[closest[pulled]], q[pulled])
    return best_R, best_t


@njit(cache=True)
def _closest(p: Array, q: Array) -> tuple[NDArray[np.int64], Array]:
    """For each of q (m, 3) the index of the closest of p (n, 3), and its squared distance."""
    index = np.zeros(len(q), dtype=np.int64)
    squared = np.full(len(q), np.inf)
    for b in range(len(q)):
        for a in range(len(p)):
            d = (p[a, 0] - q[b, 0]) ** 2 + (p[a, 1] - q[b, 1]) ** 2 + (p[a, 2] - q[b, 2]) ** 2
            if d < squared[b]:
                squared[b] = d
                index[b] = a
    return index, squared


@njit(cache=True)
def rigid(p: Array, q: Array) -> tuple[Array, Array]:
    """Rotation and translation that bring q (k, 3) closest to p (k, 3) in the least-squares sense (Arun 1987)."""
    k = len(p)
    p_mean, q_mean = p.sum(axis=0) / k, q.sum(axis=0) / k
    U, _, Vt = np.linalg.svd((p - p_mean).T @ (q - q_mean))
    if np.linalg.det(U) * np.linalg.det(Vt) < 0:
        U[:, 2] = -U[:, 2]
    R = U @ Vt
    return R, p_mean - R @ q_mean
