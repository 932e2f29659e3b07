"""The pipeline of a team: observations of all robots in, claims of all robots out."""

import numpy as np
import pytest

from covis.agents.localizer import Localizer, claims, relative_pose
from covis.agents.perception import SimulatedPerception
from covis.envs.scenes import parallel_env
from covis.envs.scoring import score
from covis.matching import Matching


@pytest.fixture(scope="module")
def scene():
    env = parallel_env("multi_robot", n_robots=3, sensors=("image", "depth", "instances"))
    observations, _ = env.reset(seed=11)
    yield env, [observations[a] for a in env.agents]
    env.close()


def test_claims_of_three_robots_are_scored(scene):
    env, observations = scene
    localizer = Localizer(SimulatedPerception(env.world.classes), "bayes", pose="known")
    said = localizer.localize(observations, np.random.default_rng(0))
    result = score(said, env.ground_truth())
    assert [(p.a, p.b) for p in result.pairs] == [(0, 1), (0, 2), (1, 2)]
    assert result.counts.precision > 0.5
    assert (result.tied >= 0).any(axis=1).all()


def test_matches_are_told_to_both_robots_under_their_own_numbering(scene):
    env, observations = scene
    localizer = Localizer(SimulatedPerception(env.world.classes), "reid")
    rng = np.random.default_rng(1)
    views = localizer.look(observations, rng)
    matchings = {(0, 2): Matching([[1, 0]], [0.7])}
    said = claims(views, matchings, 32)
    assert said[0].matches[1, 1] == 0  # robot 2 is robot 0's second partner
    assert said[2].matches[0, 0] == 1  # robot 0 is robot 2's first
    assert said[0].match_scores[1, 1] == pytest.approx(0.7)
    assert (said[1].matches == 32).all()


def test_a_match_that_the_poses_contradict_is_claimed_but_not_fused(scene):
    env, observations = scene
    views = Localizer(SimulatedPerception(env.world.classes), "reid").look(observations, np.random.default_rng(0))
    T = relative_pose(views[0], views[1]).T_source_target
    own = views[0].detections.graph.positions
    partner = views[1].detections.graph.positions @ T[:3, :3].T + T[:3, 3]
    a, b = np.unravel_index(np.linalg.norm(own[:, None] - partner, axis=2).argmax(), (len(own), len(partner)))
    matchings = {(0, 1): Matching([[a, b]], [0.9])}
    gated = claims(views, matchings, 32)[0]
    assert gated.matches[0, a] == b
    assert gated.positions[a] == pytest.approx(own[a])
    blended = claims(views, matchings, 32, "paper")[0].positions[a]
    assert min(np.linalg.norm(blended - x) for x in (own[a], partner[b])) > 0.1


def test_fewer_slots_keep_the_largest_boxes(scene):
    env, observations = scene
    localizer = Localizer(SimulatedPerception(env.world.classes), "reid", max_detections=2)
    views = localizer.look(observations, np.random.default_rng(0))
    full = Localizer(SimulatedPerception(env.world.classes), "reid").look(observations, np.random.default_rng(0))
    for few, many in zip(views, full, strict=True):
        assert len(few.detections) == min(2, len(many.detections))
        area = np.sort(np.prod(many.detections.boxes[:, 2:] - many.detections.boxes[:, :2], axis=1))[::-1]
        kept = np.prod(few.detections.boxes[:, 2:] - few.detections.boxes[:, :2], axis=1)
        assert kept.sum() == pytest.approx(area[:2].sum())


def test_relative_pose_is_near_the_true_one(scene):
    env, observations = scene
    views = Localizer(SimulatedPerception(env.world.classes), "reid").look(observations, np.random.default_rng(0))
    T = env.ground_truth().T_world_camera
    pose = relative_pose(views[0], views[1])
    assert np.linalg.norm(pose.T_source_target[:3, 3] - (np.linalg.inv(T[0]) @ T[1])[:3, 3]) < 3.0


@pytest.mark.parametrize(
    ("options", "message"),
    [({"pose": "maybe"}, "pose must be"), ({"gain": "loss"}, "gain must be"), ({"match": "nope"}, "no matcher")],
)
def test_bad_options_are_refused(scene, options, message):
    env, _ = scene
    with pytest.raises(ValueError, match=message):
        Localizer(**({"perceive": SimulatedPerception(env.world.classes), "match": "reid"} | options))
