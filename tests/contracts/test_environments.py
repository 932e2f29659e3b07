"""What every environment keeps to: PettingZoo's own tests, and those that they leave out."""

import functools
import gc
import hashlib
import importlib
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import cloudpickle
import numpy as np
import pytest
from gymnasium import spaces
from pettingzoo.test import api_test, max_cycles_test, parallel_api_test, parallel_seed_test, render_test
from pettingzoo.utils.conversions import parallel_to_aec

from covis.envs.collaborative import CollaborativeEnv
from covis.envs.scenes import SCENES, parallel_env

EXAMPLES = Path(__file__).resolve().parents[2] / "docs" / "examples"
SMALL = {"width": 48, "height": 32, "max_detections": 4, "max_cycles": 6}
ALL_SENSORS = ("image", "depth", "instances")
NAMES = [*SCENES, "box_world"]


def make(name, **options):
    """A small environment of a scene, or of the documentation's example world."""
    options = SMALL | options
    if name != "box_world":
        return parallel_env(name, **options)
    if str(EXAMPLES) not in sys.path:
        sys.path.append(str(EXAMPLES))
    world = importlib.import_module("box_world").BoxWorld
    return CollaborativeEnv(functools.partial(world, options.pop("n_robots", 2)), name=name, **options)


def module(name):
    """What PettingZoo's tests take for the environment's module."""
    fixed = {k: v for k, v in SMALL.items() if k != "max_cycles"}
    return SimpleNamespace(
        parallel_env=lambda **options: make(name, **(fixed | options)),
        env=lambda **options: parallel_to_aec(make(name, **(fixed | options))),
    )


def leaves(value, path=""):
    """All arrays and numbers of nested dictionaries, with where they are."""
    if isinstance(value, dict):
        for key in sorted(value):
            yield from leaves(value[key], f"{path}/{key}")
    else:
        yield path, np.asarray(value)


def digest(parts):
    out = hashlib.sha256()
    for part in parts:
        for path, array in leaves(part):
            out.update(f"{path} {array.dtype} {array.shape}".encode() + np.ascontiguousarray(array).tobytes())
    return out.hexdigest()


def idle(env):
    """No claims, no motion."""
    return {a: {k: np.zeros(s.shape, s.dtype) for k, s in env.action_space(a).items()} for a in env.agents}


def tame(env, rng):
    """Any claims; motion so gentle that nobody crashes at once."""
    out = {}
    for agent in env.agents:
        env.action_space(agent).seed(int(rng.integers(2**31)))
        out[agent] = env.action_space(agent).sample()
        out[agent]["control"] *= np.float32(0.1)
    return out


def episode(env, seed, action_seed=0):
    """Everything that one episode with random claims returns."""
    rng = np.random.default_rng(action_seed)
    yield dict(zip(("observations", "infos"), env.reset(seed=seed), strict=True))
    yield {"state": env.state()}
    while env.agents:
        step = env.step(tame(env, rng))
        yield dict(zip(("observations", "rewards", "terminations", "truncations", "infos"), step, strict=True))
        yield {"state": env.state()}


FULL = {"sensors": ALL_SENSORS, "messages": True}


@pytest.mark.parametrize("name", NAMES)
class TestPettingZoo:
    def test_parallel_api(self, name, recwarn):
        parallel_api_test(make(name), num_cycles=30)
        assert not [w for w in recwarn if "reset option" not in str(w.message) and "gymnasium" not in str(w.message)]

    def test_api(self, name):
        with pytest.warns(UserWarning, match="reset option"):
            api_test(parallel_to_aec(make(name)), num_cycles=30)

    def test_seed(self, name):
        parallel_seed_test(lambda: make(name), num_cycles=10)

    def test_max_cycles(self, name):
        max_cycles_test(module(name))

    def test_render(self, name, monkeypatch):
        monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
        render_test(module(name).env)


@pytest.mark.parametrize("name", NAMES)
def test_same_seed_gives_the_same_whole_episode(name):
    env = make(name, **FULL)
    first = digest(episode(env, seed=5))
    assert digest(episode(env, seed=5)) == first, "reset again"
    assert digest(episode(make(name, **FULL), seed=5)) == first, "another environment"
    assert digest(episode(env, seed=6)) != first


