"""Scripted controllers: they get where they should, and stay in the action space."""

from __future__ import annotations

import math

import numpy as np
import pytest

from covis.agents.controllers.robots import Orbit, SeekView, Waypoints, bearing_error, lively_controls, patrol, planar
from covis.envs.worlds import aerial_ground, multi_robot, target_localization
from covis.envs.worlds.aerial_ground import AerialGroundParams, AerialGroundWorld
from covis.envs.worlds.multi_robot import MultiRobotParams, MultiRobotWorld
from covis.envs.worlds.robot_generation import camera_mount, planar_poses
from covis.envs.worlds.robots import RobotWorld
from covis.envs.worlds.target_localization import TargetLocalizationWorld

EMPTY = {"n_team": 0, "n_obstacles": (0, 0), "n_backdrop": (0, 0)}


def camera_at(x: float, y: float, heading: float, tilt: float = 0.1, height: float = 1.0) -> np.ndarray:
    """T_world_camera of a robot's camera."""
    return planar_poses(np.array([[x, y, heading]]))[0] @ camera_mount((0.0, 0.0, height), tilt)


def in_camera(T: np.ndarray, points: list[list[float]]) -> np.ndarray:
    """World points in the camera's frame."""
    return (np.array(points) - T[:3, 3]) @ T[:3, :3]


@pytest.mark.parametrize("tilt", [0.0, 0.3, math.pi / 2])
def test_planar_reads_heading_from_any_tilt(tilt: float) -> None:
    for heading in (-3.0, -1.0, 0.0, 2.0):
        position, got = planar(camera_at(2.0, -1.0, heading, tilt))
        assert got == pytest.approx(heading)
        assert position == pytest.approx([2.0, -1.0])


def test_bearing_error_turns_the_short_way() -> None:
    assert bearing_error(np.zeros(2), math.radians(170), (-1.0, -0.01)) == pytest.approx(math.radians(10.57), abs=0.01)
    assert bearing_error(np.zeros(2), 0.0, (0.0, 1.0)) == pytest.approx(math.pi / 2)


def test_waypoints_are_reached_in_turn() -> None:
    world = MultiRobotWorld(2, MultiRobotParams(**EMPTY))  # type: ignore[arg-type]
    world.reset(np.random.default_rng(0))
    here = world.snapshot().positions[0, :2]
    points = here + np.array([[3.0, 0.0], [3.0, 3.0], [0.0, 0.0]])
    drive, visited = Waypoints(points, cruise=1.0), []
    for _ in range(120):
        before = drive.next
        controls = np.zeros((2, 2))
        controls[0] = drive({"pose": world.snapshot().T_world_camera[0]})
        if drive.next != before:
            visited.append(before)
        world.step(controls)
    assert visited[:4] == [0, 1, 2, 0]
    drive.reset()
    assert drive.next == 0
    world.close()


def test_patrol_goes_to_and_fro() -> None:
    drive = patrol((0.0, 0.0), (5.0, 0.0))
    assert drive({"pose": camera_at(0.1, 0.0, 0.0)})[0] > 0.5  # at a: on to b, straight ahead
    assert drive.next == 1
    control = drive({"pose": camera_at(4.9, 0.0, 0.0)})
    assert drive.next == 0
    assert control[0] == pytest.approx(0.0, abs=1e-9)
    assert abs(control[1]) == 1.0  # turn round first


@pytest.mark.parametrize("clockwise", [False, True])
def test_a_drone_orbits_facing_the_centre(clockwise: bool) -> None:
    world = AerialGroundWorld(2, AerialGroundParams(**EMPTY))  # type: ignore[arg-type]
    world.reset(np.random.default_rng(1))
    orbit = Orbit((1.0, 0.5), radius_m=4.0, altitude_m=9.0, clockwise=clockwise)
    turned, last = 0.0, None
    for step in range(300):
        T = world.snapshot().T_world_camera[0]
        controls = np.zeros((2, 4))
        controls[0] = orbit({"pose": T})
        world.step(controls)
        position, heading = planar(T)
        angle = math.atan2(position[1] - 0.5, position[0] - 1.0)
        if step > 100:
            assert np.hypot(*(position - (1.0, 0.5))) == pytest.approx(4.0, abs=0.6)
            assert T[2, 3] == pytest.approx(9.0, abs=0.3)
            assert abs(bearing_error(position, heading, (1.0, 0.5))) < 0.4
            assert last is not None
            turned += (angle - last + math.pi) % (2 * math.pi) - math.pi
        last = angle
    assert abs(turned) > 2 * math.pi
    assert (turned < 0) == clockwise
    world.close()


def test_seeking_turns_to_the_objects_and_searches_without_any() -> None:
    seek = SeekView(math.radians(70))
    T = camera_at(0.0, 0.0, 0.0)
    assert seek({"pose": T}).tolist() == [0.0, 0.5]
    assert seek({"pose": T}, np.zeros((0, 3))).tolist() == [0.0, 0.5]
    left = seek({"pose": T}, in_camera(T, [[0.5, 6.0, 0.3], [-0.5, 7.0, 0.3]]))
    right = seek({"pose": T}, in_camera(T, [[0.5, -6.0, 0.3], [-0.5, -7.0, 0.3]]))
    assert left[1] > 0 > right[1]


