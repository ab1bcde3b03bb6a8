"""Corridors between two pits: a family of tasks so small that the return of a policy is known exactly (table 2.1).

A robot is in one of 21 cells in a row; beyond either end is a pit. It moves left, stays or moves right, 20 times, and
each step costs its distance to a goal. A policy is a table of the probability of each action in each cell. Here is
lifelong_lib/Corridor-v0.
"""

from dataclasses import dataclass

import gymnasium as gym
import numpy as np

from lifelong_lib.environments.dynamical_systems import Trajectories

CELLS = np.arange(-11, 12)
PITS = np.abs(CELLS) == 11  # nobody leaves them
STEPS = 20  # of a roll-out
DISTANCE, FALLEN = 10.0, -2.0  # cells that cost 1 a step; reward of every step that ends in a pit


@dataclass(frozen=True)
class Corridors:
    """T tasks: ``goals`` (T,), each in -10 to 10, and ``wiring`` (T, 23), by cell: 1, or -1 where motors run backwards.

    Raises ValueError for a goal outside and for wires that are neither.
    """

    goals: np.ndarray
    wiring: np.ndarray

    def __post_init__(self):
        if np.abs(self.goals).max() > 10 or self.wiring.shape != (len(self), 23) or (np.abs(self.wiring) != 1).any():
            raise ValueError("a corridor has its goal in a cell of -10 to 10, and in each of 23 cells wires of 1 or -1")

    def __len__(self):
        return len(self.goals)

    def __getitem__(self, chosen) -> "Corridors":
        return Corridors(np.atleast_1d(self.goals[chosen]), np.atleast_2d(self.wiring[chosen]))

    @property
    def descriptions(self) -> np.ndarray:
        """What a robot may be told of its task (T, 3): the goal in units of 10 cells, the wires in the middle, and 1."""
        return np.column_stack([self.goals / DISTANCE, self.wiring[:, 11], np.ones(len(self))])

    @property
    def rewards(self) -> np.ndarray:
        """Of a step that ends in each cell: (T, 23)."""
        near = -np.abs(CELLS - self.goals[:, None]) / DISTANCE
        return np.where(PITS, FALLEN, near)

    @property
    def after(self) -> np.ndarray:
        """The cell (its place in CELLS) that each action leads to: (T, 23, 3)."""
        moved = np.arange(23)[:, None] + self.wiring[..., None] * np.array([-1, 0, 1])
        return np.where(PITS[:, None], np.arange(23)[:, None], moved)

    def roll_out(self, tables: np.ndarray, n: int, rngs: list) -> Trajectories:
        """Return ``n`` roll-outs of every task from random cells, with policies ``tables`` (T, 23, 3), a generator each.

        States (places in CELLS) and actions are whole numbers, (T, n, 21) and (T, n, 20).
        """
        after, task, limits = self.after, np.arange(len(self))[:, None], tables.cumsum(axis=2)[..., :2]
        states, actions = np.empty((STEPS + 1, len(self), n), int), np.empty((STEPS, len(self), n), int)
        states[0] = [rng.integers(1, 22, n) for rng in rngs]
        luck = np.stack([rng.random((STEPS, n)) for rng in rngs], axis=1)
        for h in range(STEPS):
            actions[h] = (luck[h][..., None] >= limits[task, states[h]]).sum(axis=2)
            states[h + 1] = after[task, states[h], actions[h]]
        rewards = self.rewards[task, states[1:]]
        return Trajectories(*(part.transpose(1, 2, 0) for part in (states, actions, rewards)))

    def expected(self, tables: np.ndarray) -> np.ndarray:
        """Return the expected reward per step (T,) of policies (T, 23, 3), exactly: where a robot is at each step."""
        moves = (np.eye(23)[self.after] * tables[..., None]).sum(axis=2)
        place, total = np.tile(~PITS / 21, (len(self), 1, 1)), np.zeros(len(self))
        for _ in range(STEPS):
            place = place @ moves
            total += (place[:, 0] * self.rewards).sum(axis=1)
        return total / STEPS

    def score(self, tables: np.ndarray) -> np.ndarray:
        """Return where each policy stands (T,) between one that draws its actions, 0, and the best there is, 1."""
        worth, task = np.zeros((len(self), 23)), np.arange(len(self))[:, None, None]
        for _ in range(STEPS):
            worth = (self.rewards + worth)[task, self.after].max(axis=2)
        best, drawn = worth[:, 1:-1].mean(axis=1) / STEPS, self.expected(np.full((len(self), 23, 3), 1 / 3))
        return (self.expected(tables) - drawn) / (best - drawn)


class Corridor(gym.Env):
    """One task of `Corridors` as an environment. Observations (3,): position and goal in units of 10 cells, and wires.

    Raises ValueError unless the ``task`` is one.
    """

    def __init__(self, task: Corridors):
        if len(task) != 1:
            raise ValueError(f"this environment is one corridor, not {len(task)}")
        self.after, self.rewards, self.description = task.after[0], task.rewards[0], task.descriptions[0, :2]
        self.observation_space = gym.spaces.Box(-2, 2, (3,), np.float32)
        self.action_space = gym.spaces.Discrete(3)

    def _look(self):
        return np.array([CELLS[self.place] / DISTANCE, *self.description], np.float32)

    def reset(self, *, seed: int | None = None, options: dict | None = None):
        """Begin in a random cell: (observation, info)."""
        super().reset(seed=seed)
        self.place, self.steps = int(self.np_random.integers(1, 22)), 0
        return self._look(), {}

    def step(self, action):
        """Move: (observation, reward, terminated, truncated, info); it is over after 20 steps, in a pit or not."""
        self.place, self.steps = int(self.after[self.place, action]), self.steps + 1
        return self._look(), float(self.rewards[self.place]), False, self.steps == STEPS, {}


gym.register("lifelong_lib/Corridor-v0", f"{__name__}:Corridor")  # make it with task=
