"""Precision, recall and calibration by hand."""

import numpy as np
import pytest

from covis.matching import Matching
from covis.matching.metrics import (
    Counts,
    count,
    expected_calibration_error,
    f1_per_pair,
    pooled,
    recall_at_precision,
    reliability,
)


def test_counts_by_hand():
    source, target = np.array([10, 11, 12, -1]), np.array([11, 10, 99, -1])
    matching = Matching(np.array([[0, 1], [1, 2], [3, 3]]), np.ones(3))
    counts = count(matching, source, target)
    # 10 is right, 11-99 wrong, two negatives are no object; 10 and 11 are common.
    assert counts == Counts(correct=1, retrieved=3, common=2)
    assert counts.precision == pytest.approx(1 / 3)
    assert counts.recall == pytest.approx(1 / 2)
    assert counts.f1 == pytest.approx(2 * 1 / 5)


def test_nothing_retrieved_is_precision_0():
    counts = count(Matching.empty(), np.array([1, 2]), np.array([2, 3]))
    assert (counts.precision, counts.recall, counts.f1) == (0.0, 0.0, 0.0)
    assert Counts().f1 == 0.0


def test_counts_pool_before_ratios():
    total = pooled([Counts(1, 1, 4), Counts(0, 3, 0)])
    assert total == Counts(1, 4, 4)
    assert total.precision == 0.25


def test_f1_per_pair_weighs_every_pair_alike():
    # By pair 1 and 18 / 25; of the last there is nothing to say.
    counts = np.array([[1, 1, 1], [9, 13, 12], [0, 0, 0]])
    assert f1_per_pair(counts) == pytest.approx((1 + 18 / 25) / 2)
    assert f1_per_pair(np.array([[0, 2, 0]])) == 0.0
    assert np.isnan(f1_per_pair(np.zeros((1, 3), dtype=int)))


def test_calibration_error_is_not_raised_by_few_matches():
    """What chance alone makes of 20 matches in ten bins is taken off: else a calibrated matcher would show .15."""
    rng = np.random.default_rng(2)
    errors = []
    for _ in range(200):
        scores = rng.uniform(0.3, 0.9, 60)
        errors.append(expected_calibration_error(scores, rng.uniform(0, 1, 60) < scores))
    assert np.mean(errors) < 0.11


def test_calibrated_scores_have_no_calibration_error():
    rng = np.random.default_rng(0)
    scores = rng.uniform(0, 1, 20000)
    correct = rng.uniform(0, 1, 20000) < scores
    assert expected_calibration_error(scores, correct) < 0.01


def test_overconfidence_shows():
    rng = np.random.default_rng(1)
    scores = np.full(5000, 0.9) + rng.uniform(-0.01, 0.01, 5000)
    correct = rng.uniform(0, 1, 5000) < 0.6
    assert expected_calibration_error(scores, correct) == pytest.approx(0.3, abs=0.02)


def test_reliability_bins_have_equal_mass():
    bins = reliability(np.linspace(0, 1, 100), np.linspace(0, 1, 100) > 0.5)
    assert [b.n for b in bins] == [10] * 10
    assert bins[0].accuracy == 0.0
    assert bins[-1].accuracy == 1.0


def test_no_matches_no_calibration():
    assert np.isnan(expected_calibration_error(np.zeros(0), np.zeros(0, bool)))


def test_recall_at_precision_by_hand():
    scores = np.array([0.9, 0.8, 0.8, 0.7, 0.6])
    correct = np.array([True, True, False, True, True])
    # Thresholds: .9 -> 1/1; .8 (both together) -> 2/3; .7 -> 3/4; .6 -> 4/5.
    assert recall_at_precision(scores, correct, common=8, precision=0.95) == pytest.approx(1 / 8)
    assert recall_at_precision(scores, correct, common=8, precision=0.8) == pytest.approx(4 / 8)
    assert recall_at_precision(scores, ~correct, common=8, precision=1.0) == 0.0
