"""Sun and sky at random: time of day and weather."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from .checks import check_names
from .world import Light

Color = tuple[int, int, int]

# name: sun elevation (low, high) in degrees, ambient (low, high), sky, horizon
TIMES_OF_DAY: dict[str, tuple[tuple[float, float], tuple[float, float], Color, Color]] = {
    "morning": ((14.0, 30.0), (0.42, 0.52), (134, 170, 214), (242, 220, 190)),
    "noon": ((50.0, 75.0), (0.4, 0.5), (104, 160, 226), (204, 222, 238)),
    "afternoon": ((28.0, 50.0), (0.4, 0.5), (112, 162, 218), (222, 222, 220)),
    "evening": ((10.0, 20.0), (0.46, 0.58), (96, 108, 160), (246, 176, 124)),
    "lab": ((60.0, 85.0), (0.55, 0.7), (196, 200, 204), (214, 215, 214)),
    "overcast": ((45.0, 80.0), (0.72, 0.85), (168, 176, 184), (206, 208, 210)),
}
GROUNDS: tuple[Color, ...] = ((122, 124, 120), (138, 130, 112), (104, 116, 90), (150, 146, 140), (96, 98, 104))


def sample_light(rng: np.random.Generator, times: Sequence[str], grounds: Sequence[Color] = GROUNDS) -> Light:
    """A light of one of the `times`, names of `TIMES_OF_DAY` (else ValueError), the sun anywhere around."""
    check_names("times_of_day", times, TIMES_OF_DAY)
    elevation_deg, ambient, sky, horizon = TIMES_OF_DAY[times[int(rng.integers(len(times)))]]
    elevation = math.radians(rng.uniform(*elevation_deg))
    azimuth = rng.uniform(-math.pi, math.pi)
    flat = math.cos(elevation)
    return Light(
        sun_direction=(flat * math.cos(azimuth), flat * math.sin(azimuth), math.sin(elevation)),
        ambient=float(rng.uniform(*ambient)),
        sky_color=_varied(rng, sky),
        horizon_color=_varied(rng, horizon),
        ground_color=_varied(rng, grounds[int(rng.integers(len(grounds)))]),
    )


def _varied(rng: np.random.Generator, color: Color, spread: int = 10) -> Color:
    r, g, b = (int(np.clip(c + rng.integers(-spread, spread + 1), 0, 255)) for c in color)
    return r, g, b
