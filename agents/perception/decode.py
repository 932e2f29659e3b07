"""From what the network says to masks: peaks, each object's own mask head, and which of two claims to one thing stays.

Compiled kernels over plain arrays; the network itself is in `network.py`.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array32 = NDArray[np.float32]


@njit(cache=True)
def find_peaks(heat: Array32, threshold: float) -> tuple[NDArray[np.int64], Array32]:
    """Cells (k, 2) (row, column) of local maxima over 3x3 of heat (h, w) above `threshold`, and their values (k,)."""
    h, w = heat.shape
    at = np.empty((h * w, 2), np.int64)
    value = np.empty(h * w, np.float32)
    k = 0
    for y in range(h):
        for x in range(w):
            here = heat[y, x]
            if here <= threshold:
                continue
            highest = True
            for v in range(max(0, y - 1), min(h, y + 2)):
                for u in range(max(0, x - 1), min(w, x + 2)):
                    other = heat[v, u]
                    # Of equal neighbours the first in reading order is the peak.
                    if other > here or (other == here and (v < y or (v == y and u < x))):
                        highest = False
            if highest:
                at[k, 0], at[k, 1], value[k] = y, x, here
                k += 1
    return at[:k].copy(), value[:k].copy()


@njit(cache=True, fastmath=True)
def draw_masks(
    features: Array32,
    weights: Array32,
    hidden: int,
    pixels: Array32,
    half_size: Array32,
    boxes: NDArray[np.int64],
    stride: int,
) -> Array32:
    """Mask logits (k, h, w) at the resolution of `features` (h, w, m), computed inside boxes alone; -20 elsewhere.

    Args:
        weights: (k, p) each object's own head, laid out as `network.mask_logits` reads it.
        pixels, half_size: (k, 2) visible centre and half the box's size, px.
        boxes: (k, 4) columns and rows [x0, y0, x1, y1) of `features`.
    """
    h, w, m = features.shape
    n = m + 2
    k = len(weights)
    out = np.full((k, h, w), np.float32(-20.0), np.float32)
    x = np.empty(n, np.float32)
    first = np.empty(hidden, np.float32)
    second = np.empty(hidden, np.float32)
    for i in range(k):
        p = weights[i]
        w1, b1 = p[: n * hidden], p[n * hidden : (n + 1) * hidden]
        rest = p[(n + 1) * hidden :]
        w2, b2 = rest[: hidden * hidden], rest[hidden * hidden : hidden * (hidden + 1)]
        w3, b3 = rest[hidden * (hidden + 1) : hidden * (hidden + 2)], rest[hidden * (hidden + 2)]
        for row in range(boxes[i, 1], boxes[i, 3]):
            for column in range(boxes[i, 0], boxes[i, 2]):
                x[:m] = features[row, column]
                du = ((column + 0.5) * stride - pixels[i, 0]) / half_size[i, 0]
                dv = ((row + 0.5) * stride - pixels[i, 1]) / half_size[i, 1]
                x[m] = min(max(du, np.float32(-4)), np.float32(4))
                x[m + 1] = min(max(dv, np.float32(-4)), np.float32(4))
                first[:] = b1
                for a in range(n):
                    for b in range(hidden):
                        first[b] += x[a] * w1[a * hidden + b]
                second[:] = b2
                for a in range(hidden):
                    value = max(first[a], np.float32(0))
                    for b in range(hidden):
                        second[b] += value * w2[a * hidden + b]
                total = b3
                for a in range(hidden):
                    total += max(second[a], np.float32(0)) * w3[a]
                out[i, row, column] = total
    return out


@njit(cache=True)
def mask_quality(logits: Array32, boxes: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Cells (k,) inside each mask, and the mean probability (k,) over them: how decided the mask is."""
    k = len(logits)
    cells = np.zeros(k, np.int64)
    quality = np.zeros(k)
    for i in range(k):
        for row in range(boxes[i, 1], boxes[i, 3]):
            for column in range(boxes[i, 0], boxes[i, 2]):
                value = logits[i, row, column]
                if value > 0:
                    cells[i] += 1
                    quality[i] += 1.0 / (1.0 + np.exp(-value))
        if cells[i] > 0:
            quality[i] /= cells[i]
    return cells, quality


