"""Controllers that move the robots, so that episodes are interesting without training."""

from __future__ import annotations

import numpy as np

from ...envs.worlds.world import Array, World


def scripted_controls(world: World) -> Array:
    """Controls (N, d) in [-1, 1] of the scene's own drivers at the present instant; claims never influence them."""
    drivers = getattr(world, "idm_controls", None)
    if drivers is not None:
        return np.asarray(drivers())
    return sweep(world)


def sweep(world: World) -> Array:
    """Creep forward and turn from side to side, each robot in its own rhythm."""
    time = world.snapshot().time
    controls = np.zeros((world.n_robots, world.control_size))
    controls[:, 0] = 0.2
    controls[:, 1] = 0.3 * np.sin(0.8 * time + np.arange(world.n_robots))
    return controls
