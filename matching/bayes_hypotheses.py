"""Relative poses from two correspondences, gravity known (yaw, x, y; the height offset comes from the two heights).

All positions are levelled (z up). A pose maps target to source: x_source = Rz(yaw) x_target + t.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from .bayes_view import View, detection_probability
from .pose import Array

Indices = NDArray[np.int64]

LOG_2PI = float(np.log(2 * np.pi))


@njit(cache=True)
def pair_distances(p: Array, S: Array) -> tuple[Array, Array]:
    """Horizontal distances (n, n) m and their variances (n, n) m^2."""
    n = len(p)
    distance = np.zeros((n, n))
    variance = np.ones((n, n))
    for i in range(n):
        for j in range(i + 1, n):
            dx, dy = p[j, 0] - p[i, 0], p[j, 1] - p[i, 1]
            d2 = dx * dx + dy * dy
            d = np.sqrt(d2)
            sxx, syy, sxy = S[i, 0, 0] + S[j, 0, 0], S[i, 1, 1] + S[j, 1, 1], S[i, 0, 1] + S[j, 0, 1]
            v = (dx * dx * sxx + 2 * dx * dy * sxy + dy * dy * syy) / d2 if d2 > 1e-12 else sxx + syy
            distance[i, j] = distance[j, i] = d
            variance[i, j] = variance[j, i] = v
    return distance, variance


@njit(cache=True)
def precise_pairs(distance: Array, variance: Array, limit: int) -> Indices:
    """Up to `limit` pairs (k, 2) of objects, i < j, whose distance is known best for its length."""
    n = len(distance)
    pairs = np.empty((n * (n - 1) // 2, 2), dtype=np.int64)
    cost = np.empty(len(pairs))
    k = 0
    for i in range(n):
        for j in range(i + 1, n):
            pairs[k, 0], pairs[k, 1] = i, j
            cost[k] = variance[i, j] / (distance[i, j] ** 2 + 1e-12)
            k += 1
    if k <= limit:
        return pairs
    # A share of the precise pairs, evenly, so that no few objects stand for all.
    order = np.argsort(cost)[: max(limit, k // 4)]
    return pairs[order[np.arange(limit) * len(order) // limit]]


@njit(cache=True)
def candidate_pairs(
    p_a: Array,
    S_a: Array,
    p_b: Array,
    S_b: Array,
    likely: Array,
    least: float,
    max_chi2: float,
    limit: int,
    wanted: int,
) -> Indices:
    """Two correspondences (i1, i2, j1, j2) of compatible distance, height and class: the best `wanted`, (k, 4).

    Ranked by class evidence `likely` (n, m) and by the density of their distance's error. Of large views only the
    `limit` most precise pairs of source objects are tried.
    """
    d_a, v_a = pair_distances(p_a, S_a)
    d_b, v_b = pair_distances(p_b, S_b)
    m = len(p_b)
    capacity = 16 * wanted
    out = np.empty((capacity, 4), dtype=np.int64)
    rank = np.empty(capacity)
    k = 0
    worst = -1e300
    for i1, i2 in precise_pairs(d_a, v_a, limit):
        d1, v1 = d_a[i1, i2], v_a[i1, i2]
        if d1 < 1e-6:
            continue
        h = p_a[i2, 2] - p_a[i1, 2]
        hv = S_a[i1, 2, 2] + S_a[i2, 2, 2]
        for j1 in range(m):
            if likely[i1, j1] < least:
                continue
            for j2 in range(m):
                e = d1 - d_b[j1, j2]
                v = v1 + v_b[j1, j2]
                if e * e > max_chi2 * v or j1 == j2 or d_b[j1, j2] < 1e-6:
                    continue
                evidence = likely[i1, j1] + likely[i2, j2]
                if likely[i2, j2] < least or evidence < least:
                    continue
                z = h - (p_b[j2, 2] - p_b[j1, 2])
                if z * z > max_chi2 * (hv + S_b[j1, 2, 2] + S_b[j2, 2, 2]):
                    continue
                score = evidence - 0.5 * e * e / v - 0.5 * np.log(v)
                if score < worst:
                    continue
                if k == capacity:
                    k = keep_best(out, rank, wanted)
                    worst = rank[:k].min()
                out[k, 0], out[k, 1], out[k, 2], out[k, 3] = i1, i2, j1, j2
                rank[k] = score
                k += 1
    if k > wanted:
        k = keep_best(out[:k], rank[:k], wanted)
    return out[:k]


@njit(cache=True)
def keep_best(items: Indices, rank: Array, wanted: int) -> int:
    """Move the `wanted` items of highest rank to the front; returns how many stayed."""
    threshold = np.partition(rank, len(rank) - wanted)[len(rank) - wanted]
    k = 0
    for c in range(len(rank)):
        if rank[c] >= threshold and k < wanted:
            items[k] = items[c]
            rank[k] = rank[c]
            k += 1
    return k


@njit(cache=True)
def pose_of_pair(
    p_a: Array, S_a: Array, p_b: Array, S_b: Array, i1: int, i2: int, j1: int, j2: int, out: Array
) -> None:
    """Pose (yaw, x, y) of two correspondences and its covariance, into out (9,): yaw, x, y, then cov (3 + 3).

    Closed form, then one Gauss-Newton step with the full horizontal covariances.
    """
    ax, ay = p_a[i2, 0] - p_a[i1, 0], p_a[i2, 1] - p_a[i1, 1]
    bx, by = p_b[j2, 0] - p_b[j1, 0], p_b[j2, 1] - p_b[j1, 1]
    # Rotation by the angle between the two difference vectors, without trigonometry.
    scale = 1.0 / np.sqrt((ax * ax + ay * ay) * (bx * bx + by * by))
    c = (ax * bx + ay * by) * scale
    s = (ay * bx - ax * by) * scale
    tx = 0.5 * (p_a[i1, 0] + p_a[i2, 0] - c * (p_b[j1, 0] + p_b[j2, 0]) + s * (p_b[j1, 1] + p_b[j2, 1]))
    ty = 0.5 * (p_a[i1, 1] + p_a[i2, 1] - s * (p_b[j1, 0] + p_b[j2, 0]) - c * (p_b[j1, 1] + p_b[j2, 1]))
    h00 = h01 = h02 = h11 = h12 = h22 = g0 = g1 = g2 = 0.0
    for k in range(2):
        i, j = (i1, j1) if k == 0 else (i2, j2)
        ux, uy = c * p_b[j, 0] - s * p_b[j, 1], s * p_b[j, 0] + c * p_b[j, 1]
        rx, ry = p_a[i, 0] - ux - tx, p_a[i, 1] - uy - ty
        bxx, byy, bxy = S_b[j, 0, 0], S_b[j, 1, 1], S_b[j, 0, 1]
        sxx = S_a[i, 0, 0] + c * c * bxx - 2 * c * s * bxy + s * s * byy
        syy = S_a[i, 1, 1] + s * s * bxx + 2 * c * s * bxy + c * c * byy
        sxy = S_a[i, 0, 1] + c * s * (bxx - byy) + (c * c - s * s) * bxy
        w = 1.0 / (sxx * syy - sxy * sxy)
        wxx, wyy, wxy = syy * w, sxx * w, -sxy * w
        # d(mapped)/d(yaw) = (-uy, ux)
        kx, ky = -uy, ux
        wkx, wky = wxx * kx + wxy * ky, wxy * kx + wyy * ky
        h00 += kx * wkx + ky * wky
        h01 += wkx
        h02 += wky
        h11 += wxx
        h12 += wxy
        h22 += wyy
        g0 += wkx * rx + wky * ry
        g1 += wxx * rx + wxy * ry
        g2 += wxy * rx + wyy * ry
    c00, c01, c02 = h11 * h22 - h12 * h12, h02 * h12 - h01 * h22, h01 * h12 - h02 * h11
    c11, c12, c22 = h00 * h22 - h02 * h02, h01 * h02 - h00 * h12, h00 * h11 - h01 * h01
    det = h00 * c00 + h01 * c01 + h02 * c02
    inv = 1.0 / max(det, 1e-300)
    dyaw = (c00 * g0 + c01 * g1 + c02 * g2) * inv
    out[0] = np.arctan2(s, c) + dyaw
    out[1] = tx + (c01 * g0 + c11 * g1 + c12 * g2) * inv
    out[2] = ty + (c02 * g0 + c12 * g1 + c22 * g2) * inv
    out[3], out[4], out[5] = c00 * inv, c01 * inv, c02 * inv
    out[6], out[7], out[8] = c11 * inv, c12 * inv, c22 * inv


@njit(cache=True)
def screen(
    p_a: Array,
    S_a: Array,
    p_b: Array,
    S_b: Array,
    static: Array,
    height: float,
    height_variance: float,
    prior_mean: Array,
    prior_covariance: Array,
    log_odds: float,
    view_a: View,
    view_b: View,
    pairs: Indices,
    poses: Array,
    scores: Array,
) -> None:
    """Score every pair of correspondences: sum over objects of the best positive log weight. Fills poses and scores.

    Each residual has the covariance of both detections and of the hypothesised pose. A prior of the pose (yaw, x, y),
    mean (3,) and covariance (3, 3), takes its log density off; shape (0, 0) means none.
    """
    seen = view_a.known > 0 and view_b.known > 0
    known = len(prior_covariance) > 0
    C = np.empty((3, 3))
    d = np.empty(3)
    n, m = len(p_a), len(p_b)
    radius = np.empty(n)
    for i in range(n):
        radius[i] = S_a[i, 0, 0] + S_a[i, 1, 1]
    best_a = np.empty(n)
    hyp = np.empty(9)
    for k in range(len(pairs)):
        i1, i2, j1, j2 = pairs[k]
        pose_of_pair(p_a, S_a, p_b, S_b, i1, i2, j1, j2, hyp)
        yaw, tx, ty = hyp[0], hyp[1], hyp[2]
        c, s = np.cos(yaw), np.sin(yaw)
        best_a[:] = 0.0
        total_b = void = 0.0
        for j in range(m):
            ux, uy = c * p_b[j, 0] - s * p_b[j, 1], s * p_b[j, 0] + c * p_b[j, 1]
            kx, ky = -uy, ux
            bxx, byy, bxy = S_b[j, 0, 0], S_b[j, 1, 1], S_b[j, 0, 1]
            pxx = c * c * bxx - 2 * c * s * bxy + s * s * byy + hyp[6] + 2 * kx * hyp[4] + kx * kx * hyp[3]
            pyy = s * s * bxx + 2 * c * s * bxy + c * c * byy + hyp[8] + 2 * ky * hyp[5] + ky * ky * hyp[3]
            pxy = c * s * (bxx - byy) + (c * c - s * s) * bxy + hyp[7] + kx * hyp[5] + ky * hyp[4] + kx * ky * hyp[3]
            ux += tx
            uy += ty
            reach = pxx + pyy
            best = 0.0
            for i in range(n):
                rx, ry = p_a[i, 0] - ux, p_a[i, 1] - uy
                if rx * rx + ry * ry > 9.0 * (radius[i] + reach):
                    continue
                sxx, syy, sxy = S_a[i, 0, 0] + pxx, S_a[i, 1, 1] + pyy, S_a[i, 0, 1] + pxy
                det = sxx * syy - sxy * sxy
                if not det > 0:
                    continue
                chi2 = (syy * rx * rx - 2 * sxy * rx * ry + sxx * ry * ry) / det
                if chi2 > 12.0:
                    continue
                vz = S_a[i, 2, 2] + S_b[j, 2, 2] + height_variance
                z = p_a[i, 2] - p_b[j, 2] - height
                w = log_odds + static[i, j] - 0.5 * (chi2 + z * z / vz + np.log(det * vz)) - 1.5 * LOG_2PI
                if w > best:
                    best = w
                if w > best_a[i]:
                    best_a[i] = w
            total_b += best
            if seen and best == 0.0:
                void += np.log(1.0 - detection_probability(ux, uy, p_b[j, 2] + height, view_a, p_a))
        total_a = 0.0
        for i in range(n):
            total_a += best_a[i]
            if seen and best_a[i] == 0.0:
                x, y = p_a[i, 0] - tx, p_a[i, 1] - ty
                void += np.log(
                    1.0 - detection_probability(c * x + s * y, c * y - s * x, p_a[i, 2] - height, view_b, p_b)
                )
        poses[k, 0], poses[k, 1], poses[k, 2] = yaw, tx, ty
        scores[k] = min(total_a, total_b) + 0.7 * void
        if known:
            C[:] = prior_covariance
            C[0, 0] += hyp[3]
            C[0, 1] += hyp[4]
            C[0, 2] += hyp[5]
            C[1, 1] += hyp[6]
            C[1, 2] += hyp[7]
            C[2, 2] += hyp[8]
            C[1, 0], C[2, 0], C[2, 1] = C[0, 1], C[0, 2], C[1, 2]
            d[0] = (yaw - prior_mean[0] + np.pi) % (2 * np.pi) - np.pi
            d[1], d[2] = tx - prior_mean[1], ty - prior_mean[2]
            scores[k] += 12.0 - 0.5 * d @ np.linalg.solve(C, d)


@njit(cache=True)
def distinct_best(poses: Array, scores: Array, yaw_gap: float, shift_gap: float, count: int) -> Indices:
    """Indices of the `count` best poses, none near a better one: yaw (rad) and the shift (m) at the views' centre."""
    order = np.argsort(-scores)
    keep = np.empty(count, dtype=np.int64)
    n = 0
    for k in order:
        if scores[k] <= 0 or n == count:
            break
        fresh = True
        for f in range(n):
            g = keep[f]
            dyaw = abs(poses[k, 0] - poses[g, 0])
            dyaw = min(dyaw, 2 * np.pi - dyaw) if dyaw < 2 * np.pi else dyaw - 2 * np.pi
            if abs(dyaw) > yaw_gap:
                continue
            dx, dy = poses[k, 1] - poses[g, 1], poses[k, 2] - poses[g, 2]
            if dx * dx + dy * dy < shift_gap * shift_gap:
                fresh = False
                break
        if fresh:
            keep[n] = k
            n += 1
    return keep[:n]


