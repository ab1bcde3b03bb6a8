"""Numbers that turn repeated runs into evidence.

Axis 0 is always the seed (or trial): episodes and tasks are averaged before they come here, because two roll-outs of
one run are not two runs. Every function that draws random numbers takes a seed and gives the same answer each time.
"""

import numpy as np
from scipy import stats


def standard_error(samples):
    """Return the standard error of the mean over axis 0 of `samples` (n_seeds, ...); nan with a single seed."""
    samples = np.asarray(samples, dtype=float)
    if len(samples) < 2:
        return np.full(samples.shape[1:], np.nan)[()]
    return samples.std(axis=0, ddof=1) / np.sqrt(len(samples))


def bootstrap_interval(samples, resamples=2000, seed=0):
    """Return (low, high), the 95 % bootstrap interval of the mean over axis 0, each of shape `samples.shape[1:]`.

    It is the percentile interval with its percentiles moved outwards as Student's t distribution demands
    (Hesterberg 2015, "expanded percentile"): the plain one is a quarter too narrow for six seeds. With two to four
    seeds it is the range of the resampled means. `samples`: (n_seeds, ...); `resamples`: number of draws; `seed`: of
    the draws. A single seed has no interval: (nan, nan). Raises ValueError without samples.
    """
    samples = np.asarray(samples, dtype=float)
    n = len(samples)
    if n == 0:
        raise ValueError("no samples: axis 0 must hold one entry a seed")
    if n == 1:
        return (np.full(samples.shape[1:], np.nan)[()],) * 2
    # How often each seed is drawn says all that a resample says, and makes its mean a matrix product.
    counts = np.random.default_rng(seed).multinomial(n, np.full(n, 1 / n), size=resamples)
    centre = samples.mean(axis=0)
    means = np.tensordot(counts / n, samples - centre, axes=1)  # (resamples, ...)
    tail = expanded_tail(n, 0.95)
    low, high = np.quantile(means, [tail, 1 - tail], axis=0)
    return (centre + low)[()], (centre + high)[()]


def expanded_tail(n, level):
    """Return the share of resampled means to leave out on each side for `n` seeds at coverage `level`."""
    return stats.norm.cdf(-np.sqrt(n / (n - 1)) * stats.t.ppf((1 + level) / 2, n - 1))


def paired_permutation(differences, seed=0):
    """Return the two-sided p value of a mean of paired `differences` (n,) as far from zero, were their signs chance.

    All 2^n signs are tried for n <= 14, otherwise 2^14 random ones from `seed`. Six pairs cannot give less than
    2 / 64 = 0.031.
    """
    differences = np.asarray(differences, dtype=float)
    return float(stats.permutation_test((differences,), np.mean, permutation_type="samples", n_resamples=2**14,
                                        rng=seed).pvalue)  # fmt: skip


def iterations_to_level(curve, level):
    """Return the first index at which `curve` (..., n_iterations) is at least `level`, shape (...); nan if never.

    `level`: one number, or one a curve (shape (...)).
    """
    reached = np.asarray(curve, dtype=float) >= np.asarray(level, dtype=float)[..., None]
    return np.where(reached.any(axis=-1), reached.argmax(axis=-1), np.nan)[()]


def growth_exponent(x, y):
    """Return the slope of log `y` (..., n_x) against log `x` (n_x,), shape (...): 2 means quadratic growth.

    Raises ValueError when a value is not positive, for it has no logarithm.
    """
    if np.min(x) <= 0 or np.min(y) <= 0:
        raise ValueError("growth_exponent needs positive numbers: leave out the points that are zero or below")
    return stats.linregress(np.log(x), np.log(y), axis=-1).slope


def rank_correlation(x, y):
    """Return Spearman's rank correlation of `x` (n,) with each row of `y` (..., n), (...); nan if a side is flat."""
    return stats.pearsonr(stats.rankdata(x), stats.rankdata(y, axis=-1), axis=-1).statistic


def lifelong_measures(accuracy, untrained):
    """Return what a life of T tasks came to, by name, each (...), from `accuracy` (..., T, T) and `untrained` (..., T).

    `accuracy[i, j]`: on task j when task i has been learned; `untrained[j]`: before any was. As Lopez-Paz and Ranzato
    (2017) define them, "average accuracy" is over all tasks at the end, "backward transfer" what later tasks changed of
    it since each was learned, "forward transfer" what earlier tasks gave each before it was learned; "forgetting"
    (Chaudhry et al. 2018) is how far each fell from the best it had been before the last task. The last task has none
    of the second and fourth, the first none of the third; a life needs two tasks, otherwise ValueError is raised.
    """
    accuracy = np.asarray(accuracy, dtype=float)
    if accuracy.shape[-1] < 2:
        raise ValueError("a life of fewer than two tasks has no transfer and no forgetting")
    learned = np.diagonal(accuracy, axis1=-2, axis2=-1)  # each when it was the latest
    before = np.diagonal(accuracy, offset=1, axis1=-2, axis2=-1)  # the second to last, each when it was to come next
    end, best = accuracy[..., -1, :], accuracy[..., :-1, :].max(axis=-2)
    return {
        "average accuracy": end.mean(axis=-1),
        "forgetting": (best - end)[..., :-1].mean(axis=-1),
        "forward transfer": (before - np.asarray(untrained)[..., 1:]).mean(axis=-1),
        "backward transfer": (end - learned)[..., :-1].mean(axis=-1),
    }
