"""Curves over all methods: precision and recall, reliability, errors over range and occlusion, time against F1."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from ...matching.metrics import reliability
from ..records import Record
from .charts import Axis, Series, chart, linear_axis, log_axis, unit_axis
from .html import Child, Element, h
from .leaderboard import key
from .run import Entry, Group

MAX_POINTS = 60
BINS = 6
MIN_PER_BIN = 8

Values = NDArray[np.float64]
XY = tuple[float, float]


def panel(group: Group, figure: Element, legend: Sequence[tuple[int, str, str]] = (), heading: str = "") -> Element:
    """A figure of one target with its legend: (method, label, figure beside it)."""
    items = [
        h("li", {"data-m": m}, key(m), h("span", None, label), h("span", {"class": "num"}, value))
        for m, label, value in legend
    ]
    caption = h(
        "figcaption",
        None,
        h("strong", None, heading or group.name),
        h("ul", {"class": "legend"}, items) if items else None,
    )
    return h("figure", {"class": "panel", "data-t": group.number}, figure, caption)


def section(identifier: str, title: str, note: str, panels: Child, legend: Child = None) -> Element:
    """Figures under a heading; `legend`, where they have none of their own, is shown once for all of them."""
    grid = h("div", {"class": "panels"}, panels)
    return h("section", {"id": identifier}, h("h2", None, title), h("p", {"class": "note"}, note), legend, grid)


def _common_legend(groups: Sequence[Group]) -> Element:
    """Every method of the groups with its mark."""
    labels = {e.method: e.label for g in groups for e in g.entries}
    return h("ul", {"class": "legend"}, [h("li", {"data-m": m}, key(m), h("span", None, x)) for m, x in labels.items()])


# Precision and recall


def precision_recall(groups: Sequence[Group]) -> Element:
    note = (
        "Matches pooled over all pairs of views, taken in order of their scores; recall is over the objects that both "
        "robots detected. The mark is where the method itself stops. Beside each name: average precision."
    )
    return section("precision-recall", "Precision and recall", note, [_pr_panel(g) for g in groups])


def _pr_panel(group: Group) -> Element:
    found = [(e, *_pr_series(e)) for e in group.entries]
    return _panel_of(group, "Precision against recall", unit_axis("recall"), unit_axis("precision"), found)


def _pr_series(e: Entry) -> tuple[str, list[Series]]:
    recall, precision = pr_curve(e.records)
    if not len(recall):
        return "", []
    kept = _thinned(len(recall))
    points = list(zip(recall[kept].tolist(), precision[kept].tolist(), strict=True))
    ends = [Series(e.label, points, e.method), Series(e.label, [points[-1]], e.method, line=False)]
    return f"{average_precision(recall, precision):.3f}", ends


def _panel_of(
    group: Group,
    title: str,
    x: Axis,
    y: Axis,
    found: Sequence[tuple[Entry, str, list[Series]]],
    diagonal: bool = False,
) -> Element:
    """Curves of the methods that have any, each with a figure beside its name."""
    drawn = [(e, value, series) for e, value, series in found if series]
    curves = [s for _, _, series in drawn for s in series]
    figure = chart(f"{title} of {len(drawn)} methods on {group.name}", x, y, curves, diagonal=diagonal)
    return panel(group, figure, [(e.method, e.label, value) for e, value, _ in drawn])


def pr_curve(records: Sequence[Record]) -> tuple[Values, Values]:
    """Recall and precision at each distinct score, highest first; empty without matches or common objects."""
    scores = np.array([s for r in records for s in r.scores])
    hits = np.array([h for r in records for h in r.hits], dtype=bool)
    common = sum(r.common for r in records)
    if not len(scores) or not common:
        return np.zeros(0), np.zeros(0)
    order = np.argsort(-scores, kind="stable")
    correct = np.cumsum(hits[order])
    last = np.append(np.diff(scores[order]) != 0, True)
    return correct[last] / common, (correct / np.arange(1, len(scores) + 1))[last]


def average_precision(recall: Values, precision: Values) -> float:
    """Area under the steps of the curve."""
    return float(np.sum(np.diff(recall, prepend=0.0) * precision))


def _thinned(n: int) -> NDArray[np.int64]:
    return np.unique(np.round(np.linspace(0, n - 1, min(n, MAX_POINTS))).astype(np.int64))


# Calibration


def calibration(groups: Sequence[Group]) -> Element:
    note = (
        "Matches in ten bins of equal number by score: the share that was right against the mean score. On the "
        "diagonal a score is a probability; below it, a boast. Beside each name: expected calibration error (ECE)."
    )
    return section("calibration", "Are scores probabilities?", note, [_calibration_panel(g) for g in groups])


def _calibration_panel(group: Group) -> Element:
    found = [(e, *_calibration_series(e)) for e in group.entries]
    return _panel_of(group, "Reliability", unit_axis("mean score"), unit_axis("share right"), found, diagonal=True)


def _calibration_series(e: Entry) -> tuple[str, list[Series]]:
    scores = np.array([s for r in e.records for s in r.scores])
    if not len(scores):
        return "", []
    bins = reliability(scores, np.array([h for r in e.records for h in r.hits], dtype=bool))
    points = [(b.score, b.accuracy) for b in bins]
    return "" if e.row["ece"] is None else f"{e.row['ece']:.3f}", [Series(e.label, points, e.method, markers=True)]


# Range and occlusion


def difficulty(groups: Sequence[Group]) -> list[Element]:
    """Displacement error, and the share of common objects found, against range and against occlusion."""
    errors = [p for g in groups for p in (_error_panel(g, "range"), _error_panel(g, "occlusion")) if p is not None]
    found = [p for g in groups for p in (_found_panel(g, "range"), _found_panel(g, "occlusion")) if p is not None]
    out = []
    if errors:
        note = (
            "Mean distance between estimate and truth over rightly matched objects, in bins of equal number. Coloured: "
            "fused; dashed, without marks: one robot alone, over the objects of the method with the most of them. "
            "Occlusion is the share of an object’s outline that something nearer or the image’s edge cuts off."
        )
        title = "Displacement error over range and occlusion"
        out.append(section("error", title, note, errors, _common_legend(groups)))
    if found:
        note = (
            "Share of the objects that both robots detected which a method matched rightly, in bins of equal number; "
            "the larger of the two robots’ distances or occlusions counts."
        )
        title = "Objects found over range and occlusion"
        out.append(section("found", title, note, found, _common_legend(groups)))
    return out


AXES: dict[str, tuple[str, Callable[[Record], list[float]], Callable[[Record], list[float]]]] = {
    "range": ("range, m", lambda r: r.error_range_m, lambda r: r.common_range_m),
    "occlusion": ("occlusion", lambda r: r.error_occlusion, lambda r: r.common_occlusion),
}


def _error_panel(group: Group, kind: str) -> Element | None:
    label, of, _ = AXES[kind]
    series = []
    for e in group.entries:
        points = binned([x for r in e.records for x in of(r)], [y for r in e.records for y in r.error_fused_m])
        series += [Series(f"{e.label}, fused", points, e.method, markers=True)] if points else []
    most = max(group.entries, key=lambda e: sum(len(r.error_single_m) for r in e.records))
    alone = binned([x for r in most.records for x in of(r)], [y for r in most.records for y in r.error_single_m])
    if not alone:
        return None
    series.append(Series("one robot alone", alone, None, classes="dashed"))
    return _panel_over(group, label, "error, m", series, f"Displacement error against {kind}", False)


def _found_panel(group: Group, kind: str) -> Element | None:
    label, _, of = AXES[kind]
    series = []
    for e in group.entries:
        points = binned(
            [x for r in e.records for x in of(r)], [float(y) for r in e.records for y in r.common_found if of(r)]
        )
        series += [Series(e.label, points, e.method, markers=True)] if points else []
    return _panel_over(group, label, "share found", series, f"Share found against {kind}", True) if series else None


def _panel_over(group: Group, label: str, what: str, series: list[Series], title: str, unit: bool) -> Element:
    xs = [x for s in series for x, _ in s.points]
    ys = [y for s in series for _, y in s.points]
    y = unit_axis(what) if unit else linear_axis(what, ys)
    figure = chart(f"{title} on {group.name}", linear_axis(label, xs), y, series)
    return panel(group, figure, heading=f"{group.name}: over {label.removesuffix(', m')}")


def binned(xs: Sequence[float], ys: Sequence[float]) -> list[XY]:
    """Mean y against mean x in bins of equal number; nothing where a bin would hold too few."""
    n = min(BINS, len(xs) // MIN_PER_BIN)
    if n < 2:
        return []
    x, y = np.asarray(xs), np.asarray(ys)
    chunks = np.array_split(np.argsort(x, kind="stable"), n)
    return [(float(x[c].mean()), float(y[c].mean())) for c in chunks]


# Time


def runtime(groups: Sequence[Group]) -> Element:
    note = (
        "F1 with its 95 % interval against the median time of the matcher for one pair of views, on the machine of the "
        "run. Up and to the left is better."
    )
    return section("runtime", "Time against quality", note, [_runtime_panel(g) for g in groups])


def _runtime_panel(group: Group) -> Element:
    timed = [e for e in group.entries if e.row["match_ms"]]
    series = [_timed(e) for e in timed]
    x = log_axis("time a pair, ms", [e.row["match_ms"] for e in timed])
    y = linear_axis("F1", [float(e.row["f1_high"]) for e in timed])
    return panel(group, chart(f"F1 against time on {group.name}", x, y, series))


def _timed(e: Entry) -> Series:
    note = f"{e.label}: F1 {e.f1:.3f}, {e.row['match_ms']:.2f} ms"
    bounds = [(float(e.row["f1_low"]), float(e.row["f1_high"]))]
    return Series(e.label, [(e.row["match_ms"], e.f1)], e.method, bounds, line=False, labelled=True, notes=[note])
