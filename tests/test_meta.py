"""Meta-learning: closed form and numerical derivatives of (2.6), networks by hand, policies with exact returns."""

import numpy as np
import pytest
import torch

from lifelong_lib.environments.corridor import CELLS, PITS, STEPS, Corridors
from lifelong_lib.transfer.meta import adapted, meta_gradient, outputs, size

torch.set_num_threads(1)


def tensor(*numbers):
    return torch.tensor(numbers, dtype=torch.double)


def parabolas(centres, curvatures):
    """0.5 (theta - c)^T diag(a) (theta - c), one a task."""
    return lambda parameters: (curvatures * (parameters - centres) ** 2).sum(dim=1) / 2


CENTRES, CURVES = tensor([1.0, 2.0], [-1.0, 0.0]), tensor([1.0, 2.0], [3.0, 0.5])


def test_a_step_is_equation_2_5():
    found = adapted(parabolas(CENTRES, CURVES), torch.zeros(2, 2, dtype=torch.double), 0.1)
    assert found.tolist() == [[pytest.approx(0.1), pytest.approx(0.4)], [pytest.approx(-0.3), pytest.approx(0.0)]]


def test_the_meta_gradient_of_parabolas_is_their_closed_form():
    """After the step theta' - c = (1 - v a)(theta - c), so that the gradient is a (1 - v a)^2 (theta - c), or first
    order a (1 - v a)(theta - c), and its mean over tasks."""
    losses, start = parabolas(CENTRES, CURVES), tensor(0.5, -0.5)
    away = (start - CENTRES) * (1 - 0.2 * CURVES) * CURVES
    assert torch.allclose(meta_gradient(losses, start, 2, 0.2), (away * (1 - 0.2 * CURVES)).mean(dim=0))
    assert torch.allclose(meta_gradient(losses, start, 2, 0.2, second_order=False), away.mean(dim=0))


def numerical(objective, start, nudge=1e-6):
    steps = nudge * torch.eye(len(start), dtype=torch.double)
    slopes = [float(objective(start + e) - objective(start - e)) / (2 * nudge) for e in steps]
    return tensor(*slopes)


def after_a_step(losses, tasks, step):
    return lambda start: losses(adapted(losses, start.expand(tasks, -1), step).detach()).mean()


NODES = [1, 5, 4, 1]


def regression():
    rng = np.random.default_rng(0)
    x, y = torch.tensor(rng.standard_normal((3, 6, 1))), torch.tensor(rng.standard_normal((3, 6, 1)))
    return lambda parameters: ((outputs(parameters, x, NODES) - y) ** 2).mean(dim=(1, 2)), size(NODES), 3


def exact_policies():
    """Minus the sum of rewards of softmax policies in two corridors, exactly: where a robot is after each step."""
    worlds = Corridors(np.array([-6.0, 4.0]), np.array([[1], [-1]]) * np.ones((1, 23), int))
    moves, rewards = torch.tensor(np.eye(23)[worlds.after]), torch.tensor(worlds.rewards)

    def losses(parameters):
        logits = outputs(parameters, torch.tensor(CELLS / 5.0)[:, None], [1, 4, 3])
        chain, total = (moves * torch.softmax(logits, dim=2)[..., None]).sum(dim=2), 0.0
        place = torch.tensor(~PITS / 21).expand(2, 1, 23)
        for _ in range(STEPS):
            place = place @ chain
            total = total + (place[:, 0] * rewards).sum(dim=1)
        return -total

    return losses, size([1, 4, 3]), 2


@pytest.mark.parametrize("problem", [regression, exact_policies])
def test_the_meta_gradient_is_the_numerical_derivative_and_the_first_order_one_is_not(problem):
    losses, d, tasks = problem()
    start = torch.tensor(np.random.default_rng(1).standard_normal(d))
    slope = numerical(after_a_step(losses, tasks, 0.1), start)
    exact, first = (meta_gradient(losses, start, tasks, 0.1, second_order=way) for way in (True, False))
    assert torch.allclose(exact, slope, atol=1e-6, rtol=1e-4)
    assert (first - slope).norm() > 0.01 * slope.norm()


def test_without_a_step_it_is_the_gradient_of_the_mean_loss():
    losses, d, tasks = regression()
    start = torch.tensor(np.random.default_rng(2).standard_normal(d))
    slope = numerical(lambda theta: losses(theta.expand(tasks, -1)).mean(), start)
    assert torch.allclose(meta_gradient(losses, start, tasks, 0.0), slope, atol=1e-6)


def test_with_exact_returns_one_step_serves_robots_that_no_single_policy_serves():
    """What meta-training in corridors comes to without the noise of roll-outs; two robots, one wired backwards."""
    losses, d, tasks = exact_policies()
    start = torch.tensor(0.5 * np.random.default_rng(3).standard_normal(d)).requires_grad_()
    adam = torch.optim.Adam([start], lr=0.05)
    before = after_a_step(losses, tasks, 0.3)(start.detach())
    for _ in range(150):
        start.grad = meta_gradient(losses, start, tasks, 0.3)
        adam.step()
    stepped, stood = after_a_step(losses, tasks, 0.3)(start.detach()), losses(start.detach().expand(tasks, -1)).mean()
    assert stepped < 0.5 * before and stepped < 0.5 * stood


def test_a_network_by_hand():
    """2 tanh(3 x + 1) - 0.5 for the first task, 0 x + 7 for the second, of which the weights say nothing else."""
    weights, x = tensor([3.0, 1.0, 2.0, -0.5], [0.0, 0.0, 0.0, 7.0]), tensor([0.0], [1.0])
    found = outputs(weights, x, [1, 1, 1])[..., 0]
    assert found[0].tolist() == pytest.approx([2 * np.tanh(1) - 0.5, 2 * np.tanh(4) - 0.5])
    assert found[1].tolist() == [7.0, 7.0] and size([1, 1, 1]) == 4
    assert outputs(tensor([2.0, -1.0]), x, [1, 1]).flatten().tolist() == [-1.0, 1.0]


def test_bad_inputs_are_named():
    with pytest.raises(ValueError, match=r"a network of \[1, 2\] nodes has 4 parameters, got 3"):
        outputs(torch.zeros(1, 3), torch.zeros(1, 1), [1, 2])
    with pytest.raises(ValueError, match="a loss is not finite; was the step too large"):
        adapted(lambda parameters: parameters.sum(dim=1) / 0, torch.ones(1, 2), 0.1)
