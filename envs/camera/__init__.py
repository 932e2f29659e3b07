"""Cameras: one software rasteriser, and pybullet's renderers beside it."""
