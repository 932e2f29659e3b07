"""What `bayes` computes once per pair of graphs, before any pose: level positions, height prior, static weights."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from .pose import Array

Indices = NDArray[np.int64]

LOG_2PI = float(np.log(2 * np.pi))

REACH_QUANTILE = 0.85
"""Share of the detections that lie within the reach."""


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
            q[k, x] = (max(value, 1e-12) / top) ** power if top > 1e-12 else 1.0
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


class Settings(NamedTuple):
    """The model's constants; lengths are fractions of the reach (see `bayes`)."""

    class_sharpness: float
    mislabel: float
    overlap_alpha: float
    overlap_beta: float
    match_bonus: float
    view_bonus: float
    initial_log_odds: float
    extent: float
    depth_offset: float
    depth_offset_std: float
    scale_std: float
    robot_extent: float


class Problem(NamedTuple):
    """Everything known before a pose. The last object of either side is the robot itself, at its origin.

    Attributes:
        p_a, p_b: (n + 1, 3), (m + 1, 3) m, levelled and shrunk to the common height.
        S_a, S_b: covariances (., 3, 3) m^2.
        B_a, B_b: (., nb, 3) how each bias moves each object.
        bias_precision: (nb,) of the biases' Gaussian priors, whose means are 0.
        static: (n + 1, m + 1) log weight of a match less its residual's density: class, clutter density, height.
        likely: (n + 1, m + 1) class evidence alone.
        height: m, expected height of the target's frame above the source's; height_variance: m^2.
        room_a, room_b: area (m^2), or without gravity volume (m^3), over which detections spread.
        median_range: m.
    """

    p_a: Array
    S_a: Array
    B_a: Array
    p_b: Array
    S_b: Array
    B_b: Array
    bias_precision: Array
    static: Array
    likely: Array
    height: float
    height_variance: float
    room_a: float
    room_b: float
    median_range: float


@njit(cache=True)
def ranges(positions: Array, others: Array) -> Array:
    """All distances (n + m,) m from either robot, ascending."""
    n = len(positions)
    out = np.empty(n + len(others))
    for k in range(len(out)):
        p = positions[k] if k < n else others[k - n]
        out[k] = np.sqrt(p[0] * p[0] + p[1] * p[1] + p[2] * p[2])
    return np.sort(out)


@njit(cache=True)
def reach_of(distances: Array) -> float:
    """The views' reach, m, of all distances in ascending order: what lengths of objects are fractions of.

    Detectors lose objects where their images become small, so that it goes with the objects' size; the median range,
    beside it, falls by a factor of three where a few objects happen to be near.
    """
    return max(distances[int(REACH_QUANTILE * (len(distances) - 1))], 1e-3)


@njit(cache=True)
def log_room_per_object(p: Array, room: float, dims: int) -> Array:
    """Minus the log density (n,) of detections around each: half uniform over the room, half a kernel estimate."""
    n = len(p)
    h2 = 0.25**2 * (room / np.pi if dims == 2 else (0.75 * room / np.pi) ** (2.0 / 3.0))
    norm = (2 * np.pi * h2) ** (-0.5 * dims)
    out = np.empty(n)
    for i in range(n):
        near = 0.0
        for j in range(n):
            if j != i:
                d2 = 0.0
                for a in range(dims):
                    d2 += (p[i, a] - p[j, a]) ** 2
                near += np.exp(-0.5 * d2 / h2)
        density = 0.5 * n / room + 0.5 * near * norm * n / max(n - 1, 1)
        out[i] = -np.log(density)
    return out


@njit(cache=True)
def with_robot(p: Array, S: Array, std: float, height_variance: float) -> tuple[Array, Array]:
    """Positions and covariances with the robot itself appended, at the origin."""
    n = len(p)
    p_out, S_out = np.zeros((n + 1, 3)), np.zeros((n + 1, 3, 3))
    p_out[:n] = p
    S_out[:n] = S
    S_out[n, 0, 0] = S_out[n, 1, 1] = std * std
    S_out[n, 2, 2] = height_variance
    return p_out, S_out


@njit(cache=True)
def bias_vectors(p: Array, top: Indices, classes: Indices, side: int, scaled: bool) -> Array:
    """How each bias moves each object (n + 1, nb, 3): an offset along the ray per class, a scale per robot."""
    n = len(p) - 1
    nc = len(classes)
    B = np.zeros((n + 1, nc + 2 if scaled else nc, 3))
    for i in range(n):
        r = np.sqrt(p[i, 0] ** 2 + p[i, 1] ** 2 + p[i, 2] ** 2) + 1e-12
        for c in range(nc):
            if classes[c] == top[i]:
                B[i, c] = p[i] / r
        if scaled:
            B[i, nc + side] = p[i]
    return B


