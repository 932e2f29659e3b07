"""The robot scenes: determinism, physics, descriptions, bad input."""

from __future__ import annotations

import dataclasses
import hashlib
import math
import os
import pickle
import subprocess
import sys

import numpy as np
import pytest

from covis.envs.worlds.bullet import BoxDynamics
from covis.envs.worlds.multi_robot import MultiRobotParams, MultiRobotWorld
from covis.envs.worlds.robots import RobotWorld
from covis.envs.worlds.world import SceneGenerationError, Snapshot

SMALL = MultiRobotParams(n_team=6, n_obstacles=(1, 2), n_backdrop=(1, 2))


def digest(snapshot: Snapshot) -> str:
    """A hash of every array and of the light."""
    h = hashlib.sha256(repr(snapshot.light).encode())
    for field in dataclasses.fields(snapshot):
        value = getattr(snapshot, field.name)
        if isinstance(value, np.ndarray):
            h.update(f"{field.name}{value.dtype}{value.shape}".encode() + value.tobytes())
    return h.hexdigest()


def episode(world: RobotWorld, seed: int, steps: int = 30) -> list[str]:
    """Digests of a whole episode under random controls that drive into the crowd."""
    world.reset(np.random.default_rng(seed))
    drive = np.random.default_rng(seed + 1)
    digests = [digest(world.snapshot())]
    for _ in range(steps):
        controls = drive.uniform(-0.4, 0.4, (world.n_robots, world.control_size))
        controls[:, 0] = 1.0
        world.step(controls)
        digests.append(digest(world.snapshot()))
    return digests


def test_same_seed_gives_the_same_episode_whatever_happened_before() -> None:
    used, fresh = MultiRobotWorld(), MultiRobotWorld()
    first = episode(used, 3)
    episode(used, 4)
    assert episode(used, 3) == first
    assert episode(fresh, 3) == first
    assert episode(fresh, 4) != first
    used.close()
    fresh.close()


def test_same_seed_gives_the_same_episode_in_another_process() -> None:
    """Also with another hash seed, and nothing but the digest on the terminal, past sys.stdout included."""
    world = MultiRobotWorld(params=SMALL)
    expected = hashlib.sha256("".join(episode(world, 5)).encode()).hexdigest()
    code = (
        "import sys; sys.path.insert(0, sys.argv[1]); import hashlib\n"
        "from test_robot_worlds import SMALL, MultiRobotWorld, episode\n"
        "w = MultiRobotWorld(params=SMALL)\n"
        "print(hashlib.sha256(''.join(episode(w, 5)).encode()).hexdigest()); w.close()"
    )
    environment = {**os.environ, "PYTHONHASHSEED": "77", "PYTHONWARNINGS": "ignore"}
    run = subprocess.run(
        [sys.executable, "-c", code, os.path.dirname(__file__)],
        capture_output=True,
        text=True,
        env=environment,
        check=True,
    )
    assert run.stdout == expected + "\n"
    assert run.stderr == ""


def test_controls_drive_a_unicycle() -> None:
    """Away from everything, a robot follows the arc of its speed and turn rate."""
    dynamics = BoxDynamics(np.array([[0.97, 0.67]]), np.zeros((0, 2)))
    state = dynamics.rest(np.array([[1.0, 2.0, 0.3]]))
    speed, rate = 1.2, 0.8
    for _ in range(10):
        state, touched = dynamics.advance(state, np.array([[speed, rate]]))
        assert not touched.any()
    t, r = 2.0, speed / rate
    expected = [
        1.0 + r * (math.sin(0.3 + rate * t) - math.sin(0.3)),
        2.0 - r * (math.cos(0.3 + rate * t) - math.cos(0.3)),
        0.3 + rate * t,
    ]
    assert state.planar[0] == pytest.approx(expected, abs=2e-3)
    assert np.hypot(*state.velocity[0, :2]) == pytest.approx(speed, rel=0.01)
    assert state.velocity[0, 2] == pytest.approx(rate, rel=1e-3)
    dynamics.close()


