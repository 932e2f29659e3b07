"""Vectors for a policy that only moves, against the environment's own truth."""

import numpy as np
import pytest
from pettingzoo.test import parallel_api_test

from covis.agents.claim_observations import OBJECT_COLUMNS, ClaimObservations, level_frame
from covis.agents.localizer import Localizer
from covis.agents.perception import SimulatedPerception, SimulatedPerceptionParams
from covis.agents.wrapper import LocalizeWrapper
from covis.envs.scenes import parallel_env
from covis.envs.sensing import PoseNoise

N_OBJECTS = 5


def make(scene="multi_robot"):
    """Exact poses, so that the truth is what the vector should say up to the eyes' errors."""
    env = parallel_env(
        scene, preset="easy", sensors=("depth", "instances"), pose_noise=PoseNoise(0.0, 0.0), max_cycles=4
    )
    eyes = SimulatedPerception(env.world.classes, SimulatedPerceptionParams())
    return ClaimObservations(
        LocalizeWrapper(env, Localizer(eyes, "hungarian", "known", max_detections=env.max_detections)), N_OBJECTS
    )


@pytest.mark.filterwarnings("ignore:.*reset option.*")
@pytest.mark.parametrize("scene", ["multi_robot", "aerial_ground"])
def test_it_is_an_environment(scene):
    env = make(scene)
    parallel_api_test(env, num_cycles=6)
    observations, _ = env.reset(seed=0)
    while env.agents:
        assert all(env.observation_space(a).contains(o) for a, o in observations.items())
        observations, *_ = env.step({a: env.action_space(a).sample() for a in env.agents})


def test_partners_and_objects_are_where_the_truth_has_them():
    env = make()
    observations, _ = env.reset(seed=3)
    world = env.unwrapped
    truth = world.ground_truth()
    own, other = (truth.T_world_camera[i] for i in range(2))
    vector = observations["robot_0"]
    state = world.world.state_size
    partner, objects = vector[state : state + 5], vector[state + 5 :].reshape(N_OBJECTS, OBJECT_COLUMNS)
    left = -own[:3, 0]  # level, although the camera looks down a little
    forward = np.cross(left, [0.0, 0.0, 1.0])
    offset = other[:3, 3] - own[:3, 3]
    assert partner[:2] * 10 == pytest.approx([offset @ forward, offset @ left], abs=0.02)
    turn = np.arctan2(other[1, 2], other[0, 2]) - np.arctan2(own[1, 2], own[0, 2])
    assert partner[3:] == pytest.approx([np.cos(turn), np.sin(turn)], abs=1e-3)
    claims = env.env.claims["robot_0"]
    seen = np.flatnonzero(claims.filled())
    assert objects[:, 0].sum() == min(len(seen), N_OBJECTS) >= 2
    offsets = claims.positions[seen] @ own[:3, :3].T
    expected = np.stack([offsets @ forward, offsets @ left, offsets[:, 2]], axis=1)
    nearest = np.argsort(np.linalg.norm(offsets, axis=1))[:N_OBJECTS]
    rows = objects[objects[:, 0] > 0]
    assert 10 * rows[:, 1:4] == pytest.approx(expected[nearest], abs=0.02)
    assert 10 * rows[:, 4] == pytest.approx(np.sqrt(claims.position_variance[seen][nearest]), abs=1e-3)
    matched = (claims.matches < world.max_detections).any(axis=0)
    assert rows[:, 5].astype(bool).tolist() == matched[seen][nearest].tolist()


def test_what_the_policy_sees_is_what_is_claimed():
    env = make()
    env.reset(seed=1)
    said = env.env.claims
    env.step({a: np.zeros(2, np.float32) for a in env.agents})
    answered = env.unwrapped.answered().claims
    for claims, (_, expected) in zip(answered, said.items(), strict=True):
        assert claims.boxes == pytest.approx(expected.boxes, abs=1e-3)


def test_level_frames_of_cameras_that_look_along_and_down():
    along = np.eye(4)
    along[:3, :3] = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    assert level_frame(along) == pytest.approx(np.eye(4))
    down = np.eye(4)
    down[:3, :3] = np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    assert level_frame(down) == pytest.approx(np.eye(4))


def test_bad_use_is_named():
    env = make()
    with pytest.raises(ValueError, match="LocalizeWrapper, got CollaborativeEnv"):
        ClaimObservations(env.unwrapped)
    with pytest.raises(ValueError, match="got 0 and 10"):
        ClaimObservations(env.env, n_objects=0)
    with pytest.raises(ValueError, match="got 3 and -1"):
        ClaimObservations(env.env, n_objects=3, scale_m=-1)
