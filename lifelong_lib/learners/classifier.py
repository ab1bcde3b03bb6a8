"""A network that tells classes apart, by plain gradient descent on the cross entropy (thesis section 6.4.7)."""

from collections.abc import Callable

import numpy as np
import torch
from scipy.stats import truncnorm

from lifelong_lib.learners.networks import Dense, Network
from lifelong_lib.learners.q_learning import Memory, Trial


def digit_network(seed: int) -> Network:
    """The network of section 6.4.7: 784 pixels, 50 nodes with ReLUs, 10 classes; it starts as the public code does.

    Weights are normal with a standard deviation of 0.1, none beyond two of them, and biases are 0.1.
    """
    network = Network((784,), [Dense(50), Dense(10)], seed, slope=0.0)
    rng = np.random.default_rng(seed)
    for matrix, bias in network.parts:
        matrix.copy_(torch.from_numpy(truncnorm.rvs(-2, 2, scale=0.1, size=matrix.shape, random_state=rng)))
        bias.fill_(0.1)
    return network


class Classifier:
    """Learns classes by steps of ``rate`` along the gradient of the mean cross entropy of ``batch`` inputs.

    ``seed``: a SeedSequence. ``penalty(weights (w,)) -> gradient (w,)``, if any, is added to the gradient. ``memory``,
    if any, is offered every input that is new, and gives half of every batch once it holds something; labels take the
    place of actions there, and all returns are 0.
    """

    def __init__(self, network: Network, rate: float, batch: int, seed, penalty: Callable | None = None,
                 memory: Memory | None = None):  # fmt: skip
        self.network, self.rate, self.batch, self.penalty, self.memory = network, rate, batch, penalty, memory
        self._draws, self._replays = map(np.random.default_rng, seed.spawn(2))

    def train(self, draw: Callable, iterations: int) -> None:
        """Make so many updates; ``draw(n, rng) -> inputs (n, *shape) float32, labels (n,)`` gives a task's samples."""
        for _ in range(iterations):
            old = self.batch // 2 if self.memory is not None and len(self.memory) else 0
            inputs, labels = new = draw(self.batch - old, self._draws)
            if old:
                remembered = self.memory.sample(old, self._replays)
                inputs, labels = (np.concatenate(pair) for pair in zip(new, remembered, strict=False))
            self.update(inputs, labels)
            if self.memory is not None:
                self.memory.add(_as_trial(*new), self.network)

    def update(self, inputs: np.ndarray, labels: np.ndarray) -> None:
        """One step of gradient descent on inputs (n, *shape) float32 with labels (n,)."""
        passed = self.network.forward(torch.from_numpy(inputs))
        errors = torch.softmax(passed[-1][1], dim=1)
        errors[torch.arange(len(labels)), torch.from_numpy(labels)] -= 1
        self.network.backward(passed, errors / len(labels))
        gradient = self.network.gradient
        if self.penalty:
            gradient += self.penalty(self.network.weights)
        self.network.weights.sub_(gradient, alpha=self.rate)

    def accuracy(self, inputs: np.ndarray, labels: np.ndarray) -> float:
        """The share of inputs (n, *shape) whose class is found; a network that has diverged finds none."""
        values = self.network.values(inputs)
        return float(np.mean((values.argmax(axis=1) == labels) & np.isfinite(values).all(axis=1)))


def _as_trial(inputs, labels):
    """Samples as a memory takes them: a trial shows one image more than it has actions."""
    none = np.zeros(0)
    return Trial(np.concatenate([inputs, inputs[-1:]]), none, labels, none, none, np.zeros(len(labels)), {})