@pytest.mark.parametrize("name", NAMES)
def test_another_process_gives_the_same_episode_and_prints_nothing_else(name):
    code = (
        "import os, sys; sys.path.insert(0, sys.argv[1])\n"
        "from test_environments import FULL, digest, episode, make\n"
        "env = make(sys.argv[2], **FULL)\n"
        "answer = digest(episode(env, seed=5))\n"
        "env.close()\n"
        "print(answer)"
    )
    here = str(Path(__file__).parent)
    out = subprocess.run([sys.executable, "-c", code, here, name], capture_output=True, text=True, check=True)
    # Descriptors 1 and 2 themselves are caught, so C libraries that print past Python are noticed.
    assert out.stderr == ""
    assert out.stdout == digest(episode(make(name, **FULL), seed=5)) + "\n"


@pytest.mark.parametrize("name", NAMES)
def test_seeds_and_series_of_episodes(name):
    env = make(name)

    def start(seed=None):
        observations, _ = env.reset(seed=seed)
        return digest([observations, {"state": env.state()}])

    first, second = start(3), start()
    assert first != second, "every episode of a series is another one"
    assert (start(3), start()) == (first, second), "and the series is the seed's"
    sequence = np.random.SeedSequence(3)
    assert (start(sequence), start()) == (first, second), "a SeedSequence of the same entropy"
    assert sequence.n_children_spawned == 0, "the caller's sequence is not written to"
    assert start(sequence) == first
    assert start([3, 4]) not in (first, second)
    assert start(np.random.SeedSequence(3).spawn(2)[1]) not in (first, second, start([3, 4]))
    for bad in (-1, 0.5, "3"):
        with pytest.raises(ValueError, match="seed"):
            env.reset(seed=bad)
    assert digest([make(name, seed=3).reset()[0]]) == digest([env.reset(seed=3)[0]])
    assert digest([make(name).reset()[0]]) != digest([make(name).reset()[0]]), "without a seed nothing repeats"


@pytest.mark.parametrize(
    "options", [{}, FULL, {**FULL, "n_robots": 3}, {"max_detections": 1}, {"sensors": ()}], ids=str
)
@pytest.mark.parametrize("name", NAMES)
def test_observations_infos_and_state_keep_their_form(name, options):
    env = make(name, **options)
    keys, shapes = None, None
    for part in episode(env, seed=1):
        for agent, observation in part.get("observations", {}).items():
            space = env.observation_space(agent)
            wrong = [k for k in space.spaces if not space[k].contains(observation[k])]
            assert not wrong, f"{agent}: {wrong} not in the space"
            assert set(observation) == set(space.spaces)
        if "state" in part:
            assert env.state_space.contains(part["state"])
        if "infos" in part:
            assert list(part["infos"]) == env.possible_agents
            for info in part["infos"].values():
                assert all(type(v) is float for v in info.values())
                keys = keys or list(info)
                assert list(info) == keys
            now = [(path, a.shape, a.dtype) for path, a in leaves(part["infos"])]
            assert now == (shapes := shapes or now)
        for reward in part.get("rewards", {}).values():
            assert type(reward) is float
            assert np.isfinite(reward)


@pytest.mark.parametrize("name", NAMES)
def test_spaces_are_the_same_objects_and_every_action_leaf_is_flat(name):
    env = make(name)
    for agent in env.possible_agents:
        assert env.observation_space(agent) is env.observation_space(agent)
        assert env.action_space(agent) is env.action_space(agent)
        assert env.observation_space(agent) == env.observation_space("robot_0")
        assert all(len(space.shape) == 1 for space in env.action_space(agent).values())


@pytest.mark.parametrize("name", NAMES)
def test_arrays_are_fresh(name):
    def play(spoil):
        env = make(name, **FULL)
        observations, infos = env.reset(seed=2)
        before, parts = [], []
        rng = np.random.default_rng(0)
        for _ in range(3):
            arrays = [a for _, a in leaves({"observations": observations, "state": env.state()})]
            for k, a in enumerate(arrays):
                assert a.flags.writeable
                assert not any(np.shares_memory(a, b) for b in before + arrays[:k])
            parts.append(digest([observations, infos]))
            before = arrays
            actions = tame(env, rng)
            if spoil:
                for a in arrays:
                    a[...] = 1
                for info in infos.values():
                    info.clear()
            observations, _, _, _, infos = env.step(actions)
            if spoil:
                for _, a in leaves(actions):
                    a[...] = 0
            arrays += [a for _, a in leaves(actions)]
        return parts

    assert play(spoil=True) == play(spoil=False)


