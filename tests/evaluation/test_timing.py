"""Rates, rows and memory; no number here depends on how fast the machine is."""

import time

import pytest

from covis.evaluation import memory_matching
from covis.evaluation.memory_matching import STATUS, add_memory, peak_at_largest
from covis.evaluation.timing import rates, row


def test_both_jobs_run_in_turn_and_equally_often():
    calls = []
    ours, peer = rates(lambda: calls.append("a"), lambda: calls.append("b"), seconds=1e-9, rounds=4)
    assert ours > 0
    assert peer > 0
    assert "".join(calls[-8:]) == "abababab"


def test_a_sleeping_job_has_its_rate():
    ours, peer = rates(lambda: time.sleep(0.01), seconds=0.01, rounds=2)
    assert 10 < ours <= 100
    assert peer is None


def test_rows_have_ratios_only_with_a_peer():
    assert row("envs", "x", 3, 10.0, "other", 2.0)["ratio"] == 5.0
    assert row("envs", "x", None, 10.0, None, None)["ratio"] is None


@pytest.mark.skipif(not STATUS.exists(), reason="the operating system does not tell a process's peak memory")
def test_a_quadratic_affinity_shows_in_memory():
    """In processes of their own: in this one, memory freed by other tests would hide what a solve takes."""
    clipper, reid = add_memory([{"what": "clipper", "n": 50}, {"what": "reid", "n": 50}])
    assert clipper["memory_mib"] > reid["memory_mib"] + 5


@pytest.mark.skipif(not STATUS.exists(), reason="the operating system does not tell a process's peak memory")
def test_peak_is_taken_at_the_largest_size_that_is_not_refused(monkeypatch):
    refused = []

    def peak(method, n, *, one_class):
        assert one_class
        if n > 17:
            refused.append(n)
            raise ValueError("too many")
        return 3.5

    monkeypatch.setattr(memory_matching, "peak_mib", peak)
    assert peak_at_largest("rrwhm") == (17, 3.5)
    assert refused == list(range(200, 17, -1))


@pytest.mark.skipif(not STATUS.exists(), reason="the operating system does not tell a process's memory")
def test_memory_of_an_environment_counts_its_steps_and_files():
    pytest.importorskip("pybullet")
    from covis.evaluation.memory_envs import growth

    grown = growth("target_localization", resets=3, steps=10)
    assert grown.steps >= 10
    assert grown.last_files == grown.first_files
    assert 0.9 < grown.last_mib / grown.first_mib < 1.1


def test_memory_refuses_nothing_to_do():
    from covis.evaluation import memory_envs

    with pytest.raises(ValueError, match="resets must be at least 1, got 0"):
        memory_envs.rows(resets=0)
    with pytest.raises(ValueError, match="no scene is called 'mars'; there are"):
        memory_envs.rows(scenes=("mars",))


def test_memory_is_for_environments_and_matching():
    from typer.testing import CliRunner

    from covis.scripts.main import app

    result = CliRunner().invoke(app, ["speed", "fusion", "--memory"])
    assert result.exit_code == 2
    assert "--memory is for envs and matching" in result.stderr


def test_speed_refuses_unknown_areas():
    from typer.testing import CliRunner

    from covis.scripts.main import app

    result = CliRunner().invoke(app, ["speed", "light"])
    assert result.exit_code == 2
    assert "no area is called 'light'" in result.stderr
