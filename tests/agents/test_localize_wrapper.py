"""A policy that only moves, and the scenes in Gymnasium's registry."""

import importlib
import subprocess
import sys
from pathlib import Path

import cloudpickle
import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from pettingzoo.test import parallel_api_test

import covis.agents  # enters the scenes in Gymnasium's registry
from covis.agents.gymnasium_registry import VERSIONS, gymnasium_id
from covis.agents.localizer import Localizer
from covis.agents.perception import make_perceptor
from covis.agents.wrapper import LocalizeWrapper
from covis.envs.scenes import SCENES, parallel_env

SMALL = {"width": 96, "height": 72, "max_detections": 8, "max_cycles": 4}


def test_it_comes_from_the_package():
    assert covis.agents.LocalizeWrapper is LocalizeWrapper
    with pytest.raises(AttributeError, match=r"'covis.agents' has no attribute 'Nobody'"):
        _ = covis.agents.Nobody


def make(seed=None, slots=None):
    env = parallel_env("multi_robot", sensors=("image", "depth", "instances"), seed=seed, **SMALL)
    eyes = make_perceptor("simulated", env)
    return LocalizeWrapper(env, Localizer(eyes, "hungarian", "known", max_detections=slots or env.max_detections))


def play(env, seed=None):
    """Everything of one episode as bytes."""
    observations, _ = env.reset(seed=seed)
    out = [observations["robot_0"]["image"].tobytes()]
    while env.agents:
        controls = {a: np.full(2, 0.3, np.float32) for a in env.agents}
        observations, rewards, _, _, infos = env.step(controls)
        claims = env.unwrapped.answered().claims
        out += [observations["robot_1"]["pose"].tobytes(), repr((rewards, infos)).encode()]
        out += [c.boxes.tobytes() + c.positions.tobytes() + c.matches.tobytes() for c in claims]
    return b"".join(out)


@pytest.mark.filterwarnings("ignore:.*reset option.*")
def test_it_is_an_environment_whose_actions_are_controls():
    env = make()
    parallel_api_test(env, num_cycles=8)
    assert env.action_space("robot_0") == gymnasium.spaces.Box(-1, 1, (2,), np.float32)
    assert env.action_space("robot_0") is env.action_space("robot_0")


def test_the_localizer_claims_and_is_scored():
    env = make()
    retrieved = 0.0
    for seed in range(3):
        play(env, seed)
        retrieved += env.unwrapped.last_score().counts.retrieved
    assert retrieved > 0


def test_same_seed_same_claims():
    env = make()
    first, second = play(env, seed=1), play(env)
    assert first != second
    assert (play(env, seed=1), play(env)) == (first, second)
    assert (play(make(seed=1), 1), play(cloudpickle.loads(cloudpickle.dumps(env)), 1)) == (first, first)
    assert play(env, seed=2) != first


def test_state_is_saved_with_the_localizers_random_numbers():
    env = make()
    env.reset(seed=1)
    controls = {a: np.full(2, 0.3, np.float32) for a in env.agents}
    env.step(controls)
    saved = env.save_state()
    expected = [repr(env.step(controls)[1:]) for _ in range(2)]
    for other in (env, make()):
        other.reset(options={"state": saved})
        assert [repr(other.step(controls)[1:]) for _ in range(2)] == expected
    with pytest.raises(ValueError, match="seed must be None"):
        env.reset(seed=1, options={"state": saved})
    with pytest.raises(ValueError, match="save_state"):
        env.restore_state("nonsense")


def test_bad_use_is_named():
    with pytest.raises(ValueError, match="the localizer has 5 slots, the environment 8"):
        make(slots=5)
    env = make()
    with pytest.raises(RuntimeError, match="reset"):
        env.step({})
    env.reset(seed=0)
    good = np.zeros(2, np.float32)
    with pytest.raises(ValueError, match="robot_1: no action"):
        env.step({"robot_0": good})
    for wrong in (np.zeros(3), np.array([np.nan, 0]), "x", None):
        with pytest.raises(ValueError, match="robot_1: leaf 'control'"):
            env.step({"robot_0": good, "robot_1": wrong})


def test_every_scene_is_registered_under_its_version():
    assert {name: scene.version for name, scene in SCENES.items()} == VERSIONS
    assert all(gymnasium_id(scene) in gymnasium.registry for scene in SCENES)


@pytest.mark.parametrize("scene", SCENES)
def test_gymnasium_make(scene):
    env = gymnasium.make(gymnasium_id(scene), **SMALL)
    check_env(env.unwrapped, skip_render_check=True)
    assert "depth" not in env.observation_space.spaces, "privileged images are for the localizer's eyes alone"
    env.reset(seed=0)
    _, reward, _, _, info = env.step(env.action_space.sample())
    assert np.isfinite(reward)
    assert "n_correct" in info
    env.close()


def test_gymnasium_make_names_the_views():
    with pytest.raises(ValueError, match="view must be 'team' or one of robot_0, robot_1, got 'robot'"):
        gymnasium.make("covis/MultiRobot-v0", view="robot", **SMALL)


def test_gymnasium_make_views_and_rendering():
    env = gymnasium.make("covis/MultiRobot-v0", view="team", render_mode="rgb_array", sensors=("depth",), **SMALL)
    check_env(env.unwrapped)
    assert env.action_space.shape == (4,)
    assert set(env.observation_space.spaces) >= {"depth", "pose"}
    assert "image" not in env.observation_space.spaces
    env.reset(seed=0)
    assert env.render().dtype == np.uint8
    env.close()


def test_gymnasium_finds_the_scene_by_module():
    code = "import gymnasium; print(gymnasium.make('covis.agents:covis/MultiRobot-v0', width=32, height=24).spec.id)"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert out.stdout.strip() == "covis/MultiRobot-v0"


def test_gymnasium_async_vector_env():
    env = gymnasium.make_vec("covis.agents:covis/MultiRobot-v0", num_envs=2, vectorization_mode="async", **SMALL)
    observations, _ = env.reset(seed=3)
    assert observations["image"].shape == (2, 72, 96, 3)
    assert not np.array_equal(observations["image"][0], observations["image"][1])
    for _ in range(6):  # past the end of the episodes
        observations, rewards, _, _, infos = env.step(env.action_space.sample())
        assert rewards.shape == (2,)
        assert infos["n_visible"].shape == (2,)
    env.close()


def test_the_documentations_pictures_can_be_made(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(Path(__file__).resolve().parents[2] / "docs" / "examples"))
    pictures = importlib.import_module("pictures")
    pictures.save(pictures.picture("target_localization", width=64, height=48), tmp_path / "scene.png")
    assert 1000 < (tmp_path / "scene.png").stat().st_size < 300_000
