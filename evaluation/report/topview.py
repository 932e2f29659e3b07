"""Scenes from above: two graphs with their matches, trajectories of observers and of what they localise."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..pictures import MIN_FRAMES, MIN_PATH_M, Page, Result
from .charts import path
from .html import Child, Element, h, number
from .run import Group

WIDTH, HEIGHT, MARGIN, BOTTOM = 360, 300, 14, 28
"""Below the map is room for its scale."""
MAX_TRACKS = 3
SHOWN_FRAMES = 3
"""Instants of an episode at which Fig. 9 draws the matches."""

Points = NDArray[np.float64]
Place = Callable[[Sequence[float] | Points], tuple[float, float]]


@dataclass(frozen=True)
class View:
    """A map's mapping from metres to the picture, equal scales, y up."""

    left: float
    bottom: float
    scale: float
    u0: float = 0.0

    def __call__(self, point: Sequence[float] | Points) -> tuple[float, float]:
        return (
            self.u0 + MARGIN + (point[0] - self.left) * self.scale,
            HEIGHT - BOTTOM - (point[1] - self.bottom) * self.scale,
        )


def view_of(points: Points, width: float = WIDTH, u0: float = 0.0) -> View:
    """Fits points (n, 2) m into a part of the picture."""
    low, high = points.min(axis=0), points.max(axis=0)
    span = np.maximum(high - low, 1e-3)
    room = np.array([width - 2 * MARGIN, HEIGHT - MARGIN - BOTTOM])
    scale = float((room / span).min())
    free = (room - span * scale) / (2 * scale)
    return View(float(low[0] - free[0]), float(low[1] - free[1]), scale, u0)


def scale_bar(view: View) -> Element:
    """A bar of a round length."""
    metres = 10.0 ** np.floor(np.log10(90 / view.scale))
    metres = float(next((m * metres for m in (5, 2) if m * metres * view.scale <= 90), metres))
    u, v = WIDTH - MARGIN - metres * view.scale, HEIGHT - 8
    bar = h("path", {"class": "bar", "d": f"M{number(u)} {v - 4}V{v}H{WIDTH - MARGIN}V{v - 4}"})
    return h("g", {"class": "scale"}, bar, h("text", {"x": u - 5, "y": v, "text-anchor": "end"}, f"{metres:g} m"))


# Two graphs with their matches


def two_graphs(page: Page, results: Sequence[tuple[int, Result]], title: str, pick: bool) -> Element:
    """For frames without images: both robots' detections from above, in the world where the true poses are known."""
    a, b = page.sights[:2]
    flat = [_flat(s.places) for s in (a, b)]
    parts: list[Child] = []
    known = a.pose is not None and b.pose is not None
    if known:
        robots = np.array([_place(a.pose), _place(b.pose)])
        both = view_of(np.concatenate([*flat, robots]))
        views = [both, both]
        parts += [_robot(i, both(robots[i]), s.robot) for i, s in enumerate((a, b))]
    else:
        # Each in its own sensor frame, side by side: nothing says how they stand to each other.
        views = [view_of(np.concatenate([p, np.zeros((1, 2))]), WIDTH / 2, i * WIDTH / 2) for i, p in enumerate(flat)]
        parts += [_robot(i, views[i]((0.0, 0.0)), s.robot) for i, s in enumerate((a, b))]
    centres = [[view(p) for p in points] for view, points in zip(views, flat, strict=True)]
    parts += [match_lines(method, result, centres, pick) for method, result in results]
    for i, own in enumerate(centres):
        parts.append(
            h("g", {"class": f"robot-{i}"}, [h("circle", {"class": "dot", "cx": u, "cy": v, "r": 3}) for u, v in own])
        )
    if known:
        parts.append(scale_bar(both))
    return _map(title, parts)


def match_lines(method: int, result: Result, centres: Sequence[Sequence[tuple[float, float]]], pick: bool) -> Element:
    """Matches between the first two robots, wrong ones below right ones."""
    drawn: dict[bool, list[str]] = {False: [], True: []}
    for robots, (i, j), hit in zip(result.robots, result.pairs, result.hits, strict=True):
        if robots == [0, 1] and i < len(centres[0]) and j < len(centres[1]):
            (u, v), (x, y) = centres[0][i], centres[1][j]
            drawn[hit].append(f"M{number(u)} {number(v)}L{number(x)} {number(y)}")
    paths = []
    for hit in (False, True):
        if drawn[hit]:
            d = "".join(drawn[hit])
            kind = "right" if hit else "wrong"
            paths += [h("path", {"class": f"halo {kind}-halo", "d": d}), h("path", {"class": kind, "d": d})]
    return h("g", {"data-pick": method} if pick else {}, paths)


