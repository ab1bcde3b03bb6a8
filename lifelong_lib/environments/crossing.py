"""What a crossing is, without a simulator: a car waits at a line and chooses when to go (thesis sections 5.2, 5.4).

The five junctions in SUMO, the recorded junction and the safe junction of chapter 7 stand on this. Cars are rows
(n, 4): x, y [m] of the car's middle, heading [rad] from the x axis to the left, speed [m/s].
"""

from typing import ClassVar

import gymnasium as gym
import numpy as np

from lifelong_lib.environments.pictures import OTHER, OWN, RENDER_MODES, ROAD, Picture, known_mode

STEP_SECONDS, MAX_STEPS = 0.2, 100  # a trial lasts 20 s at most
WAITS = (1, 2, 4, 8)  # steps; the last action is to go
GO = len(WAITS)
OUTCOMES = ("success", "collision", "timeout")  # of a trial
REWARDS = {"": -0.01, "success": 0.99, "collision": -1.01}  # of one step, with what it led to
SPEED = 20.0  # [m/s] limit on the roads of chapter 5, and the unit of the speed channel
LENGTH, WIDTH = 5.0, 1.8  # [m] of every car
ROWS, COLUMNS = 18, 26
ROW, COLUMN = 3.2, 200 / 26  # [m] a row is a lane; columns reach 100 m to the left and to the right
ROWS_BEHIND = 3  # rows behind the car's line in local coordinates
PIXELS = 5  # a metre, in pictures


class Crossing(gym.Env):
    """A trial: wait 1, 2, 4 or 8 steps, or go; it ends across, in a collision, or when time is up.

    ``discount``: of the rewards within one action. ``render_mode``: None or "rgb_array", the grid's field from above.

    Observations (18, 26, 3) are those of `grid`. Rewards: -0.01 a step, +1 across, -1 for a collision. ``info`` has
    ``steps``, which the action took, and ``outcome``: "", "success", "collision" or "timeout".

    An environment of this kind says how a trial begins (`_begin`), what an action does (`_act`), which cars there are
    (`cars`), where the grid lies (``origin``) and what to draw beneath the cars (`_ground`).
    """

    metadata: ClassVar = {"render_modes": RENDER_MODES, "render_fps": round(1 / STEP_SECONDS)}

    def __init__(self, discount: float, render_mode: str | None):
        self.discount, self.render_mode = discount, known_mode(render_mode)
        self.observation_space = gym.spaces.Box(0, 3, (ROWS, COLUMNS, 3), np.float32)
        self.action_space = gym.spaces.Discrete(GO + 1)
        self.steps, self._ended = 0, True

    def reset(self, *, seed: int | None = None, options: dict | None = None):
        """Begin a trial: (observation, info)."""
        super().reset(seed=seed)
        self._begin(seed is not None)
        self.steps, self._ended = 0, False
        return self._look(), {"steps": 0, "outcome": ""}

    def step(self, action):
        """Wait or go: (observation, discounted reward of its steps, terminated, truncated, info).

        Raises RuntimeError for a trial that has ended.
        """
        if self._ended:
            raise RuntimeError("the trial has ended, or was never begun: reset the environment first")
        before = self.steps
        outcome = self._act(action)
        took, late = self.steps - before, self.steps == MAX_STEPS and not outcome
        self._ended = late or bool(outcome)
        rewards = [REWARDS[""]] * (took - 1) + [REWARDS[outcome]]
        reward = float(np.dot(rewards, self.discount ** np.arange(took)))
        return self._look(), reward, bool(outcome), late, {"steps": took, "outcome": "timeout" if late else outcome}

    def render(self) -> np.ndarray | None:
        """Return a picture (288, 1000, 3) uint8 of what the grid covers, the own car in orange; None without a mode."""
        if self.render_mode is None:
            return None
        own, others = self.cars()
        lines, width = self._ground()
        low = self.origin - [COLUMN * COLUMNS / 2, 0]
        picture = Picture(low, low + [COLUMN * COLUMNS, ROW * ROWS], PIXELS)
        for line in lines:
            picture.stroke(line, width, ROAD)
        for car, colour in [*((car, OTHER) for car in others), *((car, OWN) for car in own)]:
            picture.box(car[:3], (LENGTH, WIDTH), colour)
        return picture.rgb()

    def cars(self) -> tuple[np.ndarray, np.ndarray]:
        """The own car (1, 4), or (0, 4) once it has left, and all others that are known of (n, 4)."""
        raise NotImplementedError

    def _begin(self, seeded: bool) -> None:
        """Begin a trial, after a seed with nothing left of the last one, and set ``origin`` (2,), as `grid` has it."""
        raise NotImplementedError

    def _act(self, action: int) -> str:
        """Do it, counting in ``steps``, of which there are MAX_STEPS; return "", "success" or "collision"."""
        raise NotImplementedError

    def _ground(self) -> tuple[list[np.ndarray], float]:
        """Polylines (n, 2) and their width [m]."""
        raise NotImplementedError

    def _look(self) -> np.ndarray:
        return grid(self.cars()[1], self.origin)


def outcome_shares(infos: list[dict]) -> np.ndarray:
    """Return the shares of OUTCOMES (3,) among trials, given the last info of each."""
    return np.mean([[info["outcome"] == outcome for outcome in OUTCOMES] for info in infos], axis=0)


def grid(cars: np.ndarray, origin: np.ndarray) -> np.ndarray:
    """Return the observation (18, 26, 3) of ``cars`` (n, 4); ``origin`` (2,): x of the middle, y of the lower edge.

    Rows go forwards, columns from left to right: heading (1 to the right, 0 to the left), speed in SPEED, presence.
    """
    seen = np.zeros((ROWS, COLUMNS, 3), np.float32)
    row = np.floor((cars[:, 1] - origin[1]) / ROW).astype(int)
    column = np.floor((cars[:, 0] - origin[0]) / COLUMN).astype(int) + COLUMNS // 2
    inside = (row >= 0) & (row < ROWS) & (column >= 0) & (column < COLUMNS)
    channels = np.column_stack([(1 + np.cos(cars[:, 2])) / 2, cars[:, 3] / SPEED, np.ones(len(cars))])
    seen[row[inside], column[inside]] = channels[inside]
    return seen


def overlaps(one: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Return which of the cars ``others`` (n, 4) overlap the car ``one`` (4,): (n,) bool.

    Two rectangles are apart exactly if one of their four axes separates them. Touching counts as overlap.
    """
    offset = others[:, :2] - one[:2]
    angles = others[:, 2] - one[2]
    # Both cars have the same size: on its own axes each reaches half a length or width, the other what its turn gives.
    cos, sin = np.abs(np.cos(angles)), np.abs(np.sin(angles))
    along, across = (LENGTH + LENGTH * cos + WIDTH * sin) / 2, (WIDTH + LENGTH * sin + WIDTH * cos) / 2
    apart = np.zeros(len(others), bool)
    for heading in (one[2], others[:, 2]):
        c, s = np.cos(heading), np.sin(heading)
        apart |= np.abs(offset[:, 0] * c + offset[:, 1] * s) > along
        apart |= np.abs(offset[:, 1] * c - offset[:, 0] * s) > across
    return ~apart
