"""The leaderboard: a table per target, the paper's numbers beside ours, intervals, and differences to the best."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from . import paper
from .charts import marker
from .html import Child, Element, h
from .run import Entry, Group

MINUS = "−"
TO = {"best": "to the best", "bayes": "to bayes"}
"""Titles of the columns of differences."""


@dataclass(frozen=True)
class Column:
    """A column of the table: its title, what it means, its value (None = nothing to say) and how it is written."""

    title: str
    meaning: str
    value: Callable[[Group, Entry], float | None]
    form: str = "{:.3f}"
    kind: str = ""


def _row(key: str) -> Callable[[Group, Entry], float | None]:
    return lambda group, entry: entry.row.get(key)


def _published(which: int) -> Callable[[Group, Entry], float | None]:
    def value(group: Group, entry: Entry) -> float | None:
        pair = published(group, entry)
        return None if pair is None else (*pair, paper.f1(pair))[which]

    return value


def published(group: Group, entry: Entry) -> paper.Pair | None:
    """What the paper gives for the method as it is, without options."""
    return None if entry.row["options"] else paper.published(group.target, entry.row["method"])


COLUMNS = (
    Column("Precision", "Right matches of all emitted, pooled over pairs of views.", _row("precision")),
    Column("paper", "Precision in the paper's Table 1.", _published(0), kind="paper"),
    Column("Recall", "Right matches of all objects that both robots detected.", _row("recall")),
    Column("paper", "Recall in the paper's Table 1.", _published(1), kind="paper"),
    Column("ECE", "Expected calibration error of the matches' scores; 0 is calibrated.", _row("ece")),
    Column(
        "Scene recall",
        "Right matches over the objects that both cameras show large enough to count, detected or not; above 1 where "
        "smaller ones are matched, too.",
        _row("scene_recall"),
    ),
    Column(
        "Alone, m",
        "Mean displacement error of one robot, over rightly matched objects.",
        _row("displacement_single_m"),
    ),
    Column("Fused, m", "Mean displacement error after fusion, over the same objects.", _row("displacement_fused_m")),
    Column("ms a pair", "Median time of the matcher for one pair of views.", _row("match_ms"), "{:.2f}"),
    Column(
        "Failed",
        "Pairs on which the method failed, and counts as having found nothing.",
        lambda group, entry: entry.row.get("n_failed") or None,
        "{:d}",
    ),
)


def section(groups: list[Group]) -> Element:
    return h(
        "section",
        {"id": "leaderboard"},
        h("h2", None, "Leaderboard"),
        h(
            "p",
            {"class": "note"},
            "Counts are pooled over pairs of views. Bars are 95 % bootstrap intervals over episodes; “to the best” is "
            "the difference of F1 to the highest on the same episodes, with its interval (paired bootstrap), shaded "
            "where noise alone may explain it (the interval holds 0, or p of a paired permutation test is .05 or more)."
            " The oracle and chance do not compete. A diamond is the paper’s F1, from its mean precision and recall; "
            "its scenes are not ours: it shows an order, not a target. Click a header to sort.",
        ),
        glance(groups) if len(groups) > 1 else None,
        [table(group) for group in groups],
    )


def verdict(group: Group) -> str:
    """Who won, in a sentence; nobody inside the noise."""
    best = group.best
    rivals = [e for e in group.competitors if e is not best]
    level = [e.label for e in rivals if e.level]
    if not rivals:
        return f"{best.label} alone: nothing to compare."
    if level:
        few = " Five episodes or fewer never make a winner." if n_episodes(group) < 6 else ""
        highest = f"{best.label} has the highest F1, {best.f1:.3f}"
        return f"No winner: {highest}, but {listed(level)} within the noise of it.{few}"
    lead = min(best.f1 - e.f1 for e in rivals)
    return (
        f"{best.label} leads with F1 {best.f1:.3f}, {lead:.3f} or more ahead of every other method, outside the noise."
    )


def n_episodes(group: Group) -> int:
    return int(group.best.row["episodes"])


def listed(names: list[str]) -> str:
    """`a is`, `a and b are`; long lists are counted."""
    if len(names) == 1:
        return f"{names[0]} is"
    if len(names) > 4:
        return f"{len(names)} other methods are"
    return f"{', '.join(names[:-1])} and {names[-1]} are"


def glance(groups: list[Group]) -> Element:
    """F1 of every method on every target; the best of each and what is within the noise of it are set off."""
    entries = {(e.method, g.number): e for g in groups for e in g.entries}
    labels = {e.method: e for g in groups for e in g.entries}
    ordered = sorted(labels, key=lambda m: -sum(e.f1 for (k, _), e in entries.items() if k == m))
    rows = []
    for method in ordered:
        cells = [_glance_cell(g, entries.get((method, g.number))) for g in groups]
        name = h(
            "th", {"scope": "row", "class": "name", "data-v": labels[method].label}, key(method), labels[method].label
        )
        classes = "baseline" if labels[method].baseline else None
        rows.append(h("tr", {"data-m": method, "class": classes}, name, cells))
    head = [_header("Method", "", "name")] + [_header(g.name, f"F1 on {g.name}", "num", g.number) for g in groups]
    return h(
        "article",
        None,
        h("h3", None, "F1 at a glance"),
        h("p", {"class": "facts"}, "Filled: the highest. Outlined: within the noise of it."),
        h(
            "div",
            {"class": "scroll", "tabindex": "0", "role": "region", "aria-label": "F1 of every method on every target"},
            h("table", {"class": "sortable glance"}, h("thead", None, h("tr", None, head)), h("tbody", None, rows)),
        ),
    )


def _glance_cell(group: Group, entry: Entry | None) -> Element:
    if entry is None:
        return h("td", {"data-t": group.number})
    mark = "top" if entry is group.best else "level" if entry.level else None
    value = h("span", {"class": mark}, f"{entry.f1:.3f}")
    return h("td", {"class": "num", "data-v": _exact(entry.f1), "data-t": group.number}, value)


def table(group: Group) -> Element:
    """One target's table, best F1 first."""
    shown = [c for c in COLUMNS if any(c.value(group, e) is not None for e in group.entries)]
    ordered = sorted(group.entries, key=lambda e: -e.f1)
    head = [
        _header("Method", "", "name"),
        _header("F1", "Harmonic mean of precision and recall.", "num"),
        h("th", {"class": "graphic", "scope": "col"}, "95 % interval"),
        *(_header(TO[to], f"F1 less that of {to}, and its 95 % interval.", "num") for to in _compared_to(group)),
    ]
    head += [_header(c.title, c.meaning, f"num {c.kind}".strip()) for c in shown]
    first = group.entries[0].row
    facts = f"{n_episodes(group)} episodes, {first['frames']} frames, {first['pairs']} pairs of views"
    name = paper.SCENE_NAMES.get(group.target)
    return h(
        "article",
        {"class": "target", "data-t": group.number},
        h("h3", None, group.name, h("span", {"class": "aka"}, f"the paper’s {name}") if name else None),
        h("p", {"class": "verdict"}, verdict(group)),
        h("p", {"class": "facts"}, facts),
        h(
            "div",
            {"class": "scroll", "tabindex": "0", "role": "region", "aria-label": f"Leaderboard of {group.name}"},
            h(
                "table",
                {"class": "sortable"},
                h("thead", None, h("tr", None, head)),
                h("tbody", None, [_table_row(group, e, shown) for e in ordered]),
            ),
        ),
    )


