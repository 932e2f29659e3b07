"""Charts as SVG, drawn for a phone's width and scaled up; colours come from the style sheet, by method."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from math import ceil, floor, log10

from .html import Element, h, number

WIDTH, HEIGHT = 360, 270
LEFT, RIGHT, TOP, BOTTOM = 44, 18, 12, 40


@dataclass(frozen=True)
class Axis:
    """One axis: its range in data units, where its ticks are, and what it says."""

    label: str
    low: float
    high: float
    ticks: Sequence[float]
    log: bool = False

    def share(self, value: float) -> float:
        """Where a value lies, 0 to 1 within the axis."""
        if self.log:
            return (log10(value) - log10(self.low)) / (log10(self.high) - log10(self.low))
        return (value - self.low) / (self.high - self.low)


@dataclass(frozen=True)
class Series:
    """One line: points (x, y), and optionally an interval of y and a note at each.

    `method` is the number by which its looks go, None = neutral; `labelled` writes its name beside the last point.
    """

    name: str
    points: Sequence[tuple[float, float]]
    method: int | None = None
    bounds: Sequence[tuple[float, float]] = ()
    line: bool = True
    markers: bool = False
    labelled: bool = False
    classes: str = ""
    notes: Sequence[str] = field(default_factory=tuple)


def tick_text(value: float) -> str:
    """A number in few letters: 0.25, 1000, 10k."""
    return f"{value / 1000:g}k" if abs(value) >= 10_000 else f"{value:g}"


UNIT_TICKS = (0.0, 0.2, 0.4, 0.6, 0.8, 1.0)


def unit_axis(label: str) -> Axis:
    return Axis(label, 0.0, 1.0, UNIT_TICKS)


def linear_axis(label: str, values: Sequence[float], from_zero: bool = True) -> Axis:
    """An axis with round ticks around the values."""
    low = 0.0 if from_zero else min(values, default=0.0)
    high = max(values, default=1.0)
    if high <= low:
        high = low + 1.0
    step = _round_step((high - low) / 4)
    first, last = floor(low / step + 1e-9), ceil(high / step - 1e-9)
    ticks = [round(k * step, 10) for k in range(first, last + 1)]
    return Axis(label, ticks[0], ticks[-1], ticks)


def log_axis(label: str, values: Sequence[float]) -> Axis:
    """An axis of decades around the positive values."""
    positive = [v for v in values if v > 0] or [1.0]
    low, high = floor(log10(min(positive))), ceil(log10(max(positive)))
    high = max(high, low + 1)
    return Axis(label, 10.0**low, 10.0**high, [10.0**k for k in range(low, high + 1)], log=True)


def _round_step(rough: float) -> float:
    scale = 10.0 ** floor(log10(rough))
    return next(m * scale for m in (1, 2, 2.5, 5, 10) if m * scale >= rough - 1e-12)


def chart(title: str, x: Axis, y: Axis, series: Sequence[Series], diagonal: bool = False) -> Element:
    """Lines over two axes. `title` is what a screen reader says of it."""
    to_x = _scale(x, LEFT, WIDTH - RIGHT)
    to_y = _scale(y, HEIGHT - BOTTOM, TOP)
    body: list[Element] = [*_axes(x, y, to_x, to_y)]
    if diagonal:
        ends = {"x1": to_x(x.low), "y1": to_y(y.low), "x2": to_x(x.high), "y2": to_y(y.high)}
        body.append(h("line", {"class": "diagonal", **ends}))
    body += [_series(s, to_x, to_y) for s in series]
    body += _labels([s for s in series if s.labelled], to_x, to_y)
    return h("svg", {"viewBox": f"0 0 {WIDTH} {HEIGHT}", "class": "chart", "role": "img", "aria-label": title}, body)


def _scale(axis: Axis, start: float, end: float) -> Callable[[float], float]:
    return lambda value: start + (end - start) * axis.share(value)


def _axes(x: Axis, y: Axis, to_x: Callable[[float], float], to_y: Callable[[float], float]) -> list[Element]:
    out = []
    bottom, middle = HEIGHT - BOTTOM, (LEFT + WIDTH - RIGHT) / 2
    for tick in y.ticks:
        v = to_y(tick)
        out.append(h("line", {"class": "grid", "x1": LEFT, "x2": WIDTH - RIGHT, "y1": v, "y2": v}))
        out.append(h("text", {"class": "tick", "x": LEFT - 6, "y": v + 4, "text-anchor": "end"}, tick_text(tick)))
    for tick in x.ticks:
        u = to_x(tick)
        out.append(h("line", {"class": "grid", "x1": u, "x2": u, "y1": TOP, "y2": bottom}))
        words = tick_text(tick)
        out.append(h("text", {"class": "tick", "x": u, "y": bottom + 16, "text-anchor": "middle"}, words))
    out.append(h("text", {"class": "label", "x": middle, "y": HEIGHT - 6, "text-anchor": "middle"}, x.label))
    across = (TOP + bottom) / 2
    turned: dict[str, object] = {
        "class": "label",
        "text-anchor": "middle",
        "transform": f"translate(12 {number(across)}) rotate(-90)",
    }
    out.append(h("text", turned, y.label))
    return out


def _series(s: Series, to_x: Callable[[float], float], to_y: Callable[[float], float]) -> Element:
    at = [(to_x(x), to_y(y)) for x, y in s.points]
    parts: list[Element] = [h("title", None, s.name)]
    for (u, _), (low, high) in zip(at, s.bounds, strict=False):
        parts.append(h("line", {"class": "whisker", "x1": u, "x2": u, "y1": to_y(low), "y2": to_y(high)}))
    if s.line and len(at) > 1:
        parts.append(h("path", {"class": "line", "d": path(at)}))
    if s.markers or not s.line or len(at) == 1:
        notes = list(s.notes) or [""] * len(at)
        parts += [marker(s.method, u, v, note) for (u, v), note in zip(at, notes, strict=True)]
    own = "neutral" if s.method is None else f"c{s.method}"
    return h("g", {"class": f"series {own} {s.classes}".strip(), "data-m": s.method}, parts)


def path(points: Sequence[tuple[float, float]]) -> str:
    return "M" + "L".join(f"{number(u)} {number(v)}" for u, v in points)


def marker(method: int | None, u: float, v: float, note: str = "") -> Element:
    """A method's mark: its shape tells methods apart where colours do not."""
    shapes = (
        "M-3.6 0a3.6 3.6 0 1 0 7.2 0a3.6 3.6 0 1 0-7.2 0z",
        "M-3.2-3.2h6.4v6.4h-6.4z",
        "M0-4.4L4.2 3H-4.2z",
        "M0-4.8L4.4 0L0 4.8L-4.4 0z",
        "M0 4.4L4.2-3H-4.2z",
        "M-1.9-4.6h3.8v9.2h-3.8z",
        "M-4-1.8L-1.8-4L0-2.2L1.8-4L4-1.8L2.2 0L4 1.8L1.8 4L0 2.2L-1.8 4L-4 1.8L-2.2 0z",
        "M-1.4-4.2h2.8v2.8h2.8v2.8h-2.8v2.8h-2.8v-2.8h-2.8v-2.8h2.8z",
    )
    shape = shapes[0 if method is None else method % len(shapes)]
    at = f"translate({number(u)} {number(v)})"
    return h("path", {"class": "mark", "d": shape, "transform": at}, h("title", None, note) if note else None)


