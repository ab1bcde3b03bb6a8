"""Four rooms (thesis section 6.3.2): an agent looks for a goal in another room. Here is lifelong_lib/FourRooms-v0.

The thesis shows the world in a picture only: where the doors are is ours.
"""

from typing import ClassVar

import gymnasium as gym
import numpy as np

from lifelong_lib.environments.pictures import RENDER_MODES, Picture, known_mode

PLAN = """
###########
#    #    #
#         #
#    #    #
#    #    #
## #### ###
#    #    #
#    #    #
#         #
#    #    #
###########
"""
WALLS = np.array([[cell == "#" for cell in row] for row in PLAN.split("\n")[1:-1]])
UPPER, LOWER = tuple(range(1, 5)), tuple(range(6, 10))  # rows, or columns to the left and to the right
ROOMS = {"top right": (UPPER, LOWER), "bottom left": (LOWER, UPPER), "bottom right": (LOWER, LOWER)}
MOVES = ((-1, 0), (1, 0), (0, -1), (0, 1))  # up, down, left, right: rows count downwards
START, MAX_STEPS = (1, 1), 100
STEP_REWARD, GOAL_REWARD = -0.01, 10.0  # every step costs; the one that reaches the goal brings the other too
GOAL_LEVEL, AGENT_LEVEL, WALL_LEVEL = 1 / 3, 2 / 3, 1.0  # how dark a cell of an observation is
GREYS = {"wall": (0, 0, 0), "agent": (90, 90, 90), "goal": (190, 190, 190)}  # of pictures, as in figure 6.3
PIXELS = 20  # a cell, in pictures


class FourRooms(gym.Env):
    """A trial: walk from the top left to a goal in a ``room``, a name of ROOMS.

    ``goal``: its cell (row, column), one of the room's; None: another random cell of the room in every trial.
    Observations (11, 11, 1) are those of `look`. Rewards: -0.01 a step, +10 at the goal. ``info`` has ``steps``, 1 for
    each action, and ``outcome``: "", "success" or, after 100 steps, "timeout". ``render_mode``: None or "rgb_array".
    Raises ValueError for an unknown room, goal or mode, RuntimeError for a step in a trial that has ended.
    """

    metadata: ClassVar = {"render_modes": RENDER_MODES, "render_fps": 5}

    def __init__(self, room: str = "top right", goal: tuple | None = None, render_mode: str | None = None):
        if room not in ROOMS:
            raise ValueError(f"no room {room!r} for the goal; there are {', '.join(ROOMS)}")
        if goal is not None and not all(cell in cells for cell, cells in zip(goal, ROOMS[room], strict=True)):
            raise ValueError(f"no goal at {goal} in the room {room!r}, which has rows and columns {ROOMS[room]}")
        self.room, self.fixed, self.render_mode = room, goal, known_mode(render_mode)
        self.observation_space = gym.spaces.Box(0, 1, (*WALLS.shape, 1), np.float32)
        self.action_space = gym.spaces.Discrete(len(MOVES))
        self.agent, self.goal, self.steps, self._ended = START, START, 0, True

    def reset(self, *, seed: int | None = None, options: dict | None = None):
        """Begin a trial: (observation, info)."""
        super().reset(seed=seed)
        self.goal = self.fixed or tuple(int(self.np_random.choice(cells)) for cells in ROOMS[self.room])
        self.agent, self.steps, self._ended = START, 0, False
        return look(self.agent, self.goal), {"steps": 0, "outcome": ""}

    def step(self, action):
        """Move, unless there is a wall: (observation, reward, terminated, truncated, info)."""
        if self._ended:
            raise RuntimeError("the trial has ended, or was never begun: reset the environment first")
        row, column = np.add(self.agent, MOVES[action]).tolist()
        self.agent = self.agent if WALLS[row, column] else (row, column)
        self.steps += 1
        there = self.agent == self.goal
        late = self.steps == MAX_STEPS and not there
        self._ended = there or late
        outcome = "success" if there else "timeout" if late else ""
        reward = STEP_REWARD + GOAL_REWARD * there
        return look(self.agent, self.goal), reward, there, late, {"steps": 1, "outcome": outcome}

    def render(self) -> np.ndarray | None:
        """Return a picture (220, 220, 3) uint8 in the greys of figure 6.3; None without a mode."""
        if self.render_mode is None:
            return None
        rows, columns = WALLS.shape
        picture = Picture((0, 0), (columns, rows), PIXELS)
        cells = [*((cell, "wall") for cell in np.argwhere(WALLS)), (self.goal, "goal"), (self.agent, "agent")]
        for (row, column), kind in cells:
            picture.box((column + 0.5, rows - row - 0.5, 0), (1, 1), GREYS[kind])
        return picture.rgb()


def look(agent: tuple, goal: tuple) -> np.ndarray:
    """Return the observation (11, 11, 1) with an agent and a goal at (row, column): 0 where nothing is, 1 at walls."""
    seen = WALLS[..., None].astype(np.float32)
    seen[goal], seen[agent] = GOAL_LEVEL, AGENT_LEVEL
    return seen


def positions(images: np.ndarray) -> np.ndarray:
    """Return rows and columns of agent and goal (n, 4) in observations (n, 11, 11, 1) that show both."""
    found = [np.argwhere(np.isclose(images[..., 0], level))[:, 1:] for level in (AGENT_LEVEL, GOAL_LEVEL)]
    return np.hstack(found)


gym.register("lifelong_lib/FourRooms-v0", f"{__name__}:FourRooms")