@njit(cache=True)
def spatial_distances(p: Array, S: Array) -> tuple[Array, Array]:
    """Distances (n, n) m and their variances (n, n) m^2 in space."""
    n = len(p)
    distance = np.zeros((n, n))
    variance = np.ones((n, n))
    u = np.empty(3)
    for i in range(n):
        for j in range(i + 1, n):
            d2 = 0.0
            for a in range(3):
                u[a] = p[j, a] - p[i, a]
                d2 += u[a] * u[a]
            v = 0.0
            for a in range(3):
                for b in range(3):
                    v += u[a] * (S[i, a, b] + S[j, a, b]) * u[b]
            distance[i, j] = distance[j, i] = np.sqrt(d2)
            variance[i, j] = variance[j, i] = v / d2 if d2 > 1e-12 else S[i, 0, 0] + S[j, 0, 0]
    return distance, variance


@njit(cache=True)
def triad(p: Array, i: int, j: int, k: int, F: Array) -> bool:
    """Right-handed axes of a triangle as columns of F (3, 3): along i-j, in its plane, normal. False if collinear."""
    u, w = p[j] - p[i], p[k] - p[i]
    x = np.array([u[1] * w[2] - u[2] * w[1], u[2] * w[0] - u[0] * w[2], u[0] * w[1] - u[1] * w[0]])
    lu, lx = np.sqrt((u * u).sum()), np.sqrt((x * x).sum())
    if lu < 1e-9 or lx < 1e-6 * lu * np.sqrt((w * w).sum()) or lx == 0.0:
        return False
    for a in range(3):
        F[a, 0] = u[a] / lu
        F[a, 2] = x[a] / lx
    F[0, 1] = F[1, 2] * F[2, 0] - F[2, 2] * F[1, 0]
    F[1, 1] = F[2, 2] * F[0, 0] - F[0, 2] * F[2, 0]
    F[2, 1] = F[0, 2] * F[1, 0] - F[1, 2] * F[0, 0]
    return True


