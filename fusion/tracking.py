"""Objects over time: constant-velocity Kalman filters in one frame, with association, birth and death.

Measurements carry their own time stamp. One that arrives late is handled at that time: the tracker keeps the batches of
the last seconds, goes back to the state before the late one, and takes them all in again in order.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from ..matching.checks import check_count, check_interval, finite, shaped
from ..matching.pose import Array


@dataclass(frozen=True)
class TrackerOptions:
    """How objects move, appear and disappear.

    Attributes:
        acceleration_std: m/s^2, of the white-noise acceleration, per axis; 0 for objects that stand still.
        initial_speed_std: m/s, of a new track's velocity, per axis.
        gate: squared Mahalanobis distance up to which a measurement may be a track's.
        confirm_hits: measurements that confirm a track.
        timeout_s: a confirmed track unseen for longer dies; a tentative one after `tentative_timeout_s`.
        history_s: how far back late measurements are still handled; older ones are dropped.

    Raises:
        ValueError: a value out of its range.
    """

    acceleration_std: float = 1.0
    initial_speed_std: float = 3.0
    gate: float = 16.0
    confirm_hits: int = 2
    timeout_s: float = 2.0
    tentative_timeout_s: float = 0.5
    history_s: float = 2.0

    def __post_init__(self) -> None:
        for name in ("acceleration_std", "initial_speed_std", "timeout_s", "tentative_timeout_s", "history_s"):
            check_interval(name, getattr(self, name), "[0, inf]")
        check_interval("gate", self.gate, "(0, inf]")
        check_count("confirm_hits", self.confirm_hits)


@dataclass(frozen=True, eq=False)
class Batch:
    """Measurements of one instant.

    Attributes:
        time: s, when they were measured.
        positions: (n, 3) m, the tracker's frame. covariances: (n, 3, 3) m^2.
        classes: (n,) int64, or None; measurements of another class than the track's are not associated with it.

    Raises:
        ValueError: shapes that do not fit, or a value that is not finite.
    """

    time: float
    positions: Array
    covariances: Array
    classes: NDArray[np.int64] | None = None

    def __post_init__(self) -> None:
        check_interval("time", self.time, "(-inf, inf)")
        positions = finite(self.positions, "positions")
        n = len(positions) if positions.ndim else 0
        object.__setattr__(self, "positions", shaped(positions, "positions", (n, 3)))
        object.__setattr__(self, "covariances", shaped(self.covariances, "covariances", (n, 3, 3)))
        if self.classes is not None and np.shape(self.classes) != (n,):
            raise ValueError(f"classes must have shape ({n},), got {np.shape(self.classes)}")


@dataclass(frozen=True, eq=False)
class Tracks:
    """The tracker's state at one time, n tracks.

    Attributes:
        time: s.
        ids: (n,) int64, never reused.
        states: (n, 6) position m and velocity m/s. covariances: (n, 6, 6).
        hits: (n,) int64 measurements so far. last_seen: (n,) s.
        classes: (n,) int64, -1 = unknown.
        next_id: id of the next track born.
    """

    time: float
    ids: NDArray[np.int64]
    states: Array
    covariances: Array
    hits: NDArray[np.int64]
    last_seen: Array
    classes: NDArray[np.int64]
    next_id: int

    @classmethod
    def none(cls, time: float = -np.inf) -> Tracks:
        """No track."""
        empty = np.zeros(0, dtype=np.int64)
        return cls(time, empty, np.zeros((0, 6)), np.zeros((0, 6, 6)), empty, np.zeros(0), empty, 0)

    def __len__(self) -> int:
        return len(self.ids)

    @property
    def positions(self) -> Array:
        """(n, 3) m."""
        return self.states[:, :3]

    @property
    def position_covariances(self) -> Array:
        """(n, 3, 3) m^2."""
        return self.covariances[:, :3, :3]

    def take(self, keep: NDArray[np.bool_]) -> Tracks:
        """The tracks where `keep` (n,) holds."""
        return Tracks(
            self.time,
            self.ids[keep],
            self.states[keep],
            self.covariances[keep],
            self.hits[keep],
            self.last_seen[keep],
            self.classes[keep],
            self.next_id,
        )


@dataclass(frozen=True, eq=False)
class _Past:
    """A batch already taken in: the state before it, and where its measurements went."""

    batch: Batch
    before: Tracks
    labels: NDArray[np.int64]


class Tracker:
    """Tracks of all objects in one fixed frame.

    Feed batches in any order of arrival; `tracks` is the state after the latest measured one, `at(time)` predicts it.
    """

    def __init__(self, options: TrackerOptions | None = None) -> None:
        self.options = options or TrackerOptions()
        self.reset()

    def reset(self) -> None:
        """Forget everything: a new episode."""
        self.tracks = Tracks.none()
        self.dropped = 0
        self._history: list[_Past] = []

    def update(self, batch: Batch) -> NDArray[np.int64]:
        """Take in one batch, at its own time.

        Returns:
            (n,) id of the track each measurement went to, as of now; -1 for all of a batch older than the history.
        """
        newest = self._history[-1].batch.time if self._history else -np.inf
        if batch.time < newest - self.options.history_s:
            self.dropped += 1
            return np.full(len(batch.positions), -1, dtype=np.int64)
        later = [past for past in self._history if past.batch.time > batch.time]
        state = self.tracks
        if later:
            # Ids stay unique although the past is written anew.
            state = replace(later[0].before, next_id=self.tracks.next_id)
            del self._history[-len(later) :]
        labels, state = self._advance(state, batch, None)
        self._replay(state, later)
        return labels

    def revise(self, batch: Batch, same: int) -> NDArray[np.int64]:
        """Put a batch in the place of the one taken in for the same time: more is known of that time now.

        Args:
            same: so many measurements, the first, are those of the old batch, known better; others may follow.

        Returns:
            As `update`.

        Raises:
            ValueError: `same` is more than either batch has.
            KeyError: no batch of that time is in the history.
        """
        index = next((k for k, past in enumerate(self._history) if past.batch.time == batch.time), None)
        if index is None:
            raise KeyError(f"no batch of time {batch.time} is in the history")
        past, *later = self._history[index:]
        if not 0 <= same <= min(len(past.labels), len(batch.positions)):
            raise ValueError(f"same must lie in 0..{min(len(past.labels), len(batch.positions))}, got {same}")
        remembered = np.full(len(batch.positions), -1, dtype=np.int64)
        remembered[:same] = past.labels[:same]
        state = replace(past.before, next_id=self.tracks.next_id)
        del self._history[index:]
        labels, state = self._advance(state, batch, remembered)
        self._replay(state, later)
        return labels

    def labels(self, time: float) -> NDArray[np.int64]:
        """Track id (n,) of each measurement of the batch of that time. Raises KeyError where the history has none."""
        for past in reversed(self._history):
            if past.batch.time == time:
                return past.labels
        raise KeyError(f"no batch of time {time} is in the history")

    def _replay(self, state: Tracks, later: list[_Past]) -> None:
        """Take in again what came after the state."""
        for past in later:
            _, state = self._advance(state, past.batch, past.labels)
        self.tracks = state
        self._forget()

    def confirmed(self) -> Tracks:
        """Tracks with enough measurements."""
        return self.tracks.take(self.tracks.hits >= self.options.confirm_hits)

    def at(self, time: float) -> Tracks:
        """Confirmed tracks predicted to `time` s, which must not lie before the last measurement."""
        tracks = self.confirmed()
        if time < tracks.time:
            raise ValueError(f"time {time} lies before the last measurement at {tracks.time}")
        return predict(tracks, time, self.options.acceleration_std)

    def _advance(
        self, before: Tracks, batch: Batch, remembered: NDArray[np.int64] | None
    ) -> tuple[NDArray[np.int64], Tracks]:
        labels, after = step(before, batch, self.options, remembered)
        self._history.append(_Past(batch, before, labels))
        return labels, after

    def _forget(self) -> None:
        newest = self._history[-1].batch.time
        while self._history[0].batch.time < newest - self.options.history_s:
            self._history.pop(0)


def step(
    tracks: Tracks, batch: Batch, options: TrackerOptions, remembered: NDArray[np.int64] | None = None
) -> tuple[NDArray[np.int64], Tracks]:
    """One batch: predict, associate, update, bury, give birth.

    Args:
        remembered: (n,) track ids the measurements went to when the batch was taken in before; a birth keeps its id.

    Returns:
        Each measurement's track id (n,), and the new tracks.
    """
    predicted = predict(tracks, batch.time, options.acceleration_std) if len(tracks) else tracks
    labels = np.full(len(batch.positions), -1, dtype=np.int64)
    states, covariances = predicted.states.copy(), predicted.covariances.copy()
    hits, last_seen, classes = predicted.hits.copy(), predicted.last_seen.copy(), predicted.classes.copy()
    measurement_classes = np.full(len(batch.positions), -1, dtype=np.int64) if batch.classes is None else batch.classes
    cost = _costs(states, covariances, classes, batch.positions, batch.covariances, measurement_classes, options.gate)
    for track, measurement in zip(*linear_sum_assignment(np.where(np.isinf(cost), 1e9, cost)), strict=True):
        if np.isinf(cost[track, measurement]):
            continue
        _kalman_update(states[track], covariances[track], batch.positions[measurement], batch.covariances[measurement])
        labels[measurement] = predicted.ids[track]
        hits[track] += 1
        last_seen[track] = batch.time
        classes[track] = max(classes[track], measurement_classes[measurement])
    unseen = batch.time - last_seen
    alive = unseen <= np.where(hits >= options.confirm_hits, options.timeout_s, options.tentative_timeout_s)
    born = np.flatnonzero(labels < 0)
    next_id = tracks.next_id
    taken = set(predicted.ids.tolist()) | set(labels.tolist())
    for measurement in born.tolist():
        old = -1 if remembered is None else int(remembered[measurement])
        if old < 0 or old in taken:
            old, next_id = next_id, next_id + 1
        labels[measurement] = old
        taken.add(old)
    new_covariances = np.zeros((len(born), 6, 6))
    new_covariances[:, :3, :3] = batch.covariances[born]
    new_covariances[:, 3:, 3:] = options.initial_speed_std**2 * np.eye(3)
    return labels, Tracks(
        batch.time,
        np.concatenate([predicted.ids[alive], labels[born]]),
        np.concatenate([states[alive], np.column_stack([batch.positions[born], np.zeros((len(born), 3))])]),
        np.concatenate([covariances[alive], new_covariances]),
        np.concatenate([hits[alive], np.ones(len(born), dtype=np.int64)]),
        np.concatenate([last_seen[alive], np.full(len(born), batch.time)]),
        np.concatenate([classes[alive], measurement_classes[born]]),
        max(next_id, int(labels.max(initial=-1)) + 1),
    )


def predict(tracks: Tracks, time: float, acceleration_std: float) -> Tracks:
    """Tracks carried to a later time at constant velocity."""
    dt = time - tracks.time if np.isfinite(tracks.time) else 0.0
    F = np.eye(6)
    F[:3, 3:] = dt * np.eye(3)
    q = acceleration_std**2
    Q = np.zeros((6, 6))
    Q[:3, :3] = q * dt**4 / 4 * np.eye(3)
    Q[:3, 3:] = Q[3:, :3] = q * dt**3 / 2 * np.eye(3)
    Q[3:, 3:] = q * dt**2 * np.eye(3)
    return Tracks(
        time,
        tracks.ids,
        tracks.states @ F.T,
        F @ tracks.covariances @ F.T + Q,
        tracks.hits,
        tracks.last_seen,
        tracks.classes,
        tracks.next_id,
    )


@njit(cache=True)
def _invert_symmetric(A: Array) -> tuple[Array, float]:
    """Inverse (3, 3) and determinant."""
    out = np.empty((3, 3))
    out[0, 0] = A[1, 1] * A[2, 2] - A[1, 2] * A[1, 2]
    out[0, 1] = out[1, 0] = A[0, 2] * A[1, 2] - A[0, 1] * A[2, 2]
    out[0, 2] = out[2, 0] = A[0, 1] * A[1, 2] - A[0, 2] * A[1, 1]
    out[1, 1] = A[0, 0] * A[2, 2] - A[0, 2] * A[0, 2]
    out[1, 2] = out[2, 1] = A[0, 1] * A[0, 2] - A[0, 0] * A[1, 2]
    out[2, 2] = A[0, 0] * A[1, 1] - A[0, 1] * A[0, 1]
    det = A[0, 0] * out[0, 0] + A[0, 1] * out[0, 1] + A[0, 2] * out[0, 2]
    return out / det, det


@njit(cache=True)
def _costs(
    states: Array,
    covariances: Array,
    classes: NDArray[np.int64],
    positions: Array,
    noise: Array,
    measurement_classes: NDArray[np.int64],
    gate: float,
) -> Array:
    """Negative log-likelihoods (tracks, measurements), shifted; inf beyond the gate or between classes."""
    n, m = len(states), len(positions)
    cost = np.full((n, m), np.inf)
    S = np.empty((3, 3))
    for i in range(n):
        for j in range(m):
            if classes[i] >= 0 and measurement_classes[j] >= 0 and classes[i] != measurement_classes[j]:
                continue
            for a in range(3):
                for b in range(3):
                    S[a, b] = covariances[i, a, b] + noise[j, a, b]
                S[a, a] += 1e-9
            W, det = _invert_symmetric(S)
            squared = 0.0
            for a in range(3):
                for b in range(3):
                    squared += (positions[j, a] - states[i, a]) * W[a, b] * (positions[j, b] - states[i, b])
            if squared <= gate:
                cost[i, j] = squared + np.log(det)
    return cost


@njit(cache=True)
def _kalman_update(state: Array, P: Array, position: Array, noise: Array) -> None:
    """Joseph-form update of one track (6,), (6, 6) by a position (3,), (3, 3), in place."""
    S = P[:3, :3] + noise + 1e-9 * np.eye(3)
    W, _ = _invert_symmetric(S)
    K = np.ascontiguousarray(P[:, :3]) @ W
    state += K @ (position - state[:3])
    A = np.eye(6)
    A[:, :3] -= K
    P[:] = A @ P @ A.T + K @ np.ascontiguousarray(noise) @ K.T
