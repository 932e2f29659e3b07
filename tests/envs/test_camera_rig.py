"""The cameras of an environment: backends, looks, and effects that belong to the episode."""

import numpy as np
import pytest
from box_world import BoxWorld

from covis.envs.camera.effects import EffectRanges
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
