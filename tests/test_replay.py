"""What stays in the memories of chapter 6: by sorting, by chi-square, against k-centre, and after a save."""

import itertools

import gymnasium as gym
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats
from test_q_learning import SHAPE, Lamp, learner

from lifelong_lib.learners.networks import Dense, Network
from lifelong_lib.learners.q_learning import ReplayBuffer, Trial, run_trial
from lifelong_lib.transfer.distances import extended_jaccard, manhattan, whole_experience
from lifelong_lib.transfer.replay import (
    CoverageMemory,
    EpisodicMemory,
    PairOfBuffers,
    distribution_matching,
    load,
    noisy_reward,
    save,
    surprise,
)


def trial_of(points, returns=None, actions=None):
    """A trial whose images are the points (n, ...); what a memory does not read is left empty."""
    points, none = np.asarray(points, np.float32), np.zeros(0)
    returns = np.zeros(len(points)) if returns is None else np.asarray(returns, float)
    actions = np.zeros(len(points), int) if actions is None else np.asarray(actions)
    return Trial(np.concatenate([points, points[-1:]]), none, actions, none, none, returns, {})


def by_return(trial, network, rng):
    return trial.returns


def fill(memory, points, returns=None, length=20):
    """Offer points and their returns in trials of a length, the last one being shorter."""
    returns = np.zeros(len(points)) if returns is None else np.asarray(returns)
    for first in range(0, len(points), length):
        memory.add(trial_of(points[first : first + length], returns[first : first + length]))
    return memory


def numbered(count):
    return np.arange(count, dtype=np.float32)[:, None]


def episodic(capacity, ranking=by_return, seed=0, **more):
    return EpisodicMemory(capacity, (1,), ranking, np.random.default_rng(seed), **more)


# --------------------------------------------------------------------------------------------------- priority queue

@given(capacity=st.integers(1, 9), length=st.integers(1, 6),
       scores=st.lists(st.sampled_from([-2.0, 0.0, 0.5, 1.0, np.inf]) | st.floats(-5, 5), min_size=1, max_size=40))
@settings(max_examples=150, deadline=None)
def test_what_stays_are_the_highest_scores_as_sorting_finds_them(capacity, length, scores):
    memory = fill(episodic(capacity), numbered(len(scores)), scores, length)
    kept = sorted(memory.scores[: len(memory)])
    assert kept == sorted(scores)[-capacity:] and len(memory) == min(capacity, len(scores))
    assert memory.added == len(scores)
    numbers = memory.images[: len(memory), 0].astype(int)
    assert len(set(numbers)) == len(memory), "each experience is stored once"
    assert (memory.arrivals[: len(memory)] == numbers).all(), "what comes with an image stays with it"
    assert (memory.scores[: len(memory)] == np.array(scores)[numbers]).all()
    assert (memory.returns[: len(memory)] == np.float32(np.array(scores)[numbers])).all()


def inclusions(ranking, points, returns, capacity=12, repetitions=600):
    """How often each arrival of a stream is in memory at its end."""
    counts = np.zeros(len(points))
    for seed in range(repetitions):
        memory = fill(episodic(capacity, ranking, seed), points, returns)
        counts[memory.arrivals] += 1
    return counts


def uniform_p_value(counts, capacity=12, repetitions=600):
    """Chi-square for draws without repetition: of n arrivals, all have the probability capacity / n."""
    n, share = len(counts), capacity / len(counts)
    squares = ((counts - repetitions * share) ** 2).sum() / (repetitions * share * (1 - share))
    return stats.chi2.sf(squares * (n - 1) / n, n - 1)


@pytest.mark.parametrize("count", [13, 50, 120])
def test_matching_keeps_every_arrival_with_the_same_probability(count):
    counts = inclusions(distribution_matching, numbered(count), np.zeros(count))
    assert uniform_p_value(counts) > 0.001 and counts.sum() == 600 * 12