def _header(title: str, meaning: str, classes: str, target: int | None = None) -> Element:
    button = h("button", {"type": "button", "title": meaning or None}, title)
    return h("th", {"class": classes, "scope": "col", "data-t": target}, button)


def _table_row(group: Group, entry: Entry, shown: list[Column]) -> Element:
    best = entry is group.best
    classes = "baseline" if entry.baseline else "best" if best else ""
    cells: list[Child] = [
        h("th", {"scope": "row", "class": "name", "data-v": entry.label}, key(entry.method), entry.label),
        h("td", {"class": "num strong", "data-v": _exact(entry.f1)}, f"{entry.f1:.3f}"),
        h("td", {"class": "graphic"}, interval(group, entry)),
        *(_difference_cell(entry, to, best) for to in _compared_to(group)),
    ]
    for column in shown:
        value = column.value(group, entry)
        text = "" if value is None else column.form.format(value)
        cells.append(h("td", {"class": f"num {column.kind}".strip(), "data-v": _exact(value)}, text))
    return h("tr", {"class": classes or None, "data-m": entry.method}, cells)


def _exact(value: float | None) -> str | None:
    return None if value is None else repr(float(value))


def _difference_cell(entry: Entry, to: str, best: bool) -> Element:
    """F1 less that of the best or of bayes, shaded where noise alone may explain a difference to the best."""
    difference = entry.difference(to)
    if difference is None:
        itself = best if to == "best" else entry.label == to
        return h("td", {"class": "num", "data-v": "0" if itself else None}, to if itself else "")
    value, low, high = difference
    noise = to == "best" and entry.level
    p = entry.row.get("p_value_best" if to == "best" else "p_value")
    return h(
        "td",
        {
            "class": "num difference" + (" noise" if noise else ""),
            "data-v": _exact(value),
            "title": None if p is None else f"p = {p:.3g}",
        },
        signed(value),
        h("span", {"class": "bounds"}, f"{signed(low)} to {signed(high)}"),
    )


def _compared_to(group: Group) -> list[str]:
    """The best, and bayes where that is another."""
    return ["best", *(["bayes"] if group.best.label != "bayes" and group.best.difference("bayes") else [])]


def signed(value: float) -> str:
    text = f"{abs(value):.3f}"
    return text if float(text) == 0 else (MINUS if value < 0 else "+") + text


def key(method: int) -> Element:
    """The method's mark in its colour."""
    return h(
        "svg",
        {"class": f"key series c{method}", "viewBox": "-8 -8 16 16", "aria-hidden": "true"},
        h("path", {"class": "line", "d": "M-8 0H8"}),
        marker(method, 0, 0),
    )


def interval(group: Group, entry: Entry) -> Element:
    """F1, its interval and the paper's value on a scale from 0 to 1."""
    width, middle = 120, 10
    low, high = float(entry.row["f1_low"]), float(entry.row["f1_high"])
    pair = published(group, entry)
    words = f"F1 {entry.f1:.3f}, 95 % interval {low:.3f} to {high:.3f}"
    parts: list[Any] = [
        h("line", {"class": "rule", "x1": 2, "x2": width - 2, "y1": middle, "y2": middle}),
        h("line", {"class": "bar", "x1": _at(low, width), "x2": _at(high, width), "y1": middle, "y2": middle}),
        marker(entry.method, _at(entry.f1, width), middle),
    ]
    if pair is not None:
        at = _at(paper.f1(pair), width)
        words += f"; the paper’s {paper.f1(pair):.3f}"
        parts.append(
            h("path", {"class": "published", "d": "M0-5L5 0L0 5L-5 0z", "transform": f"translate({at:.1f} 10)"})
        )
    return h(
        "svg",
        {"class": f"interval series c{entry.method}", "viewBox": f"0 0 {width} 20", "role": "img", "aria-label": words},
        h("title", None, words),
        parts,
    )


def _at(value: float, width: int) -> float:
    return 5 + (width - 10) * value
