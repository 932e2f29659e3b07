"""Optional dependencies: which extra brings what, and a clear error where one is missing."""

from __future__ import annotations

from importlib.util import find_spec

EXTRAS = {
    "envs": ("pettingzoo", "gymnasium", "highway_env", "pybullet", "cv2"),
    "learned": ("torch", "safetensors"),
    "policy": ("torch", "stable_baselines3", "supersuit"),
    "ray": ("ray",),
    "torchvision": ("torch", "safetensors", "torchvision"),
    "viz": ("matplotlib", "rerun"),
}


class MissingExtraError(RuntimeError):
    """A package that an extra brings is not installed."""


def require(extra: str, otherwise: str = "") -> None:
    """Raises MissingExtraError naming the extra and the first missing package; `otherwise` is said after that."""
    for module in EXTRAS[extra]:
        if find_spec(module) is None:
            raise MissingExtraError(f"{module} is missing: install covis[{extra}]{otherwise}")


def require_scene(perception: str) -> None:
    """What scenes need: the simulators and, for learned eyes, torch. Raises MissingExtraError."""
    require("envs")
    if perception != "simulated":
        require("learned", ", or take the eyes that need no torch: --perception simulated")