def _map(title: str, parts: Child) -> Element:
    return h("svg", {"viewBox": f"0 0 {WIDTH} {HEIGHT}", "class": "map", "role": "img", "aria-label": title}, parts)


def _flat(points: Sequence[Sequence[float]]) -> Points:
    """Positions from above (n, 2)."""
    return np.asarray(points, dtype=np.float64).reshape(-1, 3)[:, :2]


def _place(pose: Sequence[float] | None) -> Points:
    assert pose is not None
    return np.array([pose[3], pose[7]])


def _robot(i: int, at: tuple[float, float], name: str) -> Element:
    """A robot's place with its name."""
    u, v = at
    mark = h("path", {"class": "robot", "d": "M-5 5L0-6L5 5z", "transform": f"translate({number(u)} {number(v)})"})
    left = u > WIDTH * 0.7
    text = h("text", {"x": u - 8 if left else u + 8, "y": v + 4, "text-anchor": "end" if left else "start"}, name)
    return h("g", {"class": f"robot-{i}"}, mark, text)


# Fig. 9


def observers(group: Group, method: str) -> Element | None:
    """Where the observers went, and at some instants the matches between them."""
    pages = next(iter(episodes(group)), [])
    if len(pages) < MIN_FRAMES:
        return None
    tracks = [np.array([_place(p.sights[i].pose) for p in pages]) for i in (0, 1)]
    shown = [pages[k] for k in np.unique(np.linspace(0, len(pages) - 1, SHOWN_FRAMES).astype(int))]
    ends = [np.concatenate([_flat(s.places) for s in p.sights[:2]]) for p in shown]
    # Estimates far off must not shrink the map.
    cloud = np.concatenate([*tracks, *(_within(e, np.concatenate(tracks)) for e in ends)])
    view = view_of(cloud)
    parts: list[Child] = [_sightings(page, method, view) for page in shown]
    for i, track in enumerate(tracks):
        parts.append(
            h("g", {"class": f"robot-{i}"}, h("path", {"class": "track", "d": path([view(p) for p in track])}))
        )
    parts += [_robot(i, view(track[-1]), pages[0].sights[i].robot) for i, track in enumerate(tracks)]
    title = f"Observers’ trajectories from above on {group.name}, with matches of {method}"
    return _map(title, [parts, scale_bar(view)])


def episodes(group: Group) -> list[list[Page]]:
    """The kept episodes, each in order of time, in which the true poses of the first two robots are known."""
    found: dict[tuple[int, int], list[Page]] = {}
    for page in group.pages:
        two = page.sights[:2]
        if page.role != "worst" and len(two) == 2 and all(sight.pose is not None for sight in two):
            found.setdefault((page.seed, page.episode), []).append(page)
    return [sorted(pages, key=lambda page: page.frame) for pages in found.values()]


def _within(points: Points, tracks: Points) -> Points:
    """Without the farthest twentieth."""
    distance = np.linalg.norm(points - tracks.mean(axis=0), axis=1)
    return points[distance <= np.quantile(distance, 0.95)] if len(points) else points


def _sightings(page: Page, method: str, view: View) -> Element:
    """Right matches as lines from each observer to where it puts the object; wrong ones join the two places alone."""
    result = page.result(method)
    drawn: dict[bool, list[str]] = {False: [], True: []}
    dots: list[Element] = []
    robots = [view(_place(s.pose)) for s in page.sights[:2]]
    places = [_flat(s.places) for s in page.sights[:2]]
    for pair, match, hit in zip(result.robots, result.pairs, result.hits, strict=True) if result else ():
        if pair != [0, 1]:
            continue
        ends = [view(places[i][k]) for i, k in enumerate(match)]
        drawn[hit].append(path([robots[0], *ends, robots[1]] if hit else ends))
        dots += [h("circle", {"class": "dot", "cx": u, "cy": v, "r": 2}) for u, v in ends]
    paths = [
        h("path", {"class": "right" if hit else "wrong", "d": "".join(drawn[hit])})
        for hit in (False, True)
        if drawn[hit]
    ]
    standing = [
        h("circle", {"class": f"robot-{i} stand", "cx": u, "cy": v, "r": 2.6}) for i, (u, v) in enumerate(robots)
    ]
    return h("g", {"class": "sightings"}, paths, dots, standing)


# Fig. 10


@dataclass(frozen=True, eq=False)
class Track:
    """One object over an episode, as one observer estimates it.

    Attributes:
        identity: of the object.
        observer: the robot's name.
        truth: true places (t, 2) m.
        single, fused: estimates (k, 2) m of the observer alone, and fused, in the frames of right matches.
        errors: mean error of both, m, in three dimensions.
    """

    identity: int
    observer: str
    truth: Points
    single: Points
    fused: Points
    errors: tuple[float, float]


