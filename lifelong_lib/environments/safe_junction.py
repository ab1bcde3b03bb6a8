"""A left turn in SUMO on which traffic reacts and unsafe actions are masked (thesis section 7.7).

The junction stands in data/safe_junction; build.py there makes it. SUMO's cars follow those ahead of them on their own
road; here they also brake for an own car that reaches into their lane from the side. Registered as
lifelong_lib/SafeJunction-v0.
"""

from itertools import count
from pathlib import Path

import gymnasium as gym
import libsumo
import numpy as np

from lifelong_lib.environments.crossing import (
    COLUMNS,
    LENGTH,
    MAX_STEPS,
    ROW,
    ROWS,
    STEP_SECONDS,
    WIDTH,
    grid,
    overlaps,
)
from lifelong_lib.environments.prediction import (
    DIRECTIONS,
    LIMIT,
    PROFILES,
    STANDARD,
    VIEW,
    Margins,
    Prediction,
    corners,
    covered,
)
from lifelong_lib.environments.sumo import READ, SumoCrossing

FOLDER = Path(__file__).resolve().parents[2] / "data" / "safe_junction"
DENSITIES = (0.1, 0.15, 0.4)  # cars a second on each lane
GOALS = ("margin", "braking")
SAFETIES = ("mask", "shield", "none")
WAIT = 0  # actions 1, 2, 3 are to go with PROFILES
LINE = 0.1  # [m] from the own car's front to the end of its lane
FAR = 50.0  # [m] distances count up to here, section 7.7.2
BRAKES = -0.5  # [m/s^2] below which a car brakes
HARDEST = 4.5  # [m/s^2] that an own car is taken to be able to brake by
CRASH = -10.0  # reward of a collision, which only cars without a mask get
RECOVERY = 25  # steps besides those between trials, so that cars which were held up drive as they like to again
PATIENCE = 9000  # steps in which the first safe moment must come


