"""How to get every number again."""

from __future__ import annotations

from typing import Any

from .html import Child, Element, h
from .run import Group, Run

SETTINGS = ("pose", "preset", "perception", "sequence", "min_common", "episodes")
OF_SCENES = ("preset", "perception")
"""Settings that only scenes have."""


def section(run: Run) -> Element:
    return h(
        "section",
        {"id": "reproduce"},
        h("h2", None, "How to reproduce every number"),
        h(
            "p",
            {"class": "note"},
            "The same commit, command and versions give the same records, whatever the number of workers; times "
            "differ.",
        ),
        [_session(session, number, len(run.sessions)) for number, session in enumerate(run.sessions)],
        _plan(run),
        h(
            "p",
            {"class": "note"},
            "This page: ",
            h("code", None, f"covis report {run.folder.name}"),
            ", from the folder alone.",
        ),
    )


def _session(session: dict[str, Any], number: int, n: int) -> Element:
    versions = ", ".join(f"{name} {version}" for name, version in session.get("versions", {}).items())
    facts: list[tuple[str, Child]] = [
        ("command", h("code", None, str(session.get("command", "unknown")))),
        ("commit", h("code", None, str(session.get("commit") or "unknown: not run from a git checkout"))),
        ("versions", versions),
        ("renderer of scenes", str(session.get("renderer", "unknown"))),
        ("machine", str(session.get("machine", "unknown"))),
        ("started", str(session.get("started", "unknown"))),
    ]
    title = h("h3", None, f"Session {number + 1} of {n}") if n > 1 else None
    return h(
        "div", {"class": "session"}, title, h("dl", None, [[h("dt", None, k), h("dd", None, v)] for k, v in facts])
    )


def _plan(run: Run) -> Element:
    head = ["experiment", "target", "seeds", *SETTINGS]
    rows: list[Child] = []
    for group in run.groups:
        cells = [
            group.id,
            group.target,
            ", ".join(map(str, group.seeds)),
            *(_setting(group, k) for k in SETTINGS),
        ]
        rows.append(h("tr", {"data-t": group.number}, [h("td", None, c) for c in cells]))
    body = h(
        "table",
        None,
        h("thead", None, h("tr", None, [h("th", {"scope": "col"}, c.replace("_", " ")) for c in head])),
        h("tbody", None, rows),
    )
    return h(
        "div", {"class": "scroll", "tabindex": "0", "role": "region", "aria-label": "Experiments of the run"}, body
    )


def _setting(group: Group, name: str) -> str:
    return "" if name in OF_SCENES and group.kind != "scene" else said(group.settings.get(name))


def said(value: Any) -> str:
    """A setting in words."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    return "default" if value is None else str(value)
