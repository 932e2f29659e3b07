"""Aerial-ground and target-localization scenes, wheel dynamics, presets, statistics, peers."""

from __future__ import annotations

import dataclasses
import math
import pickle
import struct
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from covis.envs.worlds import aerial_ground, multi_robot, target_localization
from covis.envs.worlds.aerial_ground import AerialGroundParams, AerialGroundWorld
from covis.envs.worlds.layout import place_apart
from covis.envs.worlds.lighting import TIMES_OF_DAY, sample_light
from covis.envs.worlds.models import ROBOT_CLASSES, models, stock_husky
from covis.envs.worlds.multi_robot import MultiRobotParams, MultiRobotWorld
from covis.envs.worlds.peers import TinyPeer, gl_matrices, speed_params
from covis.envs.worlds.robots import RobotWorld
from covis.envs.worlds.statistics import scene_statistics
from covis.envs.worlds.target_localization import TargetLocalizationParams, TargetLocalizationWorld
from covis.envs.worlds.team import advance_waypoints, team_commands
from covis.envs.worlds.urdf import simplified, urdf_mesh
from covis.envs.worlds.wheels import WheelDynamics
from covis.envs.worlds.world import SceneGenerationError, Snapshot

SCENES: list[tuple[ModuleType, type[RobotWorld]]] = [
    (multi_robot, MultiRobotWorld),
    (aerial_ground, AerialGroundWorld),
    (target_localization, TargetLocalizationWorld),
]


def arrays(snapshot: Snapshot) -> dict[str, np.ndarray]:
    """All arrays of a snapshot by name."""
    named = {f.name: getattr(snapshot, f.name) for f in dataclasses.fields(snapshot)}
    return {name: value for name, value in named.items() if isinstance(value, np.ndarray)}


def same(a: Snapshot, b: Snapshot) -> bool:
    """Whether two snapshots agree bit for bit."""
    return dataclasses.astuple(a.light) == dataclasses.astuple(b.light) and all(
        x.tobytes() == y.tobytes() for x, y in zip(arrays(a).values(), arrays(b).values(), strict=True)
    )


def run(world: RobotWorld, steps: int, seed: int = 1) -> Snapshot:
    """The snapshot after steps of lively controls."""
    drive = np.random.default_rng(seed)
    for _ in range(steps):
        world.step(drive.uniform(-1, 1, (world.n_robots, world.control_size)))
    return world.snapshot()


@pytest.mark.parametrize(("module", "make"), SCENES)
@pytest.mark.parametrize("name", ["easy", "paper", "hard"])
def test_presets_make_valid_scenes(module: ModuleType, make: type[RobotWorld], name: str) -> None:
    world = make(2, module.preset(name))
    for seed in range(8):
        world.reset(np.random.default_rng(seed))
        s = run(world, 2)
        m, n = len(s.identity), world.n_robots
        assert m <= world.max_objects
        assert len(set(s.identity.tolist())) == m
        assert {0 <= c < len(world.classes) for c in s.object_class.tolist()} == {True}
        assert s.body_mesh.max() < len(world.meshes)
        assert s.body_object.max() == m - 1
        assert s.robot_state.shape == (n, world.state_size)
        assert world.horizontal_fov_rad.shape == (n,)
        assert (s.body_tints >= 0).all()
        assert (s.body_tints <= 1).all()
        assert all(np.isfinite(value).all() for value in arrays(s).values())
        assert np.linalg.norm(s.light.sun_direction) == pytest.approx(1.0)
        rotations = s.body_poses[:, :3, :3]
        assert rotations @ rotations.transpose(0, 2, 1) == pytest.approx(np.tile(np.eye(3), (len(rotations), 1, 1)))
    world.close()


@pytest.mark.parametrize("module", [module for module, _ in SCENES])
def test_unknown_presets_are_named(module: ModuleType) -> None:
    with pytest.raises(ValueError, match=r"'nightmare'.*easy, paper, hard"):
        module.preset("nightmare")


