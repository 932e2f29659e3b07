"""Vehicles in traffic: highway-env's IDM drivers, and those that we drive."""

from __future__ import annotations

import math
from typing import Any

from .driving_maps import MAPS  # noqa: F401 - first: it says what to install when highway-env is missing

# isort: split
from highway_env.vehicle.behavior import IDMVehicle


class TrafficVehicle(IDMVehicle):
    """One of highway-env's IDM drivers, with an identity, a kind and its own size.

    Attributes:
        identity: stable over an episode; -1 until assigned.
        kind: index into `KINDS`.
    """

    # highway-env's intersection changes these on its IDMVehicle class for the whole process; ours must not notice.
    ACC_MAX, COMFORT_ACC_MAX, COMFORT_ACC_MIN = 6.0, 3.0, -5.0
    DISTANCE_WANTED, TIME_WANTED, DELTA = 10.0, 1.5, 4.0

    def __init__(self, *args: Any, identity: int = -1, kind: int = 0, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.identity = identity
        self.kind = kind

    def resize(self, length: float, width: float) -> None:
        """Give this vehicle its own length and width (m); highway-env's dynamics and collisions use them."""
        self.LENGTH, self.WIDTH = length, width
        self.diagonal = math.sqrt(length**2 + width**2)


class ConnectedVehicle(TrafficVehicle):
    """A vehicle that we drive: it holds our acceleration and steering, and still knows its route.

    Attributes:
        cruise_speed: m/s that an IDM driver would not exceed in it, whatever highway-env's rules set.
    """

    cruise_speed = math.inf

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.enable_lane_change = False

    @property
    def target_speed(self) -> float:
        """m/s that an IDM driver would like to go."""
        return self._target_speed

    @target_speed.setter
    def target_speed(self, speed: float) -> None:
        self._target_speed = min(speed, self.cruise_speed)

    def act(self, action: dict[str, float] | None = None) -> None:
        """Hold `action`; without one, only keep following the route (highway-env's road calls this)."""
        if action is not None:
            self.action = dict(action)
        elif not self.crashed:
            self.follow_road()
