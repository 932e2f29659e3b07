"""Reported poses and odometry against their definition, with the pose functions that everybody else uses."""

import numpy as np
import pytest

from covis.envs.sensing import PoseNoise, up_in_camera
from covis.matching.pose import exp_se3, invert

NOISE = PoseNoise(0.5, 0.1, 0.2, 0.05)


def a_pose(rng):
    return exp_se3(np.concatenate([rng.uniform(-20, 20, 3), rng.uniform(-2, 2, 3)]))


@pytest.mark.parametrize("seed", range(5))
def test_a_report_is_the_truth_by_a_right_perturbation(seed):
    T = a_pose(np.random.default_rng(seed))
    reported = NOISE.pose(T, np.random.default_rng(100 + seed))
    normal = np.random.default_rng(100 + seed).standard_normal(4)
    xi = np.concatenate([0.5 * normal[:3], 0.1 * normal[3] * up_in_camera(T)])
    np.testing.assert_allclose(reported @ exp_se3(xi), T, atol=1e-12)


@pytest.mark.parametrize("seed", range(5))
def test_odometry_is_the_motion_and_its_errors(seed):
    rng = np.random.default_rng(seed)
    last, now = a_pose(rng), a_pose(rng)
    reported = NOISE.odometry(last, now, np.random.default_rng(100 + seed))
    normal = np.random.default_rng(100 + seed).standard_normal(4)
    motion = invert(last) @ now
    distance = np.linalg.norm(motion[:3, 3])
    xi = np.concatenate([0.2 * distance * normal[:3], 0.05 * normal[3] * up_in_camera(now)])
    np.testing.assert_allclose(reported, motion @ exp_se3(xi), atol=1e-11)


def test_without_noise_there_is_no_error():
    T = a_pose(np.random.default_rng(9))
    none = PoseNoise(0.0, 0.0, 0.0, 0.0)
    np.testing.assert_allclose(none.pose(T, np.random.default_rng(0)), T, atol=1e-12)
    np.testing.assert_allclose(none.odometry(T, T, np.random.default_rng(0)), np.eye(4), atol=1e-12)
