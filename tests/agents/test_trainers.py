"""Trainers run for real: a short rollout or update each."""

import numpy as np
import pytest

from covis.agents.localizer import Localizer
from covis.agents.perception import make_perceptor
from covis.agents.wrapper import LocalizeWrapper
from covis.envs.scenes import parallel_env
from covis.envs.wrappers import ChannelFirst, DiscreteControl, FlattenActions, FlattenObservations, SelectObservations

SMALL = {"width": 64, "height": 48, "max_detections": 6, "max_cycles": 5}
EYES = ("depth", "instances", "instance_classes")


def movers(**options):
    """Robots that learn to move, claims by a localizer; observations without the privileged images."""
    env = parallel_env("multi_robot", sensors=("image", "depth", "instances"), **(SMALL | options))
    localizer = Localizer(make_perceptor("simulated", env), "hungarian", "known", max_detections=env.max_detections)
    return SelectObservations(LocalizeWrapper(env, localizer), drop=EYES)


class TestSuperSuit:
    @pytest.fixture
    def supersuit(self):
        return pytest.importorskip("supersuit", reason="SuperSuit is not installed: pip install supersuit")

    def vectorised(self, supersuit, env, n=2, base_class="gymnasium", num_cpus=0):
        return supersuit.concat_vec_envs_v1(
            supersuit.pettingzoo_env_to_vec_env_v1(env), n, num_cpus=num_cpus, base_class=base_class
        )

    def test_concat_vec_envs(self, supersuit):
        env = self.vectorised(supersuit, FlattenObservations(movers()))
        observations, _ = env.reset(seed=1)
        assert observations.shape[0] == 4, "two robots in each of two copies"
        assert np.array_equal(observations, env.reset(seed=1)[0])
        assert not np.array_equal(observations[:2], observations[2:]), "the copies are other episodes"
        for _ in range(7):  # past the end of the episodes
            actions = np.stack([env.action_space.sample() for _ in range(4)])
            _, rewards, _, _, _ = env.step(actions)
            assert np.isfinite(rewards).all()
        env.close()

    def test_dict_observations_with_images(self, supersuit):
        env = self.vectorised(supersuit, ChannelFirst(movers()))
        observations, _ = env.reset(seed=1)
        assert observations["image"].shape == (4, 3, 48, 64)
        env.step(np.zeros((4, 2), np.float32))
        env.close()

    def test_other_processes(self, supersuit):
        env = self.vectorised(supersuit, FlattenObservations(SelectObservations(movers(), drop=("image",))), num_cpus=2)
        observations, _ = env.reset(seed=1)
        observations, _, _, _, _ = env.step(np.zeros((4, 2), np.float32))
        assert np.isfinite(observations).all()
        env.close()

    @pytest.mark.parametrize("action", ["box", "discrete"])
    def test_stable_baselines3_learns(self, supersuit, action):
        sb3 = pytest.importorskip("stable_baselines3", reason="not installed: pip install stable-baselines3")
        torch = pytest.importorskip("torch", reason="torch is not installed: pip install covis[learned]")
        env = FlattenObservations(SelectObservations(movers(), drop=("image",)))
        if action == "discrete":
            env = DiscreteControl(env, joint=True)
        vectors = self.vectorised(supersuit, env, base_class="stable_baselines3")
        # No seed here: SuperSuit's vectors have no seed(), which Stable-Baselines3 would call.
        model = sb3.PPO("MlpPolicy", vectors, n_steps=8, batch_size=16, n_epochs=1, device="cpu")
        before = [p.detach().clone() for p in model.policy.parameters()]
        model.learn(64)
        assert model.num_timesteps >= 64
        assert any(not torch.equal(a, b) for a, b in zip(before, model.policy.parameters(), strict=True))
        vectors.close()

    def test_stable_baselines3_on_images_of_one_robot(self):
        sb3 = pytest.importorskip("stable_baselines3", reason="not installed: pip install stable-baselines3")
        import gymnasium

        import covis.agents  # noqa: F401 - enters the scenes in Gymnasium's registry

        env = gymnasium.make("covis/MultiRobot-v0", **SMALL)
        model = sb3.A2C("MultiInputPolicy", env, n_steps=4, seed=0, device="cpu")
        model.learn(8)
        env.close()


class TestTorchRL:
    @pytest.fixture
    def wrapper(self):
        pytest.importorskip("torchrl", reason="TorchRL is not installed: pip install torchrl")
        from torchrl.envs.libs.pettingzoo import PettingZooWrapper

        return PettingZooWrapper

    def test_rollout_of_control(self, wrapper):
        env = wrapper(movers(), use_mask=False, group_map=None)
        data = env.rollout(4)
        robots = data["next", "robot"]
        assert robots["reward"].shape == (4, 2, 1)
        assert robots["observation", "image"].shape == (4, 2, 48, 64, 3)
        assert data["robot", "action"].shape == (4, 2, 2)

    def test_rollout_of_whole_claims(self, wrapper):
        env = wrapper(parallel_env("multi_robot", **SMALL), use_mask=False)
        data = env.rollout(4)
        assert data["robot", "action", "boxes"].shape == (4, 2, 24)
        assert data["next", "robot", "reward"].isfinite().all()

    def test_an_update(self, wrapper):
        torch = pytest.importorskip("torch", reason="torch is not installed: pip install covis[learned]")
        from tensordict.nn import TensorDictModule

        env = wrapper(FlattenObservations(SelectObservations(movers(), drop=("image",))), use_mask=False)
        size = env.observation_spec["robot", "observation"].shape[-1]
        torch.manual_seed(0)
        layers = torch.nn.Linear(size, 16), torch.nn.Tanh(), torch.nn.Linear(16, 2), torch.nn.Tanh()
        policy = torch.nn.Sequential(*layers)
        act = TensorDictModule(policy, in_keys=[("robot", "observation")], out_keys=[("robot", "action")])
        data = env.rollout(4, policy=act)
        optimizer = torch.optim.SGD(policy.parameters(), 1e-3)
        value = policy(data["robot", "observation"])
        loss = -(value * data["next", "robot", "reward"]).mean()
        loss.backward()
        optimizer.step()
        assert loss.isfinite()


def test_flat_actions_drive_a_whole_episode():
    env = FlattenObservations(FlattenActions(parallel_env("multi_robot", **SMALL)))
    env.reset(seed=0)
    while env.agents:
        observations, *_ = env.step({a: env.action_space(a).sample() for a in env.agents})
        assert all(env.observation_space(a).contains(o) for a, o in observations.items())
