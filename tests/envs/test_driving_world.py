"""The connected-driving world: frames, identities, determinism, the street, and what it refuses."""

from __future__ import annotations

import dataclasses
import hashlib
import pickle
import subprocess
import sys

import numpy as np
import pytest

pytest.importorskip("highway_env")

from covis.envs.camera.shapes import extent
from covis.envs.worlds.driving import ConnectedDrivingWorld, DrivingParams, preset
from covis.envs.worlds.driving_maps import MAPS
from covis.envs.worlds.driving_params import KINDS, MAP_COUNTS, PEDESTRIAN, PRESETS, SIGN, SIGNAL
from covis.envs.worlds.kerbs import clearance
from covis.envs.worlds.statistics import scene_statistics
from covis.envs.worlds.world import SceneGenerationError, Snapshot

SMALL = {"n_vehicles": 8, "n_pedestrians": 8, "n_parked": 8}


def fingerprint(snapshot: Snapshot) -> str:
    digest = hashlib.sha256()
    for field in dataclasses.fields(Snapshot):
        value = getattr(snapshot, field.name)
        digest.update(value.tobytes() if isinstance(value, np.ndarray) else repr(value).encode())
    return digest.hexdigest()


def episode(world: ConnectedDrivingWorld, seed: int, steps: int = 12) -> list[str]:
    world.reset(np.random.default_rng(seed))
    prints = [fingerprint(world.snapshot())]
    controls = np.random.default_rng(seed + 1)
    for _ in range(steps):
        world.step(controls.uniform(-0.3, 1.0, (world.n_robots, 2)))
        prints.append(fingerprint(world.snapshot()))
    return prints


@pytest.fixture(scope="module")
def intersection() -> ConnectedDrivingWorld:
    return ConnectedDrivingWorld(2)


@pytest.mark.parametrize("name", MAPS)
@pytest.mark.parametrize("n_robots", [2, 6])
def test_every_map_takes_two_to_six_connected_vehicles(name: str, n_robots: int) -> None:
    world = ConnectedDrivingWorld(n_robots, preset("paper", name))
    seen: dict[int, int] = {}
    gone: set[int] = set()
    for seed in (0, 1):
        world.reset(np.random.default_rng(seed))
        seen.clear()
        gone.clear()
        for _ in range(8):
            s = world.snapshot()
            m = len(s.identity)
            assert m <= world.max_objects
            assert len(set(s.identity.tolist())) == m
            assert not gone & set(s.identity.tolist()), "an identity came back"
            gone |= set(seen) - set(s.identity.tolist())
            for identity, kind in zip(s.identity.tolist(), s.object_class.tolist(), strict=True):
                assert seen.setdefault(identity, kind) == kind
            assert s.robot_object.tolist() == list(range(n_robots))
            assert s.T_world_camera.shape == (n_robots, 4, 4)
            assert s.robot_state.shape == (n_robots, world.state_size)
            assert s.body_mesh.max() < len(world.meshes)
            assert set(s.body_object[s.body_object >= 0].tolist()) == set(range(m))
            assert s.object_class.max() < len(world.classes)
            assert (s.sizes > 0).all()
            for field in dataclasses.fields(Snapshot):
                value = getattr(s, field.name)
                assert not isinstance(value, np.ndarray) or np.isfinite(value).all(), field.name
            bottom = s.positions[:, 2] - s.sizes[:, 2] / 2
            hangs = np.isin(s.object_class, (SIGNAL, SIGN))
            np.testing.assert_allclose(bottom[~hangs], 0, atol=1e-12)
            assert (bottom[hangs] > 1.5).all()
            world.step(world.idm_controls())


def test_episode_is_a_function_of_its_seed(intersection: ConnectedDrivingWorld) -> None:
    first = episode(intersection, 3)
    assert episode(intersection, 4) != first
    assert episode(intersection, 3) == first
    assert episode(ConnectedDrivingWorld(2), 3) == first
    assert len(set(first)) == len(first)


