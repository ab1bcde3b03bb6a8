"""Numbers that turn repeated runs into evidence.

Axis 0 is always the seed (or trial): episodes and tasks are averaged before they come here, because two roll-outs of
one run are not two runs. Every function that draws random numbers takes a seed and gives the same answer each time.
"""

from functools import cache

import numpy as np
from scipy import stats

FEWEST_FOR_BOOTSTRAP = 24  # from here on it covers whatever the shape (measured in the tests), below it does not
FEWEST_FOR_P = 6  # of five pairs, all of one sign, two in 32 are: 0.06


def standard_error(samples):
    """Return the standard error of the mean over axis 0 of `samples` (n_seeds, ...); nan with a single seed."""
    samples = np.asarray(samples, dtype=float)
    if len(samples) < 2:
        return np.full(samples.shape[1:], np.nan)[()]
    return samples.std(axis=0, ddof=1) / np.sqrt(len(samples))


def mean_interval(samples, resamples=10_000, seed=0):
    """Return (low, high), the 95 % interval of the mean over axis 0 of `samples` (n_seeds, ...), each of its shape.

    Below FEWEST_FOR_BOOTSTRAP seeds it is Student's t interval, from there on the BCa bootstrap (Efron 1987) with its
    percentiles moved outwards as the t distribution demands (Hesterberg 2015): the plain one is too narrow. A single
    seed has no interval: (nan, nan). `resamples`: number of draws; `seed`: of the draws. Raises ValueError without
    samples.
    """
    samples = np.asarray(samples, dtype=float)
    n, centre = len(_some(samples)), samples.mean(axis=0)
    reach = stats.t.ppf(0.975, n - 1) * standard_error(samples)
    low, high = centre - reach, centre + reach
    if n >= FEWEST_FOR_BOOTSTRAP and np.all(reach > 1e-9 * np.abs(centre)):  # equal samples have none to resample
        level = 1 - 2 * stats.norm.cdf(-np.sqrt(n / (n - 1)) * stats.t.ppf(0.975, n - 1))
        low, high = stats.bootstrap((samples,), np.mean, n_resamples=resamples, confidence_level=level,
                                    method="BCa", vectorized=True, batch=500, rng=seed).confidence_interval  # fmt: skip
    return low, high


def interquartile_mean(samples, axis=0):
    """Return the mean over `axis` of `samples` without the lowest and the highest quarter of them (rounded down)."""
    return stats.trim_mean(samples, 0.25, axis=axis)


def interquartile_interval(samples):
    """Return (low, high), the 95 % interval of the interquartile mean over axis 0 of `samples` (n_seeds, ...).

    Tukey and McLaughlin (1963): Student's t for the samples that are kept, its error from all samples, the outer
    quarters drawn in to the last that is kept. With fewer than four seeds nothing is left out.
    """
    samples = np.sort(np.asarray(samples, dtype=float), axis=0)
    n = len(_some(samples))
    left_out = n // 4
    drawn_in = np.clip(samples, samples[left_out], samples[n - left_out - 1])
    reach = stats.t.ppf(0.975, n - 2 * left_out - 1) * standard_error(drawn_in) / (1 - 2 * left_out / n)
    centre = interquartile_mean(samples)
    return centre - reach, centre + reach


def _some(samples):
    if len(samples) == 0:
        raise ValueError("no samples: axis 0 must hold one entry a seed")
    return samples


def samples_needed(distance, reach, n):
    """Return how many samples would put an interval beside a bound, four times in five; None if more than 10,000.

    Mean and spread are taken to be those seen: an interval that reaches `reach` to either side with `n` samples, and
    whose centre lies at `distance` from the bound.
    """
    spread = reach * np.sqrt(n) / stats.t.ppf(0.975, n - 1)
    enough = np.flatnonzero(spread * _distances_that_decide() <= abs(distance))
    return int(enough[0]) + 2 if len(enough) else None


@cache
def _distances_that_decide():
    """In spreads, how far from a bound the mean of 2, 3, ... 10,000 samples has to be."""
    sizes = np.arange(2, 10_001)
    return (stats.t.ppf(0.975, sizes - 1) + stats.t.ppf(0.8, sizes - 1)) / np.sqrt(sizes)


def paired_permutation(differences, centre=np.mean, seed=0):
    """Return the two-sided p value of a `centre` of `differences` (n,) as far from zero, were their signs chance.

    All 2^n signs are tried for n <= 14, otherwise 2^14 random ones from `seed`. It cannot be less than 2 / 2^n, so that
    with fewer than six pairs, where it could not come below 0.05, there is none: None.
    """
    differences = np.asarray(differences, dtype=float)
    if len(differences) < FEWEST_FOR_P:
        return None
    return float(stats.permutation_test((differences,), centre, permutation_type="samples", n_resamples=2**14,
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
