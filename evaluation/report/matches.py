"""Frames as pictures: two robots' images with the matches between them (the paper's Fig. 6), and the worst frames."""

from __future__ import annotations

import base64
from collections.abc import Sequence

from ..pictures import MIN_COMMON, Page, Result, Sight
from . import topview
from .html import Child, Element, h, number
from .leaderboard import key
from .run import Entry, Group

GAP = 6
MAX_FAILURES = 6
"""Failures shown of a target, and of all targets together at most ALL_FAILURES: pictures weigh."""
ALL_FAILURES = 36
PAPER_ORDER = ("reid", "mos", "rgm", "bayes")
"""Methods of Fig. 6 come first, then the others as they ran."""


class Images:
    """The images of the page, each written once and shown wherever it is used."""

    def __init__(self) -> None:
        self._ids: dict[bytes, str] = {}

    def use(self, image: bytes, y: float) -> Element:
        """A place where an image is shown."""
        identifier = self._ids.setdefault(image, f"image-{len(self._ids)}")
        return h("use", {"href": f"#{identifier}", "y": y})

    def definitions(self, sizes: dict[bytes, tuple[int, int]]) -> Element:
        images = []
        for image, identifier in self._ids.items():
            kind = "png" if image.startswith(b"\x89PNG") else "jpeg"
            data = f"data:image/{kind};base64,{base64.b64encode(image).decode()}"
            width, height = sizes[image]
            images.append(h("image", {"id": identifier, "href": data, "width": width, "height": height}))
        return h("svg", {"class": "images", "width": 0, "height": 0, "aria-hidden": "true"}, h("defs", None, images))


def showcase(group: Group) -> Page | None:
    """The first episode's frame in which the robots have most in common."""
    return next((p for p in group.pages if p.role == "showcase"), None)


def figure_6(groups: Sequence[Group], images: Images) -> Element | None:
    """Several methods side by side on one frame of each target."""
    shown = [(g, p) for g in groups if (p := showcase(g)) is not None]
    if not shown:
        return None
    note = (
        "One frame of each target’s first episode, the one with most in common. Solid green: right; dashed red: wrong. "
        "Boxes are detections. The paper’s Fig. 6."
    )
    blocks = [_side_by_side(group, page, images) for group, page in shown]
    return h(
        "section",
        {"id": "matches"},
        h("h2", None, "Matches, method by method"),
        h("p", {"class": "note"}, note),
        blocks,
    )


def _side_by_side(group: Group, page: Page, images: Images) -> Element:
    ordered = sorted(group.entries, key=lambda e: (_rank(e), e.method))
    figures = []
    for e in ordered:
        result = page.result(e.label)
        if result is not None:
            picture = frame(page, [(e.method, result)], images, f"{e.label} on {group.name}: {words(result)}")
            caption = h("figcaption", None, key(e.method), h("strong", None, e.label), " ", words(result))
            figures.append(h("figure", {"class": "frame", "data-m": e.method}, picture, caption))
    title = h("h3", None, group.name, h("span", {"class": "aka"}, when(page)))
    return h("article", {"data-t": group.number}, title, strip(figures, f"Matches on {group.name}, method by method"))


def strip(figures: list[Element], label: str, classes: str = "frames") -> Element:
    """Pictures in a grid; on a phone a strip that scrolls sideways, by keyboard as well."""
    return h("div", {"class": classes, "tabindex": "0", "role": "group", "aria-label": label}, figures)


def _rank(entry: Entry) -> int:
    if entry.label in PAPER_ORDER:
        return PAPER_ORDER.index(entry.label)
    return len(PAPER_ORDER) + entry.baseline


def when(page: Page, with_frame: bool = True) -> str:
    """Which frame of the run this is."""
    return f"seed {page.seed}, episode {page.episode}" + (f", frame {page.frame}" if with_frame else "")


def words(result: Result) -> str:
    right, wrong = sum(result.hits), len(result.hits) - sum(result.hits)
    return f"{right} right, {wrong} wrong, of {result.common} in common"


# One frame


