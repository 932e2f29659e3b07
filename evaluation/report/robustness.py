"""The paper's Fig. 7: precision and recall while what the matcher gets to see is made worse."""

from __future__ import annotations

from collections.abc import Sequence

from .charts import Series, chart, linear_axis, unit_axis
from .curves import panel, section
from .html import Element
from .leaderboard import signed
from .run import Entry, Group, undisturbed

KINDS = {
    "attribute_uncertainty": "reported uncertainty of attributes",
    "position_uncertainty": "reported uncertainty of positions",
    "attribute_noise": "noise of attributes",
    "position_noise": "noise of positions",
}
MEASURES = ("precision", "recall")


def figure_7(groups: Sequence[Group]) -> Element | None:
    """A panel per kind of disturbance and measure; None when nothing was disturbed."""
    panels = [p for g in groups for kind in KINDS for m in MEASURES if (p := _panel(g, kind, m)) is not None]
    if not panels:
        return None
    note = (
        "What the robots report is made worse by a rate before matching. The paper raises the reported uncertainty by "
        "0 to 15 % (its Fig. 7); beyond it, the noise itself is raised while the report stays. A flat line is robust. "
        "Beside each name: the change from no disturbance to the strongest."
    )
    return section("robustness", "Robustness", note, panels)


def _panel(group: Group, kind: str, measure: str) -> Element | None:
    series, legend = [], []
    for entry in group.entries:
        points = rates(group, entry, kind, measure)
        if len(points) > 1:
            series.append(Series(entry.label, points, entry.method, markers=True))
            change = points[-1][1] - points[0][1]
            legend.append((entry.method, entry.label, signed(change)))
    if not series:
        return None
    worst = [x for s in series for x, _ in s.points]
    title = f"{measure} on {group.name} against more {KINDS[kind]}"
    figure = chart(title, linear_axis(f"{KINDS[kind]}, % more", worst), unit_axis(measure), series)
    return panel(group, figure, legend, f"{group.name}: {measure}, {KINDS[kind]}")


def rates(group: Group, entry: Entry, kind: str, measure: str) -> list[tuple[float, float]]:
    """(rate in %, value) of a method, by rate, undisturbed first."""
    own = [e for e in group.disturbed if undisturbed(e.label) == entry.label and set(e.row["disturbance"]) == {kind}]
    points = [(100.0 * e.row["disturbance"][kind], float(e.row[measure])) for e in own]
    return sorted([(0.0, float(entry.row[measure])), *points])
