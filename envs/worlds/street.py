"""What stands and walks beside the road: parked cars, signs, signals, pedestrians, trees and houses; world frame.

`Street` holds one episode's furniture. What stands still is drawn once from the generator; pedestrians and signals move
in `step`. Objects are listed in one order: parked vehicles, signs, signals, pedestrians.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .driving_params import (
    KINDS,
    PEDESTRIAN,
    PERSON_SIZE,
    SIGN,
    SIGN_HEIGHT_M,
    SIGN_SIZE,
    SIGNAL,
    SIGNAL_HEIGHT_M,
    SIGNAL_SIZE,
    WHITE,
    DrivingParams,
    Size,
    Tint,
    draw,
    draw_coat,
    draw_kind,
    draw_paint,
)
from .kerbs import BAY_M, PAVEMENT_M, POST_M, WALK_M, Ground
from .world import Array

WALLS: tuple[Tint, ...] = (
    (0.93, 0.88, 0.8),
    (0.82, 0.62, 0.52),
    (0.75, 0.76, 0.78),
    (0.92, 0.84, 0.62),
    (0.66, 0.5, 0.44),
)
LEAVES: tuple[Tint, ...] = ((1.0, 1.0, 1.0), (0.85, 1.0, 0.7), (1.0, 0.9, 0.6), (0.7, 0.85, 0.75))
RED, AMBER, GREEN = range(3)
AMBER_S, RED_S = 1.0, 2.0
PAUSE_S = 2.0
SITE_TRIES = 12

Site = tuple[tuple[float, float], float]
"""A place (x, y) m and a heading rad."""


@dataclass(frozen=True)
class Catalogue:
    """Mesh indices of street things; `footprints` are (length, depth) m of the houses."""

    person: int
    signals: tuple[int, int, int]
    signs: tuple[int, ...]
    posts: tuple[int, int]
    trees: tuple[int, ...]
    houses: tuple[int, ...]
    footprints: tuple[tuple[float, float], ...]


class Thing(NamedTuple):
    """Something with a mesh: where it stands, its class (-1: scenery), size, look, and its middle's height (m)."""

    site: Site
    kind: int
    size: Size
    mesh: int
    tint: Tint
    height: float


@dataclass
class Things:
    """n things: positions (n, 2) m, headings rad, classes, sizes (n, 3) m, meshes, tints, middle heights (n,) m."""

    positions: Array
    headings: Array
    classes: NDArray[np.int64]
    sizes: Array
    meshes: NDArray[np.int64]
    tints: Array
    heights: Array

    @classmethod
    def of(cls, things: list[Thing]) -> Things:
        """One row per thing."""
        return cls(
            positions=np.array([t.site[0] for t in things], dtype=np.float64).reshape(-1, 2),
            headings=np.array([t.site[1] for t in things], dtype=np.float64),
            classes=np.array([t.kind for t in things], dtype=np.int64),
            sizes=np.array([t.size for t in things], dtype=np.float64).reshape(-1, 3),
            meshes=np.array([t.mesh for t in things], dtype=np.int64),
            tints=np.array([t.tint for t in things], dtype=np.float64).reshape(-1, 3),
            heights=np.array([t.height for t in things], dtype=np.float64),
        )

    def __len__(self) -> int:
        return len(self.positions)

    def footprints(self) -> Array:
        """(n, 5) x, y, heading, length, width."""
        return np.column_stack([self.positions, self.headings, self.sizes[:, :2]])


@dataclass
class Signal:
    """A traffic light: the crossing it guards (-1: none, it follows the clock), its colour, and since when (s)."""

    crossing: int
    color: int = GREEN
    since: float = 0.0

    def switch(self, stop: bool, time: float) -> None:
        """Go to red by way of amber when traffic must stop, and back to green."""
        shown = time - self.since
        if stop and self.color == GREEN:
            self.color, self.since = AMBER, time
        elif self.color == AMBER and shown >= AMBER_S:
            self.color, self.since = RED, time
        elif not stop and self.color == RED and shown >= RED_S:
            self.color, self.since = GREEN, time