@pytest.mark.parametrize("name", NAMES)
def test_any_action_of_the_space_is_accepted(name):
    env = make(name, n_robots=3, messages=True)
    for seed in range(4):
        env.reset(seed=seed)
        for agent in env.possible_agents:
            env.action_space(agent).seed(seed)
        while env.agents:
            env.step({a: env.action_space(a).sample() for a in env.agents})
    env.reset(seed=0)
    for bound in ("low", "high"):
        env.step({a: {k: edge(s, bound) for k, s in env.action_space(a).items()} for a in env.agents})
        if not env.agents:
            env.reset(seed=0)


def edge(space, bound):
    if isinstance(space, spaces.MultiDiscrete):
        return np.zeros_like(space.nvec) if bound == "low" else space.nvec - 1
    return getattr(space, bound).copy()


@functools.cache
def begun(name):
    """An environment for tests that do not move it."""
    env = make(name)
    env.reset(seed=0)
    return env


LEAVES = ("control", "boxes", "positions", "positions_single", "position_variance", "matches", "match_scores")


@pytest.mark.parametrize("name", NAMES)
class TestBadActions:
    @pytest.fixture
    def env(self, name):
        return begun(name)

    def refuses(self, env, leaf, value, match=""):
        actions = idle(env)
        actions["robot_1"][leaf] = value
        before = env.state()
        with pytest.raises(ValueError, match=rf"robot_1: leaf '{leaf}'.*{match}"):
            env.step(actions)
        np.testing.assert_array_equal(env.state(), before, "nothing has moved")

    @pytest.mark.parametrize("leaf", LEAVES)
    def test_shape(self, env, leaf):
        good = idle(env)["robot_1"][leaf]
        for wrong in (good[:-1], np.append(good, good[:1]), good[None], good[0]):
            self.refuses(env, leaf, wrong, "shape")

    @pytest.mark.parametrize("leaf", LEAVES)
    def test_type(self, env, leaf):
        good = idle(env)["robot_1"][leaf]
        for wrong in (good.astype(str), good.astype(complex), good.astype(object), good.astype(bool), None, "x", {}):
            self.refuses(env, leaf, wrong)
        if leaf == "matches":
            self.refuses(env, leaf, good.astype(float), "integers")

    @pytest.mark.parametrize("leaf", LEAVES)
    def test_values(self, env, leaf):
        good = idle(env)["robot_1"][leaf]
        if leaf == "matches":
            wrong = [-1, env.max_detections + 1]
        else:
            self.refuses(env, leaf, np.append(good[:-1], np.nan), f"NaN at {len(good) - 1}")
            wrong = [np.inf, -np.inf, 1e9]
        for value in wrong:
            self.refuses(env, leaf, np.append(good[:-1], value).astype(good.dtype), "outside")

    def test_missing_and_unknown(self, env):
        for leaf in LEAVES:
            actions = idle(env)
            del actions["robot_1"][leaf]
            with pytest.raises(ValueError, match=f"robot_1: leaf '{leaf}' is missing"):
                env.step(actions)
        actions = idle(env)
        actions["robot_1"]["mathces"] = actions["robot_1"]["matches"]
        with pytest.raises(ValueError, match="robot_1: the action has no leaf 'mathces'"):
            env.step(actions)
        for wrong in (None, np.zeros(3), 1):
            with pytest.raises(ValueError, match="robot_1: the action must be a dict"):
                env.step(idle(env) | {"robot_1": wrong})
        actions = idle(env)
        del actions["robot_1"]
        with pytest.raises(ValueError, match="robot_1: no action"):
            env.step(actions)
        with pytest.raises(ValueError, match="robot_9: there is no such agent"):
            env.step(idle(env) | {"robot_9": idle(env)["robot_1"]})