class SafeJunction(SumoCrossing):
    """A trial, from the first moment at which a way to go is safe: wait, or go with one of three accelerations.

    To wait lasts until there is a safe way to go again, without ``safety`` one step. To go lasts until the whole car is
    on its new road, or collides. The trial ends as a time-out 100 steps after its beginning if the car still waits.

    ``density``: cars a second on each lane. ``goal``: "margin", a success is worth 0.1 (d - 10), with d the smallest
    distance [m] of the own car's middle from that of another one while it crosses, at most 50, and a time-out is worth
    ``timeout``; "braking", a success is worth 1, and each step of crossing in which a car brakes by more than 0.5 m/s^2
    costs 0.1. ``margins``, ``unseen``, ``view``: of the prediction; an extra margin does not count for the first safe
    moment. ``safety``: "mask" or "shield", an action that is not safe is replaced by waiting, which with a shield takes
    ``shield_penalty`` off the reward, as a shield lets all actions be chosen; or "none".
    ``discount``, ``render_mode``: as in `Crossing`. ``folder``: where the network is.

    Observations (2, 26, 3): the two lanes of `grid`. ``info`` has ``steps`` and ``outcome`` as in `Crossing`;
    ``action_mask`` (4,), what is allowed next; ``safe`` (4,), what is safe next; ``replaced``, how many actions of the
    trial were so far (without ``safety`` nothing is: how many were not safe); ``distance``, d, and ``braking``, steps
    with a car that brakes. Resets are those of `Intersection`. Raises
    ValueError for an unknown density, goal, safety or render mode, and for files that are not those of build.py.
    """

    def __init__(self, density: float = 0.1, goal: str = "margin", timeout: float = -1.0, margins: Margins = STANDARD,
                 unseen: bool = True, view: float = VIEW, safety: str = "mask", shield_penalty: float = 1.0,
                 discount: float = 0.99, folder: Path = FOLDER, render_mode: str | None = None):  # fmt: skip
        choices = ("density", density, DENSITIES), ("goal", goal, GOALS), ("safety", safety, SAFETIES)
        for name, value, known in choices:
            if value not in known:
                raise ValueError(f"no junction with the {name} {value!r}; there are {', '.join(map(str, known))}")
        routes = Path(folder) / f"left-{density:g}.rou.xml"
        super().__init__(Path(folder) / "left.net.xml", routes, discount, render_mode)
        self.goal, self.timeout, self.safety, self.shield_penalty = goal, timeout, safety, shield_penalty
        self.observation_space = gym.spaces.Box(0, 3, (2, COLUMNS, 3), np.float32)
        self.action_space = gym.spaces.Discrete(1 + len(PROFILES))
        self.prediction = self._predict(margins, unseen, view)
        self._first = self._predict(Margins(**vars(margins) | {"extra": 0.0}), unseen, view)
        self.origin = self.roads.middle - [0, ROWS / 2 * ROW]

    def reset(self, *, seed: int | None = None, options: dict | None = None):
        """Begin a trial: (observation, info)."""
        seen, info = super().reset(seed=seed)
        return seen, info | self._said()

    def step(self, action):
        """Wait or go: (observation, discounted reward of its steps, terminated, truncated, info)."""
        unsafe = not self.safe[action]
        self.replaced += unsafe
        replaced = unsafe and self.safety != "none"
        seen, _, ended, late, info = super().step(WAIT if replaced else action)
        rewards = np.array(self._costs)
        rewards[-1] += self._worth(info["outcome"])
        rewards[0] -= self.shield_penalty * replaced
        reward = float(rewards @ self.discount ** np.arange(len(rewards)))
        return seen, reward, ended, late, info | self._said()

    def _predict(self, margins, unseen, view):
        path = self.roads.path
        inside = np.linalg.norm(np.diff(path[:-1], axis=0), axis=1).sum()  # without the last point, on the new road
        return Prediction(path, LINE, inside + LENGTH, self.roads.middle, margins, unseen, view)

    def _begin(self, seeded):
        new = seeded or not self.sumo.held
        if not new and "ego" in libsumo.vehicle.getIDList():
            libsumo.vehicle.remove("ego")
            self.sumo.drive_on(RECOVERY)
        self.sumo.begin_trial(int(self.np_random.integers(2**31)) if new else None)
        self.distance, self.braking, self.replaced = FAR, 0, 0
        for _ in range(PATIENCE):
            if self._first.safe(self.cars()[1]).any():
                break
            self.sumo.drive_on(1)
        else:
            minutes = PATIENCE * STEP_SECONDS / 60
            raise RuntimeError(f"no way to go was safe for {minutes:g} minutes: narrow the margins")
        self._look_out()

    def _act(self, action):
        self._costs = []
        return self._cross(PROFILES[action - 1]) if action != WAIT else self._wait()

    def _wait(self) -> str:
        while not self._costs or (self.safety != "none" and not self.safe[1:].any() and self.steps < MAX_STEPS):
            self._drive_on()
            self._look_out()
        return ""

    def _cross(self, acceleration) -> str:
        held = ()
        for step in count(1):
            held = react(self.cars()[0][0], self.prediction.lanes(), held)
            self.sumo.set_off(min(acceleration * STEP_SECONDS * step, LIMIT))
            self._drive_on()
            own, others = self.cars()
            brakes = lowest_acceleration() < BRAKES
            self.braking += brakes
            self._costs[-1] -= 0.1 * brakes if self.goal == "braking" else 0.0
            hit = overlaps(own[0], others).any()
            self.distance = min([self.distance, *np.linalg.norm(others[:, :2] - own[0, :2], axis=1)])
            if hit or self.sumo.way_on("to_west") >= LENGTH:
                let_go(held)
                return "collision" if hit else "success"

    def _drive_on(self):
        self.sumo.drive_on(1)
        self.steps += 1
        self._costs.append(0.0)

    def _worth(self, outcome: str) -> float:
        """Reward of how a trial ends."""
        success = 0.1 * (self.distance - 10) if self.goal == "margin" else 1.0
        timeout = self.timeout if self.goal == "margin" else 0.0
        return {"": 0.0, "success": success, "timeout": timeout, "collision": CRASH}[outcome]

    def _look_out(self):
        self.safe = np.r_[True, self.prediction.safe(self.cars()[1])]

    def _said(self) -> dict:
        mask = self.safe.copy() if self.safety == "mask" else np.ones_like(self.safe)
        return {"action_mask": mask, "safe": self.safe.copy(), "replaced": self.replaced,
                "distance": self.distance, "braking": self.braking}  # fmt: skip

    def _look(self) -> np.ndarray:
        return grid(self.cars()[1], self.origin)[ROWS // 2 - 1 : ROWS // 2 + 1]


def react(own: np.ndarray, lanes: np.ndarray, held: tuple) -> tuple:
    """Have the next car on each lane that the own car (4,) reaches into brake for it; return the names of these cars.

    How fast such a car drives in the next step is what SUMO's car-following model answers for the gap to the own car's
    body and the own car's speed along the lane. For this no car brakes harder than it likes to, by 4.5 m/s^2.
    ``lanes`` (2,): their middles; ``held``: names that the last call returned.
    """
    let_go(held)
    names = []
    body = corners(own[None], (LENGTH, WIDTH))
    for lane, direction in zip(lanes, DIRECTIONS, strict=True):
        low, high = covered(body, lane - ROW / 2, lane + ROW / 2)[0]
        back = low if direction > 0 else high  # the end of the body that a car on the lane comes to
        behind = {}
        for name, (x, y, speed) in others_around().items():
            gap = direction * (back - x)
            if low <= high and gap >= 0 and abs(y - lane) < ROW / 2:
                behind[gap] = name, speed
        if behind:
            gap = min(behind)
            name, speed = behind[gap]
            along = max(0.0, direction * own[3] * np.cos(own[2]))
            followed = libsumo.vehicle.getFollowSpeed(name, speed, gap, along, HARDEST, "ego")
            libsumo.vehicle.setSpeed(name, max(0.0, followed))
            names.append(name)
    return tuple(names)


def let_go(names: tuple) -> None:
    """Leave cars to SUMO again."""
    for name in names:
        libsumo.vehicle.setSpeed(name, -1)


def others_around() -> dict[str, tuple[float, float, float]]:
    """Return x and y of the front [m] and the speed of each car within 130 m other than the own one, by name."""
    found = libsumo.junction.getContextSubscriptionResults("centre")
    return {name: (*car[READ[0]], car[READ[2]]) for name, car in found.items() if name != "ego"}


def lowest_acceleration() -> float:
    """Return that of the car [m/s^2] within 130 m of the middle, other than the own one, that brakes most, or 0."""
    return min((libsumo.vehicle.getAcceleration(name) for name in others_around()), default=0.0)


gym.register("lifelong_lib/SafeJunction-v0", f"{__name__}:SafeJunction")
