"""From one robot's observation to detections."""

from __future__ import annotations

from typing import TYPE_CHECKING

from .detections import Detections, Perceptor
from .simulated import SimulatedPerception, SimulatedPerceptionParams

if TYPE_CHECKING:
    from ...envs.collaborative import CollaborativeEnv

__all__ = ["Detections", "Perceptor", "SimulatedPerception", "SimulatedPerceptionParams", "make_perceptor"]


def make_perceptor(name: str, env: CollaborativeEnv) -> Perceptor:
    """Eyes for an environment: `simulated`.

    Raises:
        ValueError: no perception of that name.
    """
    if name == "simulated":
        return SimulatedPerception(env.world.classes)
    raise ValueError(f"no perception is called {name!r}; there is simulated")
