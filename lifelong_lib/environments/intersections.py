"""Five junctions in SUMO: a car waits on the minor road's line and chooses when to go (thesis sections 5.2, 5.4, 5.5).

The junctions, and the traffic on them, stand in data/intersections; build.py there makes them. The simulation runs
inside this process, which can hold only one at a time. Registered as lifelong_lib/Intersection-v0.
"""

from pathlib import Path

import gymnasium as gym

from lifelong_lib.environments.crossing import (
    GO,
    LENGTH,
    MAX_STEPS,
    ROW,
    ROWS,
    ROWS_BEHIND,
    SPEED,
    WAITS,
    overlaps,
)
from lifelong_lib.environments.sumo import SumoCrossing

FOLDER = Path(__file__).resolve().parents[2] / "data" / "intersections"
TASKS = {"right": "to_east", "left": "to_west", "left2": "to_west", "forward": "to_north", "challenge": "to_north"}
CLEAR = 5.0  # [m] of its new road that must lie behind the whole car before it is across


class Intersection(SumoCrossing):
    """A trial, as in `Crossing`, at a junction in SUMO; going lasts until it ends.

    ``task``: a name of TASKS. ``coordinates``: "local", counted from the car's line, so that the nearest lane is the
    same row in every task, or "global", counted from the centre of the junction. ``discount``, ``render_mode``: as in
    `Crossing`. ``folder``: where the networks are.

    A reset with a seed begins in traffic of its own, the same in every process. Without one the traffic of the last
    trial drives on for 10 s, which takes a fraction of the time. A reset takes the simulation over from any other
    junction of this process; stepping one that has lost it raises RuntimeError. Raises ValueError for an unknown task,
    coordinates or render mode and for files that are missing or not those of build.py.
    """

    def __init__(self, task: str, coordinates: str = "local", discount: float = 0.99, folder: Path = FOLDER,
                 render_mode: str | None = None):  # fmt: skip
        if task not in TASKS or coordinates not in ("local", "global"):
            raise ValueError(f"no junction {task!r} in {coordinates!r} coordinates; there are {', '.join(TASKS)}")
        network, routes = (Path(folder) / f"{task}.{kind}.xml" for kind in ("net", "rou"))
        super().__init__(network, routes, discount, render_mode)
        self.task, self.coordinates = task, coordinates

    def _begin(self, seeded):
        new = seeded or not self.sumo.held
        line = self.sumo.begin_trial(int(self.np_random.integers(2**31)) if new else None)
        local = self.coordinates == "local"
        self.origin = line - [0, ROWS_BEHIND * ROW] if local else self.roads.middle - [0, ROWS / 2 * ROW]

    def _act(self, action):
        if action != GO:
            took = min(WAITS[action], MAX_STEPS - self.steps)
            self.sumo.drive_on(took)
            self.steps += took
            return ""  # nobody drives into a car behind its line
        self.sumo.set_off(SPEED)
        outcome = ""
        while self.steps < MAX_STEPS and not outcome:
            self.sumo.drive_on(1)
            self.steps += 1
            outcome = self._outcome()
        return outcome

    def _outcome(self) -> str:
        own, others = self.cars()
        if len(own) and overlaps(own[0], others).any():
            return "collision"
        return "success" if not len(own) or self.sumo.way_on(TASKS[self.task]) >= LENGTH + CLEAR else ""


gym.register("lifelong_lib/Intersection-v0", f"{__name__}:Intersection")
