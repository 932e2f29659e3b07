"""What `bayes` computes once per pair of graphs, before any pose: level positions, height prior, static weights."""

from __future__ import annotations

import numpy as np
from numba import njit

from .pose import Array

LOG_2PI = float(np.log(2 * np.pi))
UNKNOWN_VARIANCE_FACTOR = 100.0


@njit(cache=True)
def levelling_rotation(up: Array) -> Array:
    """Rotation (3, 3) that turns the unit vector `up` into (0, 0, 1) by the shortest way."""
    x, y, z = up[0], up[1], up[2]
    out = np.zeros((3, 3))
    if z < -0.999999:
        out[0, 0], out[1, 1], out[2, 2] = 1.0, -1.0, -1.0
        return out
    k = 1.0 / (1.0 + z)
    out[0, 0], out[0, 1], out[0, 2] = 1.0 - k * x * x, -k * x * y, -x
    out[1, 0], out[1, 1], out[1, 2] = -k * x * y, 1.0 - k * y * y, -y
    out[2, 0], out[2, 1], out[2, 2] = x, y, z
    return out


@njit(cache=True)
def level(
    positions: Array, depth_variance: Array, covariances: Array, bearing_variance: float, L: Array, p: Array, S: Array
) -> None:
    """Positions (n, 3) and covariances (n, 3, 3) turned by L, into p and S.

    `covariances` of shape (0, 3, 3) means that there are none: then `depth_variance` holds along the viewing ray and
    range^2 * `bearing_variance` across it. Infinite variances become a hundred squared ranges.
    """
    for i in range(len(positions)):
        r2 = 0.0
        for a in range(3):
            v = 0.0
            for b in range(3):
                v += L[a, b] * positions[i, b]
            p[i, a] = v
            r2 += v * v
        floor = 1e-8 * r2 + 1e-8
        if len(covariances):
            for a in range(3):
                for b in range(3):
                    v = 0.0
                    for c in range(3):
                        for d in range(3):
                            v += L[a, c] * covariances[i, c, d] * L[b, d]
                    S[i, a, b] = v
                S[i, a, a] += floor
        else:
            along = min(depth_variance[i], 100.0 * r2 + 100.0)
            across = r2 * bearing_variance
            if r2 < 1e-12:
                across = along
            for a in range(3):
                for b in range(3):
                    S[i, a, b] = (along - across) * p[i, a] * p[i, b] / max(r2, 1e-12)
                S[i, a, a] += across + floor


@njit(cache=True)
def height_spread(p_a: Array, S_a: Array, p_b: Array, S_b: Array) -> tuple[float, float, float]:
    """Posterior mean of the variance of true heights (m^2), and the mean height seen by either robot.

    Heights are N(mean of the robot, variance) plus the noise of each detection; the variance is common to both robots,
    integrated over a logarithmic grid.
    """
    n, m = len(p_a), len(p_b)
    low, high = 1e30, 1e-30
    mean = 0.0
    for k in range(n + m):
        s = S_a[k, 2, 2] if k < n else S_b[k - n, 2, 2]
        low = min(low, s)
        mean += (p_a[k, 2] if k < n else p_b[k - n, 2]) / (n + m)
    for k in range(n + m):
        z = p_a[k, 2] if k < n else p_b[k - n, 2]
        high = max(high, (z - mean) ** 2)
    low = max(0.01 * low, 1e-8)
    high = max(high, 10.0 * low)
    steps = 16
    best_log = -1e300
    logs = np.empty(steps)
    for g in range(steps):
        v = low * (high / low) ** (g / (steps - 1))
        total = 0.0
        for side in range(2):
            w = wz = wzz = logdet = 0.0
            for k in range(n if side == 0 else m):
                s = v + (S_a[k, 2, 2] if side == 0 else S_b[k, 2, 2])
                z = p_a[k, 2] if side == 0 else p_b[k, 2]
                w += 1 / s
                wz += z / s
                wzz += z * z / s
                logdet += np.log(s)
            if w > 0:
                total -= 0.5 * (logdet + np.log(w) + wzz - wz * wz / w)
        logs[g] = total
        best_log = max(best_log, total)
    norm = variance = 0.0
    for g in range(steps):
        q = np.exp(logs[g] - best_log)
        norm += q
        variance += q * low * (high / low) ** (g / (steps - 1))
    variance /= norm
    means = np.zeros(2)
    for side in range(2):
        w = wz = 0.0
        for k in range(n if side == 0 else m):
            s = variance + (S_a[k, 2, 2] if side == 0 else S_b[k, 2, 2])
            w += 1 / s
            wz += (p_a[k, 2] if side == 0 else p_b[k, 2]) / s
        means[side] = wz / w if w > 0 else 0.0
    return variance, means[0], means[1]


@njit(cache=True)
def shrink_heights(p: Array, S: Array, mean: float, variance: float) -> None:
    """Condition every detection on a height prior N(mean, variance), in place."""
    gain = np.empty(3)
    for i in range(len(p)):
        s = S[i, 2, 2] + variance
        e = mean - p[i, 2]
        for a in range(3):
            gain[a] = S[i, a, 2] / s
        for a in range(3):
            p[i, a] += gain[a] * e
        for a in range(3):
            for b in range(a, 3):
                # gain_b s = S_b2 of before the update.
                S[i, a, b] -= gain[a] * gain[b] * s
                S[i, b, a] = S[i, a, b]
        for a in range(3):
            S[i, a, a] = max(S[i, a, a], 1e-9)


