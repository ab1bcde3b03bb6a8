"""Deep Q-learning on whole returns, as in chapters 5 to 7 (thesis sections 2.1.3, 5.4), and the evaluation of a policy.

Environments are Gymnasium's. ``info`` has the ``steps`` that an action took (1 where it does not say), and may have an
``action_mask`` (n_actions,) of what is allowed next. A policy is a function of an observation and such a mask.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Protocol

import gymnasium as gym
import numpy as np
import torch

from lifelong_lib.learners.networks import Convolution, Dense, Network, RMSProp


def q_network(actions: int, shape: tuple, seed: int, dropout: float = 0.0) -> Network:
    """The network of section 5.4: 32 filters of 6 x 6, 64 of 3 x 3, stride 2, then 100 nodes and a value an action.

    ``shape``: of an observation. One without rows and columns, (features,), goes to the 100 nodes at once.
    """
    convolutions = [Convolution(32, 6, 2), Convolution(64, 3, 2)] if len(shape) == 3 else []
    return Network(shape, [*convolutions, Dense(100), Dense(actions)], seed, dropout=dropout)


@dataclass(frozen=True)
class Trial:
    """What happened from a reset to the end: n decisions.

    images (n + 1, ...): what was seen before each decision and at the end; masks (n + 1, n_actions): what was allowed
    there; actions, rewards, steps (n,): each action, its reward and how many steps it took; returns (n,): the
    discounted sum of rewards from each decision to the end; info: the last one of the environment.
    """

    images: np.ndarray
    masks: np.ndarray
    actions: np.ndarray
    rewards: np.ndarray
    steps: np.ndarray
    returns: np.ndarray
    info: dict


def run_trial(env: gym.Env, policy: Callable, discount: float, seed: int | None = None, between=None) -> Trial:
    """Run ``policy(observation, mask) -> action`` until the trial ends.

    ``discount``: of one step. ``seed``: for the environment's reset. ``between()`` is called after each decision.
    """
    image, info = env.reset(seed=seed)
    everything = np.ones(env.action_space.n, bool)
    images, masks = [image], [info.get("action_mask", everything)]
    actions, rewards, steps, ended = [], [], [], False
    while not ended:
        action = policy(images[-1], masks[-1])
        image, reward, terminated, truncated, info = env.step(action)
        ended = terminated or truncated
        images.append(image)
        masks.append(info.get("action_mask", everything))
        actions.append(action)
        rewards.append(reward)
        steps.append(info.get("steps", 1))
        if between:
            between()
    returns = returns_to_go(rewards, steps, discount)
    return Trial(*map(np.array, (images, masks, actions, rewards, steps)), returns, info)


def returns_to_go(rewards: list[float], steps: list[int], discount: float) -> np.ndarray:
    """G_i = r_i + discount^steps_i G_i+1, the n-step return of every decision of a trial that has ended: (n,)."""
    returns, value = np.zeros(len(rewards)), 0.0
    for i in reversed(range(len(rewards))):
        value = rewards[i] + discount ** steps[i] * value
        returns[i] = value
    return returns


class Memory(Protocol):
    """What a learner remembers. Chapter 6 has others than `ReplayBuffer`."""

    def __len__(self) -> int:
        """How many experiences there are."""

    def add(self, trial: Trial, network: Network) -> None:
        """Store what a trial brought; ``network`` may be asked what it is worth."""

    def sample(self, size: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """``size`` experiences: images (size, ...), actions (size,) and returns (size,)."""


class ReplayBuffer:
    """A memory of the latest ``capacity`` experiences: images of ``shape``, actions, returns.

    Raises ValueError for a capacity below 1.
    """

    def __init__(self, capacity: int, shape: tuple):
        if capacity < 1:
            raise ValueError(f"a replay buffer holds 1 experience or more, not {capacity}")
        self.images, self.added = np.zeros((capacity, *shape), np.float32), 0
        self.actions, self.returns = np.zeros(capacity, np.int64), np.zeros(capacity, np.float32)

    def __len__(self):
        return min(self.added, len(self.returns))

    def add(self, trial: Trial, network: Network | None = None) -> None:
        """Store a trial's experiences, each in the place of the oldest."""
        for experience in zip(trial.images[:-1], trial.actions, trial.returns, strict=True):
            place = self.added % len(self.returns)
            self.images[place], self.actions[place], self.returns[place] = experience
            self.added += 1

    def sample(self, size: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """``size`` experiences drawn with repetition: images (size, *shape), actions and returns (size,)."""
        chosen = rng.integers(len(self), size=size)
        return self.images[chosen], self.actions[chosen], self.returns[chosen]


class Diverged(RuntimeError):
    """The network's values left all bounds; what it learned is not to be averaged in."""


@dataclass(frozen=True)
class Settings:
    """How a network learns."""

    rate: float  # step size of RMSProp
    damping: float  # what RMSProp adds to root mean squares of gradients
    decay: float  # share of the mean square of gradients that RMSProp keeps
    discount: float  # of one time step
    epsilon: float  # share of random actions
    batch: int  # experiences an update
    warm_up: int  # experiences in the memory before the first update


class DQN:
    """Deep Q-learning on returns: they are known when a trial ends, so that no target network is needed.

    One *iteration* is one decision followed by one update. ``memory`` is given every trial and asked for every batch.
    ``seed``: a SeedSequence. ``penalty(weights (w,)) -> gradient (w,)``, if any, is added to the gradient (elastic
    weight consolidation).
    """

    def __init__(self, network: Network, memory: Memory, settings: Settings, seed, penalty: Callable | None = None):
        self.network, self.memory, self.settings, self.penalty = network, memory, settings, penalty
        self.optimiser = RMSProp(network, settings.rate, settings.damping, settings.decay)
        streams = map(np.random.default_rng, seed.spawn(4))
        self._trials, self._choices, self._batches, self._dropout = streams
        self.iterations, self._end, self._largest_return = 0, 0, 1.0

    def train(self, env: gym.Env, iterations: int, every: int = 0, look: Callable = lambda: None) -> list:
        """Learn for so many iterations; return what ``look()`` gave at the start and every ``every`` iterations.

        ``look`` is called between trials, as the process may hold one simulation only and it may use ``env``; ``env``
        is seeded at the start and after each look. A trial that is under way when the iterations are over is finished,
        without updates. Raises Diverged, see `update`, and ValueError for a memory that is full before ``warm_up``.
        """
        begin, self._end = self.iterations, self.iterations + iterations
        seen = [look()] if every else []
        seed = int(self._trials.integers(2**31))
        while self.iterations < self._end:
            trial = run_trial(env, self.explore, self.settings.discount, seed, self.learn)
            stored = len(self.memory)
            self.memory.add(trial, self.network)
            if stored == len(self.memory) < self.settings.warm_up:
                raise ValueError(f"the memory holds {stored} experiences, fewer than the warm-up needs: enlarge it")
            self._largest_return = max(self._largest_return, np.abs(trial.returns).max())
            seed = None  # the next trial goes on in the same traffic
            if every and self.iterations >= begin + every * len(seen):
                seen.append(look())
                seed = int(self._trials.integers(2**31))
        return seen

    def explore(self, observation: np.ndarray, mask: np.ndarray) -> int:
        """The network's best action, or a random one of those that are allowed."""
        if self._choices.random() < self.settings.epsilon:
            return int(self._choices.choice(np.flatnonzero(mask)))
        return self.network.best(observation, mask)

    def learn(self) -> None:
        """One update, if there is enough to learn from and iterations are left."""
        if len(self.memory) >= self.settings.warm_up and self.iterations < self._end:
            self.update()
            self.iterations += 1

    def update(self) -> float:
        """One step of RMSProp on the mean squared error of a batch (equation 2.4 with returns); return that error.

        Raises Diverged when estimates are a hundred times as far off as any return that was met is from zero.
        """
        images, actions, returns = map(torch.from_numpy, self.memory.sample(self.settings.batch, self._batches))
        passed = self.network.forward(images, self._dropout)
        values, taken = passed[-1][1], actions[:, None]
        errors = values.gather(1, taken) - returns[:, None]
        loss = float((errors**2).mean())
        if not loss < (100 * self._largest_return) ** 2:
            raise Diverged(f"the mean squared error of iteration {self.iterations} is {loss:g}; lower the rate")
        self.network.backward(passed, torch.zeros_like(values).scatter_(1, taken, 2 * errors / len(errors)))
        if self.penalty:
            self.network.gradient += self.penalty(self.network.weights)
        self.optimiser.step()
        return loss


def evaluate(env: gym.Env, policy: Callable, seeds: Iterable) -> list[dict]:
    """Run ``policy(observation, mask) -> action`` for one trial a seed.

    Returns each trial's last info, with the sum of its rewards as ``return`` and its steps in all as ``time``.
    """
    trials = (run_trial(env, policy, discount=1.0, seed=int(seed)) for seed in seeds)
    return [trial.info | {"return": trial.rewards.sum(), "time": trial.steps.sum()} for trial in trials]
