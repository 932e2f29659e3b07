"""Where things stand at the start of an episode: random layouts with bounded tries."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from .world import Array, SceneGenerationError

Draw = Callable[[int], Array]
"""A proposal for the i-th item: its position (2,) m."""

TRIES = 400


def place_apart(
    draw: Draw, n: int, separation_m: float, what: str, *, taken: Array | None = None, clearance_m: float | None = None
) -> Array:
    """Positions (n, 2) m, `separation_m` or more from each other and `clearance_m` (else the same) from `taken` (k, 2).

    Raises:
        SceneGenerationError: an item found no place within `TRIES` proposals; the message names `what`.
    """
    others = np.zeros((0, 2)) if taken is None else np.asarray(taken, dtype=np.float64).reshape(-1, 2)
    clearance = separation_m if clearance_m is None else clearance_m
    placed = np.zeros((n, 2))
    for i in range(n):
        for _ in range(TRIES):
            p = draw(i)
            if _clear(p, placed[:i], separation_m) and _clear(p, others, clearance):
                placed[i] = p
                break
        else:
            raise SceneGenerationError(
                f"no place for {what} {i + 1} of {n} in {TRIES} tries: at least {separation_m:.2f} m from the other "
                f"{i} and {clearance:.2f} m from {len(others)} things that already stand there"
            )
    return placed


def team_layout(rng: np.random.Generator, layout: str, radius_m: float, n: int) -> Draw:
    """Proposals for a team of n about the origin, within `radius_m`; `layout` is a name of `LAYOUTS`."""
    return LAYOUTS[layout](rng, radius_m, n)


def in_disc(rng: np.random.Generator, radius_m: float) -> Array:
    """A uniform point (2,) m of the disc about the origin."""
    angle, distance = rng.uniform(-np.pi, np.pi), radius_m * np.sqrt(rng.uniform())
    return np.array([distance * np.cos(angle), distance * np.sin(angle)])


def _scatter(rng: np.random.Generator, radius_m: float, n: int) -> Draw:
    return lambda i: in_disc(rng, radius_m)


def _clusters(rng: np.random.Generator, radius_m: float, n: int) -> Draw:
    count = int(rng.integers(2, 5))
    centres = np.array([in_disc(rng, 0.85 * radius_m) for _ in range(count)])
    spread = radius_m / count
    # After many refusals a cluster is full: every draw may also fall anywhere.
    return lambda i: (
        _clipped(centres[i % count] + rng.normal(0.0, spread, 2), radius_m)
        if rng.uniform() < 0.9
        else in_disc(rng, radius_m)
    )


def _rows(rng: np.random.Generator, radius_m: float, n: int) -> Draw:
    columns = int(np.ceil(np.sqrt(n)))
    turn = rng.uniform(-np.pi, np.pi)
    c, s = np.cos(turn), np.sin(turn)
    R = np.array([[c, -s], [s, c]])
    pitch = 2 * radius_m / max(columns, 2)

    def draw(i: int) -> Array:
        cell = np.array([i % columns, i // columns]) - 0.5 * (columns - 1)
        return _clipped(R @ (cell * pitch) + rng.normal(0.0, 0.15 * pitch, 2), radius_m)

    return draw


def _ring(rng: np.random.Generator, radius_m: float, n: int) -> Draw:
    start = rng.uniform(-np.pi, np.pi)

    def draw(i: int) -> Array:
        angle = start + 2 * np.pi * i / n + rng.normal(0.0, 0.2)
        distance = radius_m * rng.uniform(0.45, 1.0)
        return np.array([distance * np.cos(angle), distance * np.sin(angle)])

    return draw


LAYOUTS: dict[str, Callable[[np.random.Generator, float, int], Draw]] = {
    "scatter": _scatter,
    "clusters": _clusters,
    "rows": _rows,
    "ring": _ring,
}


def observers_around(
    rng: np.random.Generator,
    n: int,
    distance_m: tuple[float, float],
    angle_rad: tuple[float, float],
    gaze_m: float,
    separation_m: float,
    taken: Array,
) -> Array:
    """Planar poses (n, 3) on a circle about the origin, looking inward with partly overlapping views.

    Each stands `angle_rad` (low, high) further round than one that already stands, at `distance_m` (low, high), and
    looks at a point within `gaze_m` of the origin.

    Raises:
        SceneGenerationError: an observer found no place.
    """
    bearings: list[float] = []

    def draw(i: int) -> Array:
        del bearings[i:]
        if i == 0:
            bearing = rng.uniform(-np.pi, np.pi)
        else:
            bearing = bearings[int(rng.integers(i))] + rng.choice([-1.0, 1.0]) * rng.uniform(*angle_rad)
        bearings.append(bearing)
        distance = rng.uniform(*distance_m)
        return np.array([distance * np.cos(bearing), distance * np.sin(bearing)])

    positions = place_apart(draw, n, separation_m, "observer", taken=taken)
    gaze = np.array([in_disc(rng, gaze_m) for _ in range(n)]).reshape(n, 2) - positions
    return np.column_stack([positions, np.arctan2(gaze[:, 1], gaze[:, 0])])


def _clear(p: Array, others: Array, distance_m: float) -> bool:
    return bool((((others - p) ** 2).sum(1) >= distance_m**2).all())


def _clipped(p: Array, radius_m: float) -> Array:
    distance = float(np.hypot(*p))
    return p if distance <= radius_m else p * (radius_m / distance)
