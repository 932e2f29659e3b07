"""Tables of the commands: readable on a screen of any width."""

from __future__ import annotations

import io

import pytest
from rich.console import Console

from covis.scripts import tables
from covis.scripts.tables import Column, number, print_rows, share, short, words

ROWS = [
    {"name": "a method with a name that is long beyond all reason", "f1": 0.7164, "m": 12.5, "n": 1234567},
    {"name": "other", "f1": 1.0, "m": None, "n": 7},
]
COLUMNS = (
    Column("name", words("name"), label=True),
    Column("F1", share("f1")),
    Column("error\nm", number("m", "{:.2f}")),
    Column("absent", number("absent")),
    Column("from", words("n")),
    Column("from", words("m")),
)


def printed(monkeypatch: pytest.MonkeyPatch, width: int) -> str:
    stream = io.StringIO()
    monkeypatch.setattr(tables, "out", Console(file=stream, width=width))
    print_rows(ROWS, COLUMNS, "title")
    return stream.getvalue()


@pytest.mark.parametrize("width", [40, 50, 80, 180])
def test_nothing_is_cut_off_at_any_width(monkeypatch, width):
    text = printed(monkeypatch, width)
    assert all(len(line) <= width for line in text.splitlines())
    assert "…" not in text
    assert {".716", "1.000", "12.50", "12.5", "1234567", "7", "other"} <= set(text.split())


def test_columns_without_room_go_into_further_tables_with_the_labels(monkeypatch):
    assert printed(monkeypatch, 180).split().count("other") == 1
    assert printed(monkeypatch, 50).split().count("other") == 2
    assert printed(monkeypatch, 50).split().count("title") == 1


def test_columns_that_no_row_fills_are_left_out_and_titles_may_be_the_same(monkeypatch):
    lines = printed(monkeypatch, 180).splitlines()
    assert lines[0] == "title"
    assert lines[1].split() == ["error"]
    assert lines[2].split() == ["name", "F1", "m", "from", "from"]
    assert lines[-2].split() == ["other", "1.000", "7"]


def test_no_rows_print_nothing(monkeypatch):
    stream = io.StringIO()
    monkeypatch.setattr(tables, "out", Console(file=stream, width=80))
    print_rows([], COLUMNS, "title")
    assert stream.getvalue() == ""


@pytest.mark.parametrize(
    ("value", "form", "text"),
    [(0.7164, "{:.3f}", ".716"), (-0.0244, "{:+.3f}", "-.024"), (0.2, "{:+.3f}", "+.200"), (10.5, "{:.1f}", "10.5")],
)
def test_short_numbers_lose_the_zero_before_their_point_alone(value, form, text):
    assert short(value, form) == text
