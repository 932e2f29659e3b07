"""Sequence mode: state within an episode, none across episodes, every frame seen, only the chosen ones scored."""

import numpy as np

from covis.evaluation import matching_run
from covis.evaluation.benchmark import benchmark
from covis.evaluation.methods import Method
from covis.evaluation.sequence import PairTrackers
from covis.evaluation.settings import Settings
from covis.matching import METHODS, ObjectGraph


def test_trackers_forget_where_the_episode_changes():
    trackers = PairTrackers()
    trackers.begin(0, {})
    first = trackers.of("m", "a", "b")
    assert trackers.of("m", "a", "b") is first
    assert trackers.of("m", "a", "c") is not first
    trackers.begin(0, {"a": np.eye(4), "b": None})
    assert trackers.of("m", "a", "b") is first
    trackers.begin(1, {})
    assert trackers.of("m", "a", "b") is not first


def test_the_matcher_gets_a_prior_after_the_first_frame_only(small_dataset, monkeypatch):
    """Robots of the small dataset jump between frames, so only the call pattern is looked at."""
    calls = []

    def spy(source, target, *, prior=None, rng=None):
        calls.append(prior is not None)
        return METHODS["reid"](source, target)

    monkeypatch.setattr(matching_run.Method, "load", lambda self: spy)
    rows = benchmark([str(small_dataset)], [Method.parse("spy")], Settings(sequence=True))
    assert rows[0]["sequence"] is True
    assert rows[0]["pairs"] == 6
    assert len(calls) >= 6
    assert calls[0] is False


def test_min_common_scores_fewer_pairs_but_shows_the_tracker_all(small_dataset, monkeypatch):
    seen = []

    def spy(source, target, *, prior=None, rng=None):
        seen.append(prior is None)
        return METHODS["reid"](source, target)

    monkeypatch.setattr(matching_run.Method, "load", lambda self: spy)
    rows = benchmark([str(small_dataset)], [Method.parse("spy")], Settings(sequence=True, min_common=6))
    assert rows[0]["pairs"] < 6
    assert sum(seen) == 6


def test_robots_with_odometry_keep_maps_and_cameras_do_not():
    up = np.array([0.0, 0.0, 1.0])
    plain = ObjectGraph.from_positions(np.diag([1.0, 2.0, 3.0]), up=up)
    camera = ObjectGraph.from_positions(np.diag([1.0, 2.0, 3.0]), up=up, intrinsics=np.eye(3))
    still = {"a": np.eye(4), "b": np.eye(4), "camera": np.eye(4), "lost": None}
    seen = {"a": plain, "b": plain, "camera": camera, "lost": plain}
    trackers = PairTrackers()
    for _ in range(5):
        trackers.begin(0, still, seen)
    trackers.begin(0, still, {**seen, "a": plain.take(np.array([0, 1]))})
    assert trackers.maps("a", "camera") is None
    assert trackers.maps("a", "lost") is None
    ours, theirs = trackers.maps("a", "b")
    assert len(ours) == len(theirs) == 3
    trackers.begin(1, still, {**seen, "a": plain.take(np.array([0, 1]))})
    assert len(trackers.maps("a", "b")[0]) == 2
