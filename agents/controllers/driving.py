"""A driver for connected vehicles that knows only what its own vehicle knows: its state and its own detections.

`ConnectedDrivingWorld.idm_controls` is the privileged driver, with highway-env's view of the whole road.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class LaneDriver:
    """Keeps its lane, and its distance to what is seen ahead: the Intelligent Driver Model on one's own detections.

    Attributes:
        cruise_speed: m/s.
        jam_distance_m: distance of the camera to the object ahead at a standstill.
        time_gap_s: further distance per speed.
        corridor_m: half width of the corridor ahead in which objects count.
        acceleration: m/s^2, comfortable; `max_acceleration` and `max_steering_rad` are the vehicle's at control 1.
        lateral_gain, heading_gain: steering (rad) per metre off the lane's centre and per radian off its direction.
    """

    cruise_speed: float = 5.0
    jam_distance_m: float = 7.0
    time_gap_s: float = 1.2
    corridor_m: float = 1.7
    acceleration: float = 2.5
    max_acceleration: float = 5.0
    max_steering_rad: float = 0.6
    lateral_gain: float = 0.12
    heading_gain: float = 0.8

    def __call__(self, state: Array, positions: Array) -> Array:
        """Control (2,) in [-1, 1]: acceleration and steering.

        Args:
            state: (5,) own speed m/s, yaw rate rad/s, offset to the left of the lane m, heading relative to it rad,
                speed limit m/s (0: none).
            positions: (n, 3) m, detected objects in the camera frame (x right, y down, z forward).

        Raises:
            ValueError: wrong shapes.
        """
        own, seen = np.asarray(state, dtype=np.float64), np.asarray(positions, dtype=np.float64)
        if own.shape != (5,) or seen.ndim != 2 or seen.shape[1] != 3:
            raise ValueError(f"state must have shape (5,) and positions (n, 3), got {own.shape} and {seen.shape}")
        speed, _, offset, turned, limit = own
        wanted = min(self.cruise_speed, limit) if limit > 0 else self.cruise_speed
        gas = self.acceleration * (1.0 - (max(speed, 0.0) / wanted) ** 4)
        ahead = seen[(seen[:, 2] > 0.5) & (np.abs(seen[:, 0]) < self.corridor_m)]
        if len(ahead):
            gap = self.jam_distance_m + self.time_gap_s * speed
            gas -= self.acceleration * (gap / float(ahead[:, 2].min())) ** 2
        steering = -self.lateral_gain * offset - self.heading_gain * turned
        return np.clip([gas / self.max_acceleration, steering / self.max_steering_rad], -1.0, 1.0)
