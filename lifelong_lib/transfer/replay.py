"""Selective experience replay (thesis section 6.2): memories that keep what a ranking function prefers.

A *ranking function* is a plain function ``ranking(trial, network, rng) -> scores (n,)`` of a trial with n decisions,
the network that learns and a random generator; what has high scores stays. Who adds one changes nothing here.
"""

import heapq
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np

from lifelong_lib.learners.networks import Network
from lifelong_lib.learners.q_learning import Memory, ReplayBuffer, Trial


def surprise(trial: Trial, network: Network, rng: np.random.Generator) -> np.ndarray:
    """How far the network's value of each action is from the return that followed (n,): equation 6.4 with returns."""
    values = network.values(trial.images[:-1])
    return np.abs(trial.returns - values[np.arange(len(values)), trial.actions])


def noisy_reward(spread: float) -> Callable:
    """Return a ranking by absolute returns (equation 6.5) with normal noise of standard deviation ``spread``."""

    def reward(trial, network, rng):
        return np.abs(trial.returns) + spread * rng.standard_normal(len(trial.returns))

    return reward


def distribution_matching(trial: Trial, network: Network, rng: np.random.Generator) -> np.ndarray:
    """Random keys (n,): all that was ever met is kept with the same probability (equations 6.6, 6.7)."""
    return rng.standard_normal(len(trial.returns))


