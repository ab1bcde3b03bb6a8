"""Corridors between two pits: tasks so small that every policy's return is known exactly (for table 2.1; ours).

A robot stands in one of 21 cells in a row, with a pit beyond either end. It moves left, stays or moves right, 20 times,
and each step costs its distance to a goal. A policy is a table of each action's probability in each cell. Here is
lifelong_lib/Corridor-v0.
"""

from dataclasses import dataclass

import gymnasium as gym
import numpy as np

from lifelong_lib.environments.dynamical_systems import Trajectories

CELLS = np.arange(-11, 12)  # positions, the pits' too
PITS = np.abs(CELLS) == 11  # nobody leaves them
STEPS = 20  # of a roll-out
DISTANCE, FALLEN = 10.0, -2.0  # cells that cost 1 a step; reward of every step that ends in a pit


@dataclass(frozen=True)
class Corridors:
    """T tasks: ``goals`` (T,), positions within [-10, 10]; ``wiring`` (T, 23), -1 where motors run backwards, else 1.

    Raises ValueError for other numbers.
    """

    goals: np.ndarray
    wiring: np.ndarray

    def __post_init__(self):
        fits = self.wiring.shape == (len(self), 23) and (np.abs(self.wiring) == 1).all()
        if not (fits and (np.abs(self.goals) <= 10).all()):
            raise ValueError("every corridor needs a goal within -10 and 10, and for each of 23 cells wires of 1 or -1")

    def __len__(self):
        return len(self.goals)

    def __getitem__(self, chosen) -> "Corridors":
        return Corridors(np.atleast_1d(self.goals[chosen]), np.atleast_2d(self.wiring[chosen]))

    @property
    def descriptions(self) -> np.ndarray:
        """What a robot may be told (T, 3): the goal in units of 10 cells, the wires in the middle cell, and 1."""
        return np.column_stack([self.goals / DISTANCE, self.wiring[:, 11], np.ones(len(self))])

    @property
    def rewards(self) -> np.ndarray:
        """Of a step that ends in each cell: (T, 23)."""
        return np.where(PITS, FALLEN, -np.abs(CELLS - self.goals[:, None]) / DISTANCE)

    @property
    def after(self) -> np.ndarray:
        """The place in CELLS that each action leads to from each: (T, 23, 3)."""
        return np.arange(23)[:, None] + ((self.wiring * ~PITS)[..., None] * [-1, 0, 1])

    def roll_out(self, tables: np.ndarray, n: int, rngs: list) -> Trajectories:
        """Return ``n`` roll-outs of every task under its policy in ``tables`` (T, 23, 3), a generator each.

        They start in random cells. States (places in CELLS) and actions are whole numbers: (T, n, 21) and (T, n, 20).
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
        """Return the expected reward per step (T,) of policies (T, 23, 3): where a robot is after each step, summed."""
        moves = (np.eye(23)[self.after] * tables[..., None]).sum(axis=2)
        place, total = np.tile(~PITS / 21, (len(self), 1, 1)), np.zeros(len(self))
        for _ in range(STEPS):
            place = place @ moves
            total += (place[:, 0] * self.rewards).sum(axis=1)
        return total / STEPS

    def score(self, tables: np.ndarray) -> np.ndarray:
        """Return where policies stand (T,): at 0 like one that draws its actions, at 1 like the best there is."""
        worth, task = np.zeros((len(self), 23)), np.arange(len(self))[:, None, None]
        for _ in range(STEPS):
            worth = (self.rewards + worth)[task, self.after].max(axis=2)
        best, drawn = worth[:, 1:-1].mean(axis=1) / STEPS, self.expected(np.full((len(self), 23, 3), 1 / 3))
        return (self.expected(tables) - drawn) / (best - drawn)


class Corridor(gym.Env):
    """The one ``task`` of a `Corridors`. Observations (3,): position and goal in units of 10 cells, and the wires.

    Raises ValueError for more tasks than one.
    """

    def __init__(self, task: Corridors):
        if len(task) != 1:
            raise ValueError(f"this environment is one corridor, not {len(task)}: choose one, as in tasks[0]")
        self.after, self.rewards, self.told = task.after[0], task.rewards[0], task.descriptions[0, :2]
        self.observation_space, self.action_space = gym.spaces.Box(-2, 2, (3,), np.float32), gym.spaces.Discrete(3)

    def _look(self):
        return np.array([CELLS[self.place] / DISTANCE, *self.told], np.float32)

    def reset(self, *, seed: int | None = None, options: dict | None = None):
        """Begin in a random cell: (observation, info)."""
        super().reset(seed=seed)
        self.place, self.steps = int(self.np_random.integers(1, 22)), 0
        return self._look(), {}

    def step(self, action):
        """Move: (observation, reward, terminated, truncated, info). 20 steps, also in a pit, and it is over."""
        self.place, self.steps = int(self.after[self.place, action]), self.steps + 1
        return self._look(), float(self.rewards[self.place]), False, self.steps == STEPS, {}


gym.register("lifelong_lib/Corridor-v0", f"{__name__}:Corridor")
