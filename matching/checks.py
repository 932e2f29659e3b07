"""Arrays as users give them, to arrays as the library uses them; what is wrong is named with its value."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from .pose import Array


def numbers(values: ArrayLike, name: str) -> Array:
    """As float64 array. Raises ValueError naming `name` unless `values` is a regular array of real numbers."""
    try:
        array = np.asarray(values)
    except ValueError as error:  # rows of different lengths
        raise ValueError(f"{name} must be a regular array of numbers: {error}") from error
    if array.dtype.kind not in "buif":
        raise ValueError(f"{name} must be real numbers, got {array.dtype} {values!r:.80}")
    return array.astype(np.float64, copy=False)


def finite(values: ArrayLike, name: str) -> Array:
    """`numbers` without NaN and infinities. Raises ValueError naming the value and where it stands."""
    array = numbers(values, name)
    if not np.isfinite(array).all():
        where = tuple(int(i) for i in np.argwhere(~np.isfinite(array))[0])
        raise ValueError(f"{name} must be finite, got {array[where]} at {where}")
    return array


def for_each(values: ArrayLike, name: str, n: int) -> Array:
    """(n,) `values`, or one value for every object."""
    array = numbers(values, name)
    if array.shape not in ((), (n,)):
        raise ValueError(f"{name} must be one number or have shape ({n},), got {array.shape}")
    return np.broadcast_to(array, (n,)).copy()


def check_covariances(covariances: Array, n: int) -> None:
    """Raises ValueError unless (n, 3, 3), symmetric and positive semidefinite."""
    if covariances.shape != (n, 3, 3):
        raise ValueError(f"covariances must have shape ({n}, 3, 3), got {covariances.shape}")
    if n == 0:
        return
    difference = np.abs(covariances - covariances.transpose(0, 2, 1))
    skew = (difference > 1e-9 + 1e-5 * np.abs(covariances)).any(axis=(1, 2))
    if skew.any():
        bad = int(np.argmax(skew))
        raise ValueError(f"covariances must be symmetric, got {covariances[bad].tolist()} at {bad}")
    lowest = np.linalg.eigvalsh(covariances)[:, 0]
    if lowest.min() < -1e-6 * max(1e-9, float(np.abs(covariances).max())):
        bad = int(np.argmin(lowest))
        raise ValueError(f"covariances must be positive semidefinite, got an eigenvalue {lowest[bad]:.3g} at {bad}")


def pixels(image_size: ArrayLike) -> tuple[int, int]:
    """Width and height. Raises ValueError unless they are whole and positive."""
    array = finite(image_size, "image_size")
    if array.shape != (2,) or (array < 1).any() or (array != np.round(array)).any():
        raise ValueError(f"image_size must be (width, height) >= 1 in whole pixels, got {image_size!r}")
    return int(array[0]), int(array[1])


def variances(values: ArrayLike, name: str, n: int) -> Array:
    """(n,) non-negative, possibly infinite. Raises ValueError naming the value and where it stands."""
    array = numbers(values, name)
    if array.shape != (n,):
        raise ValueError(f"{name} must have shape ({n},), got {array.shape}")
    if n and not (array >= 0).all():
        bad = int(np.argmin(array >= 0))
        raise ValueError(f"{name} must be non-negative, got {array[bad]} at {bad}")
    return array


def unit_vector(values: ArrayLike, name: str) -> Array:
    """(3,) scaled to length 1. Raises ValueError where the length is off by more than a hundredth."""
    array = finite(values, name)
    if array.shape != (3,):
        raise ValueError(f"{name} must have shape (3,), got {array.shape}")
    length = float(np.linalg.norm(array))
    if abs(length - 1) > 1e-2:
        raise ValueError(f"{name} must be a unit vector, its length is {length:.3g}")
    return array / length
