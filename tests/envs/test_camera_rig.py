"""The cameras of an environment: backends, looks, and effects that belong to the episode."""

from itertools import pairwise

import numpy as np
import pytest
from box_world import BoxWorld

from covis.envs.camera.effects import EffectRanges
from covis.envs.camera.mount import Mount
from covis.envs.camera.raster import PLAIN
from covis.envs.collaborative import CollaborativeEnv
from covis.envs.scenes import parallel_env


def images(env, seed):
    observations, _ = env.reset(seed=seed)
    return np.stack([observations[a]["image"] for a in env.possible_agents])


def boxes(**options):
    return CollaborativeEnv(BoxWorld, name="boxes", width=96, height=72, **options)


def test_looks_change_colours_and_nothing_else():
    rich, plain = boxes(), boxes(look=PLAIN)
    assert (images(rich, 0) != images(plain, 0)).any()
    for a, b in zip(rich.camera_frames(), plain.camera_frames(), strict=True):
        np.testing.assert_array_equal(a.instances, b.instances)
        np.testing.assert_array_equal(a.depth, b.depth)


def test_effects_are_the_episodes_and_the_seeds():
    env = boxes(effects=EffectRanges())
    first, again, other = images(env, 1), images(env, 1), images(env, 2)
    np.testing.assert_array_equal(first, again)
    assert (first != other).any()
    assert np.abs(first.astype(int) - images(boxes(), 1)).mean() > 1.0


def test_a_lens_bends_images_and_truth_alike():
    bent = boxes(effects=EffectRanges(k1=(-0.2, -0.2)))
    straight = boxes()
    bent.reset(seed=3)
    straight.reset(seed=3)
    a, b = bent.ground_truth(), straight.ground_truth()
    assert (a.boxes != b.boxes).any()
    for frame, truth in zip(bent.camera_frames(), a.pixels, strict=True):
        assert [(frame.instances == j).sum() for j in range(len(truth))] == truth.tolist()


def test_saved_states_go_on_with_the_same_noise():
    env = parallel_env("aerial_ground", preset="easy", width=64, height=48)
    env.reset(seed=0)
    saved = env.save_state()
    rng = np.random.default_rng(0)
    actions = {a: {**env.action_space(a).sample(), "control": rng.uniform(-1, 1, 4)} for a in env.agents}
    first = env.step(actions)[0]
    env.reset(seed=9)
    env.restore_state(saved)
    second = env.step(actions)[0]
    for agent in first:
        np.testing.assert_array_equal(first[agent]["image"], second[agent]["image"])
    env.close()


def test_tiny_renderer_sees_the_same_objects():
    pytest.importorskip("pybullet")
    ours, tiny = boxes(look=PLAIN), boxes(backend="tiny")
    ours.reset(seed=4)
    tiny.reset(seed=4)
    for a, b in zip(ours.camera_frames(), tiny.camera_frames(), strict=True):
        assert (a.instances == b.instances).mean() > 0.98
    tiny.close()
    tiny.close()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"backend": "unreal"}, "backend must be one of raster, tiny, egl, got 'unreal'"),
        ({"backend": "tiny", "look": PLAIN}, "look and effects are of our own camera"),
        ({"backend": "egl", "effects": EffectRanges()}, "look and effects are of our own camera"),
    ],
)
def test_impossible_cameras_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        boxes(**options)


def test_a_mount_moves_a_camera_and_widens_its_view():
    mount = Mount(forward_m=0.2, height_m=2.0, tilt_rad=0.3, horizontal_fov_rad=1.6)
    plain, moved = (
        parallel_env("multi_robot", preset="easy", width=64, height=48, mounts=mounts)
        for mounts in (None, (None, mount))
    )
    plain.reset(seed=0)
    moved.reset(seed=0)
    before, after = plain.snapshot(), moved.snapshot()
    np.testing.assert_array_equal(after.T_world_camera[0], before.T_world_camera[0])
    np.testing.assert_array_equal(plain.camera_frames()[0].rgb, moved.camera_frames()[0].rgb)
    assert after.T_world_camera[1, 2, 3] == pytest.approx(2.0)
    assert moved.intrinsics[1, 0, 0] == pytest.approx(32 / np.tan(0.8))
    np.testing.assert_allclose(after.T_world_camera[1], mount.T_world_camera(before.body_poses[1]))


def test_a_slow_camera_keeps_its_picture_and_the_truth_goes_with_it():
    env = parallel_env("connected_driving", width=96, height=72, mounts=(Mount(height_m=1.6, rate_hz=2.5), None))
    env.reset(seed=2)
    actions = {a: env.action_space(a).sample() | {"control": np.zeros(2, np.float32)} for a in env.agents}
    pictures, names = [], []
    for _ in range(5):
        observations = env.step(actions)[0]
        pictures.append(observations["robot_0"]["image"])
        truth, frame = env.ground_truth(), env.camera_frames()[0]
        names.append({int(i) for i in truth.identity[truth.pixels[0] > 0]})
        assert [(frame.instances == j).sum() for j in range(len(truth.identity))] == truth.pixels[0].tolist()
    same = [bool((a == b).all()) for a, b in pairwise(pictures)]
    assert same == [False, True, False, True]  # steps 1..5 of 0.2 s, a picture every 0.4 s
    assert names[2] <= names[1]
    saved = env.save_state()
    first = env.step(actions)[0]["robot_0"]["image"]
    env.restore_state(saved)
    np.testing.assert_array_equal(env.step(actions)[0]["robot_0"]["image"], first)


@pytest.mark.parametrize(
    ("mounts", "error", "message"),
    [
        ((None,), ValueError, r"one Mount or None per robot, 2 of them, got \(None,\)"),
        (5, ValueError, "one Mount or None per robot, 2 of them, got 5"),
        ((None, 1.0), TypeError, r"mounts\[1\] must be a Mount"),
    ],
)
def test_mounts_must_fit_the_robots(mounts, error, message):
    with pytest.raises(error, match=message):
        boxes(mounts=mounts)


def test_a_robot_without_a_body_carries_no_mount():
    env = boxes(mounts=(Mount(), None))
    with pytest.raises(ValueError, match="robot 0 has no body"):
        env.reset(seed=0)


def test_a_camera_sees_its_own_robot_only_if_mounted_so():
    above = {"forward_m": -1.5, "height_m": 1.6, "tilt_rad": 0.6}
    for backend in ("raster", "tiny"):
        env = parallel_env(
            "multi_robot",
            preset="easy",
            width=64,
            height=48,
            backend=backend,
            mounts=(Mount(**above), Mount(**above, own_body=True)),
        )
        env.reset(seed=0)
        truth, own = env.ground_truth(), env.snapshot().robot_object
        assert truth.pixels[0, own[0]] == 0
        assert truth.pixels[1, own[1]] > 50
        env.close()


@pytest.mark.parametrize("value", [float("nan"), float("inf"), "2"])
def test_a_mount_takes_finite_numbers(value):
    with pytest.raises(ValueError, match="height_m must be a finite number"):
        Mount(height_m=value)