def test_robots_do_not_pass_through_each_other_or_obstacles() -> None:
    dynamics = BoxDynamics(np.full((2, 2), (1.0, 0.6)), np.array([[1.0, 1.0]]))
    dynamics.set_obstacles(np.array([[0.0, -5.0, 0.0]]))
    state = dynamics.rest(np.array([[-2.0, 0.0, 0.0], [0.0, -2.0, -np.pi / 2]]))
    state, touched = dynamics.advance(state, np.zeros((2, 2)))
    assert not touched.any()
    for _ in range(30):
        state, touched = dynamics.advance(state, np.array([[0.0, 0.0], [1.0, 0.0]]))
    assert touched.tolist() == [False, True]
    assert state.planar[1, 1] == pytest.approx(-5.0 + 0.5 + 0.5, abs=0.03)  # bumper at the crate's face
    state = dynamics.rest(np.array([[-2.0, 0.0, 0.0], [2.0, 0.0, np.pi]]))
    for _ in range(30):
        state, touched = dynamics.advance(state, np.array([[1.0, 0.0], [1.0, 0.0]]))
    assert touched.all()
    assert state.planar[1, 0] - state.planar[0, 0] == pytest.approx(1.0, abs=0.03)
    dynamics.set_obstacles(np.zeros((0, 3)))
    state = dynamics.rest(np.array([[20.0, 0.0, 0.0], [0.0, -4.2, -np.pi / 2]]))
    state, touched = dynamics.advance(state, np.array([[0.0, 0.0], [1.0, 0.0]]))
    assert not touched.any()  # a removed obstacle is gone
    dynamics.close()


def test_a_step_depends_on_its_arguments_alone() -> None:
    """In the thick of contacts, an engine with another past gives the same bits."""
    rng = np.random.default_rng(0)
    sizes, crates = np.full((12, 2), (0.97, 0.67)), np.full((3, 2), 1.0)
    one, other = BoxDynamics(sizes, crates), BoxDynamics(sizes, crates)
    for dynamics in (one, other):
        dynamics.set_obstacles(np.array([[0.0, 0.0, 0.4], [2.0, 1.0, 0.0], [-2.0, 1.0, 0.0]]))
    state = one.rest(np.column_stack([rng.uniform(-3, 3, (12, 2)), rng.uniform(-3, 3, 12)]))
    touches = 0
    for t in range(40):
        inward = np.arctan2(-state.planar[:, 1], -state.planar[:, 0]) - state.planar[:, 2]
        commands = np.column_stack([rng.uniform(0, 1.5, 12), np.sin(inward)])
        if t % 3 == 0:
            other.advance(other.rest(state.planar[::-1].copy()), commands)
        expected, touched = one.advance(state, commands)
        got, _ = other.advance(state, commands)
        assert np.array_equal(expected.planar, got.planar)
        touches += int(touched.sum())
        state = expected
    assert touches > 100
    one.close()
    other.close()


def test_snapshot_describes_the_scene() -> None:
    world = MultiRobotWorld(3, SMALL)
    world.reset(np.random.default_rng(1))
    for _ in range(5):
        world.step(np.tile([1.0, 0.3], (3, 1)))
    s = world.snapshot()
    m = len(s.identity)
    assert m == 9 <= world.max_objects
    assert s.identity.tolist() == list(range(9))
    assert s.robot_object.tolist() == [0, 1, 2]
    assert set(s.object_class.tolist()) == {0}  # identical look: one class ...
    assert (s.body_tints[:m] == s.body_tints[0]).all()  # ... and one colour
    assert s.body_mesh.max() < len(world.meshes)
    assert s.body_object.tolist() == list(range(m)) + [-1] * (len(s.body_mesh) - m)
    assert s.time == pytest.approx(1.0)
    for i in range(m):  # position and size are those of the drawn body
        mesh = world.meshes[s.body_mesh[i]]
        corners = mesh.vertices @ s.body_poses[i, :3, :3].T + s.body_poses[i, :3, 3]
        assert corners[:, 2].min() == pytest.approx(0.0, abs=0.01)
        assert 0.5 * (corners[:, 2].min() + corners[:, 2].max()) == pytest.approx(s.positions[i, 2])
        assert np.ptp(mesh.vertices, axis=0) == pytest.approx(s.sizes[i])
        assert s.headings[i] == pytest.approx(math.atan2(s.body_poses[i, 1, 0], s.body_poses[i, 0, 0]))
    for n in range(3):  # a camera looks along its robot's heading, a little down, x to the right
        R = s.T_world_camera[n, :3, :3]
        assert pytest.approx(np.eye(3)) == R @ R.T
        assert np.linalg.det(R) == pytest.approx(1.0)
        assert math.atan2(R[1, 2], R[0, 2]) == pytest.approx(s.headings[n])
        assert -0.17 < R[2, 2] < 0.0
        assert R[2, 0] == pytest.approx(0.0)
        assert R[2, 1] < -0.98
        assert 0.8 <= s.T_world_camera[n, 2, 3] <= 1.2
    speed = np.linalg.norm(s.velocities, axis=1)
    assert s.robot_velocity == pytest.approx(s.velocities[:3])
    assert np.abs(s.robot_state[:, 0]) == pytest.approx(speed[:3], abs=0.05)
    assert speed.max() < 1.6
    world.close()