@pytest.mark.parametrize(("module", "make"), SCENES)
@pytest.mark.parametrize("dynamics", ["box", "wheels"])
def test_seeds_decide_and_saved_states_continue(module: ModuleType, make: type[RobotWorld], dynamics: str) -> None:
    params = dataclasses.replace(module.preset("easy"), dynamics=dynamics)
    one, other = make(2, params), make(2, params)
    other.reset(np.random.default_rng(9))
    run(other, 3)
    for world in (one, other):
        world.reset(np.random.default_rng(8))
    assert same(run(one, 6), run(other, 6))
    saved = pickle.loads(pickle.dumps(one.save_state()))
    expected = run(one, 5, seed=2)
    other.reset(np.random.default_rng(9))
    run(other, 2)
    other.restore_state(saved)
    assert same(run(other, 5, seed=2), expected)
    other.reset(np.random.default_rng(9))
    assert not same(run(other, 5, seed=2), expected)
    one.close()
    other.close()


def test_look_alikes() -> None:
    """S-MRC and the case study: everything looks the same; R-MRC: four fifths do, the rest stand out."""
    for module, make in SCENES[::2]:
        world = make(2, module.preset("paper"))
        world.reset(np.random.default_rng(0))
        s = world.snapshot()
        m = len(s.identity)
        assert len(set(s.body_mesh[:m].tolist())) == 1
        assert np.ptp(s.body_tints[:m], axis=0) == pytest.approx(0.0)
    air = AerialGroundWorld(2, aerial_ground.preset("paper"))
    classes = set()
    for seed in range(10):
        air.reset(np.random.default_rng(seed))
        s = air.snapshot()
        team = slice(2, len(s.identity))
        looks = [(mesh, *tint) for mesh, tint in zip(s.body_mesh[team], s.body_tints[team].tolist(), strict=True)]
        common = max(looks.count(look) for look in looks)
        assert 0.75 <= common / len(looks) <= 0.88
        assert len(set(looks)) == len(looks) - common + 1  # no two of the unique ones look alike
        classes |= {air.classes[c].name for c in s.object_class}
    assert classes == {"husky", "rover", "carrier", "drone"}


def test_the_drone_flies_by_a_first_order_lag() -> None:
    params = AerialGroundParams(n_team=3, n_obstacles=(0, 0), n_backdrop=(0, 0), drone_lag_s=0.4, drone_speed_mps=3.0)
    world = AerialGroundWorld(2, params)
    world.reset(np.random.default_rng(0))
    s = world.snapshot()
    start, heading = s.positions[0], s.headings[0]
    controls = np.zeros((2, 4))
    controls[0] = (1.0, 0.0, 0.5, 0.2)
    steps = 12
    for _ in range(steps):
        world.step(controls)
    s = world.snapshot()
    t = steps * 0.2
    way = t - 0.4 * (1 - math.exp(-t / 0.4))  # integral of 1 - exp(-t / lag)
    c, si = math.cos(heading), math.sin(heading)
    wanted = np.array([c * 3.0 - si * 1.5, si * 3.0 + c * 1.5, 0.3])
    assert s.positions[0] - start == pytest.approx(wanted * way, abs=0.02)  # the box's centre tilts a little
    assert s.robot_state[0, :4] == pytest.approx([3.0, 0.0, 1.5, 0.3], abs=0.02)
    assert s.robot_state[0, 4] == pytest.approx(s.T_world_camera[0, 2, 3])
    assert s.robot_velocity[0] == pytest.approx(s.velocities[0])
    assert s.T_world_camera[0, 2, 2] < -0.8  # looks down
    assert s.headings[0] == pytest.approx(heading, abs=0.01)
    controls[0] = (0.0, 0.5, 0.0, -1.0)
    for _ in range(60):
        world.step(controls)
    s = world.snapshot()
    assert s.robot_state[0, 4] == params.drone_ceiling_m[0]
    assert s.robot_state[0, 3] == 0.0
    assert s.robot_state[0, 1] == pytest.approx(0.6)
    assert not s.collided.any()
    world.close()


def test_a_drone_leans_into_its_acceleration() -> None:
    world = AerialGroundWorld(2, AerialGroundParams(n_team=0, n_obstacles=(0, 0)))
    world.reset(np.random.default_rng(0))
    world.step(np.array([[1.0, 0, 0, 0], [0, 0, 0, 0]]))
    s = world.snapshot()
    up, ahead = s.body_poses[0, :3, 2], np.array([math.cos(s.headings[0]), math.sin(s.headings[0]), 0.0])
    assert up @ ahead > 0.05  # nose down: thrust points ahead
    camera_right = s.T_world_camera[0, :3, 0]
    assert camera_right[2] == pytest.approx(0.0)  # the gimbal stays level
    world.close()


