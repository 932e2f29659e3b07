"""Uncertainty of candidate matches and the weights it gives their similarities (section 3.3, Eq. 5-11)."""

from __future__ import annotations

import numpy as np

from .checks import check_interval
from .pose import Array


def attribute_statistics(samples: Array, aleatoric: Array | float = 0.0) -> tuple[Array, Array]:
    """Attributes a (n, c) and their uncertainty v (n,) from T Monte Carlo samples (T, n, c). Eq. (5)-(6).

    The attribute is the mean of the samples. Its uncertainty is the variance over the samples (epistemic) plus the
    `aleatoric` variance (n, c) that the network itself reports, both averaged over the c elements.
    """
    samples = np.asarray(samples, dtype=np.float64)
    if samples.ndim != 3 or len(samples) < 1:
        raise ValueError(f"samples must have shape (T, n, c) with T >= 1, got {samples.shape}")
    variance = samples.var(axis=0) + aleatoric
    return samples.mean(axis=0), variance.mean(axis=1)


def kronecker_plus(source: Array, target: Array) -> Array:
    """(n, n'): source_i + target_i', the matrices V and U from v (n,) and u (n,). Eq. (7), (9)."""
    return source[:, None] + target[None]


def certainty(uncertainty: Array, width: float) -> Array:
    """exp(-uncertainty / width), elementwise. Eq. (8).

    The weights of Eq. (10) and (11) are products of this: W^d_{ii',jj'} = w_ii' w_jj' and W^t_{ii',jj',kk'} =
    w_ii' w_jj' w_kk' with w = certainty(U, width), as the exponential of a sum; they are never stored.
    """
    check_interval("width", width, "(0, inf]")
    return np.exp(-uncertainty / width)


def typical(variance: Array) -> float:
    """Median of the positive finite entries of `variance`, 0 if there are none."""
    known = variance[np.isfinite(variance) & (variance > 0)]
    return float(np.median(known)) if len(known) else 0.0
