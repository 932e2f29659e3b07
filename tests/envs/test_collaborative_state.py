"""Saved states go on bit-identically."""

import functools
import importlib
import pickle
import sys
from pathlib import Path

import numpy as np
import pytest

from covis.envs.collaborative import CollaborativeEnv
from covis.envs.scenes import SCENES, parallel_env

SMALL = {"width": 48, "height": 32, "max_detections": 4, "max_cycles": 8}
FULL = SMALL | {"sensors": ("image", "depth", "instances"), "messages": True}


def actions(env, seed):
    out = {}
    for i, agent in enumerate(env.agents):
        env.action_space(agent).seed(seed * 10 + i)
        out[agent] = env.action_space(agent).sample()
        out[agent]["control"] *= np.float32(0.2)
    return out


def play(env, first, last):
    """What steps first..last-1 return, then the state."""
    out = [flat(env.step(actions(env, k))) for k in range(first, last) if env.agents]
    return [*out, env.state().tobytes(), tuple(env.agents)]


def flat(value):
    if isinstance(value, dict):
        return {k: flat(v) for k, v in value.items()}
    if isinstance(value, tuple):
        return [flat(v) for v in value]
    return (value.dtype.str, value.shape, value.tobytes()) if isinstance(value, np.ndarray) else value


@pytest.mark.parametrize("scene", SCENES)
@pytest.mark.parametrize("at", [0, 3])
def test_a_restored_state_goes_on_as_before(scene, at):
    env = parallel_env(scene, **FULL)
    last = env.reset(seed=7)
    for k in range(at):
        observations, _, _, _, infos = env.step(actions(env, k))
        last = observations, infos
    saved = env.save_state()
    seen = flat(last)
    for observation in last[0].values():
        observation["image"][:] = 0  # what the user does to the arrays must not come back
    future = play(env, at, 6)
    after = flat(env.reset())
    assert flat(env.restore_state(saved)) == seen, "the same observations and infos again"
    assert play(env, at, 6) == future
    assert flat(env.reset()) == after, "the series of episodes goes on as it did"
    other = parallel_env(scene, **FULL)
    assert flat(other.reset(options={"state": pickle.loads(pickle.dumps(saved))})) == seen, "another environment"
    assert play(other, at, 6) == future
    other.close()
    env.restore_state(saved)
    assert play(env, at, 6) == future, "any number of times"


def test_an_episode_that_is_over_can_be_saved():
    env = parallel_env("multi_robot", **(SMALL | {"max_cycles": 1}))
    env.reset(seed=0)
    before = env.save_state()
    env.step(actions(env, 0))
    over = env.save_state()
    env.restore_state(before)
    assert env.agents == ["robot_0", "robot_1"]
    env.restore_state(over)
    assert env.agents == []
    with pytest.raises(RuntimeError, match="over"):
        env.step({})


def test_bad_states_are_named():
    env = parallel_env("multi_robot", **SMALL)
    with pytest.raises(RuntimeError, match="reset"):
        env.save_state()
    env.reset(seed=0)
    saved = env.save_state()
    with pytest.raises(ValueError, match=r"a state of 'multi_robot_v0' is needed.*got dict"):
        env.restore_state({})
    with pytest.raises(ValueError, match="seed must be None"):
        env.reset(seed=1, options={"state": saved})
    other = parallel_env("connected_driving", **SMALL)
    with pytest.raises(ValueError, match="got 'multi_robot_v0'"):
        other.reset(options={"state": saved})


def test_a_world_without_states_says_so():
    sys.path.append(str(Path(__file__).resolve().parents[2] / "docs" / "examples"))
    env = CollaborativeEnv(
        functools.partial(importlib.import_module("box_world").BoxWorld, 2, 5), name="boxes", **SMALL
    )
    env.reset(seed=0)
    with pytest.raises(NotImplementedError, match="BoxWorld has no save_state"):
        env.save_state()


def test_unknown_options_are_ignored_with_a_warning():
    env = parallel_env("multi_robot", **SMALL)
    with pytest.warns(UserWarning, match="unknown reset option 'sate'"):
        env.reset(seed=0, options={"sate": 1})
