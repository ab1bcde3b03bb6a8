"""The classifier's steps against torch's automatic differentiation, and what it does with a memory."""

import numpy as np
import pytest
import torch
from bench import torch_twin
from torch import nn

from lifelong_lib.learners.classifier import Classifier, digit_network
from lifelong_lib.learners.networks import Dense, Network
from lifelong_lib.learners.q_learning import ReplayBuffer


def clouds(n, rng):
    """Three classes in the corners of a triangle."""
    labels = rng.integers(3, size=n)
    corners = np.array([[0, 2], [2, -1], [-2, -1]])
    return (corners[labels] + 0.3 * rng.standard_normal((n, 2))).astype(np.float32), labels


def small(seed=0):
    return Network((2,), [Dense(6), Dense(3)], seed, slope=0.0)


def classifier(network=None, rate=0.2, batch=30, seed=0, **more):
    return Classifier(network or small(), rate, batch, np.random.SeedSequence(seed), **more)


def test_the_network_is_that_of_section_6_4_7():
    network = digit_network(0)
    assert network.shapes == [(784,), (50,), (10,)] and network.slope == 0 and network.dropout == 0


def test_it_starts_as_the_public_implementation_does():
    network = digit_network(0)
    for matrix, bias in network.parts:
        assert (bias == 0.1).all() and abs(matrix.mean()) < 0.01 and 0.19 < abs(matrix).max() <= 0.2
    # A normal distribution that is cut at two standard deviations has 0.880 of its own.
    assert float(network.parts[0][0].std()) == pytest.approx(0.0880, rel=0.01)
    assert (digit_network(1).get_weights() != network.get_weights()).mean() > 0.9
    assert digit_network(0).get_weights().tobytes() == network.get_weights().tobytes()


def test_steps_lead_where_automatic_differentiation_and_plain_descent_lead():
    network, rng = digit_network(3), np.random.default_rng(0)
    twin = torch_twin(network)
    other, ours = torch.optim.SGD(twin.parameters(), lr=0.5), classifier(network, rate=0.5)
    for _ in range(15):
        inputs, labels = rng.random((40, 784), np.float32), rng.integers(10, size=40)
        other.zero_grad()
        nn.functional.cross_entropy(twin(torch.from_numpy(inputs)), torch.from_numpy(labels)).backward()
        other.step()
        ours.update(inputs, labels)
    inputs = rng.random((9, 784), np.float32)
    assert np.allclose(network.values(inputs), twin(torch.from_numpy(inputs)).detach().numpy(), atol=2e-4)
    assert np.abs(network.get_weights() - digit_network(3).get_weights()).max() > 0.01


def test_it_learns_what_can_be_told_apart():
    one, test = classifier(), clouds(500, np.random.default_rng(9))
    assert one.accuracy(*test) < 0.8
    one.train(clouds, 150)
    assert one.accuracy(*test) > 0.97


def test_a_network_that_has_diverged_finds_no_class():
    one = classifier()
    one.network.weights[:] = float("nan")
    assert one.accuracy(np.zeros((4, 2), np.float32), np.zeros(4, int)) == 0


def test_a_penalty_is_added_to_the_gradient():
    pulled, free = classifier(penalty=lambda weights: 2 * weights), classifier()
    inputs, labels = clouds(30, np.random.default_rng(0))
    start = free.network.get_weights()
    pulled.update(inputs, labels)
    free.update(inputs, labels)
    assert np.allclose(free.network.get_weights() - pulled.network.get_weights(), 0.2 * 2 * start, atol=1e-6)


def test_half_of_a_batch_comes_from_memory_which_is_offered_what_is_new():
    asked, seen, memory = [], [], ReplayBuffer(1000, (2,))
    one = classifier(memory=memory, batch=31)

    def numbered(n, rng):
        first = sum(asked)
        asked.append(n)
        return np.arange(first, first + n, dtype=np.float32)[:, None].repeat(2, 1), np.full(n, len(asked) % 3)

    one.update = lambda inputs, labels: seen.append((inputs[:, 0], labels))
    one.train(numbered, 4)
    assert asked == [31, 16, 16, 16] and [len(inputs) for inputs, _ in seen] == [31] * 4
    assert (memory.images[:79, 0] == np.arange(79)).all() and len(memory) == 79
    for batch, (inputs, labels) in enumerate(seen[1:], 1):
        first = 31 + 16 * (batch - 1)
        assert (inputs[:16] == np.arange(first, first + 16)).all() and (inputs[16:] < first).all()
        assert (labels[:16] == (batch + 1) % 3).all()
        given = np.where(inputs < 31, 1, 2 + (inputs - 31) // 16) % 3
        assert (labels == given).all(), "labels stay with their inputs"


def test_what_the_memory_keeps_is_not_forgotten():
    def sides(n, rng):
        inputs = rng.uniform(-3, 3, (n, 2)).astype(np.float32)
        return inputs, np.where(inputs[:, 0] > 0, 1, 2)  # of the first class there is nothing

    found = {}
    for capacity in (0, 200):
        one = classifier(memory=ReplayBuffer(200, (2,)) if capacity else None, rate=0.5)
        one.train(clouds, 150)
        if capacity:
            one.memory.add = lambda trial, network: None  # holds the first task only
        one.train(sides, 400)
        inputs, labels = clouds(500, np.random.default_rng(9))
        found[capacity] = one.accuracy(inputs[labels == 0], labels[labels == 0])
    assert found[200] > 0.75 and found[0] < 0.1


def test_the_same_seed_gives_the_same_weights_and_another_one_does_not():
    found = []
    for seed in (0, 0, 1):
        one = classifier(seed=seed, memory=ReplayBuffer(50, (2,)))
        one.train(clouds, 20)
        found.append(one.network.get_weights().tobytes())
    assert found[0] == found[1] != found[2]
