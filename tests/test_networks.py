"""The explicit gradient against automatic differentiation, layers by hand, RMSProp by hand."""

import numpy as np
import pytest
import torch
from bench import torch_twin
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import nn

from lifelong_lib.learners.networks import Convolution, Dense, Network, RMSProp
from lifelong_lib.learners.q_learning import q_network

IMAGE = (18, 26, 3)
pytestmark = pytest.mark.filterwarnings("ignore:TF32 acceleration")  # of GPUs; switching oneDNN off tells of it


def gradients_in_our_order(model, network):
    found = []
    for layer in model:
        if isinstance(layer, nn.Conv2d):
            found += [layer.weight.grad.permute(2, 3, 1, 0).reshape(-1), layer.bias.grad]
        if isinstance(layer, nn.Linear):
            found += [layer.weight.grad.t().reshape(-1), layer.bias.grad]
    return torch.cat(found)


def networks():
    small = st.tuples(st.integers(6, 12), st.integers(6, 12), st.integers(1, 3))
    kernels = st.tuples(st.integers(1, 6), st.integers(1, 3))
    return st.builds(
        lambda shape, first, nodes, outputs, seed, slope: Network(
            shape, [Convolution(4, *first), Dense(nodes), Dense(outputs)], seed, slope),
        small, kernels, st.integers(1, 7), st.integers(1, 5), st.integers(0, 99), st.sampled_from([0.0, 0.01, 0.3]),
    )  # fmt: skip


def check_gradient(network, inputs, targets):
    model = torch_twin(network)
    # With oneDNN, torch 2.13.0 writes beyond its memory on the way back through filters of one cell with a stride.
    with torch.backends.mkldnn.flags(enabled=False):
        values = model(inputs)
        ((values - targets) ** 2).sum().backward()
    passed = network.forward(inputs)
    assert torch.allclose(passed[-1][1], values, atol=1e-5)
    network.backward(passed, 2 * (passed[-1][1] - targets))
    expected = gradients_in_our_order(model, network)
    assert torch.allclose(network.gradient, expected, atol=1e-4 * float(expected.abs().max() + 1e-3))


@given(network=networks(), count=st.integers(1, 4))
@settings(max_examples=40, deadline=None)
def test_values_and_gradient_are_those_of_automatic_differentiation(network, count):
    rng = np.random.default_rng(count)
    inputs = torch.from_numpy(rng.standard_normal((count, *network.shapes[0])).astype(np.float32))
    check_gradient(network, inputs, torch.from_numpy(rng.standard_normal((count, network.shapes[-1][0])).astype("f")))


@pytest.mark.parametrize("shape", [IMAGE, (11, 11, 2), (7,)])
def test_the_networks_of_the_chapters_have_the_right_gradient(shape):
    rng, network = np.random.default_rng(0), q_network(5, shape, seed=1)
    inputs = torch.from_numpy(rng.random((6, *shape), np.float32))
    check_gradient(network, inputs, torch.from_numpy(rng.random((6, 5), np.float32)))


def test_many_updates_lead_where_torch_s_optimiser_leads():
    network = q_network(5, IMAGE, seed=3)
    model, optimiser = torch_twin(network), RMSProp(network, rate=1e-4, damping=1e-4, decay=0.95)
    other = torch.optim.RMSprop(model.parameters(), lr=1e-4, alpha=0.95, eps=1e-4)
    rng = np.random.default_rng(0)
    for _ in range(20):
        images = torch.from_numpy(rng.random((8, *IMAGE), np.float32))
        targets = torch.from_numpy(rng.random((8, 5), np.float32))
        other.zero_grad()
        ((model(images) - targets) ** 2).mean().backward()
        other.step()
        passed = network.forward(images)
        network.backward(passed, 2 * (passed[-1][1] - targets) / targets.numel())
        optimiser.step()
    images = torch.from_numpy(rng.random((8, *IMAGE), np.float32))
    assert torch.allclose(network.forward(images)[-1][1], model(images), atol=1e-4)


def test_a_step_of_rmsprop_by_hand():
    network = Network((1,), [Dense(1)], 0)
    network.weights[:], optimiser = torch.tensor([2.0, 1.0]), RMSProp(network, rate=0.1, damping=0.5, decay=0.75)
    network.gradient[:] = torch.tensor([4.0, 0.0])
    optimiser.step()  # mean of squares 0.25 * 16 = 4, root 2
    assert network.weights.tolist() == pytest.approx([2 - 0.1 * 4 / (2 + 0.5), 1.0])
    optimiser.step()  # 0.75 * 4 + 0.25 * 16 = 7
    assert network.weights[0].item() == pytest.approx(2 - 0.16 - 0.1 * 4 / (7**0.5 + 0.5))


