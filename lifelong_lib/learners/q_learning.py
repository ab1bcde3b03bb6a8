"""The deep Q-network of chapters 5 to 7, its training on whole returns, its evaluation (thesis sections 2.1.3, 5.4).

Environments are Gymnasium's, with images; ``info`` has the ``steps`` that an action took and the trial's ``outcome``.
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import nn


class QNetwork(nn.Module):
    """Two convolutions (32 of 6 x 6, 64 of 3 x 3, stride 2, no padding), 100 nodes and a value for each action.

    Leaky ReLUs throughout; ``dropout`` is the share of the 100 nodes that is left out in training. ``shape``: rows,
    columns, channels of the input. ``seed`` draws the weights, and nothing else of torch's generator is touched.
    """

    def __init__(self, actions: int, shape: tuple = (18, 26, 3), dropout: float = 0.0, seed: int = 0):
        super().__init__()
        with torch.random.fork_rng():
            torch.manual_seed(seed)
            rows, columns = (((size - 6) // 2 + 1 - 3) // 2 + 1 for size in shape[:2])
            self.layers = nn.Sequential(
                nn.Conv2d(shape[2], 32, 6, stride=2), nn.LeakyReLU(), nn.Conv2d(32, 64, 3, stride=2), nn.LeakyReLU(),
                nn.Flatten(), nn.Linear(64 * rows * columns, 100), nn.LeakyReLU(), nn.Dropout(dropout),
                nn.Linear(100, actions),
            )  # fmt: skip

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        """Values (n, actions) of images (n, rows, columns, channels)."""
        return self.layers(images.permute(0, 3, 1, 2))

    def best(self, image: np.ndarray) -> int:
        """Return the action of largest value for one image (rows, columns, channels), with all nodes in place."""
        if self.training:
            self.eval()
        with torch.inference_mode():
            return int(self(torch.from_numpy(image)[None])[0].argmax())

    def get_weights(self) -> np.ndarray:
        """All weights, layer after layer (n,)."""
        return nn.utils.parameters_to_vector(self.parameters()).detach().numpy().copy()

    def set_weights(self, weights: np.ndarray) -> None:
        """Take over what `get_weights` gave; raises ValueError for those of a network of another shape."""
        needed = sum(part.numel() for part in self.parameters())
        if np.shape(weights) != (needed,):
            raise ValueError(f"this network has {needed} weights; those given have shape {np.shape(weights)}")
        nn.utils.vector_to_parameters(torch.tensor(weights, dtype=torch.float32), self.parameters())


class ReplayBuffer:
    """The latest ``capacity`` experiences: image of ``shape``, action and return. Older ones are overwritten."""

    def __init__(self, capacity: int, shape: tuple):
        self.images, self.added = np.zeros((capacity, *shape), np.float32), 0
        self.actions, self.returns = np.zeros(capacity, np.int64), np.zeros(capacity, np.float32)

    def __len__(self):
        return min(self.added, len(self.returns))

    def add(self, image: np.ndarray, action: int, value: float) -> None:
        """Store one experience in the place of the oldest."""
        place = self.added % len(self.returns)
        self.images[place], self.actions[place], self.returns[place] = image, action, value
        self.added += 1

    def sample(self, size: int, rng: np.random.Generator) -> tuple[torch.Tensor, ...]:
        """Return ``size`` experiences drawn with repetition: images (size, *shape), actions and returns (size,)."""
        chosen = rng.integers(len(self), size=size)
        return tuple(torch.from_numpy(part[chosen]) for part in (self.images, self.actions, self.returns))


def returns_to_go(rewards: list[float], steps: list[int], discount: float) -> np.ndarray:
    """G_i = r_i + discount^steps_i G_i+1, the n-step return of every decision of a trial that has ended: (n,)."""
    returns, value = np.zeros(len(rewards)), 0.0
    for i in reversed(range(len(rewards))):
        value = rewards[i] + discount ** steps[i] * value
        returns[i] = value
    return returns


class Diverged(RuntimeError):
    """The network's values left all bounds; what it learned is not to be averaged in."""


