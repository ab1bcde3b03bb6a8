"""Trials, memory, training loop and evaluation, by hand arithmetic and in worlds with a known answer."""

import gymnasium as gym
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from lifelong_lib.learners.networks import Dense, Network
from lifelong_lib.learners.q_learning import (
    DQN,
    Diverged,
    ReplayBuffer,
    Settings,
    Trial,
    evaluate,
    q_network,
    returns_to_go,
    run_trial,
)

SHAPE = (11, 11, 1)
KNOBS = {"rate": 1e-3, "damping": 1e-6, "decay": 0.95, "discount": 0.99, "epsilon": 0.05, "batch": 60, "warm_up": 50}


class Lamp(gym.Env):
    """Two steps: the lit half of the image names the right action of each; both right is a success."""

    observation_space = gym.spaces.Box(0, 1, SHAPE, np.float32)
    action_space = gym.spaces.Discrete(2)

    def __init__(self, scale=1.0):
        self.scale = scale

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.left, self.right = 2, True
        return self.image(), {}

    def image(self):
        self.lit = int(self.np_random.integers(2))
        image = np.zeros(SHAPE, np.float32)
        image[:, 5 * self.lit : 5 * self.lit + 5] = 1
        return image

    def step(self, action):
        self.left -= 1
        good = action == self.lit
        self.right &= bool(good)
        ended = self.left == 0
        outcome = ("success" if self.right else "collision") if ended else ""
        return self.image(), self.scale * (1.0 if good else -1.0), ended, False, {"steps": 1, "outcome": outcome}


class Traps(gym.Env):
    """Three doors on a vector: the first is the best by reward, but a mask closes it, and who opens it is caught."""

    observation_space = gym.spaces.Box(0, 1, (2,), np.float32)
    action_space = gym.spaces.Discrete(3)
    caught = 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.ones(2, np.float32), {"action_mask": np.array([False, True, True])}

    def step(self, action):
        self.caught += action == 0
        return np.ones(2, np.float32), (3.0, 1.0, 2.0)[action], True, False, {"action_mask": np.ones(3, bool)}


def learner(seed=0, penalty=None, network=None, capacity=500, **knobs):
    network = network or q_network(2, SHAPE, seed)
    memory = ReplayBuffer(capacity, network.shapes[0])
    return DQN(network, memory, Settings(**KNOBS | knobs), np.random.SeedSequence(seed), penalty)


def trial_of(images, actions, returns):
    """A trial made by hand; what the memory does not read is left empty."""
    none = np.zeros(0)
    return Trial(np.array(images), none, np.array(actions), none, none, np.array(returns), {})


def numbered(first, count, action=0):
    """A trial whose images and returns are the numbers from `first` on."""
    images = np.arange(first, first + count + 1, dtype=np.float32)[:, None]
    return trial_of(images, np.arange(first, first + count) % 3, -images[:-1, 0])


# ------------------------------------------------------------------------------------------------------------- trials

def test_a_trial_holds_what_happened():
    env, seen = Lamp(), []
    trial = run_trial(env, lambda image, mask: 1, 0.5, seed=3, between=lambda: seen.append(env.left))
    lit = [int(image[:, 5:].sum() > image[:, :5].sum()) for image in trial.images]
    expected = [1.0 if side else -1.0 for side in lit[:2]]
    assert trial.images.shape == (3, *SHAPE) and trial.masks.shape == (3, 2) and trial.masks.all()
    assert trial.rewards.tolist() == expected and trial.steps.tolist() == [1, 1] and trial.actions.tolist() == [1, 1]
    assert np.allclose(trial.returns, [expected[0] + 0.5 * expected[1], expected[1]])
    assert trial.info["outcome"] == ("success" if sum(lit[:2]) == 2 else "collision") and seen == [1, 0]


def test_the_same_seed_is_the_same_trial():
    first, again, other = (run_trial(Lamp(), lambda image, mask: 0, 1.0, seed) for seed in (1, 1, 2))
    assert first.images.tobytes() == again.images.tobytes() != other.images.tobytes()


def test_returns_of_decisions_that_take_several_steps():
    found = returns_to_go([-0.1, -0.2, 1.0], [2, 1, 4], 0.5)
    assert np.allclose(found, [-0.1 + 0.25 * (-0.2 + 0.5), -0.2 + 0.5, 1.0])
    assert np.allclose(returns_to_go([1, 1, 1], [1, 1, 1], 1.0), [3, 2, 1])


def test_masks_hold_in_acting_exploring_and_evaluation_and_are_kept_in_the_trial():
    env, network = Traps(), Network((2,), [Dense(3)], 0)
    network.weights[:] = 0
    network.weights[6] = 5.0  # the bias of the first door: the network itself would always open it
    one = learner(network=network, rate=1e-2, epsilon=0.5)
    one.train(env, 300)
    evaluate(env, network.best, range(50))
    assert env.caught == 0
    trial = run_trial(env, network.best, 1.0)
    assert trial.masks.tolist() == [[False, True, True], [True, True, True]] and trial.actions.tolist() == [2]
    assert network.best(np.ones(2, np.float32)) == 0  # nothing was learned of the door that stayed closed
    evaluate(env, lambda seen, mask: 0, range(1))
    assert env.caught == 1


# ------------------------------------------------------------------------------------------------------------- memory

@given(capacity=st.integers(1, 8), lengths=st.lists(st.integers(1, 5), min_size=1, max_size=8))
@settings(max_examples=60, deadline=None)
def test_the_buffer_holds_the_latest_experiences_and_nothing_else(capacity, lengths):
    buffer, count = ReplayBuffer(capacity, (1,)), 0
    for length in lengths:
        buffer.add(numbered(count, length))
        count += length
    assert len(buffer) == min(capacity, count)
    images, actions, returns = buffer.sample(200, np.random.default_rng(0))
    kept = set(range(max(0, count - capacity), count))
    assert set(images[:, 0].astype(int)) <= kept
    assert (actions == images[:, 0].astype(int) % 3).all() and (returns == -images[:, 0]).all()
    assert {int(number) for number in buffer.images[: len(buffer), 0]} == kept