@njit(cache=True)
def prepare(
    positions_a: Array,
    depth_a: Array,
    covariances_a: Array,
    classes_a: Array,
    class_variance_a: Array,
    L_a: Array,
    positions_b: Array,
    depth_b: Array,
    covariances_b: Array,
    classes_b: Array,
    class_variance_b: Array,
    L_b: Array,
    bearing_variance: float,
    gravity: bool,
    cameras: bool,
    seen: bool,
    planes_a: Array,
    planes_b: Array,
    half_length: float,
    q: Settings,
) -> Problem:
    """Assemble the problem.

    `cameras`: detections come from images: biased depth, objects of some extent, cut off at the `planes` (2, 3) that
    bound the field of view (inward normals, levelled; (0, 3) = unknown) where their `half_length`, m, is not 0.
    """
    n, m = len(positions_a), len(positions_b)
    p_a, S_a, p_b, S_b = np.empty((n, 3)), np.empty((n, 3, 3)), np.empty((m, 3)), np.empty((m, 3, 3))
    level(positions_a, depth_a, covariances_a, bearing_variance, L_a, p_a, S_a)
    level(positions_b, depth_b, covariances_b, bearing_variance, L_b, p_b, S_b)
    distance = ranges(positions_a, positions_b)
    median_range = max(distance[(n + m) // 2], 1e-3)
    reach = reach_of(distance)
    if cameras:
        allow_for_extent(p_a, S_a, q.extent * reach, q.depth_offset * reach)
        allow_for_extent(p_b, S_b, q.extent * reach, q.depth_offset * reach)
        if half_length > 0:
            allow_for_border(p_a, S_a, planes_a, half_length)
            allow_for_border(p_b, S_b, planes_b, half_length)
    likely = np.full((n + 1, m + 1), -1e9)
    attributes = np.zeros((n, m))
    top_a, top_b = np.zeros(n, np.int64), np.zeros(m, np.int64)
    class_evidence(
        classes_a,
        class_variance_a,
        classes_b,
        class_variance_b,
        q.class_sharpness,
        q.mislabel,
        attributes,
        top_a,
        top_b,
    )
    likely[:n, :m] = attributes
    height = height_variance = robot_height_log = 0.0
    robot_std = q.robot_extent * reach
    robot_variance = robot_std**2
    if gravity:
        variance, mean_a, mean_b = height_spread(p_a, S_a, p_b, S_b)
        shrink_heights(p_a, S_a, mean_a, variance)
        shrink_heights(p_b, S_b, mean_b, variance)
        height_correction(p_a, S_a, mean_a, p_b, S_b, mean_b, variance, attributes)
        room_a, room_b = spread_area(p_a), spread_area(p_b)
        height = mean_a - mean_b
        height_variance = 2.0 * variance * (1.0 / n + 1.0 / m) + 1e-6
        # The height of a robot's sensor says nothing of the height at which the other sees the robot.
        robot_variance = 1e4 * median_range**2
        robot_height_log = 0.5 * np.log(2 * np.pi * robot_variance)
    else:
        room_a, room_b = spread_volume(p_a, S_a), spread_volume(p_b, S_b)
    log_a = log_room_per_object(p_a, room_a, 2 if gravity else 3)
    log_b = log_room_per_object(p_b, room_b, 2 if gravity else 3)
    static = np.full((n + 1, m + 1), -1e9)
    for i in range(n):
        for j in range(m):
            static[i, j] = attributes[i, j] + 0.5 * (log_a[i] + log_b[j])
    if seen:
        for i in range(n):
            static[i, m] = log_a[i] + robot_height_log
            likely[i, m] = 0.0
        for j in range(m):
            static[n, j] = log_b[j] + robot_height_log
            likely[n, j] = 0.0
    p_a, S_a = with_robot(p_a, S_a, robot_std, robot_variance)
    p_b, S_b = with_robot(p_b, S_b, robot_std, robot_variance)
    offset = cameras and q.depth_offset_std > 0
    scaled = q.scale_std > 0
    classes = np.unique(np.concatenate((top_a, top_b))) if offset else np.zeros(0, np.int64)
    B_a, B_b = bias_vectors(p_a, top_a, classes, 0, scaled), bias_vectors(p_b, top_b, classes, 1, scaled)
    precision = np.empty(B_a.shape[1])
    precision[:] = 1.0 / max(q.depth_offset_std * reach, 1e-9) ** 2
    if scaled:
        precision[len(classes) :] = 1.0 / q.scale_std**2
    return Problem(
        p_a,
        S_a,
        B_a,
        p_b,
        S_b,
        B_b,
        precision,
        static,
        likely,
        height,
        height_variance,
        room_a,
        room_b,
        median_range,
    )


@njit(cache=True)
def allow_for_extent(p: Array, S: Array, extent: float, offset: float) -> None:
    """Push detections outwards by `offset` (m) and widen them: what is seen is a face of the object, not its centre.

    The height of the visible part's centre says even less: its deviation counts fourfold.
    """
    for i in range(len(p)):
        r = np.sqrt(p[i, 0] ** 2 + p[i, 1] ** 2 + p[i, 2] ** 2) + 1e-12
        for a in range(3):
            p[i, a] *= 1.0 + offset / r
            S[i, a, a] += extent * extent * (16.0 if a == 2 else 1.0)


@njit(cache=True)
def allow_for_border(p: Array, S: Array, planes: Array, half_length: float) -> None:
    """Push detections near the border of the view outwards and widen them: what lies beyond it is missing.

    The middle of what is left lies up to the object's half length (m) less its own distance from the border inside of
    the object's: that much if the object is seen lengthwise, nothing if it is short. Both are a deviation away.
    """
    for k in range(len(planes)):
        for i in range(len(p)):
            inside = planes[k, 0] * p[i, 0] + planes[k, 1] * p[i, 1] + planes[k, 2] * p[i, 2]
            half = 0.5 * max(half_length - max(inside, 0.0), 0.0)
            for a in range(3):
                p[i, a] -= half * planes[k, a]
                for b in range(3):
                    S[i, a, b] += half * half * planes[k, a] * planes[k, b]
