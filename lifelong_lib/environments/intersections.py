"""Five junctions in SUMO: a car waits on the minor road's line and chooses when to go (thesis sections 5.2, 5.4, 5.5).

The junctions, and the traffic on them, stand in data/intersections; build.py there makes them. The simulation runs
inside this process (libsumo), which can hold only one at a time. Registered as lifelong_lib/Intersection-v0.
"""

import hashlib
from pathlib import Path
from typing import ClassVar

import gymnasium as gym
import libsumo
import numpy as np
from libsumo import constants

FOLDER = Path(__file__).resolve().parents[2] / "data" / "intersections"
TASKS = {"right": "to_east", "left": "to_west", "left2": "to_west", "forward": "to_north", "challenge": "to_north"}
STEP_SECONDS, MAX_STEPS = 0.2, 100  # a trial lasts 20 s at most
WARM_UP = 150  # steps of traffic before the first trial, until there are cars all along the 250 m of each road
PAUSE = 50  # steps between trials of one simulation, after which the cars near the junction are other ones
WAITS = (1, 2, 4, 8)  # steps; the last action is to go
GO = len(WAITS)
SPEED = 20.0  # [m/s] limit on the roads, and the unit of the speed channel
LENGTH, WIDTH = 5.0, 1.8  # [m] of every car
CLEAR = 5.0  # [m] of its new road that must lie behind the whole car before it is across
ROWS, COLUMNS = 18, 26
ROW, COLUMN = 3.2, 200 / 26  # [m] a row is a lane; columns reach 100 m to the left and to the right
ROWS_BEHIND = 3  # rows behind the car's line in local coordinates
REWARDS = {"": -0.01, "success": 0.99, "collision": -1.01}  # of one step, with what it led to
OPTIONS = {
    "step-length": STEP_SECONDS, "time-to-teleport": -1, "collision.action": "warn", "collision.check-junctions": True,
    "collision.mingap-factor": 0, "xml-validation": "never", "no-step-log": True, "no-warnings": True,
}  # fmt: skip
SPEED_MODE = 0b100110  # the ego car keeps its limits of acceleration and braking; no safe speed, no right of way
READ = (constants.VAR_POSITION, constants.VAR_ANGLE, constants.VAR_SPEED)

_running = None  # the environment that holds this process's simulation


