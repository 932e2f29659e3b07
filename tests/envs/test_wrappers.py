"""Wrappers give trainers what they ask for, and lose nothing on the way."""

import functools
import importlib
import sys
from pathlib import Path

import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env
from pettingzoo.test import parallel_api_test
from pettingzoo.utils import BaseParallelWrapper

from covis.envs.claims import decode
from covis.envs.collaborative import CollaborativeEnv
from covis.envs.single_agent import RobotView, TeamView
from covis.envs.wrappers import (
    ChannelFirst,
    DiscreteControl,
    FlattenActions,
    FlattenObservations,
    GroundTruthInfo,
    SelectObservations,
)

sys.path.append(str(Path(__file__).resolve().parents[2] / "docs" / "examples"))
BoxWorld = importlib.import_module("box_world").BoxWorld


def make(n_robots=2, **options):
    options = {"width": 32, "height": 24, "max_detections": 3, "max_cycles": 4} | options
    return CollaborativeEnv(functools.partial(BoxWorld, n_robots, 8), name="box_world", **options)


class OnlyControl(BaseParallelWrapper):
    """What LocalizeWrapper does to actions, without a localizer."""

    def __init__(self, env):
        super().__init__(env)
        self._nothing = {
            a: {k: np.zeros(s.shape, s.dtype) for k, s in env.action_space(a).items()} for a in env.possible_agents
        }

    def action_space(self, agent):
        return self.env.action_space(agent)["control"]

    def step(self, actions):
        return self.env.step({a: self._nothing[a] | {"control": c} for a, c in actions.items()})


@pytest.mark.parametrize(
    "wrap",
    [
        SelectObservations,
        FlattenObservations,
        functools.partial(FlattenObservations, single=False),
        ChannelFirst,
        FlattenActions,
        DiscreteControl,
        functools.partial(DiscreteControl, levels=5, joint=True),
        lambda env: DiscreteControl(OnlyControl(env), joint=True),
        GroundTruthInfo,
        lambda env: GroundTruthInfo(FlattenObservations(FlattenActions(env))),
    ],
)
@pytest.mark.filterwarnings("ignore:.*reset option.*")
def test_wrapped_environments_keep_the_api_and_their_spaces(wrap):
    env = wrap(make(sensors=("image", "depth", "instances")))
    parallel_api_test(env, num_cycles=10)
    observations, _ = env.reset(seed=0)
    for agent in env.possible_agents:
        assert env.observation_space(agent) is env.observation_space(agent)
        assert env.observation_space(agent).contains(observations[agent])
    while env.agents:
        actions = {a: env.action_space(a).sample() for a in env.agents}
        observations, *_ = env.step(actions)
        assert all(env.observation_space(a).contains(o) for a, o in observations.items())


def test_select_observations():
    env = SelectObservations(make(sensors=("image", "depth")), drop=("depth",))
    assert "depth" not in env.observation_space("robot_0").spaces
    env = SelectObservations(make(), keep=("pose", "up"))
    observations, _ = env.reset(seed=0)
    assert list(observations["robot_1"]) == ["pose", "up"]
    with pytest.raises(ValueError, match="no leaf 'lidar'"):
        SelectObservations(make(), drop=("lidar",))
    with pytest.raises(ValueError, match="Dict observations are needed"):
        SelectObservations(FlattenObservations(make()))


def test_flat_observations_hold_every_leaf_in_order():
    plain, flat = make(), FlattenObservations(make())
    full, _ = plain.reset(seed=3)
    vector, _ = flat.reset(seed=3)
    space = flat.observation_space("robot_0")
    assert isinstance(space, spaces.Box)
    assert space.dtype == np.float32
    leaves = plain.observation_space("robot_0").spaces
    expected = np.concatenate([full["robot_1"][name].ravel().astype(np.float32) for name in leaves])
    np.testing.assert_array_equal(vector["robot_1"], expected)
    leafwise, _ = FlattenObservations(make(), single=False).reset(seed=3)
    assert all(leaf.ndim == 1 for leaf in leafwise["robot_0"].values())
    np.testing.assert_array_equal(leafwise["robot_0"]["image"], full["robot_0"]["image"].ravel())


def test_channels_first():
    plain, _ = make().reset(seed=1)
    env = ChannelFirst(make())
    turned, _ = env.reset(seed=1)
    assert env.observation_space("robot_0")["image"].shape == (3, 24, 32)
    np.testing.assert_array_equal(turned["robot_0"]["image"].transpose(1, 2, 0), plain["robot_0"]["image"])
    with pytest.raises(ValueError, match="no 'image'"):
        ChannelFirst(make(sensors=()))


def test_flat_actions_reach_the_corners_of_the_space():
    inner = make()
    env = FlattenActions(inner)
    env.reset(seed=0)
    seen = {}
    original = inner.step
    inner.step = lambda actions: seen.update(actions) or original(actions)
    size = env.action_space("robot_0").shape
    env.step({"robot_0": np.full(size, -1, np.float32), "robot_1": np.ones(size, np.float32)})
    for name, space in inner.action_space("robot_0").items():
        low, high = (np.zeros_like(space.nvec), space.nvec - 1) if name == "matches" else (space.low, space.high)
        np.testing.assert_array_equal(seen["robot_0"][name], low)
        np.testing.assert_array_equal(seen["robot_1"][name], high)
    good = np.zeros(size, np.float32)
    for wrong, match in (
        (good[1:], "shape"),
        (good + 2, "holds 2.0 at 0"),
        (good * np.nan, "holds nan at 0"),
        ("x", "numbers"),
    ):
        with pytest.raises(ValueError, match=f"robot_1: the action .*{match}"):
            env.step({"robot_0": good, "robot_1": wrong})
    with pytest.raises(ValueError, match="only Dict actions"):
        FlattenActions(env)