def test_seeking_approaches_what_is_far_and_stays_off_what_is_near() -> None:
    seek = SeekView(math.radians(70))
    T = camera_at(0.0, 0.0, 0.0)
    assert seek({"pose": T}, in_camera(T, [[12.0, 0.0, 0.3]]))[0] > 0
    assert seek({"pose": T}, in_camera(T, [[1.5, 0.0, 0.3]]))[0] <= 0
    wide = SeekView(math.radians(70), control_size=4)
    assert wide({"pose": T}, in_camera(T, [[12.0, 0.0, 0.3]])).shape == (4,)


def test_seeking_prefers_objects_that_nobody_has_located() -> None:
    """Two objects left and right; the one whose position is already known well is worth less."""
    seek = SeekView(math.radians(50))
    T = camera_at(0.0, 0.0, 0.0)
    positions = in_camera(T, [[5.0, 5.0, 0.3], [5.0, -5.0, 0.3]])
    sharp, vague = np.eye(3) * 1e-4, np.eye(3)
    assert seek({"pose": T}, positions, np.stack([sharp, vague]))[1] < 0
    assert seek({"pose": T}, positions, np.stack([vague, sharp]))[1] > 0


WORLDS: list[RobotWorld] = [
    MultiRobotWorld(3, multi_robot.preset("easy")),
    AerialGroundWorld(2, aerial_ground.preset("easy")),
    TargetLocalizationWorld(2, target_localization.preset("easy")),
]


@pytest.mark.parametrize("world", WORLDS, ids=lambda w: type(w).__name__)
def test_lively_controls_keep_a_world_moving(world: RobotWorld) -> None:
    world.reset(np.random.default_rng(3))
    start, collisions = world.snapshot().positions[: world.n_robots], 0
    saved = world.save_state()
    for _ in range(25):
        controls = lively_controls(world)
        assert controls.shape == (world.n_robots, world.control_size)
        assert np.abs(controls).max() <= 1.0
        world.step(controls)
        collisions += int(world.snapshot().collided.sum())
    moved = np.linalg.norm(world.snapshot().positions[: world.n_robots] - start, axis=1)
    assert moved.max() > 0.3 * world.params.scale
    assert collisions <= 10
    world.restore_state(saved)
    assert np.array_equal(lively_controls(world), lively_controls(world))
    world.close()


def test_lively_observers_gather_information() -> None:
    """They see more objects at the end than at the start, over a few seeds."""
    world = MultiRobotWorld(2, multi_robot.preset("easy"))
    seek, before, after = SeekView(math.radians(75)), 0.0, 0.0

    def information() -> float:
        s = world.snapshot()
        total = 0.0
        for k, T in enumerate(s.T_world_camera):
            others = s.positions[np.arange(len(s.positions)) != k]
            prior = np.tile(np.eye(3), (len(others), 1, 1))
            position, heading = planar(T)
            total += seek.information(position[None], np.array([heading]), float(T[2, 3]), others, prior)[0]
        return total

    for seed in range(6):
        world.reset(np.random.default_rng(seed))
        before += information()
        for _ in range(25):
            world.step(lively_controls(world))
        after += information()
    assert after > 1.05 * before
    world.close()


def test_information_equals_its_numpy_reference() -> None:
    rng = np.random.default_rng(0)
    seek = SeekView(math.radians(80), depth_noise=0.05, bearing_noise=0.02, range_m=(1.0, 9.0))
    objects = np.column_stack([rng.uniform(-6, 6, (12, 2)), rng.uniform(0, 1, 12)])
    roots = rng.normal(size=(12, 3, 3))
    prior = roots @ roots.transpose(0, 2, 1)
    goals, headings = rng.uniform(-3, 3, (6, 2)), rng.uniform(-4, 4, 6)
    goals[5] = (100.0, 0.0)
    got = seek.information(goals, headings, 0.8, objects, prior)
    for goal, heading, value in zip(goals, headings, got, strict=True):
        ray = objects - [*goal, 0.8]
        r = np.linalg.norm(ray, axis=1)
        off = np.abs(np.angle(np.exp(1j * (np.arctan2(ray[:, 1], ray[:, 0]) - heading))))
        expected = 0.0
        seen = (off < 0.45 * math.radians(80)) & (r > 1.0) & (r < 9.0)
        for d, distance, P in zip(ray[seen], r[seen], prior[seen], strict=True):
            outer = np.outer(d, d) / distance**2
            information = (np.eye(3) - outer) / (0.02 * distance) ** 2 + outer / (0.05 * distance) ** 2
            expected += 0.5 * np.linalg.slogdet(np.eye(3) + P @ information)[1]
        assert value == pytest.approx(expected if seen.any() else -off.min())
    assert got[5] < 0


def test_bad_arguments_are_named() -> None:
    with pytest.raises(ValueError, match=r"points.*\(0,\)"):
        Waypoints([])
    with pytest.raises(ValueError, match=r"radius_m.*-1"):
        Orbit(radius_m=-1.0)
