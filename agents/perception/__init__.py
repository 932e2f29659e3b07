"""From one robot's observation to detections."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from .detections import Detections, Perceptor
from .simulated import SimulatedPerception, SimulatedPerceptionParams

if TYPE_CHECKING:
    from ...envs.collaborative import CollaborativeEnv

__all__ = ["Detections", "Perceptor", "SimulatedPerception", "SimulatedPerceptionParams", "make_perceptor"]


def make_perceptor(name: str, env: CollaborativeEnv) -> Perceptor:
    """Eyes for an environment.

    Args:
        name: `simulated`, `learned` with the weights that come with the package, or `learned:FOLDER` with those that
            `covis train perception --out FOLDER` has left, whichever network they are of.

    Raises:
        ValueError: no perception of that name; classes that the weights do not know.
        ImportError: `learned` without the packages of the extra `learned`.
        covis.agents.perception.weights.WeightsError: weights missing, altered, or of a network that is not installed.
    """
    kind, _, folder = name.partition(":")
    if name == "simulated":
        return SimulatedPerception(env.world.classes)
    if name == "learned" or (kind == "learned" and folder):
        try:
            from . import weights
            from .kinds import open_eyes
        except ImportError as error:
            raise ImportError(
                f"learned perception needs torch and safetensors: install covis[learned] ({error})"
            ) from error
        stored = weights.load(Path(folder) if folder else None)
        return open_eyes(stored, env.classes, image_size=(env.width, env.height))
    raise ValueError(f"no perception is called {name!r}; there are simulated, learned, learned:FOLDER")