class Intersection(gym.Env):
    """A trial: wait 1, 2, 4 or 8 steps, or go; going ends the trial across, in a collision, or when time is up.

    ``task``: a name of TASKS. ``coordinates``: "local", counted from the car's line, so that the nearest lane is the
    same row in every task, or "global", counted from the centre of the junction. ``discount``: of the rewards within
    one action. ``folder``: where the networks are.

    Observations (18, 26, 3), rows forwards, columns from left to right: heading (1 to the right, 0 to the left), speed
    in SPEED and presence of a car. Rewards: -0.01 a step, +1 across, -1 for a collision. ``info`` has ``steps``, which
    the action took, and ``outcome``: "", "success", "collision" or "timeout". Raises ValueError for an unknown task and
    for files that are missing or not those of build.py, RuntimeError for a second simulation in one process.
    """

    metadata: ClassVar = {"render_modes": []}

    def __init__(self, task: str, coordinates: str = "local", discount: float = 0.99, folder: Path = FOLDER):
        if task not in TASKS or coordinates not in ("local", "global"):
            raise ValueError(f"no junction {task!r} in {coordinates!r} coordinates; there are {', '.join(TASKS)}")
        self.task, self.coordinates, self.discount = task, coordinates, discount
        self.observation_space = gym.spaces.Box(0, 3, (ROWS, COLUMNS, 3), np.float32)
        self.action_space = gym.spaces.Discrete(GO + 1)
        self._ended = True
        self._files = {kind: checked(Path(folder) / f"{task}.{kind}.xml") for kind in ("net", "rou")}

    def reset(self, *, seed: int | None = None, options: dict | None = None):
        """Begin a trial, with a ``seed`` in traffic of its own, the same in every process; return observation and info.

        Without one the traffic of the last trial drives on for 10 s, which takes a fraction of the time.
        """
        super().reset(seed=seed)
        if seed is not None or _running is not self:
            self.simulate(int(self.np_random.integers(2**31)), WARM_UP)
        else:
            if "ego" in libsumo.vehicle.getIDList():
                libsumo.vehicle.remove("ego")
            self._drive_on(PAUSE)
        libsumo.vehicle.add("ego", "ego", typeID="ego", departPos="last", departSpeed="0")
        libsumo.simulationStep()
        libsumo.vehicle.setSpeedMode("ego", SPEED_MODE)
        libsumo.vehicle.setSpeed("ego", 0)
        libsumo.junction.subscribeContext("centre", constants.CMD_GET_VEHICLE_VARIABLE, 130, READ)
        libsumo.simulationStep()
        self.steps, self._ended = 0, False
        if self.coordinates == "local":
            self._origin = np.subtract(libsumo.vehicle.getPosition("ego"), (0, ROWS_BEHIND * ROW))
        else:
            self._origin = np.subtract(libsumo.junction.getPosition("centre"), (0, ROWS / 2 * ROW))
        return grid(self.cars()[1], self._origin), {"steps": 0, "outcome": ""}

    def step(self, action):
        """Wait or go: (observation, discounted reward of its steps, terminated, truncated, info)."""
        if self._ended:
            raise RuntimeError("the trial has ended, or was never begun: reset the environment first")
        before, outcome, going = self.steps, "", action == GO
        if going:
            libsumo.vehicle.setSpeed("ego", SPEED)
        limit = MAX_STEPS if going else min(MAX_STEPS, before + WAITS[action])
        while self.steps < limit and not outcome:
            libsumo.simulationStep()
            self.steps += 1
            outcome = self._outcome() if going else ""  # nobody drives into a car behind its line
        late = self.steps == MAX_STEPS and not outcome
        self._ended = late or bool(outcome)
        took = self.steps - before
        rewards = [REWARDS[""]] * (took - 1) + [REWARDS[outcome]]
        reward = float(np.dot(rewards, self.discount ** np.arange(took)))
        info = {"steps": took, "outcome": "timeout" if late else outcome}
        return grid(self.cars()[1], self._origin), reward, bool(outcome), late, info

    def cars(self) -> tuple[np.ndarray, np.ndarray]:
        """Poses of the ego car (1, 4), or (0, 4) once it has left, and of others within 130 m of the junction (n, 4).

        x, y [m] of the car's middle, heading [rad] from the x axis to the left, speed [m/s].
        """
        found = libsumo.junction.getContextSubscriptionResults("centre")
        own = [found.pop("ego")] if "ego" in found else []
        cars = poses([(*car[READ[0]], car[READ[1]], car[READ[2]]) for car in (*own, *found.values())])
        return cars[: len(own)], cars[len(own) :]

    def close(self):
        """Set this process's simulation free for another environment."""
        global _running
        self._ended = True
        if _running is self:
            libsumo.close()
            _running = None

    def simulate(self, seed: int, steps: int) -> None:
        """Load the junction with SUMO's own ``seed`` and let the traffic drive for so many steps, without the ego."""
        global _running
        if _running not in (None, self):
            raise RuntimeError("a process holds one SUMO simulation at a time: close the other environment first")
        options = {"net-file": self._files["net"], "route-files": self._files["rou"], "seed": seed} | OPTIONS
        words = [str(word) for key, value in options.items() for word in (f"--{key}", value)]
        if _running is self:
            libsumo.load(words)
        else:
            libsumo.start(["sumo", *words])
        _running, self._ended = self, True  # there is no ego car to decide for
        self._drive_on(steps)

    def _drive_on(self, steps):
        for _ in range(steps):
            libsumo.simulationStep()

    def _outcome(self) -> str:
        own, others = self.cars()
        if len(own) and overlaps(own[0], others).any():
            return "collision"
        on_new_road = len(own) and libsumo.vehicle.getRoadID("ego") == TASKS[self.task]
        across = not len(own) or on_new_road and libsumo.vehicle.getLanePosition("ego") >= LENGTH + CLEAR
        return "success" if across else ""


gym.register("lifelong_lib/Intersection-v0", f"{__name__}:Intersection")


def checked(file: Path) -> Path:
    """Return a file of data/intersections with the checksum that build.py wrote down; ValueError for any other."""
    if not file.exists():
        raise ValueError(f"{file} is missing; data/intersections/build.py makes it")
    known = dict(line.split()[::-1] for line in (file.parent / "SHA256SUMS").read_text().splitlines())
    if known.get(file.name) != hashlib.sha256(file.read_bytes()).hexdigest():
        raise ValueError(f"{file} is not the file that build.py made; run data/intersections/build.py again")
    return file


def poses(rows) -> np.ndarray:
    """Turn SUMO's front bumper x, y, compass angle [degree] and speed (n, 4) into middle, heading [rad] and speed."""
    rows = np.array(rows, float).reshape(-1, 4)
    heading = np.deg2rad(90 - rows[:, 2])
    middle = rows[:, :2] - LENGTH / 2 * np.column_stack([np.cos(heading), np.sin(heading)])
    return np.column_stack([middle, heading, rows[:, 3]])


def grid(cars: np.ndarray, origin: np.ndarray) -> np.ndarray:
    """Return the observation (18, 26, 3) of ``cars`` (n, 4); ``origin`` (2,): x of the middle, y of the lower edge."""
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
