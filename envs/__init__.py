"""Worlds, cameras, scoring and the PettingZoo environments."""
