"""Pictures of one frame of a scene: the paper's Fig. 6, one per method."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ..envs.render import compose, draw_correspondences
from .methods import Method
from .run_scene import make_env, play
from .settings import Settings


@dataclass(frozen=True)
class Picture:
    """A file, and what it shows."""

    file: Path
    caption: str


def correspondence_pictures(
    scene: str, methods: Sequence[Method], settings: Settings, folder: Path, episode: int = 0
) -> list[Picture]:
    """Save the scene and every method's matches, of the episode's frame with the most objects that both detected."""
    env = make_env(scene, settings, render_mode="rgb_array")
    best = -1
    images: dict[str, NDArray[np.uint8]] = {}
    try:
        for frame in play(env, episode, methods, settings):
            common = max(s.counts.common for s in frame.scores.values())
            if common <= best:
                continue
            best = common
            views = [camera.rgb for camera in env.camera_frames()]
            images = {"": compose(env)}
            for method in methods:
                label = method.label
                images[label] = draw_correspondences(views, frame.claims[label], frame.scores[label], label)
    finally:
        env.close()
    folder.mkdir(parents=True, exist_ok=True)
    return [_save(image, folder, scene, label) for label, image in images.items()]


def _save(image: NDArray[np.uint8], folder: Path, scene: str, label: str) -> Picture:
    name = "".join(c if c.isalnum() else "-" for c in label or "overview")
    file = folder / f"{scene}-{name}.png"
    cv2.imwrite(str(file), cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
    return Picture(file, f"{scene}: {label}" if label else f"{scene}: what the robots see, and the scene from above")
