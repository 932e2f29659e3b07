"""Optional dependencies: which extra brings what, and a clear error where one is missing."""

from __future__ import annotations

from importlib.util import find_spec

EXTRAS = {
    "envs": ("pettingzoo", "gymnasium", "highway_env", "pybullet", "cv2"),
    "learned": ("torch", "safetensors"),
    "policy": ("torch", "stable_baselines3", "supersuit"),
    "viz": ("matplotlib", "rerun"),
}


class MissingExtraError(RuntimeError):
    """A package that an extra brings is not installed."""


def require(extra: str) -> None:
    """Raises MissingExtraError naming the extra and the first missing package."""
    for module in EXTRAS[extra]:
        if find_spec(module) is None:
            raise MissingExtraError(f"{module} is missing: install covis[{extra}]")
