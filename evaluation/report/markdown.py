"""The report as Markdown: the leaderboard's tables, and where they come from."""

from __future__ import annotations

from .leaderboard import COLUMNS, n_episodes, signed, verdict
from .run import Entry, Group, Run


def text(run: Run) -> str:
    """The whole file."""
    lines = ["# covis benchmark", ""]
    for session in run.sessions:
        lines.append(f"    {session.get('command', 'unknown')}")
    commits = ", ".join(dict.fromkeys(str(s.get("commit") or "unknown") for s in run.sessions))
    lines += [
        "",
        f"Commit {commits}. Intervals: 95 % bootstrap over episodes; differences of F1: paired, on the same episodes.",
    ]
    for group in run.groups:
        lines += ["", *_table(group)]
    return "\n".join(lines) + "\n"


def _table(group: Group) -> list[str]:
    shown = [c for c in COLUMNS if any(c.value(group, e) is not None for e in group.entries)]
    titles = ["Method", "F1", "95 %", "to the best", *(c.title if c.kind != "paper" else "paper" for c in shown)]
    lines = [f"## {escaped(group.name)}", "", escaped(verdict(group)), ""]
    lines += [f"{n_episodes(group)} episodes.", ""]
    lines += ["| " + " | ".join(titles) + " |", "| --- |" + " ---: |" * (len(titles) - 1)]
    for entry in sorted(group.entries, key=lambda e: -e.f1):
        interval = (
            f"{entry.row['f1_low']:.3f} to {entry.row['f1_high']:.3f}" if entry.row["episodes"] > 1 else "1 episode"
        )
        cells = [escaped(entry.label), f"{entry.f1:.3f}", interval]
        cells.append(_difference(entry, entry is group.best))
        cells += [_cell(c.value(group, entry), c.form) for c in shown]
        lines.append("| " + " | ".join(cells) + " |")
    return lines


def _cell(value: float | None, form: str) -> str:
    return "" if value is None else form.format(value)


def _difference(entry: Entry, best: bool) -> str:
    difference = entry.difference("best")
    if difference is None:
        return "best" if best else ""
    value, low, high = (signed(x) for x in difference)
    return f"{value} ({low} to {high})" + (", noise" if entry.level else "")


def escaped(name: str) -> str:
    """A name that cannot break a table or become markup."""
    for character in "\\`*_<>[]|":
        name = name.replace(character, "\\" + character)
    return name.replace("\n", " ")
