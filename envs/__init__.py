"""Worlds, cameras, scoring and the PettingZoo environments."""

from ..matching import kernel_cache as kernel_cache  # before any kernel of the cameras is loaded