@njit(cache=True)
def candidate_triangles(
    p_a: Array,
    S_a: Array,
    p_b: Array,
    S_b: Array,
    static: Array,
    min_static: float,
    max_chi2: float,
    max_pairs: int,
    capacity: int,
) -> tuple[Array, Array, Array, Indices]:
    """Poses in SE(3) of three correspondences: rotations (k, 3, 3), translations (k, 3), ranks (k,), triangles (k, 6).

    The best pairs of correspondences by distance and class are each extended by every third that keeps its distances.
    """
    d_a, v_a = spatial_distances(p_a, S_a)
    d_b, v_b = spatial_distances(p_b, S_b)
    n, m = len(p_a), len(p_b)
    pairs = np.empty((200000, 4), dtype=np.int64)
    rank = np.empty(200000)
    count = 0
    for i1 in range(n):
        for i2 in range(i1 + 1, n):
            for j1 in range(m):
                for j2 in range(m):
                    if j1 == j2 or count == 200000 or static[i1, j1] < min_static or static[i2, j2] < min_static:
                        continue
                    e, v = d_a[i1, i2] - d_b[j1, j2], v_a[i1, i2] + v_b[j1, j2]
                    if e * e <= max_chi2 * v and d_a[i1, i2] > 1e-6 and d_b[j1, j2] > 1e-6:
                        pairs[count, 0], pairs[count, 1], pairs[count, 2], pairs[count, 3] = i1, i2, j1, j2
                        rank[count] = static[i1, j1] + static[i2, j2] - 0.5 * e * e / v - 0.5 * np.log(v)
                        count += 1
    order = np.argsort(-rank[:count])[:max_pairs]
    R, t = np.empty((capacity, 3, 3)), np.empty((capacity, 3))
    score, triangles = np.empty(capacity), np.empty((capacity, 6), dtype=np.int64)
    F_a, F_b = np.empty((3, 3)), np.empty((3, 3))
    k = 0
    for c in order:
        i1, i2, j1, j2 = pairs[c]
        for i3 in range(n):
            if i3 in (i1, i2) or not triad(p_a, i1, i2, i3, F_a):
                continue
            for j3 in range(m):
                if j3 in (j1, j2) or static[i3, j3] < min_static or k == capacity:
                    continue
                e, v = d_a[i1, i3] - d_b[j1, j3], v_a[i1, i3] + v_b[j1, j3]
                f, w = d_a[i2, i3] - d_b[j2, j3], v_a[i2, i3] + v_b[j2, j3]
                chi2 = e * e / v + f * f / w
                if chi2 > max_chi2 + 3.0 or not triad(p_b, j1, j2, j3, F_b):
                    continue
                R[k] = F_a @ F_b.T
                t[k] = (p_a[i1] + p_a[i2] + p_a[i3] - R[k] @ (p_b[j1] + p_b[j2] + p_b[j3])) / 3.0
                score[k] = rank[c] + static[i3, j3] - 0.5 * chi2 - 0.5 * np.log(v * w)
                triangles[k, 0], triangles[k, 1], triangles[k, 2] = i1, i2, i3
                triangles[k, 3], triangles[k, 4], triangles[k, 5] = j1, j2, j3
                k += 1
    return R[:k], t[:k], score[:k], triangles[:k]


@njit(cache=True)
def distinct_best_spatial(R: Array, t: Array, scores: Array, angle: float, shift: float, count: int) -> Indices:
    """Indices of the `count` best poses in SE(3), none within angle (rad) and shift (m) of a better one."""
    order = np.argsort(-scores)
    keep = np.empty(count, dtype=np.int64)
    n = 0
    trace = 1.0 + 2.0 * np.cos(angle)
    for k in order:
        if scores[k] <= 0 or n == count:
            break
        fresh = True
        for f in range(n):
            g = keep[f]
            if (R[k] * R[g]).sum() > trace and ((t[k] - t[g]) ** 2).sum() < shift * shift:
                fresh = False
                break
        if fresh:
            keep[n] = k
            n += 1
    return keep[:n]