@pytest.mark.parametrize("name", ["intersection", "roundabout", "racetrack"])
def test_episode_is_the_same_in_another_process(name: str) -> None:
    code = (
        "import sys, test_driving_world as t;"
        f"print(t.episode(t.ConnectedDrivingWorld(2, t.DrivingParams(map='{name}')), 5)[-1])"
    )
    here = __file__.rsplit("/", 1)[0]
    result = subprocess.run(
        [sys.executable, "-c", code], env={"PYTHONHASHSEED": "77", "PATH": "", "PYTHONPATH": here}, capture_output=True
    )
    assert result.stderr.decode() == ""
    assert result.stdout.decode().strip() == episode(ConnectedDrivingWorld(2, DrivingParams(map=name)), 5)[-1]


def test_process_wide_state_has_no_influence(intersection: ConnectedDrivingWorld) -> None:
    from highway_env.vehicle.behavior import IDMVehicle

    expected = episode(intersection, 6)
    np.random.seed(1)  # noqa: NPY002 - the point is that nobody draws from it
    before = np.random.get_state()[1].tolist()  # noqa: NPY002
    changed = {"DISTANCE_WANTED": 1.0, "COMFORT_ACC_MAX": 9.0, "COMFORT_ACC_MIN": -9.0, "TIME_WANTED": 0.1}
    kept = {name: getattr(IDMVehicle, name) for name in changed}
    try:
        for name, value in changed.items():
            setattr(IDMVehicle, name, value)
        assert episode(intersection, 6) == expected
        assert np.random.get_state()[1].tolist() == before  # noqa: NPY002
    finally:
        for name, value in kept.items():
            setattr(IDMVehicle, name, value)


def test_saved_state_continues_identically(intersection: ConnectedDrivingWorld) -> None:
    world = intersection
    world.reset(np.random.default_rng(8))
    for _ in range(4):
        world.step(world.idm_controls())
    saved = world.save_state()

    def run() -> list[str]:
        prints = []
        for _ in range(10):
            world.step(world.idm_controls())
            prints.append(fingerprint(world.snapshot()))
        return prints

    expected = run()
    world.restore_state(saved)
    assert run() == expected
    world.reset(np.random.default_rng(99))
    world.restore_state(pickle.loads(pickle.dumps(saved)))
    assert run() == expected
    other = ConnectedDrivingWorld(2)
    other.restore_state(saved)
    other.step(other.idm_controls())
    assert fingerprint(other.snapshot()) == expected[0]


def test_asking_the_driver_changes_nothing(intersection: ConnectedDrivingWorld) -> None:
    prints = []
    for ask in (False, True):
        intersection.reset(np.random.default_rng(2))
        for _ in range(6):
            if ask:
                intersection.idm_controls()
            intersection.step(np.zeros((2, 2)))
        prints.append(fingerprint(intersection.snapshot()))
    assert prints[0] == prints[1]


def test_frames_are_right_handed_and_cameras_look_ahead(intersection: ConnectedDrivingWorld) -> None:
    world = intersection
    world.reset(np.random.default_rng(1))
    before = world.snapshot()
    for k in range(2):
        T = before.T_world_camera[k]
        heading = before.headings[k]
        np.testing.assert_allclose(np.linalg.det(T[:3, :3]), 1.0)
        np.testing.assert_allclose(T[:3, 2], [np.cos(heading), np.sin(heading), 0.0], atol=1e-12)
        np.testing.assert_allclose(T[:3, 1], [0.0, 0.0, -1.0], atol=1e-12)
        np.testing.assert_allclose(T[2, 3], world.params.camera_height_m)
    # Traffic keeps to the right: the centre of the crossing lies to the left of everyone who approaches it.
    for k in range(2):
        ahead = np.array([np.cos(before.headings[k]), np.sin(before.headings[k])])
        to_centre = -before.positions[k, :2]
        assert ahead @ to_centre > 0
        assert ahead[0] * to_centre[1] - ahead[1] * to_centre[0] > 1.0
    world.step(np.array([[0.5, 1.0], [0.5, -1.0]]))
    after = world.snapshot()
    assert after.headings[0] > before.headings[0], "a positive steering control turns left"
    assert after.headings[1] < before.headings[1]
    assert after.robot_state[0, 1] > 0 > after.robot_state[1, 1]
    assert (after.robot_state[:, 0] > before.robot_state[:, 0]).all()


