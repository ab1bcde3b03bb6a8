"""Intervals and tests agree with arithmetic by hand and with scipy."""

import itertools

import numpy as np
import pytest
from scipy import stats

from lifelong_lib.reproduction import statistics as st


def test_few_samples_have_students_interval():
    samples = np.random.default_rng(3).gamma(2.0, size=9)
    theirs = stats.ttest_1samp(samples, 0).confidence_interval()
    assert st.mean_interval(samples) == pytest.approx((theirs.low, theirs.high))
    reach = 4.3027 / np.sqrt(3)
    assert st.mean_interval([1.0, 2.0, 3.0]) == pytest.approx((2 - reach, 2 + reach), abs=1e-4)


def test_many_samples_have_scipys_bootstrap_at_a_wider_level():
    samples = np.random.default_rng(3).exponential(size=40)
    low, high = st.mean_interval(samples)
    tail = stats.norm.cdf(-np.sqrt(40 / 39) * stats.t.ppf(0.975, 39))
    assert tail < 0.025
    theirs = stats.bootstrap((samples,), np.mean, confidence_level=1 - 2 * tail, n_resamples=40_000,
                             rng=1).confidence_interval  # fmt: skip
    width = theirs.high - theirs.low
    assert abs(low - theirs.low) < 0.03 * width and abs(high - theirs.high) < 0.03 * width
    assert high - samples.mean() > samples.mean() - low  # it knows that the samples are skew


@pytest.mark.parametrize("n", [5, 30])
def test_interval_keeps_shape_and_repeats_itself(n):
    samples = np.random.default_rng(1).normal(size=(n, 3, 4))
    for interval, centre in ((st.mean_interval, np.mean), (st.interquartile_interval, st.interquartile_mean)):
        low, high = interval(samples)
        assert low.shape == high.shape == (3, 4)
        assert (low < centre(samples, axis=0)).all() and (centre(samples, axis=0) < high).all()
        assert np.array_equal(low, interval(samples)[0])
    if n == 30:
        assert not np.array_equal(st.mean_interval(samples, seed=0), st.mean_interval(samples, seed=1))


@pytest.mark.parametrize("interval", [st.mean_interval, st.interquartile_interval])
def test_interval_of_equal_samples_is_a_point_and_of_one_sample_unknown(interval):
    for n in (3, 8, 30):
        assert interval([2.0] * n) == pytest.approx((2.0, 2.0))
        rounded = 0.1 * np.arange(1, n + 1) / np.arange(1, n + 1)  # equal but for the last digit
        assert interval(rounded) == pytest.approx((0.1, 0.1))
    assert np.isnan(interval([2.0])).all()
    with pytest.raises(ValueError, match="no samples"):
        interval([])


def test_interquartile_mean_and_interval_by_hand():
    samples = [-100.0, 1, 2, 3, 4, 5, 6, 90]
    assert st.interquartile_mean(samples) == 3.5 and st.interquartile_mean([1.0, 5, 9]) == 5
    # Drawn in to 2 2 2 3 4 5 5 5: mean 3.5, squares 1.5^2 x 6 + 0.5^2 x 2 = 14. Four are kept: t with 3 degrees.
    reach = 3.18245 * np.sqrt(14 / 7 / 8) / 0.5
    assert st.interquartile_interval(samples) == pytest.approx((3.5 - reach, 3.5 + reach), abs=1e-4)


def test_standard_error_by_hand():
    assert st.standard_error([1.0, 2.0, 3.0]) == pytest.approx(1 / np.sqrt(3))
    assert np.isnan(st.standard_error([[1.0, 2.0]])).all()


def test_permutation_by_hand():
    assert st.paired_permutation([1.0, 2, 3, 4, 5, 6]) == 2 / 64  # only all plus and all minus reach a sum of 21
    assert st.paired_permutation([1.0, 2, -3, 1, 2, -3]) == 1.0  # the sum is zero
    assert st.paired_permutation(np.zeros(6)) == 1.0
    assert st.paired_permutation([1.0, 2, 3, 4, 5]) is None  # it could not come below 2 / 32


