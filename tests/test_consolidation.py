"""Elastic weight consolidation against Fisher information by hand, numerical derivatives, and a strength of 0."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from lifelong_lib.learners.classifier import Classifier
from lifelong_lib.learners.networks import Dense, Network
from lifelong_lib.transfer.consolidation import ElasticWeights, diagonal_fisher


def slope_network(first, second):
    """Two classes and one input without bias: p(class 0) is the logistic function of (first - second) x."""
    network = Network((1,), [Dense(2)], 0)
    network.set_weights([first, second, 0, 0])
    return network


def test_fisher_of_a_model_of_two_parameters_by_hand():
    """The derivative of log p(0) by the first slope is (1 - p) x, of log p(1) it is -p x: F = x^2 p (1 - p)."""
    network, inputs = slope_network(0.7, -0.3), np.repeat([[0.5], [2.0], [-3.0]], 4000, axis=0)
    p = 1 / (1 + np.exp(-np.array([0.5, 2.0, -3.0])))
    expected = np.mean(np.array([0.25, 4, 9]) * p * (1 - p))
    found = diagonal_fisher(network, inputs, np.random.default_rng(0))
    assert found[:2] == pytest.approx([expected] * 2, rel=0.05)
    assert found[2:] == pytest.approx([np.mean(p * (1 - p))] * 2, rel=0.05)
    assert network.get_weights().tolist() == np.float32([0.7, -0.3, 0, 0]).tolist(), "asking changes nothing"


def test_fisher_is_exact_where_both_classes_are_equally_likely():
    found = diagonal_fisher(slope_network(0.4, 0.4), [[1.0], [3.0]], np.random.default_rng(0))
    assert found == pytest.approx([(1 + 9) / 2 / 4] * 2 + [1 / 4] * 2)  # whatever class is drawn


def test_a_network_that_has_diverged_ends_in_nan_and_not_in_an_error():
    found = diagonal_fisher(slope_network(np.nan, 1.0), [[1.0]], np.random.default_rng(0))
    assert np.isnan(found).all()


def test_fisher_is_the_curvature_of_what_a_change_of_weights_does_to_the_answers():
    """The Kullback-Leibler divergence of a small change d of one weight is F d^2 / 2; second implementation."""
    network, inputs = Network((3,), [Dense(4), Dense(3)], 5), np.random.default_rng(1).standard_normal((3, 3))
    found = diagonal_fisher(network, np.repeat(inputs, 1500, axis=0), np.random.default_rng(0))

    def log_chances(weights):
        network.set_weights(weights)
        return torch.log_softmax(torch.from_numpy(network.values(inputs)).double(), 1).numpy()

    start = network.get_weights()
    here = log_chances(start)
    for i in range(len(start)):
        divergence = [(np.exp(here) * (here - log_chances(start + d * np.eye(len(start))[i]))).sum(1).mean()
                      for d in (0.1, -0.1)]  # fmt: skip
        assert found[i] == pytest.approx(sum(divergence) / 0.01, rel=0.15, abs=0.002)


def tasks():
    numbers = st.lists(st.floats(-2, 2), min_size=4, max_size=4)
    fishers = st.lists(st.floats(0.01, 3) | st.just(0.0), min_size=4, max_size=4)
    return st.lists(st.tuples(numbers, fishers), min_size=1, max_size=4)


@given(tasks=tasks(), at=st.lists(st.floats(-2, 2), min_size=4, max_size=4), strength=st.floats(0, 50))
@settings(max_examples=80, deadline=None)
def test_the_gradient_is_that_of_the_sum_of_all_tasks_penalties(tasks, at, strength):
    penalty = ElasticWeights(strength)
    for weights, fisher in tasks:
        penalty.hold(np.array(weights), np.array(fisher))

    def total(w):
        return strength / 2 * sum((np.array(fisher) * (w - weights) ** 2).sum() for weights, fisher in tasks)

    numerical = [(total(at + d) - total(at - d)) / 2e-3 for d in 1e-3 * np.eye(4)]
    assert penalty(torch.tensor(at, dtype=torch.float64)).numpy() == pytest.approx(numerical, rel=1e-5, abs=1e-6)


def spiral(n, rng):
    inputs = rng.standard_normal((n, 2)).astype(np.float32)
    return inputs, (inputs[:, 0] * inputs[:, 1] > 0).astype(np.int64)


def trained(penalty, seed=0):
    one = Classifier(Network((2,), [Dense(8), Dense(2)], seed, slope=0.0), 0.3, 20, np.random.SeedSequence(1), penalty)
    one.train(spiral, 60)
    return one.network.get_weights()


def test_a_strength_of_0_is_no_penalty_and_a_large_one_holds_what_matters():
    start, fisher = Network((2,), [Dense(8), Dense(2)], 0).get_weights(), np.zeros(42)
    fisher[:10] = 1.0
    moved = {}
    for strength in (0.0, 3.0):
        penalty = ElasticWeights(strength)
        penalty.hold(start, fisher)
        moved[strength] = trained(penalty)
    assert moved[0.0].tobytes() == trained(None).tobytes() == trained(ElasticWeights(5.0)).tobytes()
    far = {strength: np.abs(weights - start) for strength, weights in moved.items()}
    assert far[3.0][:10].max() < 0.3 * far[0.0][:10].max() and far[3.0][10:].max() > 0.5 * far[0.0][10:].max()


def test_weights_that_matter_to_no_task_are_free_and_what_is_held_is_a_copy():
    weights, penalty = np.ones(3, np.float32), ElasticWeights(2.0)
    penalty.hold(weights, np.array([0, 1, 3], np.float32))
    weights[:] = 9
    assert penalty(torch.zeros(3)).tolist() == [0, -2, -6]


@pytest.mark.parametrize("strength", [-1.0, np.nan])
def test_a_strength_below_0_is_refused(strength):
    with pytest.raises(ValueError, match=f"the strength of a penalty is 0 or more, not {strength}"):
        ElasticWeights(strength)