def frame(page: Page, results: Sequence[tuple[int, Result]], images: Images, title: str, pick: bool = False) -> Element:
    """The first two robots, one above the other, and each method's matches; top views where there are no images."""
    pair = page.sights[:2]
    if any(sight.image is None for sight in pair) or page.image_size is None:
        return topview.two_graphs(page, results, title, pick)
    width, height = page.image_size
    offset = height + GAP
    parts: list[Child] = []
    for i, sight in enumerate(pair):
        assert sight.image is not None
        parts += [images.use(sight.image, i * offset), _boxes(sight, i * offset)]
    centres = [_centres(sight, i * offset) for i, sight in enumerate(pair)]
    parts += [topview.match_lines(method, result, centres, pick) for method, result in results]
    parts += [_plate(sight.robot, i * offset) for i, sight in enumerate(pair)]
    size = f"0 0 {width} {2 * height + GAP}"
    return h("svg", {"viewBox": size, "class": "picture", "role": "img", "aria-label": title}, parts)


def _centres(sight: Sight, offset: float) -> list[tuple[float, float]]:
    return [((u0 + u1) / 2, (v0 + v1) / 2 + offset) for u0, v0, u1, v1 in sight.boxes]


def _boxes(sight: Sight, offset: float) -> Element:
    d = "".join(
        f"M{number(u0)} {number(v0 + offset)}H{number(u1)}V{number(v1 + offset)}H{number(u0)}z"
        for u0, v0, u1, v1 in sight.boxes
    )
    return h("path", {"class": "boxes", "d": d})


def _plate(name: str, offset: float) -> Element:
    text = h("text", {"x": 9, "y": offset + 16}, name)
    back = h("rect", {"x": 4, "y": offset + 4, "width": 10 + 6.2 * len(name), "height": 17, "rx": 3})
    return h("g", {"class": "plate"}, back, text)


# Failures


def failures(groups: Sequence[Group], images: Images) -> Element | None:
    """The worst frames of every target, under the matches of a method that the reader picks."""
    most = max(1, min(MAX_FAILURES, ALL_FAILURES // len(groups)))
    blocks = [block for group in groups if (block := _failures_of(group, most, images)) is not None]
    if not blocks:
        return None
    note = (
        "Of each unit of work the worst frame of each of its two best methods is kept (lowest F1 with at least "
        f"{MIN_COMMON} objects in common); shown are the worst of these for the target’s best method. Pick a "
        f"method to see its matches."
    )
    return h("section", {"id": "failures"}, h("h2", None, "Failures"), h("p", {"class": "note"}, note), blocks)


def worst_pages(group: Group) -> list[Page]:
    """The kept failures of the best method, worst first."""
    scored = [(r, p) for p in group.pages if p.role == "worst" and (r := p.result(group.best.label)) is not None]
    scored = [(r, p) for r, p in scored if r.counts.f1 < 1]
    scored.sort(key=lambda x: (x[0].counts.f1, -len(x[0].hits)))
    return [page for _, page in scored]


def _failures_of(group: Group, most: int, images: Images) -> Element | None:
    pages = worst_pages(group)[:most]
    if not pages:
        return None
    name = f"pick-{group.number}"
    options = [h("option", {"value": e.method, "selected": e is group.best}, e.label) for e in group.entries]
    picker = h("label", {"class": "picker"}, "Matches of ", h("select", {"id": name}, options))
    figures = [_failure(group, page, images) for page in pages]
    title = h("h3", None, group.name)
    return h(
        "article",
        {"data-t": group.number},
        title,
        picker,
        strip(figures, f"Failures on {group.name}", "frames large"),
    )


def _failure(group: Group, page: Page, images: Images) -> Element:
    results = [(e.method, r) for e in group.entries if (r := page.result(e.label)) is not None]
    title = f"{group.name}, {when(page)}: two robots’ views with matches"
    picture = frame(page, results, images, title, pick=True)
    told = [h("span", {"data-pick": method}, words(result)) for method, result in results]
    best = max((r.counts.f1, m) for m, r in results if not _entry(group, m).baseline)
    others = f". Best here: {_entry(group, best[1]).label}, F1 {best[0]:.2f}." if best[0] else ". No method did better."
    caption = h("figcaption", None, h("strong", None, when(page)), " ", told, others)
    return h("figure", {"class": "frame"}, picture, caption)


def _entry(group: Group, method: int) -> Entry:
    return next(e for e in group.entries if e.method == method)


def image_sizes(groups: Sequence[Group]) -> dict[bytes, tuple[int, int]]:
    """Width and height of every stored image."""
    return {
        sight.image: (page.image_size[0], page.image_size[1])
        for group in groups
        for page in group.pages
        if page.image_size is not None
        for sight in page.sights
        if sight.image is not None
    }