def test_snapshots_are_the_callers_to_keep() -> None:
    world = MultiRobotWorld(params=SMALL)
    world.reset(np.random.default_rng(2))
    kept, expected = world.snapshot(), digest(world.snapshot())
    for field in dataclasses.fields(kept):
        value = getattr(kept, field.name)
        if isinstance(value, np.ndarray):
            value[...] = 0
    assert digest(world.snapshot()) == expected
    world.close()


def test_the_team_moves_and_stays() -> None:
    world = MultiRobotWorld(params=SMALL)
    world.reset(np.random.default_rng(3))
    start = world.snapshot().positions
    for _ in range(100):
        world.step(np.zeros((2, 2)))
    end = world.snapshot().positions
    moved = np.linalg.norm(end - start, axis=1)
    assert moved[:2] == pytest.approx(0.0, abs=1e-6)
    assert (moved[2:] > 0.5).sum() >= 2
    assert np.linalg.norm(end[2:, :2], axis=1).max() < SMALL.team_radius_m[1] + 1.5
    world.close()


def test_saved_states_continue_bit_identically() -> None:
    world = MultiRobotWorld(params=SMALL)
    world.reset(np.random.default_rng(4))
    controls = np.tile([1.0, 0.2], (2, 1))
    for _ in range(15):
        world.step(controls)
    saved = pickle.loads(pickle.dumps(world.save_state()))

    def rest_of(w: RobotWorld) -> list[str]:
        out = []
        for _ in range(20):
            w.step(controls)
            out.append(digest(w.snapshot()))
        return out

    expected = rest_of(world)
    other = MultiRobotWorld(params=SMALL)
    other.restore_state(saved)
    assert rest_of(other) == expected
    world.reset(np.random.default_rng(5))
    world.restore_state(saved)
    assert rest_of(world) == expected
    with pytest.raises(ValueError, match="MultiRobotWorld"):
        MultiRobotWorld(3, SMALL).restore_state(saved)
    with pytest.raises(ValueError, match="dict"):
        world.restore_state({})  # type: ignore[arg-type]
    world.close()
    other.close()


def test_a_pickled_world_is_independent() -> None:
    world = MultiRobotWorld(params=SMALL)
    world.reset(np.random.default_rng(6))
    controls = np.tile([1.0, 0.2], (2, 1))
    world.step(controls)
    copy = pickle.loads(pickle.dumps(world))
    world.step(controls)
    expected = digest(world.snapshot())
    world.close()
    copy.step(controls)
    assert digest(copy.snapshot()) == expected
    copy.close()


def test_close_twice_and_use_again() -> None:
    world = MultiRobotWorld(params=SMALL)
    world.close()
    first = episode(world, 7, steps=3)
    world.close()
    world.close()
    assert episode(world, 7, steps=3) == first
    world.close()


def test_two_hundred_resets_leak_nothing() -> None:
    descriptors = "/proc/self/fd"
    if not os.path.isdir(descriptors):
        pytest.skip("needs /proc")

    def resident_pages() -> int:
        with open("/proc/self/statm") as f:
            return int(f.read().split()[1])

    world = MultiRobotWorld()
    for seed in range(20):
        episode(world, seed, steps=2)
    pages, opened = resident_pages(), len(os.listdir(descriptors))
    for seed in range(200):
        world.reset(np.random.default_rng(seed))
        world.step(np.zeros((2, 2)))
    assert len(os.listdir(descriptors)) == opened
    assert (resident_pages() - pages) * 4096 < 4e6
    world.close()


