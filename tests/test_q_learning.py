"""The network, the buffer and the training loop, by hand arithmetic and in worlds with a known answer."""

import gymnasium as gym
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from lifelong_lib.learners.q_learning import DQN, Diverged, QNetwork, ReplayBuffer, evaluate, returns_to_go

SHAPE = (11, 11, 1)


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


def learner(seed=0, **more):
    network = QNetwork(2, SHAPE, seed=seed)
    return DQN(network, np.random.SeedSequence(seed), rate=1e-3, warm_up=50, capacity=500, **more)


def weights(network):
    return b"".join(part.detach().numpy().tobytes() for part in network.parameters())


def test_the_network_is_that_of_section_5_4():
    network = QNetwork(5)
    shapes = [tuple(part.shape) for part in network.parameters()]
    assert shapes == [(32, 3, 6, 6), (32,), (64, 32, 3, 3), (64,), (100, 960), (100,), (5, 100), (5,)]
    assert network(torch.zeros(7, 18, 26, 3)).shape == (7, 5)
    assert sum(isinstance(layer, torch.nn.LeakyReLU) for layer in network.layers) == 3


def test_a_seed_draws_the_weights_and_leaves_the_generator_of_torch_alone():
    before = torch.random.get_rng_state()
    assert weights(QNetwork(5, seed=1)) == weights(QNetwork(5, seed=1)) != weights(QNetwork(5, seed=2))
    assert torch.equal(torch.random.get_rng_state(), before)


def test_weights_come_back_and_those_of_another_shape_are_refused():
    one, other = QNetwork(5, seed=1), QNetwork(5, seed=2)
    given = one.get_weights()
    assert given.shape == (118_589,) and given.tobytes() == weights(one)
    other.set_weights(given)
    given[:] = 0
    assert weights(other) == weights(one)
    with pytest.raises(ValueError, match=r"this network has 118589 weights; those given have shape \(118488,\)"):
        one.set_weights(QNetwork(4).get_weights())
    with pytest.raises(ValueError, match=r"those given have shape \(2, 118589\)"):
        one.set_weights(np.zeros((2, 118_589)))


def test_an_environment_is_seeded_at_the_start_and_after_each_look_only():
    seeds = []

    class Counted(Lamp):
        def reset(self, *, seed=None, options=None):
            seeds.append(seed)
            return super().reset(seed=seed)

    learner().train(Counted(), 40, every=20, look=lambda: seeds.append("look"))
    given = [i for i, seed in enumerate(seeds) if isinstance(seed, int)]
    assert given == [i + 1 for i, seed in enumerate(seeds[:-1]) if seed == "look"] and len(given) == 2
    assert len({seeds[i] for i in given}) == 2 and seeds.count("look") == 3


def test_dropout_acts_in_training_only():
    network, image = QNetwork(2, SHAPE, dropout=0.5), torch.ones(1, *SHAPE)
    network.train()
    assert not torch.equal(network(image), network(image))
    network.best(image[0].numpy())
    assert torch.equal(network(image), network(image))


def test_returns_of_decisions_that_take_several_steps():
    found = returns_to_go([-0.1, -0.2, 1.0], [2, 1, 4], 0.5)
    assert np.allclose(found, [-0.1 + 0.25 * (-0.2 + 0.5), -0.2 + 0.5, 1.0])
    assert np.allclose(returns_to_go([1, 1, 1], [1, 1, 1], 1.0), [3, 2, 1])


@given(capacity=st.integers(1, 8), count=st.integers(1, 30))
@settings(max_examples=60, deadline=None)
def test_the_buffer_holds_the_latest_experiences_and_nothing_else(capacity, count):
    buffer = ReplayBuffer(capacity, (1,))
    for i in range(count):
        buffer.add(np.array([i]), i % 3, -i)
    assert len(buffer) == min(capacity, count)
    images, actions, returns = buffer.sample(200, np.random.default_rng(0))
    kept = set(range(max(0, count - capacity), count))
    assert set(images[:, 0].int().tolist()) <= kept
    assert (actions == images[:, 0].int() % 3).all() and (returns == -images[:, 0]).all()
    assert {int(i) for i in buffer.images[: len(buffer), 0]} == kept


def test_experiences_are_sampled_alike():
    buffer = ReplayBuffer(20, (1,))
    for i in range(25):
        buffer.add(np.array([i]), 0, 0.0)
    counts = np.bincount(buffer.sample(20_000, np.random.default_rng(1))[0][:, 0].int(), minlength=25)[5:]
    assert stats.chisquare(counts).pvalue > 0.001


def test_an_update_is_one_step_of_rmsprop_on_the_squared_error_of_the_actions_taken():
    one, other = learner(damping=0.02), QNetwork(2, SHAPE, seed=0)
    buffer = ReplayBuffer(1, SHAPE)
    image = np.random.default_rng(0).random(SHAPE, np.float32)
    buffer.add(image, 1, 0.7)
    value = other(torch.from_numpy(image)[None])[0, 1]
    loss = (value - 0.7) ** 2
    loss.backward()
    found = one.update(buffer)
    assert found == pytest.approx(loss.item(), rel=1e-5)
    for new, old in zip(one.network.parameters(), other.parameters(), strict=True):
        expected = old - 1e-3 * old.grad / ((0.05 * old.grad**2).sqrt() + 0.02)
        assert torch.allclose(new, expected, atol=1e-6)


def test_it_learns_a_world_that_cannot_fail_and_a_random_network_does_not():
    env, one = Lamp(), learner()

    def rate():
        return (evaluate(env, one.network.best, range(200))["outcomes"] == "success").mean()

    seen = one.train(env, 400, every=200, look=rate)
    assert len(seen) == 3 and seen[0] < 0.6 and seen[-1] == 1.0
    values = one.network(torch.from_numpy(np.stack([env.reset(seed=s)[0] for s in range(20)])))
    # An image does not tell the first step from the last: the mean of 1 + 0.99 * 0.95 (a twentieth of actions is
    # random, and half of those are right) and 1.
    expected = (1 + 0.99 * 0.95 + 1) / 2
    assert torch.allclose(values.max(dim=1).values, torch.tensor(expected), atol=0.1)
    assert one.iterations == 400


def test_the_same_seed_gives_the_same_weights_and_another_one_does_not():
    trained = [learner(seed) for seed in (0, 0, 1)]
    for one in trained:
        one.train(Lamp(), 30)
    first, again, other = (weights(one.network) for one in trained)
    assert first == again != other


def test_divergence_is_reported():
    with pytest.raises(Diverged, match=r"the loss of iteration 0 is .*; lower the rate"):
        learner().train(Lamp(scale=1e4), 10)


def test_evaluation_counts_what_happens():
    env = Lamp()
    right = evaluate(env, lambda image: int(image[0, 5:].sum() > image[0, :5].sum()), range(10))
    assert (right["outcomes"] == "success").all() and (right["returns"] == 2).all() and (right["times"] == 2).all()
    wrong = evaluate(env, lambda image: int(image[0, 5:].sum() < image[0, :5].sum()), range(10))
    assert (wrong["outcomes"] == "collision").all() and (wrong["returns"] == -2).all()
