"""One instant of an environment, and claims about it."""

from __future__ import annotations

from dataclasses import dataclass

from .camera.frame import Frame
from .claims import Claims
from .scoring import StepScore, Truth
from .worlds.world import Snapshot


@dataclass(frozen=True, eq=False)
class Instant:
    """One instant of the world: what is there, what the cameras see, what is true."""

    snapshot: Snapshot
    frames: tuple[Frame, ...]
    truth: Truth


@dataclass(frozen=True, eq=False)
class Answered:
    """Claims of all robots, the instant they are about, and their scores."""

    instant: Instant
    claims: tuple[Claims, ...]
    score: StepScore
