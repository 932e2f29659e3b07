"""The colours of pictures and recordings, chosen for a dark ground."""

from __future__ import annotations

from collections.abc import Iterable

Color = tuple[int, int, int]

ROBOT_COLORS: tuple[Color, ...] = (
    (64, 156, 255),
    (255, 140, 46),
    (46, 204, 134),
    (226, 122, 196),
    (126, 214, 240),
    (245, 200, 66),
    (160, 132, 255),
    (206, 212, 220),
)
"""One per robot, distinguishable with colour-blind eyes (after Okabe and Ito, brightened for a dark ground)."""
CLASS_COLORS: tuple[Color, ...] = (
    (238, 240, 244),
    (255, 209, 102),
    (124, 221, 255),
    (255, 150, 150),
    (178, 236, 140),
    (214, 170, 255),
    (255, 178, 110),
    (130, 230, 200),
)
IDENTITY_COLORS: tuple[Color, ...] = (
    (255, 214, 10),
    (0, 229, 255),
    (255, 105, 214),
    (124, 252, 80),
    (150, 120, 255),
    (255, 150, 40),
    (40, 220, 170),
    (90, 150, 255),
    (214, 255, 150),
    (255, 175, 200),
    (200, 90, 255),
    (255, 236, 150),
    (150, 240, 255),
    (0, 180, 90),
)
"""Vivid and apart from one another; none near the red of what is wrong."""
RIGHT: Color = (64, 214, 122)
WRONG: Color = (255, 72, 72)
INK: Color = (232, 235, 240)
FAINT: Color = (146, 153, 165)
CANVAS: Color = (20, 23, 29)
PLATE: Color = (35, 40, 49)


def robot_color(i: int) -> Color:
    return ROBOT_COLORS[i % len(ROBOT_COLORS)]


def class_color(i: int) -> Color:
    return CLASS_COLORS[i % len(CLASS_COLORS)]


def identity_colors(identities: Iterable[int]) -> dict[int, Color]:
    """A vivid colour for each identity, different ones for as many as there are, nearly the same in every picture."""
    n = len(IDENTITY_COLORS)
    taken: set[int] = set()
    out: dict[int, Color] = {}
    for identity in sorted(set(identities)):
        free = [k for k in range(n) if k not in taken]
        # Its own colour if that is free, else the next that is.
        choice = min(free, key=lambda k: (k - 5 * identity) % n) if free else identity % n
        taken.add(choice)
        out[identity] = IDENTITY_COLORS[choice]
    return out
