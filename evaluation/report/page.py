"""The page: everything in one HTML file, style and script included, that asks the network for nothing."""

from __future__ import annotations

from collections.abc import Sequence
from importlib.resources import files

from . import curves, leaderboard, matches, reproduce, robustness, trajectories
from .html import Element, h, page
from .run import Run
from .styles import rules


def render(run: Run) -> str:
    """The report of a run as HTML."""
    images = matches.Images()
    sections = [
        leaderboard.section(run.groups),
        curves.precision_recall(run.groups),
        curves.calibration(run.groups),
        robustness.figure_7(run.groups),
        matches.figure_6(run.groups, images),
        trajectories.figure_9(run.groups),
        trajectories.figure_10(run.groups),
        *curves.difficulty(run.groups),
        curves.runtime(run.groups),
        matches.failures(run.groups, images),
        reproduce.section(run),
    ]
    shown = [s for s in sections if s is not None]
    return page(
        h(
            "html",
            {"lang": "en"},
            _head(run),
            h(
                "body",
                None,
                h("a", {"class": "skip", "href": "#main"}, "Skip to the results"),
                _header(run, shown),
                _toolbar(run),
                h("main", {"id": "main"}, shown),
                images.definitions(matches.image_sizes(run.groups)),
                h("script", None, _asset("report.js")),
            ),
        )
    )


def _head(run: Run) -> Element:
    return h(
        "head",
        None,
        h("meta", {"charset": "utf-8"}),
        h("meta", {"name": "viewport", "content": "width=device-width, initial-scale=1"}),
        h("meta", {"name": "color-scheme", "content": "light dark"}),
        h("title", None, f"covis report: {', '.join(dict.fromkeys(g.target for g in run.groups))}"),
        h("link", {"rel": "icon", "href": "data:,"}),
        h("style", None, _asset("report.css"), rules(run.methods)),
    )


def _asset(name: str) -> str:
    return (files(__package__) / name).read_text(encoding="utf-8")


def _header(run: Run, sections: Sequence[Element]) -> Element:
    n_methods, targets = len(run.methods), len(run.groups)
    commits = ", ".join(dict.fromkeys(str(s.get("commit") or "unknown") for s in run.sessions))
    started = str(run.sessions[0].get("started", ""))[:10] if run.sessions else ""
    facts = [
        f"suite {run.suite}" if run.suite else "",
        f"{targets} target{'s' * (targets != 1)}",
        f"{n_methods} method{'s' * (n_methods != 1)}",
        f"commit {commits}",
        started,
    ]
    unfinished = run.n_finished < run.n_units
    warning = f"This run is not finished: {run.n_finished} of {run.n_units} units are in."
    links = [h("a", {"href": f"#{s.get('id')}"}, _title(s)) for s in sections]
    return h(
        "header",
        {"class": "top"},
        h("h1", None, "Who is who, and where: ", h("span", None, "covis benchmark report")),
        h("p", {"class": "facts"}, " · ".join(filter(None, facts))),
        h("p", {"class": "warning"}, warning) if unfinished else None,
        h("nav", {"aria-label": "Sections"}, links),
    )


def _title(section: Element) -> str:
    heading = section.find("h2")
    return "" if heading is None else "".join(heading.itertext())


def _toolbar(run: Run) -> Element:
    chips = [
        h(
            "button",
            {"type": "button", "class": "chip", "aria-pressed": "true", "data-chip": number, "data-name": label},
            leaderboard.key(number),
            label,
        )
        for label, number in run.methods.items()
    ]
    targets = [h("option", {"value": ""}, "all targets")]
    targets += [h("option", {"value": g.number}, g.name) for g in run.groups]
    return h(
        "div",
        {"class": "toolbar", "role": "group", "aria-label": "What to show"},
        h("label", None, h("span", {"class": "hidden"}, "Target"), h("select", {"id": "target"}, targets)),
        h(
            "label",
            None,
            h("span", {"class": "hidden"}, "Methods whose name contains"),
            h("input", {"id": "filter", "type": "search", "placeholder": "filter methods", "autocomplete": "off"}),
        ),
        h("div", {"class": "chips"}, chips),
    )
