"""Intervals and tests agree with arithmetic by hand and with scipy."""

import numpy as np
import pytest
from scipy import stats

from lifelong_lib.reproduction import statistics as st


def test_interval_agrees_with_scipy_at_the_expanded_level():
    samples = np.random.default_rng(3).gamma(2.0, size=9)
    low, high = st.bootstrap_interval(samples, resamples=40_000)
    level = 1 - 2 * st.expanded_tail(9, 0.95)
    theirs = stats.bootstrap(
        (samples,), np.mean, confidence_level=level, method="percentile", n_resamples=40_000, rng=1
    ).confidence_interval
    width = theirs.high - theirs.low
    assert abs(low - theirs.low) < 0.02 * width and abs(high - theirs.high) < 0.02 * width


def test_interval_covers_the_mean_as_often_as_it_says():
    trials = np.random.default_rng(0).normal(5.0, 2.0, size=(6, 3000))  # 6 seeds, 3000 repetitions of the experiment
    low, high = st.bootstrap_interval(trials)
    assert 0.92 < np.mean((low <= 5.0) & (5.0 <= high)) < 0.97  # the plain percentile interval gives 0.86


def test_interval_keeps_shape_repeats_itself_and_depends_on_the_seed():
    samples = np.random.default_rng(1).normal(size=(5, 3, 4))
    low, high = st.bootstrap_interval(samples)
    assert low.shape == high.shape == (3, 4)
    assert (low < samples.mean(axis=0)).all() and (samples.mean(axis=0) < high).all()
    assert np.array_equal(low, st.bootstrap_interval(samples)[0])
    many = np.random.default_rng(1).normal(size=40)
    assert st.bootstrap_interval(many, seed=0) != st.bootstrap_interval(many, seed=1)


def test_interval_of_equal_samples_is_a_point_and_of_one_sample_unknown():
    assert st.bootstrap_interval([2.0, 2.0, 2.0]) == (2.0, 2.0)
    assert np.isnan(st.bootstrap_interval([2.0])).all()
    with pytest.raises(ValueError, match="no samples"):
        st.bootstrap_interval([])


def test_standard_error_by_hand():
    assert st.standard_error([1.0, 2.0, 3.0]) == pytest.approx(1 / np.sqrt(3))
    assert np.isnan(st.standard_error([[1.0, 2.0]])).all()


def test_permutation_by_hand():
    assert st.paired_permutation([1.0, 2.0, 3.0]) == 2 / 8  # only all plus and all minus reach a sum of 6
    assert st.paired_permutation([1.0, -1.0]) == 1.0
    assert st.paired_permutation([0.1, 0.2, -0.3]) == 1.0  # the sum is zero but for rounding
    assert st.paired_permutation(np.zeros(4)) == 1.0


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