def test_experiences_are_sampled_alike():
    buffer = ReplayBuffer(20, (1,))
    buffer.add(numbered(0, 25))
    numbers = buffer.sample(20_000, np.random.default_rng(1))[0][:, 0].astype(int)
    assert stats.chisquare(np.bincount(numbers, minlength=25)[5:]).pvalue > 0.001


@pytest.mark.parametrize("capacity", [0, -3])
def test_a_buffer_without_room_is_refused(capacity):
    with pytest.raises(ValueError, match=f"a replay buffer holds 1 experience or more, not {capacity}"):
        ReplayBuffer(capacity, (1,))


def test_a_memory_smaller_than_the_warm_up_is_refused_and_does_not_wait_for_ever():
    with pytest.raises(ValueError, match="the memory holds 20 experiences, fewer than the warm-up needs"):
        learner(capacity=20).train(Lamp(), 1)


# ----------------------------------------------------------------------------------------------------------- learning

def test_settings_have_no_second_defaults_and_do_not_change():
    with pytest.raises(TypeError, match="missing 7 required"):
        Settings()
    with pytest.raises(AttributeError):
        Settings(**KNOBS).rate = 1


def test_an_environment_is_seeded_at_the_start_and_after_each_look_only():
    seeds = []

    class Counted(Lamp):
        def reset(self, *, seed=None, options=None):
            seeds.append(seed)
            return super().reset(seed=seed)

    learner().train(Counted(), 40, every=20, look=lambda: seeds.append("look"))
    given_seeds = [i for i, seed in enumerate(seeds) if isinstance(seed, int)]
    assert given_seeds == [i + 1 for i, seed in enumerate(seeds[:-1]) if seed == "look"] and len(given_seeds) == 2
    assert len({seeds[i] for i in given_seeds}) == 2 and seeds.count("look") == 3


def test_an_update_is_one_step_of_rmsprop_on_the_squared_error_of_the_actions_taken():
    one, other = learner(damping=0.02), q_network(2, SHAPE, 0)
    image = np.random.default_rng(0).random((2, *SHAPE), np.float32)
    one.memory.add(trial_of(image, [1], [0.7]))
    passed = other.forward(torch.from_numpy(image[:1]))
    value = passed[-1][1][0, 1].item()
    other.backward(passed, torch.tensor([[0.0, 2 * (value - 0.7)]]))  # the derivative of (value - 0.7)^2
    assert one.update() == pytest.approx((value - 0.7) ** 2, rel=1e-5)
    gradient = other.gradient
    expected = other.weights - 1e-3 * gradient / ((0.05 * gradient**2).sqrt() + 0.02)
    assert torch.allclose(one.network.weights, expected, atol=1e-6)


def test_a_penalty_pulls_the_weights_where_it_is_least():
    free, held = (learner(penalty=penalty) for penalty in (None, lambda weights: 1e3 * weights))
    for one in (free, held):
        one.train(Lamp(), 100)
    assert held.network.weights.abs().mean() < 0.3 * free.network.weights.abs().mean()
    nothing = learner(penalty=torch.zeros_like)
    nothing.train(Lamp(), 100)
    assert (nothing.network.weights == free.network.weights).all()


def success(env, network):
    return np.mean([info["outcome"] == "success" for info in evaluate(env, network.best, range(200))])


def test_it_learns_a_world_that_cannot_fail_and_a_random_network_does_not():
    env, one = Lamp(), learner()
    seen = one.train(env, 400, every=200, look=lambda: success(env, one.network))
    assert len(seen) == 3 and seen[0] < 0.6 and seen[-1] == 1.0
    values = one.network.values(np.stack([env.reset(seed=s)[0] for s in range(20)]))
    # An image does not tell the first step from the last: the mean of 1 + 0.99 * 0.95 (a twentieth of actions is
    # random, and half of those are right) and 1.
    assert np.allclose(values.max(axis=1), (1 + 0.99 * 0.95 + 1) / 2, atol=0.1)
    assert one.iterations == 400


def test_the_same_seed_gives_the_same_weights_and_another_one_does_not():
    trained = [learner(seed, network=q_network(2, SHAPE, seed, dropout=0.5)) for seed in (0, 0, 1)]
    for one in trained:
        one.train(Lamp(), 30)
    first, again, other = (one.network.get_weights().tobytes() for one in trained)
    assert first == again != other


def test_divergence_is_judged_against_the_returns_that_were_met():
    large = learner()
    large.train(Lamp(scale=1e4), 10)  # returns of 10,000 are no divergence where rewards are 10,000
    assert np.abs(large.memory.returns).max() > 1e4
    with pytest.raises(Diverged, match=r"the mean squared error of iteration \d+ is .*; lower the rate"):
        learner(rate=1e4).train(Lamp(), 100)


def test_evaluation_counts_what_happens():
    env = Lamp()
    right = evaluate(env, lambda image, mask: int(image[:, 5:].sum() > image[:, :5].sum()), range(10))
    assert all((info["outcome"], info["return"], info["time"]) == ("success", 2.0, 2) for info in right)
    wrong = evaluate(env, lambda image, mask: int(image[:, 5:].sum() < image[:, :5].sum()), range(10))
    assert all((info["outcome"], info["return"], info["time"]) == ("collision", -2.0, 2) for info in wrong)
    assert len(right) == 10