@pytest.mark.parametrize("name", NAMES)
def test_a_pickled_copy_and_the_original_live_on(name):
    env = make(name, **FULL)
    env.reset(seed=4)
    env.step(idle(env))
    copy = cloudpickle.loads(cloudpickle.dumps(env))
    expected = digest(episode(make(name, **FULL), seed=5))
    assert digest(episode(copy, seed=5)) == expected
    env.step(idle(env))
    copy.close()
    del copy
    gc.collect()
    env.step(idle(env))
    assert digest(episode(env, seed=5)) == expected


@pytest.mark.parametrize("name", NAMES)
def test_a_closed_environment_can_be_reset(name):
    env = make(name)
    first = digest(episode(env, seed=1))
    env.close()
    env.close()
    assert digest(episode(env, seed=1)) == first


@pytest.mark.parametrize("name", NAMES)
def test_resets_leak_nothing(name):
    proc = Path("/proc/self")
    if not proc.exists():
        pytest.skip("no /proc on this system to count memory and file descriptors")

    def descriptors():
        return len(os.listdir(proc / "fd"))

    def resident_bytes():
        gc.collect()
        return int((proc / "statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")

    env = make(name)

    def play(n):
        for seed in range(n):
            env.reset(seed=seed)
            env.step(idle(env))

    play(30)
    copy = cloudpickle.loads(cloudpickle.dumps(env))
    copy.reset(seed=0)
    copy.close()
    fds, memory = descriptors(), resident_bytes()
    play(200)
    for _ in range(5):
        copy = cloudpickle.loads(cloudpickle.dumps(env))
        copy.reset(seed=0)
        copy.close()
    assert descriptors() <= fds
    assert resident_bytes() - memory < 8e6


@pytest.mark.parametrize("name", NAMES)
def test_past_episodes_do_not_wait_for_the_garbage_collector(name):
    env = make(name)
    env.reset(seed=0)
    gc.collect()
    enabled = gc.isenabled()
    gc.disable()
    gc.set_debug(gc.DEBUG_SAVEALL)
    try:
        for seed in range(3):
            env.reset(seed=seed)
            env.step(idle(env))
            if hasattr(env.world, "save_state"):
                saved = env.save_state()
                env.step(idle(env))
                env.restore_state(saved)
                env.step(idle(env))
                del saved
        env.close()
        gc.collect()
        waiting = {f"{type(o).__module__}.{type(o).__qualname__}" for o in gc.garbage}
    finally:
        gc.set_debug(0)
        gc.garbage.clear()
        if enabled:
            gc.enable()
    assert not [name for name in waiting if name.startswith(("covis.", "highway_env.", "numpy."))]


@pytest.mark.parametrize("name", NAMES)
def test_an_episode_must_be_begun_and_ends(name):
    env = make(name, max_cycles=1)
    for call in (env.state, env.ground_truth, env.snapshot, env.camera_frames, lambda: env.step({})):
        with pytest.raises(RuntimeError, match="reset"):
            call()
    env.reset(seed=0)
    _, _, _, truncations, _ = env.step(idle(env))
    assert all(truncations.values())
    assert env.agents == []
    with pytest.raises(RuntimeError, match="over"):
        env.step({})


@pytest.mark.parametrize("name", NAMES)
def test_a_reward_of_ones_own(name):
    env = make(name, reward=lambda score: 7.0 + score.counts.retrieved)
    env.reset(seed=0)
    actions = idle(env)
    for action in actions.values():
        action["matches"] += env.max_detections  # no matches
    _, rewards, _, _, _ = env.step(actions)
    assert set(rewards.values()) == {7.0}


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize(
    ("option", "value"),
    [
        ("width", 4),
        ("height", 0),
        ("width", 32.5),
        ("max_detections", 0),
        ("max_cycles", -1),
        ("min_pixels", 0),
        ("sensors", ("lidar",)),
        ("sensors", "image"),
        ("render_mode", "ascii"),
        ("seed", -1),
        ("sensors", None),
        ("pose_noise", 0.3),
        ("reward", 5),
        ("look", "pretty"),
        ("effects", "some"),
        ("mounts", 5),
    ],
)
def test_bad_arguments_are_named(name, option, value):
    with pytest.raises((ValueError, TypeError), match=option.rstrip("s")):
        make(name, **{option: value})


def test_unknown_scene_is_named():
    with pytest.raises(ValueError, match="no scene is called 'mars'; there are"):
        parallel_env("mars")
