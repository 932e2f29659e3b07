"""Learned eyes on one thread: images per second, and the whole loop from pixels to fused positions."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..agents.localizer import Localizer
from ..agents.perception import make_perceptor
from ..envs.scenes import parallel_env
from .progress import Progress, silent
from .timing import rates, row


def rows(progress: Progress = silent) -> list[dict[str, Any]]:
    """`images`: 320x240, the shipped number of samples; `loop`: two robots, look, match by bayes, fuse.

    Raises:
        FileNotFoundError: no weights are installed.
    """
    import torch

    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    env = parallel_env("multi_robot", preset="paper")
    try:
        perceive = make_perceptor("learned", env)
        observations, _ = env.reset(seed=0)
        views = list(observations.values())
        localizer = Localizer(perceive, "bayes", pose="known", max_detections=env.max_detections)
        rng = np.random.default_rng(0)
        progress(0, 2)
        images, _ = rates(lambda: perceive(views[0], rng))
        progress(1, 2)
        loop, _ = rates(lambda: localizer.localize(views, rng))
        progress(2, 2)
    finally:
        torch.set_num_threads(threads)
        env.close()
    n = len(perceive(views[0], rng))
    return [row("perception", "images", n, images, None, None), row("perception", "loop", n, loop, None, None)]