def best_tracks(group: Group, method: str, least_m: float = MIN_PATH_M) -> tuple[list[Page], list[Track]]:
    """The kept episode in which a method followed objects longest that move at least so far, and these objects."""
    found = [(pages, tracks(pages, method, least_m)) for pages in episodes(group)]
    return max(found, key=lambda x: sum(len(t.single) for t in x[1]), default=([], []))


def tracks(pages: Sequence[Page], method: str, least_m: float) -> list[Track]:
    """The objects that a method matched rightly most often, each by the observer that saw it most; far movers first."""
    truth: dict[int, list[list[float]]] = {}
    found: dict[tuple[int, str], list[list[list[float]]]] = {}
    for page in pages:
        for identity, place in _truths(page).items():
            truth.setdefault(identity, []).append(place)
        for identity, observer, *places in _localised(page, method):
            found.setdefault((identity, observer), []).append(places)
    longest: dict[int, str] = {}
    for (identity, observer), frames in found.items():
        if identity not in longest or len(frames) > len(found[identity, longest[identity]]):
            longest[identity] = observer
    moving = [i for i in longest if _length(truth[i]) >= least_m and len(found[i, longest[i]]) >= MIN_FRAMES]
    moving.sort(key=lambda i: -(_length(truth[i]) + 1e-3) * len(found[i, longest[i]]))
    return [_track(i, longest[i], truth[i], np.array(found[i, longest[i]])) for i in moving[:MAX_TRACKS]]


def _track(identity: int, observer: str, truth: list[list[float]], places: Points) -> Track:
    """`places` (k, 3, 3): per frame the estimate alone, the fused one, the truth."""
    alone, fused, real = places[:, 0], places[:, 1], places[:, 2]
    errors = tuple(float(np.linalg.norm(x - real, axis=1).mean()) for x in (alone, fused))
    return Track(identity, observer, _flat(truth), alone[:, :2], fused[:, :2], (errors[0], errors[1]))


def _length(places: list[list[float]]) -> float:
    """Length of a path, m."""
    return float(np.linalg.norm(np.diff(np.array(places), axis=0), axis=1).sum())


def _truths(page: Page) -> dict[int, list[float]]:
    return {
        i: place
        for sight in page.sights
        for i, place in zip(sight.identity, sight.truth, strict=False)
        if i >= 0 and place is not None
    }


def _localised(page: Page, method: str) -> list[tuple[int, str, list[float], list[float], list[float]]]:
    """What either of the first two robots has in a right match: identity, robot, place alone, fused, true."""
    result = page.result(method)
    if result is None or not result.fused:
        return []
    out = []
    for robots, match, hit in zip(result.robots, result.pairs, result.hits, strict=True):
        for robot, k in zip(robots, match, strict=True):
            sight = page.sights[robot]
            place = sight.truth[k] if hit and robots == [0, 1] else None
            if place is not None:
                out.append((sight.identity[k], sight.robot, sight.places[k], result.fused[robot][k], place))
    return out


def _true_path(points: Sequence[tuple[float, float]]) -> Element:
    """A line, or a ring where nothing moves."""
    (u0, v0), (u1, v1) = np.min(points, axis=0), np.max(points, axis=0)
    if max(u1 - u0, v1 - v0) < 4:
        return h("circle", {"class": "truth", "cx": (u0 + u1) / 2, "cy": (v0 + v1) / 2, "r": 4})
    return h("path", {"class": "truth", "d": path(points)})


def _tag(at: tuple[float, float], name: str) -> Element:
    """A name beside a place, on the side where there is room."""
    u, v = at
    left = u > WIDTH * 0.75
    attributes: dict[str, object] = {"class": "tag", "x": u - 5 if left else u + 5, "y": max(v - 5, 12.0)}
    return h("text", attributes | {"text-anchor": "end" if left else "start"}, name)


def trajectories(name: str, found: Sequence[Track], which: str) -> Element:
    """True paths of the tracks, and the estimates of one robot (`single`) or of both (`fused`)."""
    view = view_of(np.concatenate([p for t in found for p in (t.truth, t.single, t.fused)]))
    parts: list[Child] = []
    for track in found:
        estimates = track.single if which == "single" else track.fused
        parts.append(_true_path([view(p) for p in track.truth]))
        parts.append(h("path", {"class": f"estimate {which}", "d": path([view(p) for p in estimates])}))
        at = [view(p) for p in estimates]
        parts.append([h("circle", {"class": f"point {which}", "cx": u, "cy": v, "r": 2.2}) for u, v in at])
    # Names last, so that no other track covers them.
    parts += [_tag(view(track.truth[0]), f"object {track.identity}") for track in found]
    what = "one robot alone" if which == "single" else "fused"
    return _map(f"Trajectories from above on {name}: truth and {what}", [parts, scale_bar(view)])
