"""Scenes by name, by path, and in PettingZoo's registry."""

from dataclasses import fields, replace
from inspect import signature
from pathlib import Path

import pytest

from covis.envs.collaborative import CollaborativeEnv
from covis.envs.scenes import SCENES, parallel_env


def test_unknown_scene_lists_the_known():
    with pytest.raises(ValueError, match=r"no scene is called 'mars'; there are connected_driving, .*World"):
        parallel_env("mars")


def test_unknown_preset_is_named():
    with pytest.raises(ValueError, match="impossible"):
        parallel_env("multi_robot", preset="impossible")


def test_preset_or_params():
    params = SCENES["multi_robot"].preset("easy")
    with pytest.raises(ValueError, match="a preset or params, not both"):
        parallel_env("multi_robot", preset="easy", params=params)


def test_parameters_of_the_generator_by_name():
    env = parallel_env("connected_driving", preset="paper", map="highway", n_pedestrians=3)
    assert env.world.params == SCENES["connected_driving"].preset("paper", "highway", n_pedestrians=3)
    assert env.world.params.n_vehicles == SCENES["connected_driving"].preset("paper", "highway").n_vehicles
    params = SCENES["multi_robot"].preset("easy", n_team=3)
    assert parallel_env("multi_robot", params=params, dynamics="wheels").world.params == replace(
        params, dynamics="wheels"
    )
    with pytest.raises(ValueError, match=r"map must be one of .*, got 'moon'"):
        parallel_env("connected_driving", map="moon")
    with pytest.raises(TypeError, match="'gravity'"):
        parallel_env("multi_robot", gravity=1.6)


@pytest.mark.parametrize("scene", SCENES)
def test_no_parameter_is_called_like_an_option_of_the_environment(scene):
    options = set(signature(CollaborativeEnv.__init__).parameters)
    assert not options & {field.name for field in fields(SCENES[scene].params)}


def test_a_scene_of_ones_own_by_path():
    env = parallel_env("box_world:BoxWorld", n_robots=3, width=32, height=24)
    observations, _ = env.reset(seed=0)
    assert sorted(observations) == ["robot_0", "robot_1", "robot_2"]
    env.close()


@pytest.mark.parametrize("path", ["no.such:World", "box_world:Nothing"])
def test_a_path_that_leads_nowhere(path):
    with pytest.raises(ValueError, match=f"no World at '{path}'"):
        parallel_env(path)


def test_what_is_no_world_is_told_what_it_lacks():
    with pytest.raises(TypeError, match=r"OrderedDict is no World: it has no classes, meshes, n_robots"):
        parallel_env("collections:OrderedDict")


@pytest.mark.parametrize("scene", SCENES)
@pytest.mark.parametrize("value", ["x", float("nan"), None, ("x", "y"), (float("nan"), 1.0)])
def test_every_impossible_parameter_is_named(scene, value):
    for field in fields(SCENES[scene].params):
        with pytest.raises(ValueError, match=field.name):
            SCENES[scene].params(**{field.name: value})


def test_every_scene_is_in_the_registry():
    pettingzoo = pytest.importorskip("pettingzoo")
    if not hasattr(pettingzoo, "parallel_registry"):
        pytest.skip("this PettingZoo has no registry")
    from importlib import import_module

    for name, scene in SCENES.items():
        import_module(f"covis.envs.{name}_v{scene.version}")
        assert f"covis/{name}-v{scene.version}" in pettingzoo.parallel_registry
        assert f"covis/{name}-v{scene.version}" in pettingzoo.aec_registry
    env = pettingzoo.make("parallel", "covis/multi_robot-v0") if hasattr(pettingzoo, "make") else None
    if env is not None:
        assert env.unwrapped.name == "multi_robot_v0"
        env.close()


@pytest.mark.parametrize("scene", SCENES)
def test_parameters_of_something_else_are_refused(scene):
    with pytest.raises(TypeError, match="got dict"):
        parallel_env(scene, params={"n_team": 3})


@pytest.mark.parametrize("scene", SCENES)
@pytest.mark.parametrize("n_robots", [1, 9, 2.5])
def test_a_number_of_robots_that_does_not_fit_is_named(scene, n_robots):
    with pytest.raises(ValueError, match=f"got {n_robots}"):
        parallel_env(scene, n_robots=n_robots)


@pytest.mark.parametrize("scene", SCENES)
def test_the_scenes_page_tells_its_spaces(scene):
    page = (Path(__file__).parents[2] / "docs" / "reference" / "scenes" / f"{scene}.md").read_text()
    env = parallel_env(scene)
    action, observation = env.action_space("robot_0"), env.observation_space("robot_0")
    for space in (action, observation):
        for name, leaf in space.spaces.items():
            assert f"`{name}` {leaf.shape}" in page
    assert f"| `state()` | {env.state_space.shape}: up to {env.world.max_objects} objects" in page