def test_matching_keeps_repeated_experiences_as_often_as_they_came():
    values = np.repeat([0, 1, 2, 1], [5, 60, 15, 20])  # the stream comes in blocks, one of which comes again
    counts = inclusions(distribution_matching, values[:, None], np.zeros(100))
    assert uniform_p_value(counts) > 0.001
    shares = np.bincount(values, counts) / counts.sum()
    assert shares == pytest.approx([0.05, 0.8, 0.15], abs=0.015)


def test_a_memory_that_has_room_keeps_all():
    assert set(fill(episodic(30, distribution_matching), numbered(30)).arrivals) == set(range(30))


def test_between_equal_scores_the_time_of_arrival_does_not_decide():
    assert uniform_p_value(inclusions(by_return, numbered(60), np.ones(60))) > 0.001


def test_the_chi_square_sees_a_memory_that_prefers_the_latest():
    slightly = inclusions(lambda trial, network, rng: rng.random(len(trial.returns)) + trial.returns,
                          numbered(60), np.linspace(0, 0.1, 60))  # fmt: skip
    assert uniform_p_value(slightly) < 1e-6


# -------------------------------------------------------------------------------------------------------- rankings

def test_surprise_is_the_distance_of_the_value_of_the_action_taken_from_the_return():
    network = Network((1,), [Dense(2)], 0)
    network.weights[:] = network.weights.new_tensor([1.0, -2.0, 0.5, 0.0])  # values x + 0.5 and -2 x
    trial = trial_of([[1.0], [2.0], [3.0]], returns=[1.0, 5.0, -7.0], actions=[0, 0, 1])
    assert surprise(trial, network, None).tolist() == pytest.approx([0.5, 2.5, 1.0])


def test_reward_is_the_absolute_return_with_noise_of_its_spread():
    trial = trial_of(np.zeros((4000, 1)), returns=np.tile([-2.0, 1.0], 2000))
    exact, noisy = (noisy_reward(spread)(trial, None, np.random.default_rng(0)) for spread in (0.0, 0.3))
    assert (exact == np.abs(trial.returns)).all()
    assert stats.kstest((noisy - exact) / 0.3, "norm").pvalue > 0.001


def test_much_noise_makes_reward_into_matching():
    returns = np.tile([0.0, 1.0], 40)
    little, much = (inclusions(noisy_reward(spread), numbered(80), returns) for spread in (1e-3, 1e4))
    assert little[returns == 0].sum() == 0 and uniform_p_value(much) > 0.001


def half_of_the_latest():
    """A ranking of a reader's own: the latest experiences, but only every second of them."""
    numbers = itertools.count()

    def ranking(trial, network, rng):
        ages = np.array([next(numbers) for _ in trial.returns])
        return np.where(rng.random(len(ages)) < 0.5, ages, -1)

    return ranking


def test_an_own_ranking_is_a_function_and_nothing_else():
    kept = fill(episodic(30, half_of_the_latest()), numbered(400)).arrivals
    assert kept.min() >= 300 and 30 <= 400 - kept.min() <= 100
    negated = EpisodicMemory(5, (1,), lambda trial, network, rng: -trial.returns, np.random.default_rng(0))
    assert sorted(fill(negated, numbered(50), np.arange(50.0)).arrivals) == [0, 1, 2, 3, 4]


def test_refreshed_scores_are_those_of_now_and_an_old_surprise_has_to_go():
    network = Network((1,), [Dense(1)], 0)
    network.weights[:] = 0.0  # all values are 0 at first
    kept, renewed = (episodic(4, surprise, refreshed=refreshed) for refreshed in (False, True))
    for memory in (kept, renewed):
        network.weights[1] = 0.0
        memory.add(trial_of(numbered(4), returns=[5.0] * 4), network)
        network.weights[1] = 5.0  # now the returns of 5 are known, and those of 4 surprise
        images, actions, returns = memory.sample(200, np.random.default_rng(0))
        assert images.shape == (200, 1) and (returns == 5).all() and (actions == 0).all()
        memory.add(trial_of(numbered(4) + 4, returns=[4.0] * 4), network)
    assert sorted(kept.arrivals) == [0, 1, 2, 3] and sorted(renewed.arrivals) == [4, 5, 6, 7]
    assert (renewed.scores == 1).all()


