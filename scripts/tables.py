"""Rows as tables on a screen of any width: no figure is cut off, columns that do not fit go into further tables."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from rich import box
from rich.table import Table
from rich.text import Text

from .console import out

Row = dict[str, Any]
MAX_LABEL = 32
"""Longer names of rows are folded."""


@dataclass(frozen=True)
class Column:
    """A column: its title, which may have two lines, and what it shows of a row; nothing where a row has nothing."""

    title: str
    text: Callable[[Row], str]
    label: bool = False


def words(key: str) -> Callable[[Row], str]:
    """A row's entry as it is."""
    return lambda row: "" if row.get(key) is None else str(row[key])


def number(key: str, form: str = "{:.3f}") -> Callable[[Row], str]:
    """A row's number in a form."""
    return lambda row: "" if row.get(key) is None else form.format(row[key])


def share(key: str) -> Callable[[Row], str]:
    """A row's number in [-1, 1], without the zero before the point."""
    return lambda row: "" if row.get(key) is None else short(row[key])


def short(value: float, form: str = "{:.3f}") -> str:
    """A number without the zero before its point: .716, -.024, 1.000."""
    text = form.format(value)
    return text.replace("0.", ".", 1) if text.lstrip("+-").startswith("0.") else text


def print_rows(rows: Sequence[Row], columns: Sequence[Column], title: str = "") -> None:
    """Print rows under their titles; columns that no row fills are left out.

    Where the screen is too narrow for all, they are cut into several tables, each with the columns that are labels.
    """
    cells = {column: [column.text(row) for row in rows] for column in columns}
    shown = [column for column in columns if any(cells[column])]
    widths = {c: max(map(len, [*c.title.split("\n"), *cells[c]])) for c in shown}
    widths |= {c: min(widths[c], MAX_LABEL) for c in shown if c.label}
    gap = 2 if sum(widths.values()) + 2 * (len(widths) - 1) <= out.width else 1
    if title and rows:
        out.print(Text(title, style="bold"))
    for part in _parts(shown, widths, gap):
        table = Table(box=box.SIMPLE_HEAD, show_edge=False, pad_edge=False, padding=(0, gap - 1, 0, 0), header_style="")
        lines = max(column.title.count("\n") for column in part)
        for column in part:
            heading = Text("\n" * (lines - column.title.count("\n")) + column.title, style="bold")
            side: Literal["left", "right"] = "left" if column.label else "right"
            table.add_column(heading, justify=side, width=widths[column], overflow="fold")
        for k in range(len(rows)):
            table.add_row(*(Text(cells[column][k]) for column in part))
        out.print(table)
        out.print()


def _parts(shown: Sequence[Column], widths: dict[Column, int], gap: int) -> list[list[Column]]:
    """The columns of each table: all labels, and as many figures as fit beside them."""
    labels = [column for column in shown if column.label]
    start = sum(widths[column] + gap for column in labels)
    parts: list[list[Column]] = []
    used = out.width + 1
    for column in shown:
        if column.label:
            continue
        if used + widths[column] > out.width:
            parts.append(list(labels))
            used = start
        parts[-1].append(column)
        used += widths[column] + gap
    return parts
