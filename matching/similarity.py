"""Attribute, distance and angular similarity of two graphs (section 3.2)."""

from __future__ import annotations

import numpy as np

from .pose import Array


def attribute_similarity(a: Array, b: Array) -> Array:
    """A (n, n'): cosine of attribute vectors a (n, c) and b (n', c); a zero vector is similar to nothing. Eq. (1)."""
    norm_a = np.linalg.norm(a, axis=1)
    norm_b = np.linalg.norm(b, axis=1)
    scale = norm_a[:, None] * norm_b[None]
    return np.divide(a @ b.T, scale, out=np.zeros((len(a), len(b))), where=scale > 0)
