"""From one robot's observation to detections."""

from __future__ import annotations

from typing import TYPE_CHECKING

from .detections import Detections, Perceptor
from .simulated import SimulatedPerception, SimulatedPerceptionParams

if TYPE_CHECKING:
    from ...envs.collaborative import CollaborativeEnv

__all__ = ["Detections", "Perceptor", "SimulatedPerception", "SimulatedPerceptionParams", "make_perceptor"]


def make_perceptor(name: str, env: CollaborativeEnv) -> Perceptor:
    """Eyes for an environment: `simulated`, or `learned` with the weights that come with the package.

    Raises:
        ValueError: no perception of that name; classes that the weights do not know.
        ImportError: `learned` without the packages of the extra `learned`.
        covis.agents.perception.weights.WeightsError: weights are missing or altered.
    """
    if name == "simulated":
        return SimulatedPerception(env.world.classes)
    if name == "learned":
        try:
            from .learned import LearnedPerception
        except ImportError as error:
            raise ImportError(
                f"learned perception needs torch and safetensors: install covis[learned] ({error})"
            ) from error
        return LearnedPerception(env.classes, image_size=(env.width, env.height))
    raise ValueError(f"no perception is called {name!r}; there are simulated, learned")
