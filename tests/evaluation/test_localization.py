"""`covis localize` on a few steps: the rows, and that what they say hangs together."""

from dataclasses import replace
from itertools import islice

import numpy as np
import pytest

pytest.importorskip("pybullet")

from covis.evaluation.localization import (
    MIN_SCORE,
    accuracy,
    estimators,
    faults_of,
    localization_rows,
    motion_of,
    sizes_of,
)
from covis.evaluation.localization_team import FAULTS, BayesMatches, TrueMatches, instants, play
from covis.evaluation.settings import Settings

SETTINGS = Settings(pose="known", seed=3, episodes=1)


def first_steps(n_steps, n_robots):
    return list(islice(instants("multi_robot", replace(SETTINGS, n_robots=n_robots)), n_steps))


def test_estimators_are_compared_on_the_same_detections():
    steps = first_steps(8, 2)
    rows = {
        name: accuracy(list(play(steps, options, lambda _: BayesMatches(MIN_SCORE))))
        for name, options in estimators("multi_robot").items()
    }
    assert rows["paper"]["n"] == rows["covariance"]["n"] > 0
    assert rows["paper"]["single_m"] == rows["covariance"]["single_m"]
    assert rows["covariance"]["alone_ratio"] == pytest.approx(1.0)
    assert rows["covariance, tracked"]["ratio"] < rows["covariance"]["ratio"] < 1.0
    # Intersection does not know that the errors are independent: consistent, but less sure of itself.
    assert rows["intersection"]["nees_per_dof"] < rows["covariance"]["nees_per_dof"]
    assert rows["covariance"]["ratio"] < rows["intersection"]["ratio"]
    assert "identity_switches" in rows["covariance, tracked"]


def test_protections_keep_a_wrong_robot_out():
    steps = first_steps(8, 4)
    rows = faults_of(steps, lambda episode: TrueMatches.of(steps, episode), motion_of("multi_robot", "simulated"))
    growth = {(row["protections"], row["fault"]): row["growth"] for row in rows}
    for fault in FAULTS[3:]:
        assert growth["with", fault.name] < 0.25 < growth["without", fault.name]


def test_tracks_that_know_what_they_see_lose_less_by_a_delay():
    steps = first_steps(10, 4)
    motion = motion_of("multi_robot", "simulated")

    def truth(episode):
        return TrueMatches.of(steps, episode)

    def names(episode):
        return truth(episode).names

    usual, ideal = (
        {(row["protections"], row["fault"]): row["fused_m"] for row in faults_of(steps, truth, motion, names=known)}
        for known in (None, names)
    )
    assert {protections for protections, _ in ideal} == {"with"}
    assert ideal["with", "0.4 s delay"] <= usual["with", "0.4 s delay"]


def test_exact_poses_leave_only_the_eyes_errors():
    noisy, exact = (
        next(instants("target_localization", replace(SETTINGS, n_robots=2), exact_poses=known))
        for known in (False, True)
    )
    assert not np.allclose(noisy.views[0].T_world_camera, exact.views[0].T_world_camera, atol=1e-4)
    assert np.trace(exact.views[0].pose_covariance) < 1e-6 < np.trace(noisy.views[0].pose_covariance)
    np.testing.assert_array_equal(noisy.views[0].detections.graph.positions, exact.views[0].detections.graph.positions)


def test_more_robots_localise_better():
    rows = sizes_of(first_steps(3, 6))
    sizes = [row for row in rows if row["what"] == "size"]
    assert [row["robots"] for row in sizes] == list(range(1, 7))
    assert sizes[0]["fused_m"] == pytest.approx(sizes[0]["single_m"])
    assert sizes[5]["fused_m"] < sizes[2]["fused_m"] < sizes[0]["fused_m"]
    made = [row for row in rows if row["what"] == "consistency"]
    assert all(row["consistent_frames"] == 1.0 for row in made)
    assert all(row[f1] > row["pairwise_f1"] - 0.05 for row in made for f1 in ("f1", "convex_f1", "spectral_f1"))


def test_an_unknown_part_is_named():
    with pytest.raises(ValueError, match="unknown part 'all'; there are scenes, faults, team"):
        localization_rows(["all"])