@njit(cache=True)
def suppress(
    logits: Array32,
    boxes: NDArray[np.int64],
    cells: NDArray[np.int64],
    scores: NDArray[np.float64],
    max_iou: float,
    max_inside: float,
) -> NDArray[np.int64]:
    """Indices of the masks to keep, best score first: a mask goes when a better one overlaps it too much.

    Too much is IoU above `max_iou`, or a share of its own cells above `max_inside` inside the better one.
    """
    order = np.argsort(-scores)
    kept = np.empty(len(order), np.int64)
    n = 0
    for i in order:
        good = cells[i] > 0
        for j in kept[:n]:
            if not good:
                break
            shared = 0
            for row in range(max(boxes[i, 1], boxes[j, 1]), min(boxes[i, 3], boxes[j, 3])):
                for column in range(max(boxes[i, 0], boxes[j, 0]), min(boxes[i, 2], boxes[j, 2])):
                    if logits[i, row, column] > 0 and logits[j, row, column] > 0:
                        shared += 1
            union = cells[i] + cells[j] - shared
            if shared > max_iou * union or shared > max_inside * cells[i]:
                good = False
        if good:
            kept[n] = i
            n += 1
    return kept[:n].copy()


@njit(cache=True)
def full_masks(
    logits: Array32, boxes: NDArray[np.int64], height: int, width: int
) -> tuple[NDArray[np.bool_], NDArray[np.int64], NDArray[np.float64]]:
    """Masks (k, H, W) at twice the resolution by bilinear interpolation of the logits (k, H/2, W/2).

    A pixel that several masks claim goes to the one with the highest logit. Also visible pixels (k,) and tight boxes
    (k, 4), zeros where a mask is empty.
    """
    k, h, w = logits.shape
    owner = np.full((height, width), -1, np.int64)
    best = np.zeros((height, width), np.float32)
    for i in range(k):
        for v in range(max(0, 2 * boxes[i, 1]), min(height, 2 * boxes[i, 3])):
            y = (v + 0.5) / 2 - 0.5
            y0 = min(max(int(np.floor(y)), 0), h - 2)
            fy = min(max(y - y0, 0.0), 1.0)
            for u in range(max(0, 2 * boxes[i, 0]), min(width, 2 * boxes[i, 2])):
                x = (u + 0.5) / 2 - 0.5
                x0 = min(max(int(np.floor(x)), 0), w - 2)
                fx = min(max(x - x0, 0.0), 1.0)
                a, b = max(logits[i, y0, x0], -6.0), max(logits[i, y0, x0 + 1], -6.0)
                c, d = max(logits[i, y0 + 1, x0], -6.0), max(logits[i, y0 + 1, x0 + 1], -6.0)
                value = (a * (1 - fx) + b * fx) * (1 - fy) + (c * (1 - fx) + d * fx) * fy
                if value > best[v, u]:
                    best[v, u] = value
                    owner[v, u] = i
    masks = np.zeros((k, height, width), np.bool_)
    pixels = np.zeros(k, np.int64)
    tight = np.zeros((k, 4))
    for v in range(height):
        for u in range(width):
            i = owner[v, u]
            if i < 0:
                continue
            masks[i, v, u] = True
            if pixels[i] == 0:
                tight[i, 0], tight[i, 1], tight[i, 2] = u, v, u + 1
            pixels[i] += 1
            tight[i, 0] = min(tight[i, 0], u)
            tight[i, 2] = max(tight[i, 2], u + 1)
            tight[i, 3] = v + 1
    return masks, pixels, tight


@njit(cache=True)
def tight_boxes(masks: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Tight boxes (k, 4) px of masks (k, H, W), zeros where a mask is empty."""
    k, height, width = masks.shape
    out = np.zeros((k, 4))
    for i in range(k):
        empty = True
        for v in range(height):
            for u in range(width):
                if not masks[i, v, u]:
                    continue
                if empty:
                    out[i, 0], out[i, 1], out[i, 2] = u, v, u + 1
                    empty = False
                out[i, 0] = min(out[i, 0], u)
                out[i, 2] = max(out[i, 2], u + 1)
                out[i, 3] = v + 1
    return out


@njit(cache=True)
def spread_pixels(
    masks: NDArray[np.bool_], pixels: NDArray[np.int64], tight: NDArray[np.float64], number: int
) -> Array32:
    """Centres (k, number, 2) px of pixels spread evenly over each mask in reading order; all masks are non-empty."""
    k = len(masks)
    out = np.zeros((k, number, 2), np.float32)
    for i in range(k):
        seen, filled = 0, 0
        for v in range(int(tight[i, 1]), int(tight[i, 3])):
            for u in range(int(tight[i, 0]), int(tight[i, 2])):
                if not masks[i, v, u]:
                    continue
                while filled < number and seen >= (filled + 0.5) * pixels[i] / number - 1:
                    out[i, filled, 0], out[i, filled, 1] = u + 0.5, v + 0.5
                    filled += 1
                seen += 1
    return out