def test_permutation_of_another_centre():
    """Of eight numbers the lowest and highest two do not count: 2, 3, 4, 5 have the mean 3.5."""
    differences = [90.0, 1, 2, 3, 4, 5, 6, -80]
    signs = np.array(list(itertools.product((-1, 1), repeat=8)))
    means = st.interquartile_mean(signs * differences, axis=1)
    found = st.paired_permutation(differences, st.interquartile_mean)
    assert found == np.mean(np.abs(means) >= 3.5 - 1e-9)  # as the distribution of signs is symmetric
    assert found < st.paired_permutation(differences)


def test_permutation_agrees_with_scipy_and_its_draws_with_all_signs():
    differences = np.random.default_rng(5).normal(0.5, 1.0, size=10)
    theirs = stats.permutation_test((differences, np.zeros(10)), lambda a, b: np.mean(a - b), vectorized=False,
                                    permutation_type="samples", n_resamples=np.inf).pvalue
    assert st.paired_permutation(differences) == pytest.approx(theirs)
    many = np.random.default_rng(6).normal(0.4, 1.0, size=15)
    assert st.paired_permutation(many) == pytest.approx(stats.ttest_1samp(many, 0).pvalue, abs=0.03)
    assert st.paired_permutation(many) == st.paired_permutation(many)


def test_curve_measures_by_hand():
    curve = np.array([[2.0, 3.0, 4.0], [1.0, 1.0, 4.0]])
    assert st.iterations_to_level(curve, 3.0).tolist() == [1.0, 2.0]
    assert st.iterations_to_level(curve, [4.0, 1.0]).tolist() == [2.0, 0.0]
    assert np.isnan(st.iterations_to_level(curve[0], 9.0))


def test_growth_exponent_of_powers():
    x = np.array([5, 10, 20, 40])
    assert np.allclose(st.growth_exponent(x, np.array([3.0 * x**2, 0.1 * x])), [2, 1])
    with pytest.raises(ValueError, match="positive"):
        st.growth_exponent(x, [1, 2, 0, 4])


@pytest.mark.filterwarnings("ignore:An input array is constant")
def test_rank_correlation_agrees_with_scipy_where_ranks_tie():
    x, y = [1, 1, 1, 2, 2, 2, 3], np.random.default_rng(2).normal(size=(4, 7))
    assert np.allclose(st.rank_correlation(x, y), [stats.spearmanr(x, row).statistic for row in y])
    assert np.isnan(st.rank_correlation([1, 2, 3], [4.0, 4.0, 4.0]))


def test_the_measures_of_a_life_by_hand():
    accuracy = [[0.9, 0.2, 0.3],
                [0.8, 0.7, 0.4],
                [0.6, 0.75, 0.8]]  # fmt: skip
    found = st.lifelong_measures(accuracy, [0.1, 0.1, 0.25])
    assert found["average accuracy"] == pytest.approx((0.6 + 0.75 + 0.8) / 3)
    assert found["backward transfer"] == pytest.approx(((0.6 - 0.9) + (0.75 - 0.7)) / 2)
    assert found["forgetting"] == pytest.approx(((0.9 - 0.6) + (0.7 - 0.75)) / 2)
    assert found["forward transfer"] == pytest.approx(((0.2 - 0.1) + (0.4 - 0.25)) / 2)
    relearned = [[0.5, 0.0, 0.0], [0.9, 0.5, 0.0], [0.6, 0.5, 0.5]]  # the first task was best after the second
    found = st.lifelong_measures(np.stack([accuracy, relearned]), np.zeros((2, 3)))
    assert found["forgetting"] == pytest.approx([0.125, 0.15]) and found["backward transfer"][1] == pytest.approx(0.05)


def test_a_life_without_forgetting_and_one_of_a_single_task():
    kept = st.lifelong_measures(np.tril(np.ones((4, 4))), np.zeros(4))
    assert list(kept.values()) == [1, 0, 0, 0]
    with pytest.raises(ValueError, match="fewer than two tasks"):
        st.lifelong_measures([[0.5]], [0.1])