@pytest.mark.parametrize("joint", [False, True])
def test_discrete_control(joint):
    inner = make()
    env = DiscreteControl(inner, levels=3, joint=joint)
    env.reset(seed=0)
    seen = {}
    original = inner.step
    inner.step = lambda actions: seen.update(actions) or original(actions)
    rest = {a: env.action_space(a).sample() for a in env.agents}
    picks = {"robot_0": 2 if joint else np.array([0, 2]), "robot_1": 7 if joint else np.array([2, 1])}
    env.step({a: rest[a] | {"control": picks[a]} for a in env.agents})
    np.testing.assert_array_equal(seen["robot_0"]["control"], [-1, 1])
    np.testing.assert_array_equal(seen["robot_1"]["control"], [1, 0])
    decode("robot_0", seen["robot_0"], inner.action_space("robot_0"))
    for wrong in (9 if joint else np.array([3, 0]), 0.5, "x", np.array([-1, 0])):
        with pytest.raises(ValueError, match="robot_1: leaf 'control'"):
            env.step({a: rest[a] | {"control": wrong if a == "robot_1" else picks[a]} for a in env.agents})
    with pytest.raises(ValueError, match="levels"):
        DiscreteControl(make(), levels=1)


def test_ground_truth_info_is_fixed_in_shape_and_true():
    env = GroundTruthInfo(make())
    _, infos = env.reset(seed=0)
    truth = env.unwrapped.ground_truth()
    for i, agent in enumerate(env.possible_agents):
        info = infos[agent]
        np.testing.assert_allclose(info["truth_positions"], truth.positions_in_camera(i))
        np.testing.assert_array_equal(info["truth_boxes"], truth.boxes[i])
        assert info["truth_present"].sum() == len(truth.identity)
        assert info["truth_identity"].shape == (env.unwrapped.world.max_objects,)
        assert "n_correct" in info
        info["truth_pose"][:] = 0
    assert np.any(env.unwrapped.ground_truth().T_world_camera != 0)


@pytest.mark.parametrize("others", ["idle", "repeat", lambda world: np.full((world.n_robots, 2), 0.5)])
@pytest.mark.parametrize("wrap", [lambda e: e, OnlyControl])
def test_one_robot_learns(wrap, others):
    env = RobotView(wrap(make(n_robots=3)), "robot_1", others)
    check_env(env, skip_render_check=True)
    env.reset(seed=1)
    action = env.action_space.sample()
    control = action["control"] if isinstance(action, dict) else action
    _, reward, terminated, truncated, info = env.step(action)
    assert isinstance(reward, float)
    assert (terminated, truncated) == (False, False)
    assert "n_correct" in info
    speed = env.parallel.world.speed
    expected = {"idle": 0.0, "repeat": 1.5 * control[0]}.get(others, 0.75) if isinstance(others, str) else 0.75
    np.testing.assert_allclose(speed[[0, 2]], expected, rtol=1e-6)
    np.testing.assert_allclose(speed[1], 1.5 * control[0], rtol=1e-6)


def test_idle_robots_claim_nothing():
    env = RobotView(make(), "robot_0", "idle")
    env.reset(seed=0)
    nothing = env._nothing
    assert env.step(nothing)[4]["n_retrieved"] == 0


def test_views_refuse_what_they_cannot_do():
    with pytest.raises(ValueError, match="no robot 'robot_7'"):
        RobotView(make(), "robot_7")
    with pytest.raises(ValueError, match="others must be"):
        RobotView(make(), others="dance")
    with pytest.raises(ValueError, match="stand still"):
        RobotView(DiscreteControl(OnlyControl(make()), joint=True))
    with pytest.raises(ValueError, match="must be flat"):
        TeamView(make())
    env = TeamView(OnlyControl(make()))
    env.reset(seed=0)
    with pytest.raises(ValueError, match="shape"):
        env.step(np.zeros(3))


@pytest.mark.parametrize(
    "wrap",
    [
        OnlyControl,
        FlattenActions,
        lambda e: DiscreteControl(OnlyControl(e)),
        lambda e: FlattenObservations(OnlyControl(e)),
    ],
)
def test_one_policy_moves_the_team(wrap):
    env = TeamView(wrap(make(n_robots=3)))
    check_env(env, skip_render_check=True)
    observation, infos = env.reset(seed=0)
    assert env.observation_space.contains(observation)
    assert {"robot_0/n_correct", "robot_2/n_correct"} <= set(infos)
    if wrap is OnlyControl:
        assert observation["pose"].shape == (3, 4, 4)
        env.step(np.array([1, 0, -1, 0, 0.5, 0], np.float32))
        np.testing.assert_allclose(env.parallel.world.speed, [1.5, -1.5, 0.75])


def test_seed_and_state_go_through_views_and_wrappers():
    env = RobotView(FlattenObservations(FlattenActions(make())), others="repeat")
    first, _ = env.reset(seed=5)
    assert np.array_equal(first, env.reset(seed=5)[0])
    assert not np.array_equal(first, env.reset(seed=6)[0])
    assert np.array_equal(first, env.reset(seed=np.random.SeedSequence(5))[0])
