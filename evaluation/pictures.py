"""What a report shows of a run beside its numbers: some frames of each unit, with what the robots saw and matched.

A page is one frame. Kept are the frames of the unit that holds a target's first episode (one of them with images), from
every unit the episode in which its first two robots see one moving object in the most frames (for trajectories), and
the worst frame of each of its two best methods, images included. One Parquet file a unit, in `pictures/` beside
`records/`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from types import MappingProxyType
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from ..matching.metrics import Counts
from .methods import EVALUATION_ONLY

MAX_EPISODE_PAGES = 60
"""Frames kept from the first episode on, at most."""
WORST_OF = 2
"""The worst frames of so many of a unit's methods are kept."""
MIN_COMMON = 3
"""A frame with fewer objects in common is no failure worth looking at."""
MIN_FRAMES = 3
"""An object that is followed in fewer frames has no trajectory."""
MIN_PATH_M = 0.2
"""An object whose true path is shorter stands still."""
JPEG_QUALITY = 82

Array = NDArray[np.float64]
Places = Mapping[int, Array]

FLOATS = pa.list_(pa.float32())
POINTS = pa.list_(FLOATS)
INTS = pa.list_(pa.int32())
SIGHT = pa.struct(
    [
        ("robot", pa.string()),
        ("image", pa.binary()),
        ("pose", FLOATS),
        ("boxes", POINTS),
        ("places", POINTS),
        ("identity", pa.list_(pa.int64())),
        ("truth", POINTS),
    ]
)
RESULT = pa.struct(
    [
        ("method", pa.string()),
        ("robots", pa.list_(INTS)),
        ("pairs", pa.list_(INTS)),
        ("scores", FLOATS),
        ("hits", pa.list_(pa.bool_())),
        ("common", pa.int32()),
        ("fused", pa.list_(POINTS)),
    ]
)
SCHEMA = pa.schema(
    [
        ("target", pa.string()),
        ("seed", pa.int64()),
        ("episode", pa.int64()),
        ("frame", pa.int64()),
        ("role", pa.string()),
        ("image_size", INTS),
        ("sights", pa.list_(SIGHT)),
        ("results", pa.list_(RESULT)),
    ]
)


@dataclass(frozen=True)
class Sight:
    """What one robot saw in one frame.

    Attributes:
        robot: its name.
        image: JPEG or PNG, or None.
        pose: true T_world_sensor, 16 numbers row by row, or None.
        boxes: per detection [u0, v0, u1, v1]; empty where unknown.
        places: per detection where this robot alone puts it, m: world frame by the true pose, else sensor frame.
        identity: per detection the true object; negative = none.
        truth: per detection the true place in the world, m, or empty.
    """

    robot: str
    image: bytes | None
    pose: list[float] | None
    boxes: list[list[float]]
    places: list[list[float]]
    identity: list[int]
    truth: list[list[float] | None]


@dataclass(frozen=True)
class Result:
    """What one method made of the frame: a match per entry, and per robot the fused place of each detection.

    Attributes:
        method: its label.
        robots: per match the two robots' numbers.
        pairs: per match the two detections' numbers.
        scores, hits: per match its score, and whether it is right.
        common: objects that both robots detected, summed over pairs of robots.
        fused: per robot and detection, m, world frame; empty where nothing was fused.
    """

    method: str
    robots: list[list[int]]
    pairs: list[list[int]]
    scores: list[float]
    hits: list[bool]
    common: int
    fused: list[list[list[float]]] = field(default_factory=list)

    @property
    def counts(self) -> Counts:
        return Counts(sum(self.hits), len(self.hits), self.common)


@dataclass(frozen=True)
class Page:
    """One frame. `role`: `showcase` (the first episode's frame with most in common), `episode`, or `worst`."""

    target: str
    episode: int
    frame: int
    role: str
    image_size: list[int] | None
    sights: list[Sight]
    results: list[Result]
    seed: int = 0

    def result(self, method: str) -> Result | None:
        return next((r for r in self.results if r.method == method), None)

    def without_images(self) -> Page:
        return replace(self, sights=[replace(s, image=None) for s in self.sights])


