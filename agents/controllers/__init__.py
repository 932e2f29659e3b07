"""Controllers that move the robots, so that episodes are interesting without training."""

from __future__ import annotations

import numpy as np

from ...envs.worlds.world import Array, World
from .robots import lively_controls


def scripted_controls(world: World) -> Array:
    """Controls (N, d) in [-1, 1] at the present instant, of the scene's own drivers where it has some.

    They act on the true state, never on a claim, so that an episode does not depend on the methods scored on it.
    """
    drivers = getattr(world, "idm_controls", None)
    if drivers is not None:
        return np.asarray(drivers())
    return np.asarray(lively_controls(world))
