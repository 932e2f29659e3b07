"""RLlib trains on the environments; it pins other versions, so it has a virtual environment of its own."""

import os

import pytest

if os.environ.get("COVIS_TEST_RLLIB") is None:
    pytest.skip("RLlib has its own virtual environment: make test-rllib", allow_module_level=True)

import gymnasium
import numpy as np
import ray
from ray.rllib.algorithms.ppo import PPOConfig
from ray.rllib.env.wrappers.pettingzoo_env import ParallelPettingZooEnv
from ray.tune.registry import register_env

from covis.agents.localizer import Localizer
from covis.agents.perception import make_perceptor
from covis.agents.wrapper import LocalizeWrapper
from covis.envs.scenes import parallel_env
from covis.envs.wrappers import FlattenObservations, SelectObservations

SMALL = {"width": 48, "height": 32, "max_detections": 4, "max_cycles": 5}


def moving(_config=None):
    """Robots that learn to move, claims by a localizer."""
    env = parallel_env("multi_robot", sensors=("image", "depth", "instances"), **SMALL)
    localizer = Localizer(make_perceptor("simulated", env), "hungarian", "known", max_detections=env.max_detections)
    return _flat(LocalizeWrapper(env, localizer))


def claiming(_config=None):
    """Whole Dict actions, claims included."""
    return _flat(parallel_env("multi_robot", **SMALL))


def _flat(env):
    leaves = ("pose", "up", "odometry", "state")
    return ParallelPettingZooEnv(FlattenObservations(SelectObservations(env, keep=leaves)))


@pytest.fixture(scope="module", autouse=True)
def cluster():
    ray.init(num_cpus=1, include_dashboard=False, log_to_driver=False, local_mode=False)
    yield
    ray.shutdown()


@pytest.mark.parametrize("make", [moving, claiming])
def test_ppo_updates(make):
    register_env(make.__name__, make)
    config = (
        PPOConfig()
        .environment(make.__name__)
        .env_runners(num_env_runners=0)
        .multi_agent(policies={"team"}, policy_mapping_fn=lambda agent, *_, **__: "team")
        .training(train_batch_size=40, minibatch_size=20, num_epochs=1)
    )
    algorithm = config.build_algo()
    result = algorithm.train()
    assert result["num_env_steps_sampled_lifetime"] >= 20
    assert np.isfinite(result["learners"]["team"]["total_loss"])
    algorithm.stop()


def test_the_wrapped_environment_is_in_its_spaces():
    env = moving()
    observations, _ = env.reset(seed=0)
    space = env.get_observation_space("robot_0")
    assert isinstance(space, gymnasium.spaces.Box)
    assert all(space.contains(o) for o in observations.values())