@pytest.mark.parametrize("capacity", [0, -3])
def test_a_memory_without_room_is_refused(capacity):
    with pytest.raises(ValueError, match=f"^a replay buffer holds 1 experience or more, not {capacity}$"):
        episodic(capacity)
    with pytest.raises(ValueError, match=f"^a replay buffer holds 1 experience or more, not {capacity}$"):
        CoverageMemory(capacity, (1,), by_return, manhattan, 1.0, np.random.default_rng(0))


@pytest.mark.parametrize(("ranking", "said"), [
    (lambda trial, network, rng: [1.0, 2.0, np.nan], "must give an array (3,) of numbers, and gave nan"),
    (lambda trial, network, rng: trial.returns[1:], "must give an array (3,) of numbers, and gave an array (2,)"),
    (lambda trial, network, rng: trial.returns[:, None], "and gave an array (3, 1)"),
    (lambda trial, network, rng: 1.0, "the ranking <lambda> must give an array (3,) of numbers, and gave an array ()"),
])  # fmt: skip
def test_a_ranking_that_gives_nan_or_another_shape_is_named(ranking, said):
    with pytest.raises(ValueError) as error:
        episodic(5, ranking).add(trial_of(numbered(3)))
    assert said in str(error.value) and "\n" not in str(error.value)


def test_the_name_of_a_ranking_is_no_ranking():
    with pytest.raises(ValueError, match="^a ranking is a function of a trial, its network .*, not 'luck'$"):
        episodic(5, "luck")


# -------------------------------------------------------------------------------------------------------- coverage

def euclidean(one, others):
    return np.sqrt(((others - one) ** 2).sum(axis=1))


def as_points(trial):
    return trial.images[:-1]


def covering(capacity, eta, seed=0, distance=euclidean, d=2):
    return CoverageMemory(capacity, (d,), as_points, distance, eta, np.random.default_rng(seed))


def radius(points, centres):
    """How far the point that is farthest from all centres is from them."""
    return max(euclidean(point, centres).min() for point in points)


def greedy_radius(points, count):
    """The radius of k-centre by Gonzalez's rule, which is at most twice the least one possible."""
    distances = np.full(len(points), np.inf)
    for _ in range(count):
        farthest = 0 if np.isinf(distances[0]) else distances.argmax()
        distances = np.minimum(distances, euclidean(points[farthest], points))
    return distances.max()


def known_sets():
    rng, places = np.random.default_rng(0), [(0, 0), (3, 0), (0, 3), (3, 3), (1.5, 1.5)]
    middles = np.repeat(places, (20, 700, 20, 200, 60), axis=0)
    clusters = middles + 0.05 * rng.standard_normal(middles.shape)
    line = np.column_stack([np.linspace(0, 10, 1000), np.zeros(1000)])
    walk = np.cumsum(0.05 * rng.standard_normal((1000, 2)), axis=0)
    sets = {"square": rng.random((1000, 2)), "clusters": clusters, "line": line, "walk": walk}
    return {name: points.astype(np.float32) for name, points in sets.items()}


@pytest.mark.parametrize("name", known_sets())
def test_coverage_is_at_most_two_and_a_half_times_as_coarse_as_k_centre(name):
    points = known_sets()[name]
    best = greedy_radius(points, 40)
    for shuffled in (points, np.random.default_rng(1).permutation(points)):
        for eta in (best, 2 * best):
            memory = fill(covering(40, eta), shuffled)
            assert radius(points, memory.images) < 2.5 * best
    sample = fill(EpisodicMemory(40, (2,), distribution_matching, np.random.default_rng(0)), points)
    assert radius(points, sample.images) > 1.5 * best, "a random sample is no cover"


@given(points=st.lists(st.tuples(st.integers(0, 6), st.integers(0, 6)), min_size=1, max_size=60),
       capacity=st.integers(1, 12), eta=st.sampled_from([0.5, 1.5, 3.0, 20.0]), seed=st.integers(0, 5))
