"""A road copied into highway-env's own classes: what tests drive beside ours."""

from __future__ import annotations

from typing import Any

import numpy as np

from .traffic import FastRoad

# isort: split
from highway_env.road.regulation import RegulatedRoad
from highway_env.road.road import Road, RoadNetwork
from highway_env.vehicle.kinematics import Vehicle


def stock_twin(road: FastRoad) -> Road:
    """highway-env's own `Road` or `RegulatedRoad`, lanes and vehicle code, in the same state.

    Connected vehicles become ones that hold their present action.
    """
    network = RoadNetwork()
    network.graph = road.network.graph
    kind = RegulatedRoad if road.regulated else Road
    twin = kind(
        network=network,
        np_random=np.random.default_rng(0),
        neighbour_vehicles_connected_lanes=road.neighbour_vehicles_connected_lanes,
    )
    twin.objects = [_twin_body(o, twin) for o in road.objects]
    twin.vehicles = [_twin_body(v, twin) for v in road.vehicles]
    if road.regulated:
        twin.steps = road.steps
    return twin


def _twin_body(body: Any, road: Road) -> Any:
    twin = body.__class__.__new__(body.__class__)
    twin.__dict__.update(body.__dict__)
    twin.road, twin.position = road, body.position.copy()
    if isinstance(body, Vehicle):
        twin.action = dict(body.action)
        twin.route = None if body.route is None else list(body.route)
        twin.impact = None if body.impact is None else np.array(body.impact)
    return twin