def test_windows_of_a_convolution_by_hand():
    image = torch.arange(12.0).view(1, 3, 4, 1)
    layer = Convolution(1, 2, 2)
    assert layer.gather(image).tolist() == [[0, 1, 4, 5], [2, 3, 6, 7]]
    assert layer.shape((3, 4, 1)) == (1, 2, 1)
    overlapping = Convolution(1, 2, 1)
    spread = overlapping.scatter(torch.ones(6, 4), (3, 4, 1))
    assert spread[0, :, :, 0].tolist() == [[1, 2, 2, 1], [2, 4, 4, 2], [1, 2, 2, 1]]


@given(rows=st.integers(5, 9), columns=st.integers(5, 9), size=st.integers(1, 5), stride=st.integers(1, 3))
@settings(max_examples=60, deadline=None)
def test_scatter_is_the_transpose_of_gather(rows, columns, size, stride):
    rng, layer = np.random.default_rng(0), Convolution(1, size, stride)
    images = torch.from_numpy(rng.standard_normal((2, rows, columns, 2)))
    gathered = layer.gather(images)
    other = torch.from_numpy(rng.standard_normal(gathered.shape)).float()
    there = (gathered.float() * other).sum()
    here = (images.float() * layer.scatter(other, images.shape[1:])).sum()
    assert torch.allclose(there, here, atol=1e-3)


def test_the_network_is_that_of_section_5_4():
    network = q_network(5, IMAGE, seed=0)
    assert network.shapes == [IMAGE, (7, 11, 32), (3, 5, 64), (100,), (5,)]
    assert [len(matrix) for matrix, _ in network.parts] == [6 * 6 * 3, 3 * 3 * 32, 3 * 5 * 64, 100]
    assert len(network.weights) == 118_589 and network.slope == 0.01


def test_first_weights_come_from_the_seed_and_lie_within_their_limits():
    one, same, other = (q_network(5, IMAGE, seed).get_weights() for seed in (1, 1, 2))
    assert (one == same).all() and (one != other).any()
    for matrix, bias in q_network(5, IMAGE, 1).parts:
        limit = len(matrix) ** -0.5
        assert matrix.abs().max() <= limit and bias.abs().max() <= limit
        assert matrix.std().item() == pytest.approx(limit / 3**0.5, rel=0.05)


def test_weights_come_back_and_those_of_another_shape_are_refused():
    one, other = q_network(5, IMAGE, 1), q_network(5, IMAGE, 2)
    given_weights = one.get_weights()
    other.set_weights(given_weights)
    image = np.random.default_rng(0).random((1, *IMAGE))
    assert (one.values(image) == other.values(image)).all()
    given_weights[:] = 0
    assert (one.get_weights() == other.get_weights()).all() and other.get_weights().any()
    with pytest.raises(ValueError, match=r"this network has 118589 weights; those given have shape \(118488,\)"):
        one.set_weights(q_network(4, IMAGE, 0).get_weights())


def test_dropout_leaves_out_its_share_scales_up_the_others_and_acts_with_a_generator_only():
    network = Network((4,), [Dense(1000), Dense(1)], 0, dropout=0.2)
    inputs = torch.ones(1, 4)
    whole, thinned = (network.forward(inputs, rng)[0][1][0] for rng in (None, np.random.default_rng(0)))
    gone = thinned == 0
    assert gone.float().mean().item() == pytest.approx(0.2, abs=0.04)
    assert torch.allclose(thinned[~gone], whole[~gone] / 0.8)
    passed = network.forward(inputs, np.random.default_rng(0))
    network.backward(passed, torch.ones(1, 1))
    to_hidden = network._gradients[0][1][0]  # of the biases of the hidden nodes
    assert (to_hidden[gone] == 0).all() and (to_hidden[~gone] != 0).all()


def test_the_best_action_is_the_best_of_those_that_are_allowed():
    network = Network((1,), [Dense(3)], 0)
    network.weights[:] = torch.tensor([1.0, 3.0, 2.0, 0, 0, 0])
    seen = np.ones(1, np.float32)
    assert network.best(seen) == 1 and network.best(seen, np.array([True, False, True])) == 2
    assert network.best(-seen, np.array([False, True, True])) == 2


def test_an_image_too_small_for_the_layers_is_refused():
    with pytest.raises(ValueError, match=r"an input of \(5, 11, 1\) is too small for Convolution\(nodes=32, size=6"):
        q_network(2, (5, 11, 1), 0)