@dataclass
class Walker:
    """A pedestrian on a polyline (k, 2) m of samples about a metre apart.

    Attributes:
        path: the polyline; its first and last `WALK_M` metres are pavement if it is a crossing.
        at: samples along it.
        pace: m/s, negative against the polyline.
        lateral: m to the left of it.
        crossing: index of the crossing that `path` is, or -1.
        waiting: s to stand still.
    """

    path: Array
    at: float
    pace: float
    lateral: float
    crossing: int = -1
    waiting: float = 0.0

    @property
    def speed(self) -> float:
        """m/s."""
        return 0.0 if self.waiting > 0 else abs(self.pace)

    @property
    def on_road(self) -> bool:
        """Whether it stands between the kerbs."""
        return self.crossing >= 0 and WALK_M - 0.5 < self.at < len(self.path) - 0.5 - WALK_M

    def site(self) -> Site:
        """Where it stands."""
        k = min(int(self.at), len(self.path) - 2)
        (ax, ay), (bx, by) = self.path[k : k + 2].tolist()
        dx, dy = bx - ax, by - ay
        length, t = math.hypot(dx, dy), self.at - k
        x = ax + t * dx - self.lateral * dy / length
        y = ay + t * dy + self.lateral * dx / length
        return (x, y), math.atan2(dy, dx) + (math.pi if self.pace < 0 else 0.0)

    def walk(self, dt: float, road_is_safe: Callable[[Array], bool]) -> None:
        """Go on for `dt` s; turn back at the ends, and step onto the road only when it is safe there."""
        if self.waiting > 0:
            self.waiting = max(self.waiting - dt, 0.0)
            return
        before, last = self.at, len(self.path) - 1.0
        was_on_road = self.on_road
        self.at += self.pace * dt
        if self.on_road and not was_on_road and not road_is_safe(self.path.mean(axis=0)):
            self.at, self.waiting = before, 0.6
        elif not 0.0 <= self.at <= last:
            self.at, self.pace = min(max(self.at, 0.0), last), -self.pace
            self.waiting = PAUSE_S


