"""Pictures in the manner of the paper's Fig. 4 and 5: what the eyes saw, and how unsure they are of it, per object."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from ..matching.pose import Array
from .perception_images import PerceptionTarget, default_targets, make_env, test_images

if TYPE_CHECKING:
    from ..agents.perception.detections import Detections
    from ..agents.perception.weights import Weights

Picture = NDArray[np.uint8]
TITLES = (
    "masks",
    "depth of the centre, m",
    "v: attribute uncertainty",
    "u: position uncertainty, m (1 sigma)",
)
GREY = 0.35
SMALLEST_SHOWN = 0.001
IMAGES = 12
"""Of each target, from which the figure takes one."""
BAND = 22
"""Height of the titles, px."""


def figure(image: Picture, found: Detections, name: str = "image") -> Picture:
    """Five panels side by side (H + BAND, 5 W, 3): image, masks, depth, v and the square root of u.

    Args:
        image: (H, W, 3) RGB.
        found: detections in it, with masks.
        name: title of the first panel.

    Raises:
        ValueError: detections without masks.
    """
    if found.masks is None:
        raise ValueError("a figure needs detections with masks")
    graph = found.graph
    faded = (GREY * image.mean(axis=2, keepdims=True)).repeat(3, axis=2)
    values = (graph.positions[:, 2], graph.attribute_variance, np.sqrt(graph.position_variance))
    panels = [image.copy(), _outlined(image, found.masks)]
    panels += [_painted(faded, found, value) for value in values]
    return np.concatenate([_titled(p, title) for p, title in zip(panels, (name, *TITLES), strict=True)], axis=1)


def require_drawable(file: Path) -> None:
    """Raises ValueError for a kind of picture that cannot be written."""
    if not (file.suffix and cv2.haveImageWriter(file.name)):
        raise ValueError(f"a figure is written as .png or .jpg, not as {file.name!r}")


def save_figure(file: Path, weights: Weights, seed: int = 0) -> None:
    """Write one row of panels per target of `covis benchmark perception`, in the format that the name asks for.

    Raises:
        ValueError: see `require_drawable`.
        OSError: the file cannot be written.
    """
    require_drawable(file)
    rows = [_liveliest(target, weights, seed) for target in default_targets()]
    file.parent.mkdir(parents=True, exist_ok=True)
    _, code = cv2.imencode(file.suffix, cv2.cvtColor(np.concatenate(rows), cv2.COLOR_RGB2BGR))
    file.write_bytes(code.tobytes())


def _liveliest(target: PerceptionTarget, weights: Weights, seed: int) -> Picture:
    """The figure of the image, of the first few of a target's test images, in which the eyes find the most objects."""
    from ..agents.perception.frames import TEST_KEY
    from ..agents.perception.kinds import open_eyes

    env = make_env(target)
    eyes = open_eyes(weights, env.classes)
    best, picture = -1, np.zeros((0, 0, 3), np.uint8)
    try:
        for number, image in enumerate(test_images(env, IMAGES, (TEST_KEY, seed))):
            found = eyes(image.observation, np.random.default_rng((seed, number)))
            if len(found) > best:
                best, picture = len(found), figure(image.observation["image"], found, target.name)
    finally:
        env.close()
    return picture


def _outlined(image: Picture, masks: NDArray[np.bool_]) -> Picture:
    out = image.copy()
    for i, mask in enumerate(masks):
        hue = np.array([[[int(i * 67) % 180, 220, 255]]], np.uint8)
        color = cv2.cvtColor(hue, cv2.COLOR_HSV2RGB)[0, 0].astype(np.float64)
        out[mask] = (0.5 * out[mask] + 0.5 * color).astype(np.uint8)
        edge = mask & ~cv2.erode(mask.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)
        out[edge] = color.astype(np.uint8)
    return out


def _painted(background: Array, found: Detections, values: Array) -> Picture:
    """Each mask in the colour of its value, from the least (dark) to the greatest (bright), with its number.

    Where numbers would cover each other, those of the larger masks stay.
    """
    assert found.masks is not None
    out = background.astype(np.uint8)
    span = np.ptp(values) if len(values) else 0.0
    for mask, value in zip(found.masks, values, strict=True):
        share = (value - values.min()) / span if span > 0 else 0.5
        level = np.array([[round(255 * float(share))]], np.uint8)
        out[mask] = cv2.cvtColor(cv2.applyColorMap(level, cv2.COLORMAP_VIRIDIS), cv2.COLOR_BGR2RGB)[0, 0]
    written = np.zeros(out.shape[:2], bool)
    for i in np.argsort(-found.masks.sum(axis=(1, 2)), kind="stable"):
        text = f"{values[i]:.2g}" if values[i] >= SMALLEST_SHOWN else "0"
        _write(out, written, text, int(found.boxes[i, 0]), int(max(found.boxes[i, 1] - 2, 9)))
    return out


def _write(out: Picture, written: NDArray[np.bool_], text: str, left: int, bottom: int) -> None:
    """White text, unless something is `written` there already."""
    (width, height), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, 0.33, 1)
    left = max(0, min(left, out.shape[1] - width))
    place = np.s_[max(bottom - height, 0) : bottom + 2, left : left + width + 2]
    if written[place].any():
        return
    written[place] = True
    cv2.putText(out, text, (left, bottom), cv2.FONT_HERSHEY_SIMPLEX, 0.33, (255, 255, 255), 1, cv2.LINE_AA)


def _titled(panel: Picture, title: str) -> Picture:
    band = np.full((BAND, panel.shape[1], 3), 255, np.uint8)
    cv2.putText(band, title, (4, 15), cv2.FONT_HERSHEY_SIMPLEX, 0.42, (0, 0, 0), 1, cv2.LINE_AA)
    return np.concatenate([band, panel])
