"""Dead reckoning of the MRCLAM robots, and the calibration of odometry and camera that their own readings allow.

Two things in these logs are not what their headers say. The odometry is what the robots were told to do: on sequence 6
the motion follows 0.2 to 0.25 s later, and turns are 0.91 to 0.95 as large. And the range is the distance along the
optical axis, short by the cosine of the bearing: that explains 92 to 98 % of its error's variance there. Both show
without any truth, in how a robot's readings of a landmark that stands still move from one moment to the next, and are
calibrated from them, robot by robot; short logs are left as they are.
"""

from __future__ import annotations

from collections.abc import Set
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from ..matching.pose import Array

MAX_COAST_S = 1.0
"""Longest time an odometry reading is held, s: a longer gap is taken as standing still."""
MIN_CALIBRATION_PAIRS = 300
"""Successive readings of landmarks below which odometry is not calibrated."""
CALIBRATION_DELAYS_S = tuple(0.05 * k for k in range(9))
"""Delays of the motion behind the odometry that are tried, s."""
CAMERA_RANGE_SCALE = 1.036
"""Depth that the platform's cameras report over true depth: 1.025 to 1.052 on the five robots of sequence 6, measured
there with motion capture; a robot's own readings cannot tell it."""


@dataclass(frozen=True, eq=False)
class Track:
    """Planar poses over time: times (k,) s, states (k, 3) x m, y m, unwrapped heading rad."""

    times: Array
    states: Array


def integrate_odometry(odometry: Array) -> Track:
    """Dead reckoning from readings (k, 3) of time s, speed m/s and turn rate rad/s, each held until the next."""
    times, speed, turn = odometry.T
    held = np.minimum(np.diff(times), MAX_COAST_S)
    states = np.zeros((len(times), 3))
    states[1:, 2] = np.cumsum(turn[:-1] * held)
    # A chord of the arc: the speed shrinks by sinc(half the turn) and points along the middle heading.
    half = 0.5 * turn[:-1] * held
    chord = speed[:-1] * held * np.sinc(half / np.pi)
    middle = states[:-1, 2] + half
    states[1:, 0] = np.cumsum(chord * np.cos(middle))
    states[1:, 1] = np.cumsum(chord * np.sin(middle))
    return Track(times, states)


def pose_at(track: Track, time: float) -> Array:
    """Pose (4, 4) at a time, interpolated linearly; beyond the ends the nearest."""
    x, y, heading = states_at(track, np.array([time]))[0]
    T = np.eye(4)
    T[:2, :2] = [[np.cos(heading), -np.sin(heading)], [np.sin(heading), np.cos(heading)]]
    T[:2, 3] = x, y
    return T


def states_at(track: Track, times: Array) -> Array:
    """States (n, 3) interpolated at times (n,)."""
    return np.stack([np.interp(times, track.times, column) for column in track.states.T], axis=1).astype(np.float64)


@dataclass(frozen=True)
class Calibration:
    """What a robot's own readings say about its odometry and its camera.

    Attributes:
        delay_s: of the motion behind the odometry.
        speed_gain, turn_gain: real motion over odometry.
        axis_exponent, range_scale: true range = reading / (range_scale * cos(bearing) ** axis_exponent); the exponent
            is 0 for a range, 1 for a depth along the axis.
    """

    delay_s: float
    speed_gain: float
    turn_gain: float
    axis_exponent: float
    range_scale: float = 1.0

    def dead_reckoning(self, odometry: Array) -> Track:
        """Corrected odometry (k, 3), integrated."""
        gains = np.array([self.speed_gain, self.turn_gain])
        return integrate_odometry(np.column_stack([odometry[:, 0] + self.delay_s, odometry[:, 1:] * gains]))

    def readings(self, readings: Array) -> Array:
        """Readings (n, 4) with their range corrected."""
        corrected = readings.copy()
        corrected[:, 2] /= self.range_scale * np.maximum(np.cos(readings[:, 3]), 0.1) ** self.axis_exponent
        return corrected


UNCALIBRATED = Calibration(0.0, 1.0, 1.0, 0.0)


def calibrate(odometry: Array, readings: Array, landmark_barcodes: Set[int]) -> Calibration:
    """The calibration that explains best how barcodes that stand still move in view.

    Args:
        odometry: (k, 3) time s, speed m/s, turn rate rad/s.
        readings: (n, 4) time s, barcode, range m, bearing rad.
        landmark_barcodes: barcodes that do not move.

    Returns:
        UNCALIBRATED where there are fewer than MIN_CALIBRATION_PAIRS successive readings.
    """
    before, after = _successive(readings, landmark_barcodes)
    if len(before) < MIN_CALIBRATION_PAIRS:
        return UNCALIBRATED

    def errors(x: Array, delay: float) -> Array:
        trial = Calibration(delay, float(x[0]), float(x[1]), float(x[2]))
        return _prediction_errors(trial.dead_reckoning(odometry), trial.readings(before), trial.readings(after))

    start = np.array([1.0, 1.0, 0.0])
    fits = []
    for delay in CALIBRATION_DELAYS_S:
        fit = least_squares(errors, start, args=(delay,), loss="soft_l1", max_nfev=20)
        fits.append((float(fit.cost), delay, fit.x))
        start = fit.x
    _, delay, best = min(fits, key=lambda f: f[0])
    scale = CAMERA_RANGE_SCALE if best[2] > 0.5 else 1.0
    # Landmarks and odometry fix speed over range only: the motion shrinks with the ranges.
    return Calibration(delay, float(best[0]) / scale, float(best[1]), float(best[2]), scale)


def _successive(readings: Array, barcodes: Set[int]) -> tuple[Array, Array]:
    """Readings (m, 4) and the next reading (m, 4) of the same barcode, at most 1.5 s later."""
    before, after = [np.zeros((0, 4))], [np.zeros((0, 4))]
    for barcode in barcodes:
        own = readings[readings[:, 1] == barcode]
        gap = np.diff(own[:, 0])
        near = (gap > 0) & (gap < 1.5)
        before.append(own[:-1][near])
        after.append(own[1:][near])
    return np.concatenate(before), np.concatenate(after)


def _prediction_errors(track: Track, before: Array, after: Array) -> Array:
    """Errors in range and bearing, over their typical size, of predicting a reading from the last by the odometry."""
    start, end = states_at(track, before[:, 0]), states_at(track, after[:, 0])
    # Landmark in the dead-reckoning frame, then seen from the later pose.
    heading = start[:, 2] + before[:, 3]
    dx = start[:, 0] + before[:, 2] * np.cos(heading) - end[:, 0]
    dy = start[:, 1] + before[:, 2] * np.sin(heading) - end[:, 1]
    bearing = after[:, 3] - np.arctan2(dy, dx) + end[:, 2]
    bearing = (bearing + np.pi) % (2 * np.pi) - np.pi
    return np.concatenate([(after[:, 2] - np.hypot(dx, dy)) / 0.03, bearing / 0.01])