@dataclass
class DQN:
    """Deep Q-learning on returns: they are known when a trial ends, so that no target network is needed.

    One *iteration* is one decision followed by one update of ``batch`` experiences; updates begin when ``warm_up``
    experiences are stored. ``rate``: step size of RMSProp, which adds ``damping`` to root mean squares of gradients;
    ``discount``: of one time step; ``epsilon``: share of random actions; ``capacity``: experiences kept.
    """

    network: QNetwork
    seed: np.random.SeedSequence
    rate: float = 1e-4
    damping: float = 1e-6
    discount: float = 0.99
    epsilon: float = 0.05
    batch: int = 60
    warm_up: int = 500
    capacity: int = 20_000
    iterations: int = field(default=0, init=False)

    def __post_init__(self):
        self._trials, self._choices, self._batches = map(np.random.default_rng, self.seed.spawn(3))
        self.optimiser = torch.optim.RMSprop(self.network.parameters(), lr=self.rate, alpha=0.95, eps=self.damping)
        self.buffer = None

    def train(self, env, iterations: int, every: int = 0, look: Callable = lambda: None) -> list:
        """Train for so many iterations; return what ``look()`` gave at the start and every ``every`` iterations.

        ``look`` is called between trials, as the process may hold one simulation only and it may use ``env``; ``env``
        is seeded at the start and after each look. A trial that is under way when the iterations are over is finished,
        without updates. Raises Diverged when a loss is not below 10,000; no return is further from 0 than 2.
        """
        buffer = self.buffer = self.buffer or ReplayBuffer(self.capacity, env.observation_space.shape)
        seen, end, looks = [look()] if every else [], self.iterations + iterations, 1
        seed = int(self._trials.integers(2**31))
        while self.iterations < end:
            image, trial, ended, seed = env.reset(seed=seed)[0], [], False, None
            while not ended:
                explores = self._choices.random() < self.epsilon
                action = int(self._choices.integers(env.action_space.n)) if explores else self.network.best(image)
                following, reward, terminated, truncated, info = env.step(action)
                trial.append((image, action, reward, info["steps"]))
                image, ended = following, terminated or truncated
                if len(buffer) >= self.warm_up and self.iterations < end:
                    self.update(buffer)
                    self.iterations += 1
            images, actions, rewards, steps = zip(*trial, strict=True)
            for experience in zip(images, actions, returns_to_go(rewards, steps, self.discount), strict=True):
                buffer.add(*experience)
            if every and self.iterations >= end - iterations + looks * every:
                seen.append(look())
                looks, seed = looks + 1, int(self._trials.integers(2**31))
        return seen

    def update(self, buffer: ReplayBuffer) -> float:
        """One step of RMSProp on the squared error of a batch; return the loss. Raises Diverged, as `train` does."""
        images, actions, returns = buffer.sample(self.batch, self._batches)
        self.network.train()
        values = self.network(images).gather(1, actions[:, None])[:, 0]
        loss = ((values - returns) ** 2).mean()
        if not loss.item() < 1e4:
            raise Diverged(f"the loss of iteration {self.iterations} is {loss.item():g}; lower the rate")
        self.optimiser.zero_grad()
        loss.backward()
        self.optimiser.step()
        return loss.item()


def evaluate(env, policy: Callable, seeds) -> dict[str, np.ndarray]:
    """Run ``policy(image) -> action`` for one trial a seed; outcomes (n,), times [steps] (n,), sums of rewards (n,)."""
    outcomes, times, returns = [], [], []
    for seed in seeds:
        image, ended, time, value = env.reset(seed=int(seed))[0], False, 0, 0.0
        while not ended:
            image, reward, terminated, truncated, info = env.step(policy(image))
            time, value, ended = time + info["steps"], value + reward, terminated or truncated
        outcomes.append(info["outcome"])
        times.append(time)
        returns.append(value)
    return {"outcomes": np.array(outcomes), "times": np.array(times), "returns": np.array(returns)}
