"""One mode of the posterior over relative poses: soft assignment in turn with Gauss-Newton, and its Laplace evidence.

State: rotation R and translation t of target to source, and biases b. An object's bias vectors (nb, 3) say how each
bias moves it. Perturbations are ordered [rotation about source axes (1: z only, or 3), translation, biases]; the prior
is Gaussian in them, given as a precision about a mean state (zero rows: flat).
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from .bayes_assignment import assignment_marginals
from .bayes_prepare import Settings
from .bayes_view import View, detection_probability
from .pose import Array

LOG_2PI = float(np.log(2 * np.pi))


@njit(cache=True)
def cholesky(A: Array, d: int) -> bool:
    """Lower Cholesky factor in place; False if A is not positive definite."""
    for i in range(d):
        for j in range(i + 1):
            v = A[i, j]
            for k in range(j):
                v -= A[i, k] * A[j, k]
            if i == j:
                if not v > 1e-300:
                    return False
                A[i, i] = np.sqrt(v)
            else:
                A[i, j] = v / A[j, j]
    return True


@njit(cache=True)
def cholesky_solve(L: Array, g: Array, d: int) -> None:
    """Solve L L^T x = g in place of g."""
    for i in range(d):
        v = g[i]
        for k in range(i):
            v -= L[i, k] * g[k]
        g[i] = v / L[i, i]
    for i in range(d - 1, -1, -1):
        v = g[i]
        for k in range(i + 1, d):
            v -= L[k, i] * g[k]
        g[i] = v / L[i, i]


@njit(cache=True)
def rotate_by(R: Array, w0: float, w1: float, w2: float) -> None:
    """R <- exp(w) R, in place."""
    angle = np.sqrt(w0 * w0 + w1 * w1 + w2 * w2)
    if angle < 1e-12:
        return
    x, y, z = w0 / angle, w1 / angle, w2 / angle
    c, s = np.cos(angle), np.sin(angle)
    E = np.empty((3, 3))
    E[0, 0], E[0, 1], E[0, 2] = c + x * x * (1 - c), x * y * (1 - c) - z * s, x * z * (1 - c) + y * s
    E[1, 0], E[1, 1], E[1, 2] = y * x * (1 - c) + z * s, c + y * y * (1 - c), y * z * (1 - c) - x * s
    E[2, 0], E[2, 1], E[2, 2] = z * x * (1 - c) - y * s, z * y * (1 - c) + x * s, c + z * z * (1 - c)
    out = np.empty((3, 3))
    for a in range(3):
        for b in range(3):
            out[a, b] = E[a, 0] * R[0, b] + E[a, 1] * R[1, b] + E[a, 2] * R[2, b]
    R[:] = out


@njit(cache=True)
def rotation_difference(R: Array, R0: Array, out: Array) -> None:
    """Rotation vector w with R = exp(w) R0, into out (3,)."""
    D = np.empty((3, 3))
    for a in range(3):
        for b in range(3):
            D[a, b] = R[a, 0] * R0[b, 0] + R[a, 1] * R0[b, 1] + R[a, 2] * R0[b, 2]
    x, y, z = D[2, 1] - D[1, 2], D[0, 2] - D[2, 0], D[1, 0] - D[0, 1]
    s = 0.5 * np.sqrt(x * x + y * y + z * z)
    c = 0.5 * (D[0, 0] + D[1, 1] + D[2, 2] - 1.0)
    angle = np.arctan2(s, c)
    k = 0.5 if s < 1e-9 else 0.5 * angle / s
    out[0], out[1], out[2] = k * x, k * y, k * z


@njit(cache=True)
def residual_edges(
    p_a: Array,
    S_a: Array,
    B_a: Array,
    p_b: Array,
    S_b: Array,
    B_b: Array,
    static: Array,
    R: Array,
    t: Array,
    bias: Array,
    temper: float,
    bonus_a: Array,
    bonus_b: Array,
    shared_a: Array,
    shared_b: Array,
    min_log_weight: float,
    rows: Array,
    cols: Array,
    log_weights: Array,
    residuals: Array,
    weights: Array,
    mapped: Array,
) -> int:
    """Possible matches under a pose, row by row; returns how many.

    Parts of log weights: bonus_a (n,) and bonus_b (m,) of every match, shared_a and shared_b of those in which neither
    object is the robot itself, which is the last of either side.

    Fills rows, cols, log_weights, residuals (k, 3) = source - mapped target, weights (k, 6) the inverse covariance
    (xx, yy, zz, xy, xz, yz) and mapped (m, 3), the rotated (not shifted) target positions.
    """
    n, m, nb = len(p_a), len(p_b), len(bias)
    S = np.empty((m, 6))
    M = np.empty((3, 3))
    v = np.empty(3)
    for j in range(m):
        for a in range(3):
            v[a] = p_b[j, a]
            for k in range(nb):
                v[a] += bias[k] * B_b[j, k, a]
        for a in range(3):
            mapped[j, a] = R[a, 0] * v[0] + R[a, 1] * v[1] + R[a, 2] * v[2]
            for b in range(3):
                M[a, b] = R[a, 0] * S_b[j, 0, b] + R[a, 1] * S_b[j, 1, b] + R[a, 2] * S_b[j, 2, b]
        S[j, 0] = M[0, 0] * R[0, 0] + M[0, 1] * R[0, 1] + M[0, 2] * R[0, 2]
        S[j, 1] = M[1, 0] * R[1, 0] + M[1, 1] * R[1, 1] + M[1, 2] * R[1, 2]
        S[j, 2] = M[2, 0] * R[2, 0] + M[2, 1] * R[2, 1] + M[2, 2] * R[2, 2]
        S[j, 3] = M[0, 0] * R[1, 0] + M[0, 1] * R[1, 1] + M[0, 2] * R[1, 2]
        S[j, 4] = M[0, 0] * R[2, 0] + M[0, 1] * R[2, 1] + M[0, 2] * R[2, 2]
        S[j, 5] = M[1, 0] * R[2, 0] + M[1, 1] * R[2, 1] + M[1, 2] * R[2, 2]
    e = 0
    max_chi2 = 40.0
    for i in range(n):
        xi, yi, zi = p_a[i, 0], p_a[i, 1], p_a[i, 2]
        for k in range(nb):
            xi += bias[k] * B_a[i, k, 0]
            yi += bias[k] * B_a[i, k, 1]
            zi += bias[k] * B_a[i, k, 2]
        trace = S_a[i, 0, 0] + S_a[i, 1, 1] + S_a[i, 2, 2]
        for j in range(m):
            x, y, z = xi - mapped[j, 0] - t[0], yi - mapped[j, 1] - t[1], zi - mapped[j, 2] - t[2]
            if x * x + y * y + z * z > max_chi2 * temper * (trace + S[j, 0] + S[j, 1] + S[j, 2]):
                continue
            sxx, syy, szz = (
                temper * (S_a[i, 0, 0] + S[j, 0]),
                temper * (S_a[i, 1, 1] + S[j, 1]),
                temper * (S_a[i, 2, 2] + S[j, 2]),
            )
            sxy, sxz, syz = (
                temper * (S_a[i, 0, 1] + S[j, 3]),
                temper * (S_a[i, 0, 2] + S[j, 4]),
                temper * (S_a[i, 1, 2] + S[j, 5]),
            )
            cxx, cxy, cxz = syy * szz - syz * syz, sxz * syz - sxy * szz, sxy * syz - sxz * syy
            det = sxx * cxx + sxy * cxy + sxz * cxz
            if not det > 0:
                continue
            inv = 1.0 / det
            wxx, wxy, wxz = cxx * inv, cxy * inv, cxz * inv
            wyy, wyz, wzz = (sxx * szz - sxz * sxz) * inv, (sxy * sxz - sxx * syz) * inv, (sxx * syy - sxy * sxy) * inv
            chi2 = wxx * x * x + wyy * y * y + wzz * z * z + 2 * (wxy * x * y + wxz * x * z + wyz * y * z)
            if chi2 > max_chi2:
                continue
            w = bonus_a[i] + bonus_b[j] + static[i, j] - 0.5 * (chi2 + np.log(det)) - 1.5 * LOG_2PI
            if i < n - 1 and j < m - 1:
                w += shared_a[i] + shared_b[j]
            if w < min_log_weight:
                continue
            rows[e], cols[e], log_weights[e] = i, j, w
            residuals[e, 0], residuals[e, 1], residuals[e, 2] = x, y, z
            weights[e, 0], weights[e, 1], weights[e, 2] = wxx, wyy, wzz
            weights[e, 3], weights[e, 4], weights[e, 5] = wxy, wxz, wyz
            e += 1
    return e


@njit(cache=True)
def normal_equations(
    rows: Array,
    cols: Array,
    residuals: Array,
    weights: Array,
    probability: Array,
    n_edges: int,
    B_a: Array,
    B_b: Array,
    mapped: Array,
    R: Array,
    nr: int,
    H: Array,
    g: Array,
) -> None:
    """Adds the expected information H (d, d) and gradient g (d,) of the edges, d = nr + 3 + biases."""
    nb = B_a.shape[1]
    d = nr + 3 + nb
    J = np.zeros((d, 3))
    WJ = np.empty((d, 3))
    J[nr, 0] = J[nr + 1, 1] = J[nr + 2, 2] = 1.0
    for e in range(n_edges):
        p = probability[e]
        if p < 1e-4:
            continue
        i, j = rows[e], cols[e]
        x, y, z = mapped[j, 0], mapped[j, 1], mapped[j, 2]
        # d(mapped)/d(rotation about axis k) = e_k x mapped.
        if nr == 1:
            J[0, 0], J[0, 1], J[0, 2] = -y, x, 0.0
        else:
            J[0, 0], J[0, 1], J[0, 2] = 0.0, -z, y
            J[1, 0], J[1, 1], J[1, 2] = z, 0.0, -x
            J[2, 0], J[2, 1], J[2, 2] = -y, x, 0.0
        for k in range(nb):
            for a in range(3):
                J[nr + 3 + k, a] = (
                    R[a, 0] * B_b[j, k, 0] + R[a, 1] * B_b[j, k, 1] + R[a, 2] * B_b[j, k, 2] - B_a[i, k, a]
                )
        wxx, wyy, wzz = p * weights[e, 0], p * weights[e, 1], p * weights[e, 2]
        wxy, wxz, wyz = p * weights[e, 3], p * weights[e, 4], p * weights[e, 5]
        for a in range(d):
            WJ[a, 0] = wxx * J[a, 0] + wxy * J[a, 1] + wxz * J[a, 2]
            WJ[a, 1] = wxy * J[a, 0] + wyy * J[a, 1] + wyz * J[a, 2]
            WJ[a, 2] = wxz * J[a, 0] + wyz * J[a, 1] + wzz * J[a, 2]
            g[a] += WJ[a, 0] * residuals[e, 0] + WJ[a, 1] * residuals[e, 1] + WJ[a, 2] * residuals[e, 2]
            for b in range(a + 1):
                H[a, b] += WJ[a, 0] * J[b, 0] + WJ[a, 1] * J[b, 1] + WJ[a, 2] * J[b, 2]


@njit(cache=True)
def overlap_log_prior(k: float, n: int, m: int, q: Settings) -> float:
    """Log prior of one set of k matches among n and m objects, densities of objects set aside.

    k of min(n, m) is beta-binomial; all sets of k matches are equally likely; every match has a bonus.
    """
    small = min(n, m)
    a, b = q.overlap_alpha, q.overlap_beta
    k = min(k, float(small))
    out = math.lgamma(small + 1.0) - math.lgamma(k + 1.0) - math.lgamma(small - k + 1.0)
    out += math.lgamma(k + a) + math.lgamma(small - k + b) - math.lgamma(small + a + b)
    out -= math.lgamma(a) + math.lgamma(b) - math.lgamma(a + b)
    out += math.lgamma(n - k + 1.0) + math.lgamma(m - k + 1.0) + math.lgamma(k + 1.0)
    out -= math.lgamma(n + 1.0) + math.lgamma(m + 1.0)
    return out + k * (0.5 * np.log(n * m) + q.match_bonus)


@njit(cache=True)
def overlap_log_odds(k: float, n: int, m: int, q: Settings) -> float:
    """Slope of `overlap_log_prior` in k: what the prior gives to one more match."""
    step = 0.5
    low = max(0.0, k - step)
    high = min(float(min(n, m)), k + step)
    if not high > low:
        return q.initial_log_odds
    slope = (overlap_log_prior(high, n, m, q) - overlap_log_prior(low, n, m, q)) / (high - low)
    return min(max(slope, -1.0), 4.0)


@njit(cache=True)
def seen_by_other(
    p: Array,
    R: Array,
    t: Array,
    view: View,
    detections: Array,
    log_bonus: float,
    bonus: Array,
    shared: Array,
) -> float:
    """What the other robot's field of view says of objects p (n, 3), which R and t bring into its frame.

    An object that it detects with probability d counts 1 - d when it stays alone; a match has sqrt(d e) instead, where
    e is the partner's. The Poisson void term is the expected number of common objects, half of it from either side. The
    last object is the robot itself, which is known to be there: a match with it depends on whether it is detected, and
    takes nothing of the other object but "stays alone". Fills parts of log weights, `bonus` and `shared` (n,), for
    `residual_edges`; returns what stays when no match is made.
    """
    n = len(p)
    total = 0.0
    for i in range(n):
        x, y, z = p[i, 0], p[i, 1], p[i, 2]
        d = detection_probability(
            R[0, 0] * x + R[0, 1] * y + R[0, 2] * z + t[0],
            R[1, 0] * x + R[1, 1] * y + R[1, 2] * z + t[1],
            R[2, 0] * x + R[2, 1] * y + R[2, 2] * z + t[2],
            view,
            detections,
        )
        if i == n - 1:
            bonus[i] = np.log(d) - np.log(1.0 - d)
            total += np.log(1.0 - d)
        else:
            bonus[i] = -np.log(1.0 - d)
            shared[i] = 0.5 * (np.log(d) + log_bonus)
            total += np.log(1.0 - d) + 0.5 * d
    return total


@njit(cache=True)
def refine(
    p_a: Array,
    S_a: Array,
    B_a: Array,
    p_b: Array,
    S_b: Array,
    B_b: Array,
    static: Array,
    prior_R: Array,
    prior_t: Array,
    prior_precision: Array,
    prior_log_norm: float,
    R: Array,
    t: Array,
    bias: Array,
    nr: int,
    tempers: Array,
    max_iterations: int,
    q: Settings,
    view_a: View,
    view_b: View,
    marginals: Array,
    information: Array,
) -> float:
    """Climb to the mode nearest to (R, t, bias), in place; returns its log evidence against "nothing in common".

    Fills marginals (n, m), the probability of every match under this mode, and information (d, d).
    """
    n, m, nb = len(p_a), len(p_b), len(bias)
    d = nr + 3 + nb
    capacity = n * m
    rows, cols = np.empty(capacity, np.int64), np.empty(capacity, np.int64)
    log_weights, probability = np.empty(capacity), np.empty(capacity)
    residuals, weights, mapped = np.empty((capacity, 3)), np.empty((capacity, 6)), np.empty((m, 3))
    H, g, factor = np.empty((d, d)), np.empty(d), np.empty((d, d))
    offset, w = np.empty(d), np.empty(3)
    evidence = -1e300
    log_odds = q.initial_log_odds
    # The last object of either side is the robot itself.
    n0, m0 = n - 1, m - 1
    seen = view_a.known > 0 and view_b.known > 0
    bonus_a, bonus_b, shared_a, shared_b = np.zeros(n), np.zeros(m), np.zeros(n), np.zeros(m)
    for iteration in range(max_iterations + 1):
        void = 0.0
        shared_a[:] = log_odds
        if seen:
            R_inverse = np.ascontiguousarray(R.T)
            void = seen_by_other(p_a, R_inverse, -(R_inverse @ t), view_b, p_b, q.view_bonus, bonus_a, shared_a)
            void += seen_by_other(p_b, R, t, view_a, p_a, q.view_bonus, bonus_b, shared_b)
        temper = tempers[min(iteration, len(tempers) - 1)]
        n_edges = residual_edges(
            p_a,
            S_a,
            B_a,
            p_b,
            S_b,
            B_b,
            static,
            R,
            t,
            bias,
            temper,
            bonus_a,
            bonus_b,
            shared_a,
            shared_b,
            -6.0,
            rows,
            cols,
            log_weights,
            residuals,
            weights,
            mapped,
        )
        log_z = assignment_marginals(rows, cols, log_weights, n_edges, n, m, 30, probability)
        rotation_difference(R, prior_R, w)
        if nr == 1:
            offset[0] = w[2]
        else:
            offset[0], offset[1], offset[2] = w[0], w[1], w[2]
        for a in range(3):
            offset[nr + a] = t[a] - prior_t[a]
        for k in range(nb):
            offset[nr + 3 + k] = bias[k]
        penalty = 0.0
        for a in range(d):
            g[a] = 0.0
            for b in range(d):
                H[a, b] = prior_precision[a, b]
                g[a] -= prior_precision[a, b] * offset[b]
            penalty -= 0.5 * g[a] * offset[a]
        normal_equations(rows, cols, residuals, weights, probability, n_edges, B_a, B_b, mapped, R, nr, H, g)
        trace = 0.0
        for a in range(d):
            trace = max(trace, H[a, a])
        for a in range(d):
            for b in range(a + 1, d):
                H[a, b] = H[b, a]
        factor[:] = H
        for a in range(d):
            factor[a, a] += 1e-9 * trace + 1e-12
        if not cholesky(factor, d):
            return -1e300
        decrement = 0.0
        offset[:] = g
        cholesky_solve(factor, offset, d)
        for a in range(d):
            decrement += g[a] * offset[a]
        common = 0.0
        for e in range(n_edges):
            if rows[e] < n0 and cols[e] < m0:
                common += probability[e]
        final = iteration == max_iterations or (iteration >= len(tempers) - 1 and decrement < 1e-3)
        if final:
            half_logdet = 0.0
            for a in range(d):
                half_logdet += np.log(factor[a, a])
            evidence = log_z - penalty + prior_log_norm + 0.5 * d * LOG_2PI - half_logdet
            if seen:
                evidence += void
            else:
                evidence += overlap_log_prior(common, n0, m0, q) - log_odds * common
            break
        if iteration >= 1:
            log_odds = overlap_log_odds(common, n0, m0, q)
        # A turn beyond half a radian is outside what Gauss-Newton sees.
        size = 0.0
        for a in range(nr):
            size = max(size, abs(offset[a]))
        shorten = min(1.0, 0.5 / size) if size > 0 else 1.0
        if nr == 1:
            rotate_by(R, 0.0, 0.0, shorten * offset[0])
        else:
            rotate_by(R, shorten * offset[0], shorten * offset[1], shorten * offset[2])
        for a in range(3):
            t[a] += shorten * offset[nr + a]
        for k in range(nb):
            bias[k] += shorten * offset[nr + 3 + k]
    marginals[:] = 0.0
    for e in range(n_edges):
        marginals[rows[e], cols[e]] = probability[e]
    information[:] = H
    return evidence


@njit(cache=True)
def screen_spatial(
    p_a: Array,
    S_a: Array,
    p_b: Array,
    S_b: Array,
    static: Array,
    R: Array,
    t: Array,
    temper: float,
    log_odds: float,
    scores: Array,
) -> None:
    """Score poses in SE(3), like `screen`: the smaller of the two robots' sums of best positive log weights."""
    n, m = static.shape
    bonus_a, bonus_b, shared_a, shared_b = np.zeros(n), np.zeros(m), np.full(n, log_odds), np.zeros(m)
    none_a, none_b, no_bias = np.zeros((n, 0, 3)), np.zeros((m, 0, 3)), np.zeros(0)
    rows, cols, logs = np.empty(n * m, np.int64), np.empty(n * m, np.int64), np.empty(n * m)
    residuals, weights, mapped = np.empty((n * m, 3)), np.empty((n * m, 6)), np.empty((m, 3))
    for k in range(len(R)):
        count = residual_edges(
            p_a,
            S_a,
            none_a,
            p_b,
            S_b,
            none_b,
            static,
            R[k],
            t[k],
            no_bias,
            temper,
            bonus_a,
            bonus_b,
            shared_a,
            shared_b,
            0.0,
            rows,
            cols,
            logs,
            residuals,
            weights,
            mapped,
        )
        best_a, best_b = np.zeros(n), np.zeros(m)
        for e in range(count):
            best_a[rows[e]] = max(best_a[rows[e]], logs[e])
            best_b[cols[e]] = max(best_b[cols[e]], logs[e])
        scores[k] = min(best_a.sum(), best_b.sum())
