"""How often the ledger's intervals cover the truth, by simulation, and whether as many samples as it names decide."""

import numpy as np
import pytest

from lifelong_lib.reproduction import statistics as st

# Share of intervals that cover the mean. Below 24 samples Student's t does not know that a distribution is skew, and
# with three or four samples not that it has two humps: the ledger says so (claims.toml, rule 1).
COVERS = {
    "normal": {3: 0.95, 4: 0.95, 6: 0.95, 10: 0.95, 24: 0.95, 40: 0.95},
    "exponential": {3: 0.88, 4: 0.88, 6: 0.89, 10: 0.90, 24: 0.935, 40: 0.94},
    "two-humped": {3: 0.88, 4: 0.90, 6: 0.94, 10: 0.95, 24: 0.96, 40: 0.96},
}
MEANS = {"normal": 0.0, "exponential": 1.0, "two-humped": 0.0}


def draw(shape, size, rng):
    if shape == "normal":
        return rng.normal(size=size)
    if shape == "exponential":
        return rng.exponential(size=size)
    return rng.normal(size=size) + rng.choice([-2.0, 2.0], size)


@pytest.mark.parametrize("shape", COVERS)
@pytest.mark.parametrize("n", [3, 4, 6, 10, 24, 40])
def test_intervals_of_the_mean_cover_as_often_as_the_ledger_says(shape, n):
    few = n < st.FEWEST_FOR_BOOTSTRAP
    samples = draw(shape, (n, 10_000 if few else 2000), np.random.default_rng([n, list(COVERS).index(shape)]))
    low, high = st.mean_interval(samples, resamples=4000)
    covered = np.mean((low <= MEANS[shape]) & (MEANS[shape] <= high))
    assert covered == pytest.approx(COVERS[shape][n], abs=0.012)
    assert few or 0.93 <= covered <= 0.97


# Tails such as those of lifetimes at the start on new tasks (quadrotors: of 24 differences one is ten times the rest).
TAILS = {
    "normal": lambda size, rng: rng.normal(size=size),
    "exponential": lambda size, rng: rng.exponential(size=size),
    "t with 2 degrees": lambda size, rng: rng.standard_t(2, size=size),
    "one in ten far below": lambda size, rng: rng.normal(size=size)
    - 10 * rng.exponential(size=size) * (rng.random(size) < 0.1),
    "one in 24 very far below": lambda size, rng: rng.normal(size=size) - 40 * (rng.random(size) < 1 / 24),
}


@pytest.mark.parametrize("tail", TAILS)
@pytest.mark.parametrize("n", [10, 24, 48])
def test_intervals_of_the_interquartile_mean_cover_whatever_the_tail(tail, n):
    rng = np.random.default_rng([n, list(TAILS).index(tail)])
    truth = st.interquartile_mean(TAILS[tail](400_000, rng))
    low, high = st.interquartile_interval(TAILS[tail]((n, 10_000), rng))
    assert 0.92 <= np.mean((low <= truth) & (truth <= high)) <= 0.97


def test_with_such_tails_intervals_of_the_mean_do_not_cover():
    """Why rewards of lifetimes have another centre."""
    samples = TAILS["one in 24 very far below"]((10, 10_000), np.random.default_rng(0))
    low, high = st.mean_interval(samples)
    assert np.mean((low <= -40 / 24) & (-40 / 24 <= high)) < 0.6


@pytest.mark.parametrize("distance", [0.5, 1.0, 2.0])
def test_as_many_samples_as_are_named_decide_four_times_in_five(distance):
    rng = np.random.default_rng(3)
    seen = rng.normal(size=8)
    seen = (seen - seen.mean()) / seen.std(ddof=1) + distance  # mean `distance`, spread 1, against a bound of 0
    low, high = st.mean_interval(seen)
    needed = st.samples_needed(seen.mean(), (high - low) / 2, len(seen))
    decided = {n: np.mean(st.mean_interval(rng.normal(distance, 1, size=(n, 4000)), resamples=200)[0] > 0)
               for n in (needed, max(2, needed // 2))}  # fmt: skip
    assert decided[needed] >= 0.79 and decided[max(2, needed // 2)] < 0.7


def test_numbers_of_samples_by_hand():
    # Spread 1: 4 samples reach 3.182 / 2. With n samples t(0.975) + t(0.8) over the root of n has to be 1 or less:
    # 9: (2.306 + 0.889) / 3 = 1.065; 10: (2.262 + 0.883) / 3.162 = 0.995.
    assert st.samples_needed(1.0, 3.18245 / 2, 4) == st.samples_needed(-1.0, 3.18245 / 2, 4) == 10
    assert st.samples_needed(1e-4, 1.0, 4) is None