@settings(max_examples=100, deadline=None)
def test_numbers_of_neighbours_are_exact_and_the_most_crowded_goes(points, capacity, eta, seed):
    memory = covering(capacity, eta, seed, manhattan)
    for point in np.array(points, np.float32):
        before = np.concatenate([memory.images[: len(memory)], [point]])
        full = len(memory) == capacity
        memory.add(trial_of([point]))
        stored = memory.images[: len(memory)]
        near = np.abs(stored[:, None] - stored).sum(axis=2) < eta
        assert (memory.neighbours[: len(memory)] == near.sum(axis=1) - 1).all()
        if full:
            crowds = (np.abs(before[:, None] - before).sum(axis=2) < eta).sum(axis=1)
            gone = list(map(tuple, before))
            for place in map(tuple, stored):
                gone.remove(place)
            assert gone[0] in map(tuple, before[crowds == crowds.max()]), "one with the most neighbours"


def test_who_is_as_crowded_as_all_others_stays_whenever_it_came():
    counts = np.zeros(60)
    for seed in range(600):
        counts[fill(covering(12, 1e3, seed, manhattan, d=1), numbered(60)).arrivals] += 1
    assert uniform_p_value(counts) > 0.001


@pytest.mark.parametrize("eta", [0.0, -1.0, np.nan])
def test_an_eta_within_which_nothing_lies_is_refused(eta):
    with pytest.raises(ValueError, match=f"^neighbours are those within a distance above 0, not {eta}$"):
        covering(5, eta)


def test_a_distance_that_is_not_a_number_is_named():
    def broken(one, others):
        return np.full(len(others), np.nan)

    with pytest.raises(ValueError, match="^the distance broken gave nan; it must be a number for all experiences$"):
        covering(5, 1.0, distance=broken).add(trial_of([[0, 0], [1, 1]]))


def test_jaccard_and_manhattan_by_hand():
    x, y, other = [1.0, 2.0, 0.0], [1.0, 0.0, 2.0], [0.0, 0.0, 3.0]
    rows = np.array([[*row, np.dot(row, row)] for row in (x, y, other)])
    assert extended_jaccard(rows[0], rows).tolist() == pytest.approx([0, 1 - 1 / (5 + 5 - 1), 1])
    assert extended_jaccard(rows[1], rows).tolist() == pytest.approx([1 - 1 / 9, 0, 1 - 6 / (5 + 9 - 6)])
    assert manhattan(np.array(x), np.array([x, y, other])).tolist() == [0, 4, 6]


def test_a_whole_experience_is_state_action_next_state_and_reward():
    trial = run_trial(Lamp(), lambda image, mask: 1, 1.0, seed=3)
    whole = whole_experience(trial)
    assert whole.shape == (2, 2 * 121 + 2 + 1 + 1)
    for row, before, after, reward in zip(whole, trial.images[:-1], trial.images[1:], trial.rewards, strict=True):
        expected = np.concatenate([before.ravel(), [0, 1], after.ravel(), [reward]])
        assert (row[:-1] == expected).all() and row[-1] == pytest.approx(expected @ expected)


def test_coverage_of_whole_experiences_counts_as_distances_among_all_say():
    rng, memory = np.random.default_rng(0), CoverageMemory(30, SHAPE, whole_experience, extended_jaccard, 0.6,
                                                           np.random.default_rng(0))  # fmt: skip
    env, described = Lamp(), []
    for seed in range(40):
        trial = run_trial(env, lambda image, mask: int(rng.integers(2)), 1.0, seed)
        memory.add(trial)
        described += list(whole_experience(trial))
    stored = np.array(described)[memory.arrivals][:, :-1]
    common = stored @ stored.T
    squares = (stored**2).sum(axis=1)
    near = 1 - common / (squares[:, None] + squares - common) < 0.6
    assert (memory.neighbours[:30] == near.sum(axis=1) - 1).all() and near.sum() > 60


# -------------------------------------------------------------------------------------------------- pair and disk

