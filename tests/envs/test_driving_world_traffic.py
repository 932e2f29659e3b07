"""Our fast road moves the traffic exactly as highway-env's own classes do."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("highway_env")

from highway_env.road.regulation import RegulatedRoad
from highway_env.road.road import Road, RoadNetwork

from covis.envs.worlds.collision_kernels import collisions, translation
from covis.envs.worlds.driving import ConnectedDrivingWorld, DrivingParams, _pedestrian_obstacle
from covis.envs.worlds.driving_maps import MAPS, road_map
from covis.envs.worlds.highway_peer import bare_intersection
from covis.envs.worlds.lane_kernels import closest_lane, heading_at, position_at, projected
from covis.envs.worlds.traffic import vehicle_table
from covis.envs.worlds.traffic_lanes import FastNetwork, LaneTable
from covis.envs.worlds.traffic_twin import stock_twin
from covis.envs.worlds.traffic_vehicles import ConnectedVehicle

STEPS = 100


def states(vehicles) -> np.ndarray:
    return np.array([[*v.position, v.heading, v.speed, v.crashed] for v in vehicles])


def take_over(stock: list, fast: list) -> None:
    """Give highway-env's vehicles the last bits of ours.

    highway-env's dot products go through BLAS, which on CPUs with AVX-512 rounds once where ours rounds twice; and its
    steering law multiplies a difference fivefold per substep in a car that creeps. What grows from the last bit in this
    way is no difference of the rules, so every step starts from equal positions, headings and speeds; decisions (lanes,
    timers, who yields, crashes) are never taken over and must agree through all steps.
    """
    for a, b in zip(stock, fast, strict=True):
        a.position[:], a.heading, a.speed = b.position, b.heading, b.speed


CASES = [("intersection", 12, False), *((name, 11, True) for name in MAPS)]


@pytest.mark.parametrize(("name", "seed", "connected_lanes"), CASES)
def test_trajectories_equal_highway_env(name: str, seed: int, connected_lanes: bool) -> None:
    world = ConnectedDrivingWorld(2, DrivingParams(map=name, n_vehicles=10))
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
        assert [(v.target_speed, v.timer) for v in fast.vehicles] == [(v.target_speed, v.timer) for v in stock.vehicles]
        take_over(stock.vehicles, fast.vehicles)
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
                b = vehicles[j]
                now, soon, shift = a._is_colliding(b, 0.1)
                assert (now, soon) == found.get((i, j), (False, False))
                if soon:
                    ours = translation(a.polygon(), b.polygon(), a.velocity * 0.1, b.velocity * 0.1)
                    np.testing.assert_allclose(ours, shift, rtol=0, atol=1e-12)
                hits += now
    assert hits > 50


def test_crashes_equal_highway_env() -> None:
    world = ConnectedDrivingWorld(2, DrivingParams(n_vehicles=10))
    world.reset(np.random.default_rng(2))
    fast = world._episode.road
    a, b, c = fast.vehicles[:3]
    b.position, b.heading, b.speed = a.position + [3.0, 1.0], a.heading + 0.7, 6.0
    c.position, c.speed = a.position + [1.0, 6.0], 4.0
    fast.objects = [_pedestrian_obstacle(fast, fast.vehicles[4].position + [0.5, 2.0])]
    stock = stock_twin(fast)
    for _ in range(45):
        for road in (fast, stock):
            road.act()
            road.step(1 / 15)
        np.testing.assert_allclose(states(fast.vehicles), states(stock.vehicles), rtol=0, atol=1e-9)
        assert [v.crashed for v in fast.vehicles] == [v.crashed for v in stock.vehicles]
    assert sum(v.crashed for v in fast.vehicles) >= 2


def test_neighbours_equal_highway_env() -> None:
    world = ConnectedDrivingWorld(2, DrivingParams(map="highway", n_vehicles=14))
    world.reset(np.random.default_rng(4))
    fast = world._episode.road
    for vehicle in fast.vehicles:
        for lane in fast.network.all_side_lanes(vehicle.lane_index):
            assert fast.neighbour_vehicles(vehicle, lane) == Road.neighbour_vehicles(fast, vehicle, lane)


def test_bare_intersection_has_the_same_traffic() -> None:
    world = ConnectedDrivingWorld(2)
    world.reset(np.random.default_rng(0))
    env, action = bare_intersection(world)
    assert len(env.road.vehicles) == len(world.traffic())
    np.testing.assert_array_equal(states(env.road.vehicles)[:, :4], states(world.traffic())[:, :4])
    observation, *_ = env.step(action)
    assert len(observation) == 2
    env.close()
    with pytest.raises(ValueError, match="'merge'"):
        bare_intersection(ConnectedDrivingWorld(2, DrivingParams(map="merge")))
