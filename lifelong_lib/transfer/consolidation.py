"""Elastic weight consolidation (Kirkpatrick et al. 2016), the rival of selective replay in thesis section 6.4.7."""

import numpy as np
import torch

from lifelong_lib.learners.networks import Network


def diagonal_fisher(network: Network, inputs: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """The diagonal of the Fisher information (weights,) of a classifier: how much each weight matters to its answers.

    The mean over ``inputs`` (n, *shape) of the squared derivative of log p(class), with a class drawn for each input
    from what the network itself gives: a softmax of its outputs. It is nan for a network that has diverged.
    """
    total = torch.zeros_like(network.weights)
    for row in torch.from_numpy(np.asarray(inputs, np.float32)):
        passed = network.forward(row[None])
        chances = torch.softmax(passed[-1][1].double(), dim=1)
        drawn = int((chances[0].cumsum(0) > rng.random()).int().argmax())
        chances[0, drawn] -= 1  # the derivatives of -log p(drawn) by the outputs
        network.backward(passed, chances.float())
        total += network.gradient**2
    return (total / len(inputs)).numpy()


class ElasticWeights:
    """The penalty of all earlier tasks, ``strength`` / 2 times the sum over tasks t of F_t (w - w_t)^2.

    Called with the network's weights (w,) it gives the penalty's gradient (w,), as learners take it. The sum of squares
    is one square around the mean of the w_t that is weighted by F_t, and a constant: memory does not grow with tasks.
    """

    def __init__(self, strength: float):
        if not strength >= 0:
            raise ValueError(f"the strength of a penalty is 0 or more, not {strength}")
        self.strength, self.fisher, self.centre = strength, 0.0, 0.0

    def hold(self, weights: np.ndarray, fisher: np.ndarray) -> None:
        """Keep near ``weights`` (w,), which have learned a task, as much as its ``fisher`` (w,) says."""
        weights, fisher = torch.tensor(weights), torch.tensor(fisher)
        self.fisher = self.fisher + fisher
        share = fisher / torch.where(self.fisher > 0, self.fisher, 1)
        self.centre = self.centre + share * (weights - self.centre)

    def __call__(self, weights: torch.Tensor) -> torch.Tensor:
        """The gradient at ``weights`` (w,); zero before the first task."""
        return self.strength * self.fisher * (weights - self.centre)