class Street:
    """One episode's street; `objects` can be detected, `scenery` cannot.

    Attributes:
        solids: (k, 5) x, y, heading, length, width of all that stands still and stops a car.
    """

    def __init__(self, rng: np.random.Generator, params: DrivingParams, ground: Ground, catalogue: Catalogue) -> None:
        self.signals: list[Signal] = []
        self.walkers: list[Walker] = []
        self._rng, self._params, self._ground, self._catalogue = rng, params, ground, catalogue
        self._taken: list[tuple[float, float, float]] = []
        signals = self._find_signals()
        parked = self._parked()
        signs = self._signs()
        lights = [Thing(at, SIGNAL, SIGNAL_SIZE, catalogue.signals[GREEN], WHITE, SIGNAL_HEIGHT_M) for at in signals]
        posts = [_standing(thing.site, -1, SIGN_SIZE, catalogue.posts[1], WHITE) for thing in signs]
        posts += [_standing(at, -1, SIGNAL_SIZE, catalogue.posts[0], WHITE) for at in signals]
        still = [*parked, *signs, *lights]
        self.scenery = Things.of([*posts, *self._houses(), *self._trees()])
        self.solids = np.vstack([Things.of(still).footprints(), self.scenery.footprints()])
        self.objects = Things.of([*still, *self._pedestrians()])

    def step(self, dt: float, time: float, road_is_safe: Callable[[Array], bool], held_back: set[int]) -> None:
        """Move pedestrians and switch signals.

        Args:
            dt: s.
            time: s since the reset.
            road_is_safe: whether somebody may step onto the road at this point (2,) m.
            held_back: crossings on whose arm traffic must yield now.
        """
        first = len(self.objects) - len(self.walkers)
        for walker in self.walkers:
            walker.walk(dt, road_is_safe)
        if self.walkers:
            self.objects.positions[first:], self.objects.headings[first:] = zip(
                *(walker.site() for walker in self.walkers), strict=True
            )
        stopped = held_back | {walker.crossing for walker in self.walkers if walker.on_road}
        for k, signal in enumerate(self.signals, first - len(self.signals)):
            by_clock = signal.crossing < 0 and (time + 3.7 * k) % 11.0 > 5.5
            signal.switch(by_clock or signal.crossing in stopped, time)
            self.objects.meshes[k] = self._catalogue.signals[signal.color]

    def velocities(self) -> Array:
        """(n, 2) m/s of the objects."""
        out = np.zeros((len(self.objects), 2))
        first = len(self.objects) - len(self.walkers)
        speeds, headings = np.array([walker.speed for walker in self.walkers]), self.objects.headings[first:]
        out[first:, 0], out[first:, 1] = speeds * np.cos(headings), speeds * np.sin(headings)
        return out

    # --- generation ---------------------------------------------------------------------------------------------------

    def _find_signals(self) -> list[Site]:
        """Sites of the signals: at the crossings first, then anywhere along the kerbs."""
        sites: list[Site] = []
        for crossing, (x, y), heading in self._ground.posts[: self._params.n_signals]:
            self._taken.append((float(x), float(y), 0.8))
            self.signals.append(Signal(crossing))
            sites.append(((float(x), float(y)), heading))
        for _ in range(self._params.n_signals - len(sites)):
            site = self._site(math.pi, POST_M, 1.5)
            if site is not None:
                self.signals.append(Signal(-1))
                sites.append(site)
        return sites

    def _parked(self) -> list[Thing]:
        found = []
        for _ in range(self._params.n_parked):
            kind = draw_kind(self._rng, parked=True)
            site = self._site(0.0, BAY_M / 2, KINDS[kind].size[0] / 2 + 0.5, parking=True)
            if site is not None:
                mesh, tint = draw_paint(self._rng, kind, self._params.look_alike_fraction)
                found.append(_standing(site, KINDS[kind].object_class, KINDS[kind].size, mesh, tint))
        return found

    def _signs(self) -> list[Thing]:
        found = []
        common, *rare = self._catalogue.signs
        for _ in range(self._params.n_signs):
            site = self._site(math.pi, POST_M, 1.0)
            if site is not None:
                usual = self._rng.uniform() < self._params.look_alike_fraction
                mesh = common if usual else rare[int(self._rng.integers(len(rare)))]
                found.append(Thing(site, SIGN, SIGN_SIZE, mesh, WHITE, SIGN_HEIGHT_M))
        return found

    def _houses(self) -> list[Thing]:
        found = []
        for _ in range(self._params.n_buildings):
            k = int(self._rng.integers(len(self._catalogue.houses)))
            length, depth = self._catalogue.footprints[k]
            outward = BAY_M + PAVEMENT_M + 1.0 + depth / 2
            site = self._site(math.pi, outward, 0.55 * length, wider=2.0, room=outward + depth / 2 - 1.0)
            if site is not None:
                wall = draw(self._rng, WALLS)
                found.append(_standing(site, -1, (length, depth, 0.0), self._catalogue.houses[k], wall))
        return found

    def _trees(self) -> list[Thing]:
        found = []
        for _ in range(self._params.n_trees):
            outward = BAY_M + PAVEMENT_M + float(self._rng.uniform(0.2, 4.0))
            site = self._site(float(self._rng.uniform(0, 6)), outward, 1.3, wider=2.0, islands=True)
            if site is not None:
                mesh = self._catalogue.trees[int(self._rng.integers(len(self._catalogue.trees)))]
                found.append(_standing(site, -1, (0.4, 0.4, 0.0), mesh, draw(self._rng, LEAVES)))
        return found

    def _pedestrians(self) -> list[Thing]:
        found = []
        for _ in range(self._params.n_pedestrians):
            walker = self._draw_walker()
            if walker is not None:
                self.walkers.append(walker)
                coat = draw_coat(self._rng, self._params.look_alike_fraction)
                found.append(_standing(walker.site(), PEDESTRIAN, PERSON_SIZE, self._catalogue.person, coat))
        return found

    def _draw_walker(self) -> Walker | None:
        rng, ground = self._rng, self._ground
        pace = float(rng.uniform(1.0, 1.6) * rng.choice([-1.0, 1.0]))
        if ground.crossings and rng.uniform() < self._params.crossing_share:
            k = int(rng.integers(len(ground.crossings)))
            path = ground.crossings[k]
            start = 0.0 if pace > 0 else len(path) - 1.0
            return Walker(path, start, pace, float(rng.uniform(-1.0, 1.0)), k, float(rng.uniform(0.0, 3.0)))
        if not ground.pavements:
            return None
        paths = [self._weights(path, 0.7) for path in ground.pavements]
        totals = np.array([weights.sum() for weights in paths])
        k = int(rng.choice(len(paths), p=totals / totals.sum()))
        at = float(rng.choice(len(paths[k]), p=paths[k] / totals[k]))
        return Walker(ground.pavements[k], at, pace, float(rng.uniform(-1.1, 1.1)))

    def _site(
        self,
        turn: float,
        outward: float,
        radius: float,
        *,
        wider: float = 1.0,
        room: float = 0.0,
        parking: bool = False,
        islands: bool = False,
    ) -> Site | None:
        """A free site `outward` m from a kerb, heading along the traffic plus `turn`; None after a few tries."""
        sites = self._ground.sites(outward, max(room, outward), parking=parking, islands=islands)
        if len(sites) == 0:
            return None
        cumulative = np.cumsum(self._weights(sites[:, :2], wider))
        for _ in range(SITE_TRIES):
            x, y, heading = sites[int(np.searchsorted(cumulative, self._rng.uniform() * cumulative[-1]))].tolist()
            if all((x - a) ** 2 + (y - b) ** 2 >= (radius + r) ** 2 for a, b, r in self._taken):
                self._taken.append((x, y, radius))
                return (x, y), heading + turn
        return None

    def _weights(self, places: Array, wider: float) -> Array:
        """How busy each place (k, 2) is: a Gaussian of its distance from the focus."""
        distance = np.hypot(*(places - self._ground.focus).T)
        return np.exp(-0.5 * (distance / (wider * self._params.street_spread_m)) ** 2) + 1e-9


def _standing(site: Site, kind: int, size: Size, mesh: int, tint: Tint) -> Thing:
    """A thing that stands on the ground."""
    return Thing(site, kind, size, mesh, tint, size[2] / 2)