class PictureBook:
    """Chooses the pages of one unit. `first_episode` is the number of the target's first, in this unit or not."""

    def __init__(self, first_episode: int) -> None:
        self._first = first_episode
        self._in_first_unit = False
        self._episode: list[Page] = []
        self._running: tuple[int, list[Page], list[Places]] = (-1, [], [])
        self._longest: tuple[int, list[Page]] = (MIN_FRAMES - 1, [])
        self._showcase: Page | None = None
        self._worst: dict[str, tuple[tuple[float, int], Page]] = {}
        self._totals: dict[str, Counts] = {}

    def see(
        self,
        episode: int,
        counts: Mapping[str, Counts],
        make_page: Callable[[], Page],
        shared: Places = MappingProxyType({}),
    ) -> None:
        """One frame: what each method scored in it, how to make its page, which is called only when wanted, and the
        true places (3,) m of the objects that the first two robots both detected."""
        for method, c in counts.items():
            self._totals[method] = self._totals.get(method, Counts()) + c
        worse = [m for m, c in counts.items() if self._is_worst(m, c)]
        self._in_first_unit |= episode == self._first
        followed = self._in_first_unit and len(self._episode) < MAX_EPISODE_PAGES
        if not worse and not followed and not shared:
            return
        page = make_page()
        for method in worse:
            self._worst[method] = _badness(counts[method]), replace(page, role="worst")
        if followed:
            self._add_to_episode(page, showcase=episode == self._first)
        elif shared:
            self._add_to_running(episode, replace(page.without_images(), role="episode"), shared)

    def pages(self) -> list[Page]:
        """What is kept, episodes before the failures."""
        self._end_running()
        kept = [*self._episode, *self._longest[1]]
        ranked = sorted(self._worst, key=lambda m: -self._totals[m].f1)
        for method in ranked[:WORST_OF]:
            page = self._worst[method][1]
            if page not in kept:
                kept.append(page)
        return kept

    def _add_to_running(self, episode: int, page: Page, shared: Places) -> None:
        if episode != self._running[0]:
            self._end_running()
            self._running = (episode, [], [])
        self._running[1].append(page)
        self._running[2].append(shared)

    def _end_running(self) -> None:
        """Keep the episode that has ended if its longest shared view is the longest yet."""
        _, pages, shared = self._running
        frames = longest_shared(shared)
        if frames > self._longest[0]:
            self._longest = frames, pages
        self._running = (-1, [], [])

    def _is_worst(self, method: str, counts: Counts) -> bool:
        if method in EVALUATION_ONLY or counts.common < MIN_COMMON:
            return False
        return method not in self._worst or _badness(counts) > self._worst[method][0]

    def _add_to_episode(self, page: Page, showcase: bool) -> None:
        best = self._showcase
        if showcase and (best is None or _most_common(page) > _most_common(best)):
            if best is not None:
                self._episode[self._episode.index(best)] = replace(best.without_images(), role="episode")
            self._showcase = replace(page, role="showcase")
            self._episode.append(self._showcase)
        else:
            self._episode.append(replace(page.without_images(), role="episode"))


def longest_shared(frames: Sequence[Places]) -> int:
    """The most frames of an episode in which both robots saw one and the same moving object."""
    seen: dict[int, list[Array]] = {}
    for shared in frames:
        for identity, place in shared.items():
            seen.setdefault(identity, []).append(place)
    return max((len(places) for places in seen.values() if _length(places) >= MIN_PATH_M), default=0)


def _length(places: Sequence[Array]) -> float:
    return float(np.linalg.norm(np.diff(np.array(places), axis=0), axis=1).sum())


def _badness(counts: Counts) -> tuple[float, int]:
    return -counts.f1, counts.retrieved + counts.common


def _most_common(page: Page) -> int:
    return max((r.common for r in page.results), default=0)


def to_table(pages: Sequence[Page]) -> pa.Table:
    return pa.Table.from_pylist([asdict(page) for page in pages], schema=SCHEMA)


def from_table(table: pa.Table) -> list[Page]:
    return [
        Page(**row | {"sights": [Sight(**s) for s in row["sights"]], "results": [Result(**r) for r in row["results"]]})
        for row in table.to_pylist()
    ]


def jpeg(rgb: np.ndarray) -> bytes:
    """An RGB image (H, W, 3) as JPEG."""
    import cv2

    done, data = cv2.imencode(".jpg", cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    if not done:
        raise RuntimeError(f"an image of shape {rgb.shape} cannot be written as JPEG")
    return bytes(data)


def recompressed(image: bytes) -> bytes:
    """A PNG as JPEG where OpenCV is installed, else as it is."""
    try:
        import cv2
    except ImportError:
        return image
    decoded = cv2.imdecode(np.frombuffer(image, np.uint8), cv2.IMREAD_COLOR)
    if decoded is None:
        raise ValueError(f"an image of {len(image)} bytes is neither PNG nor JPEG")
    return jpeg(cv2.cvtColor(decoded, cv2.COLOR_BGR2RGB))


def rounded(values: Any) -> list[Any]:
    """Nested lists of an array; NaN-free input is assumed."""
    return np.asarray(values, dtype=np.float32).tolist()
