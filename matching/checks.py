"""Arrays and options as users give them, to those that the library uses; what is wrong is named with its value."""

from __future__ import annotations

from functools import lru_cache
from operator import index

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

LARGEST = 1e12
"""Largest size of a coordinate, confidence or feature. Above it sums of products lose what is to be told apart."""


def check_interval(name: str, value: float, interval: str) -> None:
    """Raises ValueError naming the value unless it is a number in the interval, written like "(0, 1]" or "[1, inf)"."""
    low, high, low_belongs, high_belongs = _bounds(interval)
    try:
        above = value >= low if low_belongs else value > low
        below = value <= high if high_belongs else value < high
        inside = bool(above and below)
    except (TypeError, ValueError):  # a string, an array
        inside = False
    if not inside:
        raise ValueError(f"{name} must lie in {interval}, got {value!r}")


@lru_cache
def _bounds(interval: str) -> tuple[float, float, bool, bool]:
    low, high = interval[1:-1].split(",")
    return float(low), float(high), interval[0] == "[", interval[-1] == "]"


def check_count(name: str, value: int, least: int = 1) -> None:
    """Raises ValueError naming the value unless it is a whole number of at least `least`."""
    try:
        enough = index(value) >= least
    except TypeError:
        enough = False
    if not enough:
        raise ValueError(f"{name} must be a whole number of at least {least}, got {value!r}")


def numbers(values: ArrayLike, name: str) -> Array:
    """As float64 array. Raises ValueError naming `name` unless `values` is a regular array of real numbers."""
    if np.ma.is_masked(values):
        raise ValueError(f"{name} must not be masked, got {np.ma.count_masked(values)} masked values")
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


def bounded(values: ArrayLike, name: str) -> Array:
    """`finite`, and no larger than `LARGEST`. Raises ValueError naming the value and where it stands."""
    array = finite(values, name)
    if np.abs(array).max(initial=0.0) > LARGEST:
        where = tuple(int(i) for i in np.argwhere(np.abs(array) > LARGEST)[0])
        raise ValueError(f"{name} must not exceed {LARGEST:g}, got {array[where]:g} at {where}")
    return array


def shaped(values: ArrayLike, name: str, shape: tuple[int, ...]) -> Array:
    """`finite`, of the given shape. Raises ValueError naming `name`."""
    array = numbers(values, name)
    if array.shape != shape:
        raise ValueError(f"{name} must have shape {shape}, got {array.shape}")
    return finite(array, name)


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
    array = shaped(values, name, (3,))
    length = float(np.linalg.norm(array))
    if abs(length - 1) > 1e-2:
        raise ValueError(f"{name} must be a unit vector, its length is {length:.3g}")
    return array / length