def _labels(series: Sequence[Series], to_x: Callable[[float], float], to_y: Callable[[float], float]) -> list[Element]:
    """Names beside the last point of each series, moved where they would cover another name or mark."""
    at = {s.name: (to_x(s.points[-1][0]), to_y(s.points[-1][1])) for s in series if s.points}
    taken = [(u - 5, v - 5, u + 5, v + 5) for u, v in at.values()]
    out: list[Element] = []
    for s in sorted((s for s in series if s.points), key=lambda s: at[s.name][1]):
        u, v = at[s.name]
        anchor, x, y, box = _free_place(u, v, 7.2 * len(s.name), [b for b in taken if not _inside(u, v, b)])
        taken.append(box)
        parts = [h("text", {"class": "tag", "x": x, "y": y + 4, "text-anchor": anchor}, s.name)]
        if abs(y - v) > 8:
            parts.insert(0, h("line", {"class": "leader", "x1": u, "y1": v, "x2": x, "y2": y}))
        out.append(h("g", {"data-m": s.method}, parts))
    return out


Box = tuple[float, float, float, float]


def _free_place(u: float, v: float, width: float, taken: Sequence[Box]) -> tuple[str, float, float, Box]:
    """Text anchor, place and box of a name near (u, v): the nearest of several places that covers nothing."""
    places = []
    for shift in (0, -11, 11, -22, 22, -33, 33, -44, 44, -55, 55):
        for anchor, x in (("start", u + 8), ("end", u - 8)):
            left = x if anchor == "start" else x - width
            box = (left, v + shift - 5, left + width, v + shift + 5)
            inside = box[0] >= LEFT and box[2] <= WIDTH - 2 and box[1] >= 2 and box[3] <= HEIGHT - BOTTOM
            places.append((sum(_overlap(box, b) for b in taken) + 1000 * (not inside), anchor, x, v + shift, box))
    _, anchor, x, y, box = min(places, key=lambda place: place[0])
    return anchor, x, y, box


def _overlap(a: Box, b: Box) -> float:
    return max(0.0, min(a[2], b[2]) - max(a[0], b[0])) * max(0.0, min(a[3], b[3]) - max(a[1], b[1]))


def _inside(u: float, v: float, box: Box) -> bool:
    """Whether a box is the point's own mark."""
    return box == (u - 5, v - 5, u + 5, v + 5)
