"""Trajectories: the observers' with the matches between them (the paper's Fig. 9), the targets' (Fig. 10)."""

from __future__ import annotations

from collections.abc import Sequence

from ..pictures import MIN_PATH_M, Page
from . import topview
from .curves import section
from .html import Element, h
from .leaderboard import key
from .matches import when
from .paper import CASE_STUDY_ERROR_M
from .run import Entry, Group


def figure_9(groups: Sequence[Group]) -> Element | None:
    panels = [panel for group in groups for entry in _shown(group) if (panel := _observers(group, entry)) is not None]
    if not panels:
        return None
    note = (
        f"The first episode from above: the two observers’ paths, and at {topview.SHOWN_FRAMES} instants lines from "
        "each observer to where it alone puts a matched object. Green: right; dashed red joins two places wrongly "
        "taken for one object. The paper’s Fig. 9."
    )
    return section("observers", "Observers and their matches", note, panels)


def _shown(group: Group) -> list[Entry]:
    """The best method, and the paper's."""
    paper = [e for e in group.entries if e.label == "rgm" and e is not group.best]
    return [group.best, *paper]


def _observers(group: Group, entry: Entry) -> Element | None:
    figure = topview.observers(group, entry.label)
    if figure is None:
        return None
    episode = when(topview.episodes(group)[0][0], with_frame=False)
    caption = h("figcaption", None, h("strong", None, group.name), key(entry.method), f"{entry.label}; {episode}")
    return h("figure", {"class": "panel", "data-t": group.number, "data-m": entry.method}, figure, caption)


def figure_10(groups: Sequence[Group]) -> Element | None:
    panels = [panel for group in groups for panel in _tracks(group)]
    if not panels:
        return None
    single, fused = (1000 * error for error in CASE_STUDY_ERROR_M)
    note = (
        f"Up to {topview.MAX_TRACKS} moving objects of an episode (objects that stand still, where none that moves was "
        "followed), in the frames in which the best method matched them rightly (the oracle, where it followed none): "
        "as one observer estimates them alone, and fused with the other. Thick line or ring: truth. Shown is the kept "
        "episode in which objects are followed longest; of every unit of the run, the one with the longest shared "
        "view of a moving object is kept. The paper’s Fig. 10; its case study reports "
        f"{single:.1f} mm alone and {fused:.1f} mm fused."
    )
    return section("trajectories", "Trajectories: truth, one robot, fused", note, panels)


def _tracks(group: Group) -> list[Element]:
    """One panel alone, one fused: by the best method if it followed something that moves, else by the oracle, else of
    what stands still."""
    entries = [group.best, *(e for e in group.entries if e.label == "oracle")]
    for least_m in (MIN_PATH_M, 0.0):
        for entry in entries:
            pages, found = topview.best_tracks(group, entry.label, least_m)
            if found:
                return [_panel(group, entry, pages[0], found, which) for which in ("single", "fused")]
    return []


def _panel(group: Group, entry: Entry, page: Page, found: Sequence[topview.Track], which: str) -> Element:
    what = "one robot alone" if which == "single" else "fused"
    index = 0 if which == "single" else 1
    errors = ", ".join(f"object {t.identity} ({t.observer}) {t.errors[index]:.3f} m" for t in found)
    words = f"matched by {entry.label}; {when(page, with_frame=False)}. Mean error: {errors}."
    caption = h("figcaption", None, h("strong", None, f"{group.name}: {what}"), words)
    figure = topview.trajectories(group.name, found, which)
    return h("figure", {"class": "panel", "data-t": group.number}, figure, caption)