class EpisodicMemory(ReplayBuffer):
    """A memory of the ``capacity`` experiences of highest score: a priority queue. Images have ``shape``.

    Each experience is scored when it comes, and a random key decides between equal scores, so that when they came does
    not matter. An insert costs a logarithm of the capacity. ``refreshed``: those that are sampled are scored anew, as a
    trial made of their images, actions and returns; the queue is then ordered once a trial.

    `added`: how many experiences were met; `arrivals` (capacity,): how many of them before each one stored, which tells
    its task. Raises ValueError for a capacity below 1, a ranking that is no function, scores of another shape or nan.
    """

    def __init__(self, capacity: int, shape: tuple, ranking: Callable, rng: np.random.Generator, refreshed=False):
        super().__init__(capacity, shape)
        if not callable(ranking):
            raise ValueError(f"a ranking is a function of a trial, its network and a generator, not {ranking!r}")
        self.ranking, self.rng, self.refreshed, self.network = ranking, rng, refreshed, None
        self.scores, self.keys, self.arrivals = np.zeros(capacity), np.zeros(capacity), np.zeros(capacity, np.int64)
        self.queue = None  # (score, key, place) of all that are stored, as a heap; None: to be made from the arrays

    def add(self, trial: Trial, network: Network | None = None) -> None:
        """Store those of a trial's experiences that rank higher than what they replace."""
        self.network = network
        scores = self._scores_of(trial)
        _store(self, trial, zip(scores.tolist(), self.rng.random(len(scores)).tolist(), strict=True))

    def sample(self, size: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """``size`` experiences drawn with repetition: images (size, *shape), actions and returns (size,)."""
        chosen = rng.integers(len(self), size=size)
        images, actions, returns = self.images[chosen], self.actions[chosen], self.returns[chosen]
        if self.refreshed:
            none = np.zeros(0)
            trial = Trial(np.concatenate([images, images[-1:]]), none, actions, none, none, returns, {})
            self.scores[chosen], self.queue = self._scores_of(trial), None
        return images, actions, returns

    def _scores_of(self, trial):
        scores, wanted = np.asarray(self.ranking(trial, self.network, self.rng), float), (len(trial.returns),)
        if scores.shape != wanted or np.isnan(scores).any():
            name = getattr(self.ranking, "__name__", self.ranking)
            found = "nan" if scores.shape == wanted else f"an array {scores.shape}"
            raise ValueError(f"the ranking {name} must give an array {wanted} of numbers, and gave {found}")
        return scores

    def _place_for(self, rank):
        """Where an experience of a rank (score, key) goes; None if all that are stored rank higher."""
        n = place = len(self)
        if self.queue is None:
            self.queue = list(zip(self.scores[:n].tolist(), self.keys[:n].tolist(), range(n), strict=True))
            heapq.heapify(self.queue)
        if n < len(self.returns):
            heapq.heappush(self.queue, (*rank, place))
        else:
            *lowest, place = self.queue[0]
            if rank < tuple(lowest):
                return None
            heapq.heapreplace(self.queue, (*rank, place))
        self.scores[place], self.keys[place] = rank
        return place


class CoverageMemory(ReplayBuffer):
    """A memory that covers what was met: when it is full, of its ``capacity`` experiences and the newcomer the one with
    the most neighbours goes (equations 6.8, 6.9); a random key decides between equal numbers.

    ``features(trial) -> (n, d)`` describe experiences; ``distance(one (d,), others (m, d)) -> (m,)``; neighbours are
    nearer than ``eta``. `neighbours` (capacity + 1,) are exact at any time, where the thesis counts anew when it
    samples: who comes adds one to each neighbour's number, who goes takes it off. An insert costs twice the distances
    to all that are stored. `arrivals`, `added`: as in `EpisodicMemory`. Raises ValueError for a capacity below 1, an
    ``eta`` that is not above 0, and a distance that is not a number.
    """

    def __init__(self, capacity: int, shape: tuple, features: Callable, distance: Callable, eta: float, rng):
        super().__init__(capacity, shape)
        if not eta > 0:
            raise ValueError(f"neighbours are those within a distance above 0, not {eta}")
        self.features, self.distance, self.eta, self.rng = features, distance, eta, rng
        self.arrivals, self.described = np.zeros(capacity, np.int64), None
        self.neighbours, self.keys = np.zeros(capacity + 1, np.int64), np.zeros(capacity + 1)  # the last: a newcomer's

    def add(self, trial: Trial, network: Network | None = None) -> None:
        """Store a trial's experiences, each in the place of the one that has the most neighbours."""
        described = self.features(trial)
        if self.described is None:  # a feature's values lie side by side: few features of all experiences are read
            self.described = np.zeros((described.shape[1], len(self.keys)), np.float32).T
        _store(self, trial, described)

    def _place_for(self, features):
        """Where an experience goes; None if it has the most neighbours itself."""
        new, last = len(self), len(self.returns)
        self.described[new], self.keys[new] = features, self.rng.random()
        near = self._near(new, new)
        self.neighbours[:new] += near
        self.neighbours[new] = near.sum()
        if new < last:
            return new
        most = np.flatnonzero(self.neighbours == self.neighbours.max())
        place = most[self.keys[most].argmin()]
        self.neighbours -= self._near(place, last + 1)
        for array in (self.described, self.keys, self.neighbours):
            array[place] = array[last]
        return None if place == last else place

    def _near(self, place, count):
        """Which of the first ``count`` experiences are neighbours of the one at ``place``."""
        distances = self.distance(self.described[place], self.described[:count])
        if np.isnan(distances).any():
            raise ValueError(f"the distance {self.distance.__name__} gave nan; it must be a number for all experiences")
        return distances < self.eta


class PairOfBuffers:
    """A long-term memory and a small one of the latest experiences (section 6.2.2), both of which are offered all."""

    def __init__(self, long_term: Memory, recent: Memory):
        self.long_term, self.recent = long_term, recent

    def __len__(self):
        return max(len(self.long_term), len(self.recent))  # until the long-term memory is full it has the recent, too

    def add(self, trial: Trial, network: Network | None = None) -> None:
        """Offer a trial to both."""
        self.long_term.add(trial, network)
        self.recent.add(trial, network)

    def sample(self, size: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """``size`` experiences, as `ReplayBuffer.sample` has them: half from the long-term memory, then the recent."""
        old, new = self.long_term.sample(size // 2, rng), self.recent.sample(size - size // 2, rng)
        return tuple(np.concatenate(pair) for pair in zip(old, new, strict=True))


def save(memory: ReplayBuffer, path: Path) -> None:
    """Write what a memory holds (of a pair: one of the two) to an npz file, whole or not at all, without pickle."""
    part = Path(f"{path}.part")
    with part.open("wb") as file:
        np.savez_compressed(file, allow_pickle=False, added=memory.added, **_arrays(memory))
    os.replace(part, path)


def load(memory: ReplayBuffer, path: Path) -> None:
    """Give a memory what `save` wrote of one made with the same arguments; ValueError for one of another sort."""
    with np.load(path, allow_pickle=False) as stored:
        arrays = dict(stored)
    if any(name not in arrays or arrays[name].shape != own.shape for name, own in _arrays(memory).items()):
        raise ValueError(f"{path} is of a memory of another kind or size; make this one as that one was made")
    memory.added = int(arrays.pop("added"))
    vars(memory).update(arrays)
    if isinstance(memory, EpisodicMemory):
        memory.queue = None


def _arrays(memory):
    return {name: value for name, value in vars(memory).items() if isinstance(value, np.ndarray)}


def _store(memory, trial, described):
    """Store a trial's experiences where ``memory._place_for`` what describes each of them says, if anywhere."""
    for i, each in enumerate(described):
        place = memory._place_for(each)
        if place is not None:
            memory.images[place], memory.actions[place] = trial.images[i], trial.actions[i]
            memory.returns[place], memory.arrivals[place] = trial.returns[i], memory.added
        memory.added += 1
