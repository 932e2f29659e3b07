"""What one robot remembers: the landmarks it saw, in its own moving frame, by its odometry.

A Kalman filter over all landmarks at once, because an error of the robot's heading swings them together: one that is
seen again puts all the others right. The robot stays at the origin; what moves are the landmarks.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..matching.checks import check_count, check_interval
from ..matching.graph import ObjectGraph
from ..matching.pose import Array, invert, transform
from .posefilter import heading, levelling

RECENT_FRAMES = 2
"""A landmark seen so many frames ago was seen just now."""


@dataclass(frozen=True)
class MapOptions:
    """What is remembered, and for how long; tuned on the first 450 s of MRCLAM's sequence 6, frames of 1 s.

    Attributes:
        odometry_std_m, odometry_std_per_m: translation error of one step, and per metre of it.
        odometry_std_rad, odometry_std_per_rad: heading error of one step, and per radian of its turn.
        gate: squared Mahalanobis distance up to which a detection may be the landmark's.
        doubt: what a pair of detection and landmark costs, on the scale of squared Mahalanobis distance plus log
            determinant (m^2 to the third): pairs must make up for it to be believed.
        trials: first pairs tried.
        confirmed: sightings less misses that make a landmark; what moves does not come to so many.
        miss: what one miss takes away; a landmark in plain view is often not detected.
        known: most sightings that count.
        plain: share of the field of view's width, and of the farthest detection's range, that is plain view.
        moved_m: a detection this close to a landmark that was seen just now and is not there any more is the same
            object, and that moves.
        patience: frames that one which is not confirmed waits for its next sighting.
        memory: frames without a sighting after which a landmark is forgotten; memories of 60 and 180 made the
            matching of maps worse.
        floor_m: 1 sigma that is left however often a landmark was seen.
        max_std_m: one that is less certain than this is not shown to the matcher.

    Raises:
        ValueError: a value out of its range.
    """

    odometry_std_m: float = 0.006
    odometry_std_per_m: float = 0.06
    odometry_std_rad: float = 0.01
    odometry_std_per_rad: float = 0.07
    gate: float = 11.0
    doubt: float = 3.0
    trials: int = 12
    confirmed: float = 3.0
    miss: float = 0.5
    known: float = 8.0
    plain: float = 0.7
    moved_m: float = 0.4
    patience: int = 3
    memory: int = 40
    floor_m: float = 0.02
    max_std_m: float = 0.3

    def __post_init__(self) -> None:
        for field in fields(self):
            if field.name in ("trials", "patience", "memory"):
                check_count(field.name, getattr(self, field.name), 0)
            elif field.name != "doubt":
                check_interval(field.name, getattr(self, field.name), "[0, inf)")
        check_interval("doubt", self.doubt, "(-inf, inf)")


class _Fit(NamedTuple):
    """Detections taken for landmarks: total cost, landmark (n,) of each or -1, and the map corrected by them."""

    cost: float
    landmark: NDArray[np.int64]
    positions: Array
    covariance: Array


class LocalMap:
    """Landmarks around one robot; what moves is dropped.

        map.predict(odometry, graph.up)
        remembered = map.see(graph)

    Attributes:
        positions: (k, 3) m, sensor frame now.
        covariance: (3 k, 3 k) m^2 of all of them.
    """

    def __init__(self, options: MapOptions | None = None) -> None:
        self.options = options or MapOptions()
        self.positions: Array = np.zeros((0, 3))
        self.covariance: Array = np.zeros((0, 0))
        self._sightings: Array = np.zeros(0)
        self._age: NDArray[np.int64] = np.zeros(0, dtype=np.int64)
        self._looks: ObjectGraph | None = None
        self._reach = 0.0

    def predict(self, odometry: Array, up: Array) -> None:
        """The robot has moved by `odometry` (4, 4), its own motion in its sensor frame; `up` (3,) is level."""
        o, k = self.options, len(self.positions)
        if k == 0:
            return
        R = odometry[:3, :3].T
        self.positions = transform(invert(odometry), self.positions)
        C = np.einsum("ab,ibjc,dc->iajd", R, self.covariance.reshape(k, 3, k, 3), R).reshape(3 * k, 3 * k)
        step = o.odometry_std_m + o.odometry_std_per_m * float(np.linalg.norm(odometry[:3, 3]))
        level = levelling(up)
        turn = o.odometry_std_rad + o.odometry_std_per_rad * abs(heading(level @ odometry[:3, :3] @ level.T))
        # A wrong heading swings all landmarks together, a wrong step shifts them together.
        swing = np.cross(up, self.positions).ravel()
        level_shift = np.tile(np.eye(3) - np.outer(up, up), (k, k))
        self.covariance = C + turn**2 * np.outer(swing, swing) + step**2 * level_shift
        self._age += 1
        lasting = np.where(self._sightings >= o.confirmed, o.memory, o.patience)
        self._take(np.flatnonzero(self._age <= lasting))

    def see(self, graph: ObjectGraph) -> ObjectGraph:
        """Take in a frame's detections; the same, steadied by the memory, and after them what else is remembered.

        The result has no field of view: what is remembered may lie anywhere.
        """
        landmark = self._associate(graph)
        landmark = self._forget(graph, landmark)
        new = np.flatnonzero(landmark < 0)
        landmark[new] = len(self.positions) + np.arange(len(new))
        self._add(graph.take(new))
        self._age[landmark] = 0
        self._sightings[landmark] = np.minimum(self._sightings[landmark] + 1, self.options.known)
        return self._graph(landmark, graph)

    def _graph(self, first: NDArray[np.int64], frame: ObjectGraph) -> ObjectGraph:
        """The landmarks `first`, then the others that are sure enough."""
        assert self._looks is not None
        C = _blocks(self.covariance)
        others = (self._sightings >= self.options.confirmed) & (
            np.sqrt(np.trace(C, axis1=1, axis2=2)) < self.options.max_std_m
        )
        others[first] = False
        chosen = np.concatenate([first, np.flatnonzero(others)])
        p, C = self.positions[chosen], C[chosen] + self.options.floor_m**2 * np.eye(3)
        ray = p / np.maximum(np.linalg.norm(p, axis=1), 1e-9)[:, None]
        return replace(
            self._looks.take(chosen),
            positions=p,
            covariances=C,
            position_variance=np.einsum("ni,nij,nj->n", ray, C, ray),
            up=frame.up,
            horizontal_fov_rad=None,
            intrinsics=None,
        )

    def _associate(self, graph: ObjectGraph) -> NDArray[np.int64]:
        """Landmark (n,) of every detection, -1 for none; corrects the map by them.

        Neighbours are easily taken for each other after a turn, when all landmarks are off together. So several first
        pairs are tried, each followed by what is closest once the map is corrected; the likeliest whole is taken.
        """
        best = _Fit(0.0, np.full(len(graph), -1), self.positions, self.covariance)
        if len(graph) and len(self.positions):
            R = graph.full_covariances()
            cost, _, _ = self._compare(best, graph.positions, R)
            order = np.argsort(cost, axis=None)[: self.options.trials]
            for first in order[np.isfinite(cost.ravel()[order])]:
                fit = self._fit(best, graph.positions, R, int(first))
                best = fit if fit.cost < best.cost else best
        self.positions, self.covariance = best.positions, best.covariance
        return best.landmark

    def _fit(self, start: _Fit, seen: Array, R: Array, first: int) -> _Fit:
        """Pairs from the first (flat index into detections x landmarks) on, until none passes the gate."""
        fit = _Fit(0.0, np.full(len(seen), -1), self.positions, self.covariance)
        while True:
            cost, off, W = self._compare(fit, seen, R)
            at = int(np.argmin(cost)) if (fit.landmark >= 0).any() else first
            i, a = divmod(at, len(self.positions))
            if not np.isfinite(cost[i, a]):
                return fit
            rows = slice(3 * a, 3 * a + 3)
            gain = fit.covariance[:, rows] @ W[i, a]
            covariance = fit.covariance - gain @ fit.covariance[rows]
            landmark = fit.landmark.copy()
            landmark[i] = a
            moved = fit.positions + (gain @ off[i, a]).reshape(-1, 3)
            fit = _Fit(fit.cost + float(cost[i, a]), landmark, moved, 0.5 * (covariance + covariance.T))

    def _compare(self, fit: _Fit, seen: Array, R: Array) -> tuple[Array, Array, Array]:
        """Of every detection with every landmark: cost (n, k), inf where impossible; offset; inverse covariance."""
        off = seen[:, None] - fit.positions
        W: Array = np.asarray(np.linalg.inv(R[:, None] + _blocks(fit.covariance)), dtype=np.float64)
        squared = np.einsum("nki,nkij,nkj->nk", off, W, off)
        possible = squared < self.options.gate
        possible[fit.landmark >= 0] = False
        possible[:, fit.landmark[fit.landmark >= 0]] = False
        return np.where(possible, squared - np.log(np.linalg.det(W)) + self.options.doubt, np.inf), off, W

    def _forget(self, graph: ObjectGraph, landmark: NDArray[np.int64]) -> NDArray[np.int64]:
        """Count what should have been seen, drop what has gone or moved; `landmark` in the numbers of what stays."""
        o = self.options
        missed = np.ones(len(self.positions), dtype=np.bool_)
        missed[landmark[landmark >= 0]] = False
        self._reach = max(self._reach, float(np.linalg.norm(graph.positions, axis=1).max(initial=0.0)))
        if graph.horizontal_fov_rad is not None and graph.forward is not None:
            r = np.linalg.norm(self.positions, axis=1)
            ahead = self.positions @ graph.forward > r * np.cos(o.plain * graph.horizontal_fov_rad / 2)
            self._sightings[missed & ahead & (r < o.plain * self._reach)] -= o.miss
        new = graph.positions[landmark < 0]
        apart = np.linalg.norm(self.positions[:, None] - new, axis=2).min(axis=1, initial=np.inf)
        moved = (self._age <= RECENT_FRAMES) & (apart < o.moved_m)
        keep = ~missed | (~moved & (self._sightings > 0))
        self._take(np.flatnonzero(keep))
        number = np.append(np.cumsum(keep) - 1, -1)
        return np.asarray(number[landmark])

    def _add(self, graph: ObjectGraph) -> None:
        """Make landmarks of detections."""
        k, n = len(self.positions), len(graph)
        C = np.zeros((k + n, 3, k + n, 3))
        C[:k, :, :k] = self.covariance.reshape(k, 3, k, 3)
        new = np.arange(k, k + n)
        C[new, :, new] = graph.full_covariances()
        self.positions = np.concatenate([self.positions, graph.positions])
        self.covariance = C.reshape(3 * (k + n), 3 * (k + n))
        self._sightings = np.concatenate([self._sightings, np.zeros(n)])
        self._age = np.concatenate([self._age, np.zeros(n, dtype=np.int64)])
        self._looks = graph if self._looks is None else _joined(self._looks, graph)

    def _take(self, index: NDArray[np.int64]) -> None:
        """Keep the landmarks at `index`, in that order."""
        rows = (3 * index[:, None] + np.arange(3)).ravel()
        self.positions, self.covariance = self.positions[index], self.covariance[np.ix_(rows, rows)]
        self._sightings, self._age = self._sightings[index], self._age[index]
        self._looks = None if self._looks is None else self._looks.take(index)


def _blocks(covariance: Array) -> Array:
    """Covariances (k, 3, 3) of the single landmarks, of all together (3 k, 3 k)."""
    k = len(covariance) // 3
    each = np.arange(k)
    return np.asarray(covariance.reshape(k, 3, k, 3)[each, :, each])


def _joined(first: ObjectGraph, second: ObjectGraph) -> ObjectGraph:
    """The objects of both."""
    names = ("positions", "attributes", "position_variance", "attribute_variance")
    arrays: dict[str, Any] = {name: np.concatenate([getattr(first, name), getattr(second, name)]) for name in names}
    embedding = None
    if first.embedding is not None and second.embedding is not None:
        embedding = np.concatenate([first.embedding, second.embedding])
    covariances = np.concatenate([first.full_covariances(), second.full_covariances()])
    return replace(first, **arrays, covariances=covariances, embedding=embedding)
