"""What observations, infos and rewards of the environment mean."""

import functools
import importlib
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from covis.envs.claims import Claims, claims_to_action
from covis.envs.collaborative import CollaborativeEnv
from covis.envs.scenes import parallel_env
from covis.envs.sensing import MAX_DEPTH_M, PoseNoise

sys.path.append(str(Path(__file__).resolve().parents[2] / "docs" / "examples"))
BoxWorld = importlib.import_module("box_world").BoxWorld
NO_NOISE = PoseNoise(0, 0, 0, 0)
SENSORS = ("image", "depth", "instances")


def make(n_robots=2, n_boxes=8, **options):
    options = {"width": 64, "height": 48, "max_detections": 8, "max_cycles": 5} | options
    return CollaborativeEnv(functools.partial(BoxWorld, n_robots, n_boxes), name="box_world", **options)


def act(env, claims=None, control=(0.0, 0.0)):
    n = len(env.possible_agents) - 1
    claims = claims or [Claims.empty(env.max_detections, n)] * (n + 1)
    return {a: claims_to_action(c, np.array(control)) for a, c in zip(env.agents, claims, strict=True)}


def true_claims(env, error=0.0):
    """Claims of perfect eyes, `error` metres off."""
    truth = env.ground_truth()
    out = []
    for i in range(truth.n_robots):
        claim = Claims.empty(env.max_detections, truth.n_robots - 1)
        claim.boxes[: len(truth.identity)] = truth.boxes[i]
        claim.positions[: len(truth.identity)] = truth.positions_in_camera(i) + [error, 0, 0]
        claim.positions_single[: len(truth.identity)] = truth.positions_in_camera(i) + [0, 2 * error, 0]
        both = np.flatnonzero(truth.visible().all(axis=0))
        claim.matches[:, both] = both
        out.append(claim)
    return out


def test_without_noise_robots_know_where_they_are():
    env = make(pose_noise=NO_NOISE)
    before, _ = env.reset(seed=0)
    after, _, _, _, _ = env.step(act(env, control=(0.8, 0.5)))
    truth = env.ground_truth()
    for i, agent in enumerate(env.possible_agents):
        np.testing.assert_allclose(after[agent]["pose"], truth.T_world_camera[i], atol=1e-6)
        np.testing.assert_allclose(before[agent]["odometry"], np.eye(4), atol=1e-6)
        np.testing.assert_allclose(before[agent]["pose"] @ after[agent]["odometry"], after[agent]["pose"], atol=1e-5)
        np.testing.assert_allclose(after[agent]["pose_covariance"], 0)
        np.testing.assert_allclose(after[agent]["up"], [0, -1, 0], atol=1e-6)


def test_pose_errors_are_as_large_as_the_covariance_says():
    env = make(pose_noise=PoseNoise(0.5, 0.05), width=8, height=8, sensors=())
    errors = []
    for seed in range(150):
        observations, _ = env.reset(seed=seed)
        truth = env.ground_truth().T_world_camera
        for i, o in enumerate(observations.values()):
            motion = np.linalg.inv(o["pose"].astype(float)) @ truth[i]
            errors.append([*motion[:3, 3], motion[0, 2]])
    errors = np.array(errors)
    covariance = observations["robot_0"]["pose_covariance"]
    np.testing.assert_allclose(errors[:, :3].std(axis=0), np.sqrt(np.diag(covariance)[:3]), rtol=0.15)
    np.testing.assert_allclose(errors[:, 3].std(), np.sqrt(np.trace(covariance[3:, 3:])), rtol=0.15)
    assert np.abs(errors.mean(axis=0)).max() < 0.1


def test_images_are_what_the_cameras_saw():
    env = make(sensors=SENSORS)
    observations, _ = env.reset(seed=1)
    for frame, o in zip(env.camera_frames(), observations.values(), strict=True):
        np.testing.assert_array_equal(o["image"], frame.rgb)
        np.testing.assert_array_equal(o["depth"], np.minimum(frame.depth, MAX_DEPTH_M))
        assert np.isfinite(o["depth"]).all()
        np.testing.assert_array_equal(o["instances"] > 0, frame.instances >= 0)


def test_instance_ids_are_right_and_carry_no_identity():
    env = make(sensors=SENSORS)
    seen = set()
    for seed in range(4):
        observations, _ = env.reset(seed=seed)
        snapshot = env.snapshot()
        for frame, o in zip(env.camera_frames(), observations.values(), strict=True):
            for j in np.unique(frame.instances[frame.instances >= 0]):
                (number,) = np.unique(o["instances"][frame.instances == j])
                assert o["instance_classes"][number] == snapshot.object_class[j]
                seen.add((int(j), int(number)))
    assert len({j for j, _ in seen}) < len(seen), "the same object gets other numbers"