def test_batches_of_a_pair_are_even_and_each_half_comes_from_its_own_buffer():
    pair = PairOfBuffers(episodic(9), ReplayBuffer(5, (1,)))
    fill(pair, numbered(60), -np.arange(60.0))  # the first have the highest scores
    images, actions, returns = pair.sample(60, np.random.default_rng(0))
    assert set(images[:30, 0]) <= set(range(9)) and set(images[30:, 0]) <= set(range(55, 60))
    assert images.shape == (60, 1) and (returns == -images[:, 0]).all() and actions.shape == (60,)
    assert len(pair) == 9 and [len(part) for part in pair.sample(7, np.random.default_rng(0))] == [7] * 3


def test_a_pair_is_as_long_as_what_it_met_until_the_long_term_memory_is_full():
    pair, seen = PairOfBuffers(episodic(20), ReplayBuffer(5, (1,))), []
    for _ in range(4):
        fill(pair, numbered(8))
        seen.append(len(pair))
    assert seen == [8, 16, 20, 20]


class Switched(gym.Wrapper):
    """The lamp of another task: the dark half names the action."""

    def step(self, action):
        return self.env.step(1 - action)


def test_matching_holds_two_tasks_alike_where_a_memory_of_size_0_has_nothing_of_the_first():
    """In a learner; the control is the recent buffer of a pair without the long-term memory."""
    def learn_both(memory, recent):
        one = learner(warm_up=20)
        one.memory = memory
        one.train(Lamp(), 150)
        boundary = recent.added
        one.train(Switched(Lamp()), 150)
        return boundary

    alone, recent = ReplayBuffer(20, SHAPE), ReplayBuffer(20, SHAPE)
    matching = EpisodicMemory(40, SHAPE, distribution_matching, np.random.default_rng(0))
    boundary = learn_both(PairOfBuffers(matching, recent), recent)
    assert 10 <= (matching.arrivals < boundary).sum() <= 30
    boundary = learn_both(alone, alone)
    assert boundary <= alone.added - len(alone), "only experiences of the second task are left"


@pytest.mark.parametrize("kind", ["episodic", "coverage", "latest"])
def test_a_memory_is_the_same_after_a_save_and_goes_on_alike(kind, tmp_path):
    def make():
        rng = np.random.default_rng(7)
        return {"episodic": lambda: EpisodicMemory(15, (2,), distribution_matching, rng),
                "coverage": lambda: CoverageMemory(15, (2,), as_points, euclidean, 0.2, rng),
                "latest": lambda: ReplayBuffer(15, (2,))}[kind]()  # fmt: skip

    points = np.random.default_rng(1).random((90, 2))
    memory, again = fill(make(), points[:50]), fill(make(), points[20:])  # what it held is gone
    save(memory, tmp_path / "memory.npz")
    load(again, tmp_path / "memory.npz")
    assert [path.name for path in tmp_path.iterdir()] == ["memory.npz"]
    if kind != "latest":
        again.rng.bit_generator.state = memory.rng.bit_generator.state
    for _ in range(2):
        assert memory.added == again.added and len(memory) == len(again)
        for name, array in vars(memory).items():
            if isinstance(array, np.ndarray):
                assert array.dtype == getattr(again, name).dtype and (array == getattr(again, name)).all(), name
        fill(memory, points[50:])
        fill(again, points[50:])
    first, second = (one.sample(9, np.random.default_rng(0)) for one in (memory, again))
    assert all((a == b).all() for a, b in zip(first, second, strict=True))


def test_what_was_saved_of_another_memory_is_refused(tmp_path):
    save(fill(episodic(5), numbered(9)), tmp_path / "five")
    with pytest.raises(ValueError, match="five is of a memory of another kind or size; make this one as"):
        load(episodic(6), tmp_path / "five")
    save(fill(ReplayBuffer(5, (1,)), numbered(9)), tmp_path / "latest")
    with pytest.raises(ValueError, match="another kind or size"):
        load(episodic(5), tmp_path / "latest")


def test_the_same_seed_keeps_the_same():
    one, same, other = (fill(episodic(9, distribution_matching, seed), numbered(99)).arrivals for seed in (0, 0, 1))
    assert (one == same).all() and (one != other).any()
