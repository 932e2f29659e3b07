"""From instance images to what the network learns: heat maps and points in and around objects."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ...matching.pose import Array


@dataclass(frozen=True, eq=False)
class ObjectTable:
    """What is visible of m objects in one image.

    Attributes:
        pixels: (m,) int64, number of visible pixels.
        boxes: (m, 4) tight box [u0, v0, u1, v1]; zeros where nothing is visible.
        centres: (m, 2) px, the visible pixel nearest to the mean of all visible pixels.
        order: (k,) int64, flat indices of all objects' pixels, object by object.
        start: (m + 1,) int64, first of each object in `order`.
    """

    pixels: NDArray[np.int64]
    boxes: Array
    centres: Array
    order: NDArray[np.int64]
    start: NDArray[np.int64]

    def mirrored(self, width: int) -> ObjectTable:
        seen = self.pixels > 0
        boxes, centres = self.boxes.copy(), self.centres.copy()
        boxes[seen, 0], boxes[seen, 2] = width - self.boxes[seen, 2], width - self.boxes[seen, 0]
        centres[seen, 0] = width - self.centres[seen, 0]
        v, u = self.order // width, self.order % width
        return replace(self, boxes=boxes, centres=centres, order=v * width + (width - 1 - u))


def object_table(instances: NDArray[np.int32], n_objects: int) -> ObjectTable:
    """The table of an instance image (H, W) with objects 0..n_objects - 1; negative is none."""
    return ObjectTable(*_object_table(instances, n_objects))


@njit(cache=True)
def _object_table(
    instances: NDArray[np.int32], m: int
) -> tuple[NDArray[np.int64], Array, Array, NDArray[np.int64], NDArray[np.int64]]:
    height, width = instances.shape
    pixels = np.zeros(m, np.int64)
    boxes = np.zeros((m, 4))
    mean = np.zeros((m, 2))
    for v in range(height):
        for u in range(width):
            i = instances[v, u]
            if i < 0:
                continue
            if pixels[i] == 0:
                boxes[i, 0], boxes[i, 1], boxes[i, 2] = u, v, u + 1
            pixels[i] += 1
            boxes[i, 0] = min(boxes[i, 0], u)
            boxes[i, 2] = max(boxes[i, 2], u + 1)
            boxes[i, 3] = v + 1
            mean[i, 0] += u + 0.5
            mean[i, 1] += v + 0.5
    start = np.zeros(m + 1, np.int64)
    for i in range(m):
        start[i + 1] = start[i] + pixels[i]
        if pixels[i] > 0:
            mean[i] /= pixels[i]
    order = np.empty(start[m], np.int64)
    filled = np.zeros(m, np.int64)
    centres = np.zeros((m, 2))
    nearest = np.full(m, np.inf)
    for v in range(height):
        for u in range(width):
            i = instances[v, u]
            if i < 0:
                continue
            order[start[i] + filled[i]] = v * width + u
            filled[i] += 1
            away = (u + 0.5 - mean[i, 0]) ** 2 + (v + 0.5 - mean[i, 1]) ** 2
            if away < nearest[i]:
                nearest[i] = away
                centres[i, 0], centres[i, 1] = u + 0.5, v + 0.5
    return pixels, boxes, centres, order, start


@njit(cache=True)
def draw_heat(
    heat: NDArray[np.float32],
    weight: NDArray[np.float32],
    centres: Array,
    boxes: Array,
    pixels: NDArray[np.int64],
    min_pixels: int,
    stride: int,
) -> None:
    """Draw Gaussians at visible centres into heat (h, w), in place; objects below `min_pixels` get weight 0 instead."""
    h, w = heat.shape
    for i in range(len(pixels)):
        if pixels[i] == 0:
            continue
        size = np.sqrt((boxes[i, 2] - boxes[i, 0]) * (boxes[i, 3] - boxes[i, 1])) / stride
        sigma = min(max(0.07 * size, 0.7), 3.0)
        column, row = int(centres[i, 0] // stride), int(centres[i, 1] // stride)
        reach = int(np.ceil(3 * sigma))
        if pixels[i] < min_pixels:
            reach = max(2, int(0.5 * size))
        for y in range(max(0, row - reach), min(h, row + reach + 1)):
            for x in range(max(0, column - reach), min(w, column + reach + 1)):
                if pixels[i] < min_pixels:
                    weight[y, x] = 0.0
                    continue
                value = np.exp(-((x - column) ** 2 + (y - row) ** 2) / (2 * sigma * sigma))
                if value > heat[y, x]:
                    heat[y, x] = value
    for i in range(len(pixels)):
        if pixels[i] >= min_pixels:
            weight[int(centres[i, 1] // stride), int(centres[i, 0] // stride)] = 1.0


def pixels_inside(table: ObjectTable, obj: int, number: int, width: int, rng: np.random.Generator) -> Array:
    """Centres (number, 2) px of random visible pixels of one object, with repetition."""
    at = table.order[table.start[obj] + rng.integers(0, table.pixels[obj], number)]
    return np.stack([at % width + 0.5, at // width + 0.5], axis=1)


def points_around(
    table: ObjectTable, obj: int, number: int, width: int, height: int, rng: np.random.Generator
) -> Array:
    """Points (number, 2) px to judge a mask by: half anywhere about the box, half near the object's own pixels."""
    u0, v0, u1, v1 = table.boxes[obj]
    size = np.array([u1 - u0, v1 - v0])
    half = number // 2
    low = np.array([u0, v0]) - 0.15 * size - 3
    anywhere = low + rng.random((half, 2)) * (1.3 * size + 6)
    spread = np.maximum(1.5, 0.1 * size)
    near = pixels_inside(table, obj, number - half, width, rng) + spread * rng.standard_normal((number - half, 2))
    return np.clip(np.concatenate([anywhere, near]), 0.01, [width - 0.01, height - 0.01])
