"""The text of --method."""

import numpy as np
import pytest

from covis.evaluation.methods import Method, oracle, random_matching


@pytest.mark.parametrize(
    ("text", "name", "options"),
    [
        ("rgm", "rgm", {}),
        ("rgm:acceptance=metropolis", "rgm", {"acceptance": "metropolis"}),
        ("hungarian:gate_m=2.5", "hungarian", {"gate_m": 2.5}),
        ("mypkg.mine:match", "mypkg.mine:match", {}),
        (
            "mypkg.mine:match:radius=3,fast=true,mode=None",
            "mypkg.mine:match",
            {"radius": 3, "fast": True, "mode": None},
        ),
        ("pygm:rrwm", "pygm:rrwm", {}),
    ],
)
def test_parse(text, name, options):
    method = Method.parse(text)
    assert (method.label, method.name, dict(method.options)) == (text, name, options)


@pytest.mark.parametrize("text", ["", ":a=1", "rgm:a=1,b", "rgm:1a=2"])
def test_bad_text_is_refused(text):
    with pytest.raises(ValueError, match="--method"):
        Method.parse(text)


def test_oracle_finds_everything_and_nothing_else():
    matching = oracle(np.array([3, -1, 5]), np.array([5, 9, -1, 3]))
    assert {tuple(p) for p in matching.pairs.tolist()} == {(0, 3), (2, 0)}


def test_random_is_uniform():
    rng = np.random.default_rng(0)
    counts = np.zeros((3, 5))
    for _ in range(3000):
        matching = random_matching(3, 5, rng)
        assert len(matching) == 3
        counts[tuple(matching.pairs.T)] += 1
    np.testing.assert_allclose(counts / 3000, 1 / 5, atol=0.04)
    assert len(random_matching(0, 5, rng)) == 0
