"""The bare highway-env environment that our driving scene's speed is compared with."""

from __future__ import annotations

from typing import Any

from .driving import SIMULATION_HZ, SUBSTEPS, ConnectedDrivingWorld
from .traffic_vehicles import ConnectedVehicle

# isort: split
from highway_env.envs.intersection_env import MultiAgentIntersectionEnv
from highway_env.vehicle.behavior import IDMVehicle

IDLE = 1
"""The peer's action that keeps the speed."""


def bare_intersection(world: ConnectedDrivingWorld) -> tuple[Any, tuple[int, ...]]:
    """highway-env's multi-agent intersection with the traffic of `world`, and an action for its `step`.

    Stock lanes, vehicles, right-of-way rules, reward and multi-agent Kinematics observation; as many controlled
    vehicles as the world has connected ones, at the same places; the same simulation and policy rates and chance of
    newcomers.

    Raises:
        ValueError: the world's map is not the intersection.
        RuntimeError: the world has no scene yet.
    """
    if world.params.map != "intersection":
        raise ValueError(f"the peer is highway-env's intersection, the world's map is {world.params.map!r}")
    config = {
        "controlled_vehicles": world.n_robots,
        "simulation_frequency": SIMULATION_HZ,
        "policy_frequency": SIMULATION_HZ // SUBSTEPS,
        "spawn_probability": world.params.spawn_probability,
        "duration": 1e9,
        "initial_vehicle_count": 1,
    }
    env = MultiAgentIntersectionEnv({**MultiAgentIntersectionEnv.default_config(), **config})
    env.reset(seed=0)
    road = env.road
    road.vehicles, env.controlled_vehicles = [], []
    for vehicle in world.traffic():
        connected = isinstance(vehicle, ConnectedVehicle)
        kind = env.action_type.vehicle_class if connected else IDMVehicle
        twin = kind(road, vehicle.position.copy(), heading=vehicle.heading, speed=vehicle.speed)
        twin.plan_route_to(vehicle.route[-1][1])
        road.vehicles.append(twin)
        if connected:
            env.controlled_vehicles.append(twin)
    env.define_spaces()
    return env, (IDLE,) * world.n_robots
