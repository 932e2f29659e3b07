"""Our fast road moves the traffic exactly as highway-env's own classes do."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("highway_env")

from highway_env.road.regulation import RegulatedRoad
from highway_env.road.road import Road, RoadNetwork

from covis.envs.worlds.driving import ConnectedDrivingWorld, DrivingParams
from covis.envs.worlds.driving_maps import MAPS, road_map
from covis.envs.worlds.traffic import (
    ConnectedVehicle,
    FastNetwork,
    LaneTable,
    closest_lane,
    collisions,
    heading_at,
    position_at,
    projected,
    stock_twin,
    vehicle_table,
)

STEPS = 100


def states(vehicles) -> np.ndarray:
    return np.array([[*v.position, v.heading, v.speed, v.crashed] for v in vehicles])


CASES = [("intersection", 12, False), *((name, 11, True) for name in MAPS)]


@pytest.mark.parametrize(("name", "seed", "connected_lanes"), CASES)
def test_trajectories_equal_highway_env(name: str, seed: int, connected_lanes: bool) -> None:
    world = ConnectedDrivingWorld(2, DrivingParams(map=name))
    world.reset(np.random.default_rng(seed))
    fast = world._episode.road
    fast.network = FastNetwork(world.map.network, connected_lanes)
    fast.neighbour_vehicles_connected_lanes = connected_lanes
    stock = stock_twin(fast)
    assert type(stock) in (Road, RegulatedRoad)
    assert type(stock.network) is RoadNetwork
    assert len(stock.vehicles) > 5
    moved = 0.0
    for step in range(STEPS):
        for road in (fast, stock):
            for vehicle in road.vehicles:
                if isinstance(vehicle, ConnectedVehicle):
                    vehicle.act({"acceleration": 0.3 * np.sin(step), "steering": 0.01})
            for _ in range(3):
                road.act()
                road.step(1 / 15)
        np.testing.assert_allclose(states(fast.vehicles), states(stock.vehicles), rtol=0, atol=1e-9)
        assert [v.lane_index for v in fast.vehicles] == [v.lane_index for v in stock.vehicles]
        assert [v.target_lane_index for v in fast.vehicles] == [v.target_lane_index for v in stock.vehicles]
        moved = max(moved, *(v.speed for v in fast.vehicles))
    assert moved > 1.0


@pytest.mark.parametrize("name", MAPS)
def test_lane_geometry_equals_highway_env(name: str) -> None:
    network = road_map(name).network
    table = LaneTable(network)
    rng = np.random.default_rng(5)
    for lane, row in zip(table.lanes, table.rows, strict=True):
        for s in rng.uniform(-5, min(float(lane.length), 300.0) + 5, 5):
            point = lane.position(s, rng.normal())
            np.testing.assert_allclose(projected(row, *point), lane.local_coordinates(point), atol=1e-9)
            np.testing.assert_allclose(heading_at(row, s), lane.heading_at(s), atol=1e-12)
            np.testing.assert_allclose(position_at(row, s), lane.position(s, 0), atol=1e-9)
            heading = lane.heading_at(s) + rng.normal()
            expected = network.get_closest_lane_index(point, heading)
            assert table.indices[closest_lane(table.rows, *point, heading)] == expected


def test_collisions_equal_highway_env() -> None:
    world = ConnectedDrivingWorld(2, DrivingParams(map="racetrack"))
    world.reset(np.random.default_rng(0))
    vehicles = world._episode.road.vehicles
    rng = np.random.default_rng(3)
    hits = 0
    for _ in range(60):
        for v in vehicles:
            v.position, v.heading, v.speed = rng.uniform(0, 18, 2), rng.uniform(-4, 4), rng.uniform(-3, 10)
        table = vehicle_table(vehicles, world._episode.road.network.table)
        found = {(i, j): (bool(now), bool(soon)) for i, j, now, soon in collisions(table, len(vehicles), 0.1).tolist()}
        for i, a in enumerate(vehicles):
            for j in range(i + 1, len(vehicles)):
                now, soon, _ = a._is_colliding(vehicles[j], 0.1)
                assert (now, soon) == found.get((i, j), (False, False))
                hits += now
    assert hits > 50
