"""Rows of `covis speed matching` have the form that every area's have; no timing is asserted."""

from importlib.util import find_spec

import numpy as np
import pytest

from covis.evaluation import speed_matching
from covis.evaluation.speed_matching import method_rows, problem

KEYS = {"area", "what", "n", "ours", "peer", "peer_value", "ratio", "unit"}


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    def once(ours, peer=None, *, seconds=1.0, rounds=5):
        ours()
        if peer is not None:
            peer()
        return 2.0, None if peer is None else 1.0

    monkeypatch.setattr(speed_matching, "rates", once)


def test_problem_has_n_objects_a_side():
    p = problem(15)
    assert (len(p.source), len(p.target)) == (15, 15)
    assert (np.asarray(p.truth) >= 0).sum() == 10


def test_a_method_is_measured_until_it_refuses_a_size(monkeypatch):
    monkeypatch.setattr(speed_matching, "SIZES", (5, 15, 200))
    found = method_rows("clipper")
    assert [r["n"] for r in found] == [5, 15]
    assert all(set(r) == KEYS and r["area"] == "matching" and r["what"] == "clipper" for r in found)
    assert all(r["peer"] is None and r["ratio"] is None for r in found)


def test_a_method_that_needs_a_prior_gets_one(monkeypatch):
    monkeypatch.setattr(speed_matching, "SIZES", (5,))
    assert len(method_rows("hungarian")) == 1


def test_rrwm_is_compared_with_pygmtools_where_installed(monkeypatch):
    monkeypatch.setattr(speed_matching, "SIZES", (5,))
    (row,) = method_rows("rrwm")
    assert set(row) == KEYS
    if find_spec("pygmtools") is None:
        assert row["peer"] is None
        assert row["ratio"] is None
    else:
        assert row["ratio"] == 2.0