def test_observers_up_to_eight_have_different_views() -> None:
    world = MultiRobotWorld(8)
    for seed in range(5):
        world.reset(np.random.default_rng(seed))
        s = world.snapshot()
        assert s.T_world_camera.shape == (8, 4, 4)
        xy = s.positions[:, :2]
        gaps = np.linalg.norm(xy[:, None] - xy[None], axis=2) + 10 * np.eye(len(xy))
        assert gaps.min() >= world.params.separation_m - 1e-9
    world.close()


@pytest.mark.parametrize("bad", [0, 1, 9, -3, 2.5, "two", True])
def test_impossible_numbers_of_observers(bad: object) -> None:
    with pytest.raises(ValueError, match=f"n_robots.*{bad}"):
        MultiRobotWorld(bad)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"n_team": -1}, "n_team.*-1"),
        ({"n_team": 400}, "n_team.*400"),
        ({"n_team": 2.5}, "n_team.*2.5"),
        ({"n_team": "5"}, "n_team.*'5'"),
        ({"n_obstacles": (1.5, 2)}, "n_obstacles.*1.5"),
        ({"team_radius_m": 5.0}, "team_radius_m.*5.0"),
        ({"n_obstacles": (-1, 2)}, "n_obstacles.*-1"),
        ({"n_obstacles": (4, 2)}, "n_obstacles"),
        ({"scale": -1.0}, "scale.*-1"),
        ({"scale": float("nan")}, "scale.*nan"),
        ({"separation_m": 0.0}, "separation_m"),
        ({"team_radius_m": (0.0, 0.0)}, "team_radius_m"),
        ({"team_radius_m": (9.0, 5.0)}, "team_radius_m"),
        ({"layouts": ("spiral",)}, "spiral"),
        ({"layouts": ()}, "layouts"),
        ({"times_of_day": ("midnight",)}, "midnight"),
        ({"obstacles": "cow"}, "cow"),
        ({"dynamics": "legs"}, "legs"),
        ({"unique_share": 1.5}, "unique_share.*1.5"),
        ({"horizontal_fov_deg": 180.0}, "horizontal_fov_deg.*180"),
        ({"camera_height_m": (0.0, 1.0)}, "camera_height_m"),
        ({"observer_distance_m": (1.0, float("inf"))}, "observer_distance_m.*inf"),
    ],
)
def test_impossible_parameters_are_named(changes: dict[str, object], named: str) -> None:
    with pytest.raises(ValueError, match=named):
        MultiRobotParams(**changes)  # type: ignore[arg-type]


def test_more_observers_than_fit() -> None:
    params = dataclasses.replace(SMALL, observer_distance_m=(1.0, 1.5), separation_m=2.0)
    with pytest.raises(ValueError, match=r"n_robots = 8.*1.5"):
        MultiRobotWorld(8, params)


def test_a_scene_without_room_says_why() -> None:
    params = dataclasses.replace(SMALL, n_team=2, team_radius_m=(5.0, 5.0), n_obstacles=(60, 60))
    world = MultiRobotWorld(2, params)
    with pytest.raises(SceneGenerationError, match="no place for obstacle"):
        world.reset(np.random.default_rng(0))
    world.close()


def test_bad_controls_and_missing_reset() -> None:
    world = MultiRobotWorld(params=SMALL)
    with pytest.raises(RuntimeError, match="reset"):
        world.step(np.zeros((2, 2)))
    with pytest.raises(RuntimeError, match="reset"):
        world.snapshot()
    world.reset(np.random.default_rng(0))
    with pytest.raises(ValueError, match=r"\(3, 2\)"):
        world.step(np.zeros((3, 2)))
    with pytest.raises(ValueError, match="nan"):
        world.step(np.array([[0.0, np.nan], [0.0, 0.0]]))
    with pytest.raises(ValueError, match=r"1\.5"):
        world.step(np.array([[0.0, 1.5], [0.0, 0.0]]))
    world.close()