def test_velocities_are_the_derivatives_of_positions(intersection: ConnectedDrivingWorld) -> None:
    world = intersection
    world.reset(np.random.default_rng(11))
    before = world.snapshot()
    world.step(np.zeros((2, 2)))
    after = world.snapshot()
    where = {identity: i for i, identity in enumerate(after.identity.tolist())}
    moved = 0
    for i, identity in enumerate(before.identity.tolist()):
        if identity in where:
            j = where[identity]
            mean = (after.positions[j] - before.positions[i]) / world.step_seconds
            slowest = min(np.linalg.norm(before.velocities[i]), np.linalg.norm(after.velocities[j]))
            fastest = max(np.linalg.norm(before.velocities[i]), np.linalg.norm(after.velocities[j]))
            if before.object_class[i] == PEDESTRIAN and slowest != fastest:
                continue  # one who stops or turns back within the step
            assert slowest - 0.6 <= np.linalg.norm(mean) <= fastest + 0.6
            moved += np.linalg.norm(mean) > 0.5
    assert moved > 8


def test_braking_ends_at_a_standstill(intersection: ConnectedDrivingWorld) -> None:
    intersection.reset(np.random.default_rng(0))
    for _ in range(15):
        intersection.step(np.tile([-1.0, 0.0], (2, 1)))
    assert np.abs(intersection.snapshot().robot_state[:, 0]).max() < 1e-6


def test_driving_into_the_street_is_a_collision() -> None:
    world = ConnectedDrivingWorld(2, DrivingParams(n_vehicles=0, max_vehicles=0, n_parked=60, street_spread_m=40.0))
    assert world.ends_on_collision
    collided = 0
    for seed in range(4):
        world.reset(np.random.default_rng(seed))
        assert not world.snapshot().collided.any()
        for _ in range(25):
            world.step(np.tile([0.6, -0.4], (2, 1)))
        collided += int(world.snapshot().collided.sum())
    assert collided >= 4


def test_street_stands_beside_the_road() -> None:
    for name in MAPS:
        world = ConnectedDrivingWorld(2, DrivingParams(map=name))
        world.reset(np.random.default_rng(7))
        street, table = world._episode.street, world._network.table
        standing = np.array(street.objects.positions[: len(street.objects) - len(street.walkers)])
        assert clearance(table, standing).min() > 0.4
        assert clearance(table, np.array(street.scenery.positions)).min() > 1.5
        for path in world._ground.pavements:
            assert clearance(table, path).min() > 0.5


def test_pedestrians_cross_and_signals_switch() -> None:
    world = ConnectedDrivingWorld(2, DrivingParams(n_vehicles=4, max_vehicles=4, crossing_share=1.0, n_pedestrians=12))
    world.reset(np.random.default_rng(0))
    colors, on_road = set(), 0
    red, amber, green = world._catalogue.signals
    for _ in range(60):
        world.step(np.tile([-1.0, 0.0], (2, 1)))
        s = world.snapshot()
        meshes = s.body_mesh[: len(s.identity)][s.object_class == SIGNAL]
        assert set(meshes.tolist()) <= {red, amber, green}
        colors |= set(meshes.tolist())
        crossing = [w for w in world._episode.street.walkers if w.on_road]
        assert len(world._episode.road.objects) == len(crossing), "highway-env's drivers see who crosses"
        on_road = max(on_road, len(crossing))
    assert colors == {red, amber, green}
    assert on_road >= 2