def test_messages_are_the_partners_claims_of_the_last_step():
    env = make(n_robots=3, messages=True)
    first, _ = env.reset(seed=0)
    assert (first["robot_0"]["message_matches"] == env.max_detections).all()
    assert not first["robot_0"]["message_boxes"].any()
    claims = true_claims(env, 0.1)
    observations, *_ = env.step(act(env, claims))
    got = observations["robot_1"]
    for slot, partner in enumerate((0, 2)):
        np.testing.assert_allclose(got["message_boxes"][slot], claims[partner].boxes, rtol=1e-6)
        np.testing.assert_allclose(got["message_positions"][slot], claims[partner].positions, rtol=1e-5)
        np.testing.assert_array_equal(got["message_matches"][slot], claims[partner].matches)


def test_figures_and_reward_of_perfect_claims():
    env = make(min_pixels=4)
    env.reset(seed=3)
    truth = env.ground_truth()
    both = int(truth.visible().all(axis=0).sum())
    tied = int((truth.pixels > 0).all(axis=0).sum())
    assert both >= 2
    _, rewards, _, _, infos = env.step(act(env, true_claims(env, 0.1)))
    info = infos["robot_0"]
    assert (info["n_correct"], info["n_retrieved"], info["n_visible"], info["n_covisible"]) == (both, both, both, tied)
    assert info["precision"] == 1
    assert info["displacement_fused_m"] == pytest.approx(0.1, abs=1e-4)
    assert info["displacement_single_m"] == pytest.approx(0.2, abs=1e-4)
    seen = int((truth.pixels > 0).any(axis=0).sum())
    assert rewards["robot_0"] == pytest.approx(seen / len(truth.identity) * (1 - 0.1 / 2.0), abs=1e-3)
    assert set(rewards.values()) == {rewards["robot_0"]}
    _, _, _, _, infos = env.step(act(env))
    assert (infos["robot_0"]["n_retrieved"], infos["robot_0"]["episode_n_retrieved"]) == (0, both)
    assert infos["robot_0"]["displacement_fused_m"] == 0.0
    assert infos["robot_0"]["episode_displacement_fused_m"] == pytest.approx(0.1, abs=1e-4)
    _, infos = env.reset()
    assert infos["robot_0"]["episode_n_retrieved"] == 0


def test_state_lists_objects_and_robots():
    env = make(n_boxes=5)
    env.reset(seed=0)
    state, snapshot = env.state(), env.snapshot()
    table = state[: 13 * 5].reshape(5, 13)
    np.testing.assert_array_equal(table[:, 0], 1)
    np.testing.assert_array_equal(table[:, 2:5], snapshot.positions)
    np.testing.assert_array_equal(state[13 * 5 :].reshape(2, 18)[:, :16].reshape(2, 4, 4), snapshot.T_world_camera)


@pytest.mark.parametrize("n_boxes", [0, 1])
def test_scenes_with_few_objects(n_boxes):
    env = make(n_boxes=n_boxes, sensors=SENSORS, messages=True, render_mode="rgb_array")
    observations, _ = env.reset(seed=0)
    assert all(env.observation_space(a).contains(o) for a, o in observations.items())
    for _ in range(3):
        _, rewards, *_ = env.step({a: env.action_space(a).sample() for a in env.agents})
        assert np.isfinite(list(rewards.values())).all()
    env.render()


def test_one_robot_alone_is_refused():
    with pytest.raises(ValueError, match="at least two robots, the world has 1"):
        make(n_robots=1)


def test_collisions_end_the_episode_only_where_the_world_says():
    class Crash(BoxWorld):
        ends_on_collision = True

        def snapshot(self):
            return replace(super().snapshot(), collided=np.array([False, self.time > 0.3]))

    for ends in (True, False):
        Crash.ends_on_collision = ends
        env = CollaborativeEnv(Crash, name="crash", width=8, height=8, max_cycles=3)
        env.reset(seed=0)
        env.step(act(env))
        _, _, terminations, truncations, infos = env.step(act(env))
        assert set(terminations.values()) == {ends}
        assert set(truncations.values()) == {False}
        assert (infos["robot_0"]["collided"], infos["robot_1"]["collided"]) == (0.0, 1.0)
        assert bool(env.agents) is not ends


def test_a_world_with_more_objects_than_it_said_is_an_error():
    class Liar(BoxWorld):
        def reset(self, rng):
            super().reset(rng)
            self.max_objects = 1  # what it says from now on; it has eight

        def snapshot(self):
            self.max_objects = 8
            out = super().snapshot()
            self.max_objects = 1
            return out

    env = CollaborativeEnv(Liar, name="liar", width=8, height=8)
    with pytest.raises(RuntimeError, match="liar: 8 objects, max_objects is 1"):
        env.reset(seed=0)


def test_pettingzoo_registry():
    pettingzoo = pytest.importorskip("pettingzoo")
    if not hasattr(pettingzoo, "parallel_registry"):
        pytest.skip("this PettingZoo has no registry")
    import covis.envs.multi_robot_v0 as scene

    env = scene.parallel_env(width=32, height=24)
    assert env.metadata["name"] == "multi_robot_v0"
    assert "covis/multi_robot-v0" in pettingzoo.parallel_registry
    assert scene.env(width=32, height=24).unwrapped.name == "multi_robot_v0"
    assert parallel_env("multi_robot", width=32, height=24).action_space("robot_0") == env.action_space("robot_0")
