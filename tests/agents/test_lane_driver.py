"""The driver that sees only with its own eyes."""

from __future__ import annotations

import numpy as np
import pytest

from covis.agents.controllers.driving import LaneDriver

NOBODY = np.zeros((0, 3))


def test_it_reaches_and_keeps_its_speed() -> None:
    driver = LaneDriver(cruise_speed=5.0)
    assert driver(np.array([0.0, 0, 0, 0, 0]), NOBODY)[0] > 0.3
    assert abs(driver(np.array([5.0, 0, 0, 0, 0]), NOBODY)[0]) < 1e-9
    assert driver(np.array([5.0, 0, 0, 0, 3.0]), NOBODY)[0] < 0, "the speed limit counts"


def test_it_brakes_for_what_is_ahead_only() -> None:
    driver, state = LaneDriver(), np.array([4.0, 0, 0, 0, 10.0])
    free = driver(state, NOBODY)[0]
    assert driver(state, np.array([[0.3, 0.5, 6.0]]))[0] < -0.5
    assert driver(state, np.array([[4.0, 0.5, 6.0], [0.0, 0.5, -6.0]]))[0] == free


def test_it_steers_back_to_the_lane() -> None:
    driver = LaneDriver()
    assert driver(np.array([5.0, 0, 1.0, 0, 0]), NOBODY)[1] < 0
    assert driver(np.array([5.0, 0, -1.0, 0, 0]), NOBODY)[1] > 0
    assert driver(np.array([5.0, 0, 0, 0.3, 0]), NOBODY)[1] < 0


def test_bad_input_is_named() -> None:
    with pytest.raises(ValueError, match=r"\(4,\)"):
        LaneDriver()(np.zeros(4), NOBODY)
    with pytest.raises(ValueError, match=r"\(2,\)"):
        LaneDriver()(np.zeros(5), np.zeros(2))


def test_it_drives_in_traffic() -> None:
    pytest.importorskip("highway_env")
    from covis.envs.worlds.driving import ConnectedDrivingWorld, preset
    from covis.matching.pose import invert, transform

    world, driver = ConnectedDrivingWorld(2, preset("paper", "highway")), LaneDriver(cruise_speed=9.0)
    for seed in range(3):
        world.reset(np.random.default_rng(seed))
        for _ in range(25):
            s = world.snapshot()
            controls = []
            for k in range(2):
                others = transform(invert(s.T_world_camera[k]), np.delete(s.positions, s.robot_object[k], axis=0))
                controls.append(driver(s.robot_state[k], others))
            world.step(np.array(controls))
        end = world.snapshot()
        assert not end.collided.any()
        assert np.abs(end.robot_state[:, 2]).max() < 1.0
        assert end.robot_state[:, 0].min() > 0.0
