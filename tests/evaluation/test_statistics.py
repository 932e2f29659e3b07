"""Differences between methods: the episode is the unit, and noise makes no winner."""

import numpy as np
import pytest
from scipy import stats

from covis.evaluation.statistics import (
    bootstrap_f1,
    bootstrap_interval,
    bootstrap_mean,
    episode_sums,
    paired_difference,
)
from covis.matching.metrics import Counts


def sums(correct, retrieved=10, common=10):
    return {k: np.array([c, retrieved, common], dtype=float) for k, c in enumerate(correct)}


def test_sums_pool_by_episode():
    counts = [Counts(1, 2, 3), Counts(4, 5, 6), Counts(1, 1, 1)]
    found = episode_sums([(7, 0), (7, 1), (7, 0)], counts)
    assert {k: v.tolist() for k, v in found.items()} == {(7, 0): [2, 3, 4], (7, 1): [4, 5, 6]}


def test_a_difference_by_hand():
    """F1 = correct / 10 an episode. Ahead by 2 in each of three episodes: of the 8 exchanges two (none, all) make a
    difference as large, and every resample has the difference .2."""
    d = paired_difference(sums([8, 5, 6]), sums([6, 3, 4]))
    assert d.value == pytest.approx(0.2)
    assert (d.low, d.high) == pytest.approx((0.2, 0.2))
    assert d.p_value == pytest.approx(2 / 8)
    assert d.noise  # three episodes never make a winner


def test_pairing_sees_what_separate_intervals_hide():
    rng = np.random.default_rng(0)
    hard = rng.integers(1, 9, 20)
    ahead = paired_difference(sums(hard + 1), sums(hard))
    assert ahead.value == pytest.approx(0.1)
    assert not ahead.noise
    assert ahead.p_value < 0.001
    intervals = [bootstrap_f1(range(20), [Counts(int(c), 10, 10) for c in hard + k]) for k in (0, 1)]
    assert intervals[0][1] > intervals[1][0]  # they overlap


def test_noise_is_called_noise():
    """Of 100 comparisons of equally good methods, about five p-values fall below .05."""
    rng = np.random.default_rng(1)
    p = [
        paired_difference(sums(rng.binomial(10, 0.5, 9)), sums(rng.binomial(10, 0.5, 9)), samples=50).p_value
        for _ in range(100)
    ]
    assert 0 <= sum(x < 0.05 for x in p) <= 12
    assert 0.3 < np.median(p) < 0.7


def test_many_episodes_are_sampled_and_agree_with_the_exact_test():
    rng = np.random.default_rng(2)
    own, other = rng.integers(3, 9, 12), rng.integers(2, 8, 12)
    exact = paired_difference(sums(own), sums(other)).p_value
    # A thirteenth episode without a difference doubles every exchange, and the test is sampled.
    sampled = paired_difference(sums([*own, 5]), sums([*other, 5])).p_value
    assert sampled == pytest.approx(exact, abs=0.02)


def test_equal_methods_do_not_differ():
    d = paired_difference(sums([3, 4, 5, 6, 7, 8, 2]), sums([3, 4, 5, 6, 7, 8, 2]))
    assert (d.value, d.low, d.high, d.p_value) == (0.0, 0.0, 0.0, 1.0)
    assert d.noise


def test_episodes_are_paired_by_their_keys_in_whatever_order():
    own, other = sums([9, 5, 7, 2, 8, 6]), sums([8, 4, 6, 1, 7, 5])
    turned = dict(reversed(other.items()))
    assert paired_difference(own, turned) == paired_difference(own, other)
    assert paired_difference(own, turned).low == pytest.approx(0.1)


def test_episodes_must_be_the_same():
    with pytest.raises(ValueError, match="same episodes"):
        paired_difference(sums([1, 2]), sums([1]))


def test_the_interval_of_a_mean_narrows_and_holds_it():
    rng = np.random.default_rng(4)
    few, many = rng.normal(3.0, 1.0, 10), rng.normal(3.0, 1.0, 1000)
    for values in (few, many):
        low, high = bootstrap_mean(values)
        assert low < values.mean() < high
        assert high - low == pytest.approx(4 * values.std() / np.sqrt(len(values)), rel=0.15)
    assert bootstrap_mean([2.0, 2.0]) == (2.0, 2.0)


def episodes_of(rng, n, skill):
    """Correct, retrieved, common (n, 3) of n episodes."""
    common = rng.integers(8, 14, n)
    return np.column_stack([rng.binomial(common, skill), rng.integers(8, 14, n), common]).astype(float)


def pooled_f1(*columns, axis=-1):
    correct, retrieved, common = (np.sum(c, axis=axis) for c in columns)
    return 2 * correct / (retrieved + common)


def test_intervals_and_p_values_are_those_of_scipy():
    rng = np.random.default_rng(4)
    a, b = episodes_of(rng, 9, 0.7), episodes_of(rng, 9, 0.55)
    own, other = dict(enumerate(a)), dict(enumerate(b))
    scipy_options = {"paired": True, "vectorized": True, "method": "percentile", "n_resamples": 40_000, "rng": 5}
    interval = stats.bootstrap(tuple(a.T), pooled_f1, **scipy_options).confidence_interval
    assert bootstrap_interval(own, samples=40_000) == pytest.approx(tuple(interval), abs=0.004)

    def difference(*columns, axis=-1):
        return pooled_f1(*columns[:3]) - pooled_f1(*columns[3:])

    both = stats.bootstrap((*a.T, *b.T), difference, **scipy_options).confidence_interval
    found = paired_difference(own, other, samples=40_000)
    assert (found.low, found.high) == pytest.approx(tuple(both), abs=0.006)
    assert found.value == pytest.approx(float(difference(*a.T, *b.T)))

    # Whole episodes change sides: each is one observation, told apart by its number.
    def of_sides(first, second, axis=-1):
        numbers = [np.asarray(x).astype(int) for x in (first, second)]
        pool = np.concatenate([a, b])
        return difference(*(pool[n][..., k] for n in numbers for k in range(3)))

    sides = stats.permutation_test(
        (np.arange(9), np.arange(9, 18)),
        of_sides,
        permutation_type="samples",
        vectorized=True,
        n_resamples=np.inf,
        alternative="two-sided",
    )
    # SciPy doubles the smaller tail, we count both: the same, as exchanging all episodes changes the sign.
    assert found.p_value == pytest.approx(sides.pvalue, abs=1e-9)


def test_of_two_methods_that_are_equally_good_few_are_called_a_winner():
    rng = np.random.default_rng(11)
    calls = [
        not paired_difference(
            dict(enumerate(episodes_of(rng, 8, 0.6))), dict(enumerate(episodes_of(rng, 8, 0.6))), samples=400
        ).noise
        for _ in range(300)
    ]
    assert np.mean(calls) <= 0.08  # .05, and two standard errors of 300 trials
    clear = paired_difference(
        dict(enumerate(episodes_of(rng, 8, 0.9))), dict(enumerate(episodes_of(rng, 8, 0.4))), samples=400
    )
    assert not clear.noise