def test_ground_robots_ignore_the_drones_controls() -> None:
    world = AerialGroundWorld(2, aerial_ground.preset("easy"))
    world.reset(np.random.default_rng(0))
    saved = world.save_state()
    world.step(np.array([[0, 0, 0, 0], [0.5, 0.2, 0, 0]]))
    expected = world.snapshot()
    world.restore_state(saved)
    world.step(np.array([[0, 0, 0, 0], [0.5, 0.2, 1.0, -1.0]]))
    assert same(world.snapshot(), expected)
    with pytest.raises(ValueError, match=r"\(2, 2\)"):
        world.step(np.zeros((2, 2)))
    world.close()


def test_obstacles_of_the_case_study_are_objects_that_stand_still() -> None:
    world = TargetLocalizationWorld()
    world.reset(np.random.default_rng(0))
    before = world.snapshot()
    for _ in range(20):
        world.step(np.zeros((2, 2)))
    after = world.snapshot()
    moved = np.linalg.norm(after.positions - before.positions, axis=1)
    assert (moved[4:] == 0.0).all()
    assert (after.velocities[4:] == 0.0).all()
    assert (moved[2:4] > 0.05).all()  # both targets
    assert len(moved) >= 4 + 20
    assert np.abs(after.positions[:, :2]).max() < 4.0  # an arena of a few metres
    assert after.sizes[:, 0].max() < 0.4
    world.close()


def test_wheels_drive_like_the_unicycle_they_stand_for() -> None:
    dynamics = WheelDynamics(1, np.zeros((0, 2)))
    state = dynamics.rest(np.array([[0.0, 0.0, 0.0]]))
    for _ in range(15):
        state, touched = dynamics.advance(state, np.array([[1.0, 0.0]]))
    assert state.velocity[0] == pytest.approx([1.0, 0.0, 0.0], abs=0.05)
    assert not touched.any()
    state = dynamics.rest(np.array([[0.0, 0.0, 0.0]]))
    rates = []
    for _ in range(25):  # skid steering slips and wobbles: the mean follows the command
        state, _ = dynamics.advance(state, np.array([[0.0, 0.8]]))
        rates.append(state.velocity[0, 2])
    assert np.mean(rates[5:]) == pytest.approx(0.8, rel=0.25)
    assert np.abs(state.planar[0, :2]).max() < 1.0
    dynamics.close()


