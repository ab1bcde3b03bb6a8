"""Model-agnostic meta-learning (Finn et al. 2017; thesis section 2.2.2): a start that one gradient step makes good.

A loss is a function ``losses(parameters (T, d)) -> (T,)`` of torch tensors, one number a task: of a regression, or of
policies, which it then rolls out itself.
"""

from collections.abc import Callable

import torch


def size(nodes: list) -> int:
    """Number of parameters d of a network with so many ``nodes`` in each layer."""
    return sum((before + 1) * after for before, after in zip(nodes, nodes[1:], strict=False))


def outputs(parameters: torch.Tensor, inputs: torch.Tensor, nodes: list) -> torch.Tensor:
    """Outputs (T, n, nodes[-1]) of T networks for ``inputs`` (n, nodes[0]), or (T, n, nodes[0]) of their own.

    ``parameters`` (T, d): layer after layer a matrix (nodes before, nodes after) and a bias. Hidden layers end in a
    tanh; two entries in ``nodes`` make a linear model. Raises ValueError for parameters of another number.
    """
    if parameters.shape[1] != size(nodes):
        raise ValueError(f"a network of {nodes} nodes has {size(nodes)} parameters, got {parameters.shape[1]}")
    values, rest = inputs, parameters
    for layer, (before, after) in enumerate(zip(nodes, nodes[1:], strict=False)):
        matrix, bias, rest = rest.split([before * after, after, rest.shape[1] - (before + 1) * after], dim=1)
        values = torch.tanh(values) if layer else values
        values = values @ matrix.reshape(-1, before, after) + bias[:, None]
    return values


def adapted(losses: Callable, parameters: torch.Tensor, step: float, through: bool = False) -> torch.Tensor:
    """Return parameters (T, d) after one gradient step of size ``step`` on each task (equation 2.5).

    ``through``: whether the gradient can be differentiated again. Raises ValueError for a loss that is not finite.
    """
    parameters = parameters if parameters.requires_grad else parameters.detach().requires_grad_()
    loss = losses(parameters)
    if not torch.isfinite(loss).all():
        raise ValueError("a loss is not finite; was the step too large?")
    (gradient,) = torch.autograd.grad(loss.sum(), parameters, create_graph=through)
    return parameters - step * gradient


def meta_gradient(losses: Callable, start: torch.Tensor, tasks: int, step: float, second_order: bool = True):
    """Return the gradient (d,) of the mean loss of all tasks after one step from ``start`` (d,) (equation 2.6).

    ``losses`` is asked before and after the step, and may draw other data each time. Without ``second_order`` the
    gradient of the step counts as a constant.
    """
    start = start.detach().requires_grad_()
    after = adapted(losses, start.expand(tasks, -1), step, through=second_order)
    return torch.autograd.grad(losses(after).mean(), start)[0]