def test_drivers_rarely_collide_and_get_somewhere() -> None:
    collided = 0
    for name in ("intersection", "highway"):
        world = ConnectedDrivingWorld(2, preset("paper", name))
        for seed in (200, 201, 202, 203):
            world.reset(np.random.default_rng(seed))
            start = world.snapshot().positions[:2]
            for _ in range(25):
                world.step(world.idm_controls())
            s = world.snapshot()
            collided += bool(s.collided.any())
            assert np.linalg.norm(s.positions[:2] - start, axis=1).max() > 3.0
    assert collided <= 1


def test_vehicle_sizes_are_those_of_their_meshes(intersection: ConnectedDrivingWorld) -> None:
    for kind in KINDS:
        for mesh in kind.meshes:
            low, high = extent(intersection.meshes[mesh])
            np.testing.assert_allclose(high - low, kind.size, atol=0.12)
            assert abs(low[2]) < 1e-9


def test_paper_preset_is_as_the_paper_says() -> None:
    stats = scene_statistics(ConnectedDrivingWorld(2, preset("paper")), range(300, 308), steps=(0,))
    assert 10 <= stats.objects_per_view <= 20
    assert 0.3 <= stats.non_covisible_per_view <= 0.7
    assert 0.7 <= stats.look_alikes <= 0.95
    assert stats.partly_hidden >= 0.3


def test_presets_differ_and_are_fresh() -> None:
    assert len({preset(name) for name in PRESETS}) == 3
    assert preset("paper") == DrivingParams()
    assert set(MAP_COUNTS) <= set(MAPS)
    with pytest.raises(ValueError, match="'paler'"):
        preset("paler")
    with pytest.raises(ValueError, match="'moon'"):
        preset("paper", "moon")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"map": "parking"}, "'parking'"),
        ({"n_vehicles": -1}, "-1"),
        ({"n_vehicles": 30, "max_vehicles": 20}, "30 exceeds max_vehicles 20"),
        ({"n_pedestrians": 2.5}, r"2\.5"),
        ({"spawn_probability": 1.2}, r"1\.2"),
        ({"look_alike_fraction": float("nan")}, "nan"),
        ({"horizontal_fov_rad": 3.2}, r"3\.2"),
        ({"camera_height_m": 0.0}, r"0\.0"),
        ({"prewarm_s": 1e9}, "1000000000"),
        ({"max_steering_rad": 2.0}, r"2\.0"),
        ({"times_of_day": ("teatime",)}, "teatime"),
    ],
)
def test_impossible_parameters_are_named(changes: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        DrivingParams(**changes)


def test_bad_use_is_named(intersection: ConnectedDrivingWorld) -> None:
    for n in (0, 1, 7):
        with pytest.raises(ValueError, match=f"got {n}"):
            ConnectedDrivingWorld(n)
    with pytest.raises(RuntimeError, match="reset"):
        ConnectedDrivingWorld(2).snapshot()
    intersection.reset(np.random.default_rng(0))
    for controls in (np.zeros(2), np.zeros((3, 2)), np.full((2, 2), np.nan)):
        with pytest.raises(ValueError, match=r"shape \(2, 2\)"):
            intersection.step(controls)
    with pytest.raises(ValueError, match="dict"):
        intersection.restore_state({})


def test_no_room_is_an_error_after_bounded_tries(monkeypatch: pytest.MonkeyPatch) -> None:
    world = ConnectedDrivingWorld(2, DrivingParams(**SMALL, prewarm_s=0.0))
    monkeypatch.setattr(world, "_place_connected", lambda episode: False)
    with pytest.raises(SceneGenerationError, match="2 connected vehicles on map 'intersection'"):
        world.reset(np.random.default_rng(0))


def test_closing_twice_is_harmless() -> None:
    world = ConnectedDrivingWorld(2, DrivingParams(**SMALL))
    world.reset(np.random.default_rng(0))
    world.close()
    world.close()