def test_wheels_stop_at_obstacles_and_say_nothing() -> None:
    """Loading the URDF prints warnings from C; none may reach the terminal."""
    code = (
        "import numpy as np\n"
        "from covis.envs.worlds.wheels import WheelDynamics\n"
        "d = WheelDynamics(1, np.array([[1.0, 1.0]])); d.set_obstacles(np.array([[2.0, 0.0, 0.0]]))\n"
        "s = d.rest(np.zeros((1, 3)))\n"
        "for _ in range(15): s, touched = d.advance(s, np.array([[1.0, 0.0]]))\n"
        "print(bool(touched[0]), bool(0.7 < s.planar[0, 0] < 1.2)); d.close()"
    )
    done = subprocess.run([sys.executable, "-W", "ignore", "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "True True\n"
    assert done.stderr == ""


def test_team_kernels_equal_their_numpy_reference() -> None:
    rng = np.random.default_rng(0)
    t, k = 7, 3
    waypoints, speed = rng.uniform(-5, 5, (t, 4, 2)), rng.uniform(0.2, 1, t)
    speed[2] = 0.0
    target = rng.integers(0, 4, t)
    planar = np.column_stack([rng.uniform(-2, 2, (t, 2)), rng.uniform(-3, 3, t)])
    others = rng.uniform(-3, 3, (k, 2))
    got = team_commands(waypoints, speed, 1.2, 2.0, target, planar, others)
    wish = waypoints[np.arange(t), target] - planar[:, :2]
    wish /= np.linalg.norm(wish, axis=1, keepdims=True)
    away = planar[:, None, :2] - np.vstack([planar[:, :2], others])
    distance = np.linalg.norm(away, axis=2)
    distance[np.arange(t), np.arange(t)] = np.inf
    push = 3.0 * np.clip(1 - distance / 2.0, 0, None) / distance
    wish += (push[..., None] * (away + 0.6 * np.stack([-away[..., 1], away[..., 0]], -1))).sum(1)
    error = np.angle(np.exp(1j * (np.arctan2(wish[:, 1], wish[:, 0]) - planar[:, 2])))
    expected = np.column_stack([speed * np.clip(np.cos(error), 0, 1), np.clip(2.5 * error, -1.2, 1.2) * (speed > 0)])
    assert got == pytest.approx(expected, abs=1e-9)
    planar[1, :2] = waypoints[1, target[1]] + 0.1
    planar[4, :2] = waypoints[4, target[4]] + (0.6 + 0.5 * speed[4] + 0.01, 0.0)
    after = advance_waypoints(waypoints, speed, target, planar, 0.6)
    assert after[1] == (target[1] + 1) % 4
    assert after[4] == target[4]


def test_place_apart_keeps_its_distances_or_says_why() -> None:
    rng = np.random.default_rng(0)
    taken = np.array([[0.0, 0.0]])
    spots = place_apart(lambda i: rng.uniform(-5, 5, 2), 12, 1.0, "thing", taken=taken, clearance_m=2.0)
    gaps = np.linalg.norm(spots[:, None] - spots[None], axis=2) + 10 * np.eye(12)
    assert gaps.min() >= 1.0
    assert np.linalg.norm(spots, axis=1).min() >= 2.0
    with pytest.raises(SceneGenerationError, match="no place for thing 2 of 2"):
        place_apart(lambda i: np.zeros(2), 2, 1.0, "thing")
    assert place_apart(lambda i: np.zeros(2), 0, 1.0, "thing").shape == (0, 2)


def test_light_varies_and_stays_in_its_bounds() -> None:
    rng = np.random.default_rng(0)
    for name, (elevation, ambient, _, _) in TIMES_OF_DAY.items():
        lights = [sample_light(rng, (name,)) for _ in range(20)]
        for light in lights:
            height = math.degrees(math.asin(light.sun_direction[2]))
            assert elevation[0] - 1e-6 <= height <= elevation[1] + 1e-6
            assert ambient[0] <= light.ambient <= ambient[1]
            assert all(0 <= c <= 255 for c in light.sky_color + light.horizon_color + light.ground_color)
        assert len({light.sun_direction for light in lights}) == 20
    with pytest.raises(ValueError, match="dusk"):
        sample_light(rng, ("dusk",))


def test_models_stand_on_the_ground_within_their_boxes() -> None:
    small = models(0.5)
    for model, half in zip(models(), small, strict=True):
        assert model.mesh.vertices[:, 2].min() == pytest.approx(0.0, abs=0.05)
        assert -1 <= model.object_class < len(ROBOT_CLASSES)
        if model.object_class >= 0:
            assert ROBOT_CLASSES[model.object_class].name == model.name
            assert half.size == pytest.approx(0.5 * model.size)
        assert len(model.mesh.faces) < 600


def test_stock_meshes_at_any_level_of_detail() -> None:
    """Coarser has fewer triangles and about the same box; the finest is the files' own."""
    levels = [stock_husky(d) for d in (0.0, 0.02, 0.05)]
    counts = [len(mesh.faces) for mesh in levels]
    assert counts[0] > 30000 > 3 * counts[1] > 9 * counts[2] > 0
    for mesh in levels:
        assert np.ptp(mesh.vertices, axis=0) == pytest.approx([0.98, 0.68, 0.385], abs=0.03)
        assert mesh.vertices[:, 2].min() == pytest.approx(0.0, abs=0.01)
        assert np.unique(mesh.faces).max() == len(mesh.vertices) - 1
    world = MultiRobotWorld(2, MultiRobotParams(n_team=3, meshes="stock"))
    world.reset(np.random.default_rng(0))
    s = world.snapshot()
    assert s.sizes[0] == pytest.approx(np.ptp(world.meshes[s.body_mesh[0]].vertices, axis=0))
    assert len(world.meshes[s.body_mesh[0]].faces) > 1000
    world.close()
    with pytest.raises(ValueError, match=r"meshes.*high"):
        MultiRobotParams(meshes="high")


def test_urdf_meshes_stand_where_their_joints_put_them(tmp_path: Path) -> None:
    """A tetrahedron as STL on a link turned by 90 degrees about z and moved."""
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3]], dtype="<f4")
    faces = [(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)]
    body = b"".join(struct.pack("<12fH", 0, 0, 0, *corners[list(face)].ravel(), 0) for face in faces)
    (tmp_path / "tetra.stl").write_bytes(b" " * 80 + struct.pack("<I", 4) + body)
    (tmp_path / "robot.urdf").write_text(
        '<robot name="r"><material name="paint"><color rgba="1 0.5 0 1"/></material><link name="root"/>'
        '<link name="arm"><visual><geometry><mesh filename="tetra.stl"/></geometry><material name="paint"/></visual>'
        '</link><joint name="j" type="fixed"><origin xyz="0 0 1" rpy="0 0 1.5707963"/>'
        '<parent link="root"/><child link="arm"/></joint></robot>'
    )
    mesh = urdf_mesh(str(tmp_path / "robot.urdf"))
    expected = np.array([[0, 0, 1], [0, 1, 1], [-2, 0, 1], [0, 0, 4]])
    assert sorted(np.round(mesh.vertices, 5).tolist()) == sorted(expected.tolist())
    assert (mesh.colors == [255, 128, 0]).all()
    assert len(simplified(mesh, 10.0).faces) == 0
    (tmp_path / "tetra.stl").write_bytes(b"solid ascii")
    with pytest.raises(ValueError, match=r"tetra\.stl"):
        urdf_mesh(str(tmp_path / "robot.urdf"))