@njit(cache=True)
def height_correction(
    p_a: Array, S_a: Array, mean_a: float, p_b: Array, S_b: Array, mean_b: float, variance: float, out: Array
) -> None:
    """Adds to out (n, m) what turns N(z_i - z_j; s_i + s_j) of shrunk heights into the exact likelihood ratio.

    log of the integral of N(X; z_i, s_i) N(X; z_j, s_j) / N(X; 0, variance) over X, less log N(z_i - z_j; s_i + s_j):
    the height prior was counted for both detections and belongs to the match once.
    """
    for i in range(len(p_a)):
        v_i = min(S_a[i, 2, 2], 0.999 * variance)
        for j in range(len(p_b)):
            v_j = min(S_b[j, 2, 2], 0.999 * variance)
            v = 1.0 / (1.0 / v_i + 1.0 / v_j)
            z = v * ((p_a[i, 2] - mean_a) / v_i + (p_b[j, 2] - mean_b) / v_j)
            ratio = 0.5 * (LOG_2PI + np.log(variance)) - 0.5 * np.log(1.0 - v / variance)
            out[i, j] += ratio + z * z / (2.0 * (variance - v))


@njit(cache=True)
def class_evidence(
    a: Array,
    v_a: Array,
    b: Array,
    v_b: Array,
    sharpness: float,
    mislabel: float,
    out: Array,
    top_a: Array,
    top_b: Array,
) -> None:
    """Adds to out (n, m) the log-likelihood ratio "one object" : "two" of class confidences a (n, c), b (m, c).

    Confidences raised to `sharpness` are taken as likelihoods of the class; class frequencies are estimated from both
    graphs by expectation maximisation. An attribute variance takes sharpness away; `mislabel` is the share of classes
    that tell nothing.
    """
    n, m, c = len(a), len(b), a.shape[1]
    q = np.empty((n + m, c))
    for k in range(n + m):
        v = v_a[k] if k < n else v_b[k - n]
        power = sharpness / (1.0 + 4.0 * v)
        top = 0.0
        for x in range(c):
            top = max(top, a[k, x] if k < n else b[k - n, x])
        total = 0.0
        best = 0
        for x in range(c):
            value = a[k, x] if k < n else b[k - n, x]
            q[k, x] = (max(value, 1e-12) / top) ** power if top > 0 else 1.0
            total += q[k, x]
            if q[k, x] > q[k, best]:
                best = x
        if k < n:
            top_a[k] = best
        else:
            top_b[k - n] = best
        for x in range(c):
            q[k, x] = (1 - mislabel) * q[k, x] / total + mislabel / c
    if c == 1:
        return
    frequency = np.full(c, 1.0 / c)
    new = np.empty(c)
    for _ in range(10):
        new[:] = 0.5
        for k in range(n + m):
            total = 0.0
            for x in range(c):
                total += q[k, x] * frequency[x]
            for x in range(c):
                new[x] += q[k, x] * frequency[x] / total
        total = new.sum()
        for x in range(c):
            frequency[x] = new[x] / total
    for k in range(n + m):
        total = 0.0
        for x in range(c):
            total += q[k, x] * frequency[x]
        for x in range(c):
            q[k, x] /= total
    for i in range(n):
        for j in range(m):
            total = 0.0
            for x in range(c):
                total += q[i, x] * q[n + j, x] * frequency[x]
            out[i, j] += np.log(total)


@njit(cache=True)
def spread_area(p: Array) -> float:
    """Horizontal area (m^2) over which detections spread: of the disc with their covariance."""
    n = len(p)
    if n < 2:
        return 1.0
    mx = my = 0.0
    for i in range(n):
        mx += p[i, 0] / n
        my += p[i, 1] / n
    sxx = syy = sxy = 0.0
    for i in range(n):
        dx, dy = p[i, 0] - mx, p[i, 1] - my
        sxx += dx * dx / n
        syy += dy * dy / n
        sxy += dx * dy / n
    area = 4 * np.pi * np.sqrt(max(sxx * syy - sxy * sxy, 0.0))
    # Collinear objects still occupy some width.
    return max(area, 0.1 * np.pi * (sxx + syy), 1e-4)


@njit(cache=True)
def spread_volume(p: Array, S: Array) -> float:
    """Volume (m^3) over which detections spread: of the ball with their covariance, noise included."""
    n = len(p)
    mean = np.zeros(3)
    C = np.zeros((3, 3))
    for i in range(n):
        mean += p[i] / n
    for i in range(n):
        for a in range(3):
            for b in range(3):
                C[a, b] += ((p[i, a] - mean[a]) * (p[i, b] - mean[b]) + S[i, a, b]) / n
    size = C[0, 0] + C[1, 1] + C[2, 2]
    for a in range(3):
        C[a, a] += 0.003 * size + 1e-6
    return 4.0 / 3.0 * np.pi * 5.0**1.5 * np.sqrt(max(np.linalg.det(C), 1e-18))
