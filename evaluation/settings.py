"""What a benchmark run is asked to do."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

PoseKnowledge = Literal["unknown", "known"]

SCENE_NAMES = ("connected_driving", "multi_robot", "aerial_ground", "target_localization")
"""As in `covis.envs.scenes.SCENES`, which needs the simulators; a test compares the two."""

MIN_DETECTIONS = 3
"""Both views of a pair need at least this many detections to count as a pair."""


def scene_preset(target: str, settings: Settings) -> str | None:
    """Difficulty of a target in this run: `paper` for scenes unless another is asked for; datasets have none."""
    return settings.preset or ("paper" if target in SCENE_NAMES else None)


@dataclass(frozen=True)
class Settings:
    """Options of a run, the same for every target and method.

    Attributes:
        pose: `known` hands the noisy relative pose to the matcher as prior.
        preset: difficulty of scenes; None = `paper`.
        min_common: pairs with fewer common objects are left out.
        sequence: carry a tracker's state through each episode and pass it as prior.
        seed: of shuffling, scenes and matchers.
        episodes: episodes per scene; on a dataset, the first so many (None = all).
        perception: eyes of the robots in scenes: `learned`, `learned:FOLDER` with weights of that folder, `simulated`.
        n_robots: robots with cameras in scenes; None = the scene's own number.
    """

    pose: PoseKnowledge = "unknown"
    preset: str | None = None
    min_common: int = 0
    sequence: bool = False
    seed: int = 0
    episodes: int | None = None
    perception: str = "learned"
    n_robots: int | None = None

    def __post_init__(self) -> None:
        if self.pose not in get_args(PoseKnowledge):
            raise ValueError(f"pose must be one of {', '.join(get_args(PoseKnowledge))}, got {self.pose!r}")
        if self.perception not in ("learned", "simulated") and not self.perception.startswith("learned:"):
            raise ValueError(f"perception must be learned, learned:FOLDER or simulated, got {self.perception!r}")
        if self.sequence and self.pose == "known":
            raise ValueError("sequence gives the matcher a prior of its own: it goes with pose='unknown'")
        if self.min_common < 0:
            raise ValueError(f"min_common must be non-negative, got {self.min_common}")
        if self.seed < 0:
            raise ValueError(f"seed must be non-negative, got {self.seed}")
        if self.episodes is not None and self.episodes < 1:
            raise ValueError(f"episodes must be at least 1, got {self.episodes}")
        if self.n_robots is not None and self.n_robots < 2:
            raise ValueError(f"n_robots must be at least 2, got {self.n_robots}")