def test_statistics_of_a_scene_made_to_measure() -> None:
    """Two observers that look at each other across an empty yard each see just the other."""

    class Facing(MultiRobotWorld):
        def _place_observers(self, rng: np.random.Generator, team: np.ndarray) -> np.ndarray:
            return np.array([[-3.0, 0.0, 0.0], [3.0, 0.0, np.pi]])

    world = Facing(2, MultiRobotParams(n_team=0, n_obstacles=(0, 0), n_backdrop=(0, 0)))
    s = scene_statistics(world, range(2), steps=(0, 1))
    assert s.instants == 4
    assert s.objects == 2
    assert s.objects_per_view == s.classes == 1
    assert s.objects_by_robot == (1.0, 1.0)
    assert s.covisible_per_pair == 0
    assert s.non_covisible_per_view == s.non_covisible_per_pair == s.pairs_without_covisible == 1
    assert s.partly_hidden == s.fully_hidden == s.look_alikes == 0
    assert s.depth_m == pytest.approx(5.9, abs=0.2)
    world.close()
    with pytest.raises(ValueError, match="seed"):
        scene_statistics(world, [])


def test_statistics_see_who_hides_whom() -> None:
    """Third robot behind the second: hidden from robot 0, seen by robot 1 from the side."""

    class Queue(MultiRobotWorld):
        def _place_observers(self, rng: np.random.Generator, team: np.ndarray) -> np.ndarray:
            return np.array([[-4.0, 0.0, 0.0], [1.0, -5.0, np.pi / 2]])

        def _place_team(self, rng: np.random.Generator, radius: float) -> np.ndarray:
            return np.array([[0.0, 0.0, np.pi / 2], [1.6, 0.0, np.pi / 2]])

    params = MultiRobotParams(
        n_team=2, n_obstacles=(0, 0), n_backdrop=(0, 0), camera_height_m=(0.35, 0.35), moving_share=0.0
    )
    world = Queue(2, params)
    s = scene_statistics(world, [0], steps=(0,))
    assert s.objects_per_view == 1.5
    assert s.fully_hidden == pytest.approx(1 / 4)
    assert s.covisible_per_pair == 1
    assert s.non_covisible_per_pair == pytest.approx(1 / 2)
    assert s.non_covisible_per_view == pytest.approx(1 / 3)
    assert s.look_alikes == pytest.approx(2 / 3)
    world.close()


