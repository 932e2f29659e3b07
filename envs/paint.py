"""Strokes of the pictures: text, plates, smooth lines, dashes, panels."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from .colors import CANVAS, INK, Color

Image = NDArray[np.uint8]
Array = NDArray[np.float64]
GAP = 8
SHIFT = 4
"""Fractional bits of the coordinates handed to OpenCV, for smooth outlines."""


@lru_cache(maxsize=1)
def _font() -> Any:
    return cv2.FontFace("sans") if hasattr(cv2, "FontFace") else None


def text(
    picture: Image, words: str, at: tuple[float, float], size: int = 14, color: Color = INK, bold: bool = False
) -> int:
    """Write; `at` is the left end of the baseline. Returns the width in pixels."""
    where = (round(at[0]), round(at[1]))
    if _font() is None:  # OpenCV 4 has only its stroke font
        cv2.putText(picture, words, where, cv2.FONT_HERSHEY_SIMPLEX, size / 30, color, 1 + bold, cv2.LINE_AA)
    else:
        cv2.putText(picture, words, where, color, _font(), size, 650 if bold else 400)
    return text_width(words, size, bold)


def text_width(words: str, size: int = 14, bold: bool = False) -> int:
    """Pixels from the first letter's left to the last one's right."""
    if _font() is None:
        return int(cv2.getTextSize(words, cv2.FONT_HERSHEY_SIMPLEX, size / 30, 1 + bold)[0][0])
    return int(cv2.getTextSize((4000, 100), words, (0, 0), _font(), size, 650 if bold else 400)[2])


def plate(picture: Image, words: str, at: tuple[int, int], color: Color, size: int = 13, ink: Color = CANVAS) -> int:
    """Words on a rounded plate; `at` is its upper left corner. Returns the plate's width."""
    width, height = text_width(words, size, True) + 14, size + 9
    u, v = at
    rounded(picture, (u, v, u + width, v + height), color, 5)
    text(picture, words, (u + 7, v + height - 6), size, ink, True)
    return width


def rounded(picture: Image, box: tuple[int, int, int, int], color: Color, radius: int) -> None:
    """A filled rectangle [u0, v0, u1, v1) with round corners."""
    u0, v0, u1, v1 = box
    cv2.rectangle(picture, (u0 + radius, v0), (u1 - radius - 1, v1 - 1), color, -1)
    cv2.rectangle(picture, (u0, v0 + radius), (u1 - 1, v1 - radius - 1), color, -1)
    for u in (u0 + radius, u1 - radius - 1):
        for v in (v0 + radius, v1 - radius - 1):
            cv2.circle(picture, (u, v), radius, color, -1, cv2.LINE_AA)


def fixed(points: Array) -> NDArray[np.int32]:
    """Pixels with `SHIFT` fractional bits; (0, 0) is the outer corner of the first one."""
    return np.round((np.clip(points, -1e4, 1e4) - 0.5) * (1 << SHIFT)).astype(np.int32)


def polyline(picture: Image, points: Array, color: Color, width: int = 1, closed: bool = False) -> None:
    """A smooth line through points (n, 2)."""
    cv2.polylines(picture, [fixed(points)], closed, color, width, cv2.LINE_AA, SHIFT)


def polygon(picture: Image, points: Array, color: Color) -> None:
    """A filled polygon with corners (n, 2)."""
    cv2.fillPoly(picture, [fixed(points)], color, cv2.LINE_AA, SHIFT)


def disc(picture: Image, centre: Array, radius: float, color: Color, width: int = -1) -> None:
    """A circle; filled unless a line width is given."""
    u, v = (int(x) for x in fixed(np.asarray(centre, dtype=np.float64)))
    cv2.circle(picture, (u, v), round(radius * (1 << SHIFT)), color, width, cv2.LINE_AA, SHIFT)


def cross(picture: Image, at: Array, color: Color, half: float = 4.0) -> None:
    """A cross like an x."""
    for slope in (half, -half):
        polyline(picture, at + np.array([[-half, -slope], [half, slope]]), color, 2)


def dashes(picture: Image, start: Array, end: Array, color: Color, width: int = 2, dash: float = 8.0) -> None:
    """A dashed straight line."""
    steps = max(int(np.linalg.norm(end - start) // dash), 1)
    for k in range(0, steps, 2):
        ends = start + (end - start) * np.array([[k / steps], [min(k + 1, steps) / steps]])
        polyline(picture, ends, color, width)


def corners(picture: Image, box: Array, color: Color, width: int = 1, share: float = 0.28) -> None:
    """Only the corners of a box [u0, v0, u1, v1]: quieter than the whole."""
    u0, v0, u1, v1 = (float(x) for x in box)
    du, dv = share * (u1 - u0), share * (v1 - v0)
    for u, v, su, sv in ((u0, v0, 1, 1), (u1, v0, -1, 1), (u0, v1, 1, -1), (u1, v1, -1, -1)):
        polyline(picture, np.array([[u + su * du, v], [u, v], [u, v + sv * dv]]), color, width)


def blend(picture: Image, mask: NDArray[Any], color: Color, alpha: float = 1.0) -> None:
    """Mix a colour into the picture where `mask` (H, W), in [0, 1], says."""
    _blend(picture, mask.astype(np.float32), np.array(color, np.float32), np.float32(alpha))


@njit(cache=True)
def _blend(picture: Image, mask: NDArray[np.float32], color: NDArray[np.float32], alpha: np.float32) -> None:
    for v in range(picture.shape[0]):
        for u in range(picture.shape[1]):
            weight = alpha * mask[v, u]
            if weight > 0:
                for c in range(3):
                    value = np.float32(picture[v, u, c])
                    picture[v, u, c] = np.uint8(value + weight * (color[c] - value) + np.float32(0.5))


def blank(width: int, height: int, color: Color = CANVAS) -> Image:
    return np.full((height, width, 3), color, dtype=np.uint8)


def beside(parts: Sequence[Image], gap: int = GAP) -> Image:
    """Pictures of one height, side by side."""
    space = blank(gap, parts[0].shape[0])
    return np.concatenate([x for part in parts for x in (part, space)][:-1], axis=1)


def below(parts: Sequence[Image], gap: int = GAP) -> Image:
    """Pictures of one width, one below the other."""
    space = blank(parts[0].shape[1], gap)
    return np.concatenate([x for part in parts for x in (part, space)][:-1], axis=0)


def round_length(length: float) -> float:
    """The largest of 1, 2 or 5 times a power of ten that is at most `length`."""
    power = 10.0 ** np.floor(np.log10(length))
    return float(power * max(k for k in (1, 2, 5) if k * power <= length * (1 + 1e-9)))
