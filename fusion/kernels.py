"""Compiled core of fusion: information fusion and gating of all groups at once."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ..matching.pose import Array


@njit(cache=True)
def _invert_spd(A: Array, out: Array) -> None:
    """Inverse of a symmetric positive definite (3, 3) by its Cholesky factor, with a floor under the diagonal."""
    floor = 1e-12 * (A[0, 0] + A[1, 1] + A[2, 2]) + 1e-12
    a, b, c = A[0, 0] + floor, A[1, 1] + floor, A[2, 2] + floor
    l00 = np.sqrt(a)
    l10, l20 = A[1, 0] / l00, A[2, 0] / l00
    l11 = np.sqrt(max(b - l10 * l10, floor))
    l21 = (A[2, 1] - l20 * l10) / l11
    l22 = np.sqrt(max(c - l20 * l20 - l21 * l21, floor))
    i00, i11, i22 = 1.0 / l00, 1.0 / l11, 1.0 / l22
    i10 = -l10 * i00 * i11
    i21 = -l21 * i11 * i22
    i20 = (l10 * l21 - l20 * l11) * i00 * i11 * i22
    out[0, 0] = i00 * i00 + i10 * i10 + i20 * i20
    out[1, 1] = i11 * i11 + i21 * i21
    out[2, 2] = i22 * i22
    out[0, 1] = out[1, 0] = i10 * i11 + i20 * i21
    out[0, 2] = out[2, 0] = i20 * i22
    out[1, 2] = out[2, 1] = i21 * i22


@njit(cache=True)
def fuse_groups(rows: NDArray[np.int64], positions: Array, covariances: Array) -> tuple[Array, Array]:
    """Information fusion of each group: rows (m, N) into positions (n, 3) and covariances (n, 3, 3), -1 = absent."""
    m, N = rows.shape
    fused, fused_covariances = np.zeros((m, 3)), np.zeros((m, 3, 3))
    W, total = np.zeros((3, 3)), np.zeros((3, 3))
    vector = np.zeros(3)
    for k in range(m):
        count, only = 0, 0
        for r in range(N):
            if rows[k, r] >= 0:
                count += 1
                only = rows[k, r]
        if count == 1:  # exactly the measurement, with no rounding and no floor
            fused[k] = positions[only]
            fused_covariances[k] = covariances[only]
            continue
        total[:] = 0.0
        vector[:] = 0.0
        for r in range(N):
            d = rows[k, r]
            if d < 0:
                continue
            _invert_spd(covariances[d], W)
            for i in range(3):
                for j in range(3):
                    total[i, j] += W[i, j]
                    vector[i] += W[i, j] * (positions[d, j] - positions[only, j])
        # The information is inverted without a floor of its own: its condition is bounded by the floors above.
        _invert_information(total, fused_covariances[k])
        for i in range(3):
            fused[k, i] = positions[only, i]  # relative to one member: large offsets lose digits
            for j in range(3):
                fused[k, i] += fused_covariances[k, i, j] * vector[j]
    return fused, fused_covariances


@njit(cache=True)
def _invert_information(A: Array, out: Array) -> None:
    """Inverse of a symmetric information matrix (3, 3), scaled so that its size does not matter."""
    scale = 3.0 / (A[0, 0] + A[1, 1] + A[2, 2])
    scaled = A * scale
    inverse = np.linalg.inv(scaled)
    for i in range(3):
        for j in range(3):
            out[i, j] = 0.5 * (inverse[i, j] + inverse[j, i]) * scale


@njit(cache=True)
def gate_groups(rows: NDArray[np.int64], positions: Array, covariances: Array, threshold: float, trusted: int) -> None:
    """Set to -1, in place, the members of each group that disagree with its largest consistent core.

    The core is the member that most others agree with (by the threshold on the squared Mahalanobis distance of their
    difference), and those others; among equals the more precise. Of two that disagree the more precise is kept. In
    groups that robot `trusted` (column, -1 = none) measured too, its measurement is the core.
    """
    m, N = rows.shape
    W, S = np.zeros((3, 3)), np.zeros((3, 3))
    agree = np.zeros((N, N), dtype=np.bool_)
    for k in range(m):
        for i in range(N):
            for j in range(i):
                a, b = rows[k, i], rows[k, j]
                agree[i, j] = agree[j, i] = False
                if a < 0 or b < 0:
                    continue
                for x in range(3):
                    for y in range(3):
                        S[x, y] = covariances[a, x, y] + covariances[b, x, y]
                _invert_spd(S, W)
                squared = 0.0
                for x in range(3):
                    for y in range(3):
                        squared += (positions[a, x] - positions[b, x]) * W[x, y] * (positions[a, y] - positions[b, y])
                agree[i, j] = agree[j, i] = squared <= threshold
        core, support, spread = -1, -1, np.inf
        for i in range(N):
            d = rows[k, i]
            if d < 0:
                continue
            count = 0
            for j in range(N):
                count += agree[i, j]
            trace = covariances[d, 0, 0] + covariances[d, 1, 1] + covariances[d, 2, 2]
            if count > support or (count == support and trace < spread):
                core, support, spread = i, count, trace
        if trusted >= 0 and rows[k, trusted] >= 0:
            core = trusted
        for i in range(N):
            if i != core and not agree[core, i]:
                rows[k, i] = -1