def test_peers_show_the_same_scene() -> None:
    """TinyRenderer's ids of the same boxes and meshes agree with what our camera sees."""
    from covis.envs.camera.backends import TINY_SAMPLE_OFFSET
    from covis.envs.camera.raster import Rasterizer, intrinsics_from_fov

    peer = TinyPeer(width=160, height=120, stock=False, params=speed_params(6))
    first = peer.reset(np.random.default_rng(0))
    controls = np.tile([0.5, 0.2], (2, 1))
    images = peer.step(controls)
    assert len(first) == len(images) == 2
    world = MultiRobotWorld(2, speed_params(6))
    world.reset(np.random.default_rng(0))
    world.step(controls)
    snapshot = world.snapshot()
    raster = Rasterizer(world.meshes, 160, 120, sample_offset=TINY_SAMPLE_OFFSET)
    for robot, image in enumerate(images):
        frame = raster.render(snapshot, robot, intrinsics_from_fov(160, 120, float(world.horizontal_fov_rad[robot])))
        ours = np.where(frame.instances >= 0, frame.instances, -1)
        theirs = np.where((image.ids >= 0) & (image.ids < 8), image.ids, -1)
        union = (ours >= 0) | (theirs >= 0)
        assert union.sum() > 100
        assert (ours == theirs)[union].mean() > 0.95
    peer.close()
    peer.close()
    world.close()


@pytest.mark.parametrize("stock", [False, True])
def test_a_peer_plays_the_scene_of_another_world(stock: bool) -> None:
    params = speed_params(3)
    world, peer = MultiRobotWorld(2, params), TinyPeer(width=64, height=48, stock=stock, params=params)
    peer.reset(np.random.default_rng(1))
    peer.step(np.ones((2, 2)))
    world.reset(np.random.default_rng(0))
    images = peer.follow(world)
    here, there = world.snapshot(), peer.world.snapshot()
    assert np.allclose(there.body_poses, here.body_poses, atol=1e-12)
    again = peer.follow(world)
    assert all((a.rgb == b.rgb).all() for a, b in zip(images, again, strict=True))
    controls = np.tile([0.5, 0.0], (2, 1))
    world.step(controls)
    peer.step(controls)
    moved = world.snapshot().positions - here.positions
    assert np.linalg.norm(moved[:2], axis=1) == pytest.approx(0.2 * 0.5 * params.max_speed_mps, rel=0.01)
    if not stock:
        assert np.allclose(peer.world.snapshot().positions, world.snapshot().positions, atol=1e-9)
    peer.close()
    world.close()


def test_the_stock_peer_steps_and_sees() -> None:
    peer = TinyPeer(width=64, height=48, stock=True, params=speed_params(2))
    before = peer.reset(np.random.default_rng(0))[0]
    for _ in range(3):
        after = peer.step(np.ones((2, 2)))[0]
    assert after.rgb.shape == (48, 64, 4)
    assert (after.rgb != before.rgb).any()
    peer.close()


def test_gl_matrices_project_like_a_pinhole() -> None:
    T = np.eye(4)
    T[:3, :3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]
    T[:3, 3] = (1.0, 2.0, 3.0)
    view, projection = gl_matrices(T, math.radians(90), 0.75)
    V, P = np.reshape(view, (4, 4)).T, np.reshape(projection, (4, 4)).T
    point = np.array([1.0 + 4.0, 2.0 - 2.0, 3.0 - 1.5, 1.0])  # 4 m ahead, 2 m right, 1.5 m down
    clip = P @ V @ point
    assert clip[:2] / clip[3] == pytest.approx([0.5, -0.5])


def test_bad_parameters_of_the_new_scenes_are_named() -> None:
    with pytest.raises(ValueError, match=r"drone_lag_s.*0\.0"):
        AerialGroundParams(drone_lag_s=0.0)
    with pytest.raises(ValueError, match=r"drone_altitude_m.*30"):
        AerialGroundParams(drone_altitude_m=(10.0, 30.0))
    with pytest.raises(ValueError, match=r"drone_fov_deg.*200"):
        AerialGroundParams(drone_fov_deg=200.0)
    with pytest.raises(ValueError, match=r"backdrop.*desert"):
        TargetLocalizationParams(backdrop="desert")
    with pytest.raises(ValueError, match=r"n_robots.*0"):
        AerialGroundWorld(0)
