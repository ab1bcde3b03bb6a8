"""Which ways of setting off are safe, by prediction (thesis sections 7.4 and 7.7.1). No simulator is known here.

The own car follows its path with a known acceleration; traffic keeps its lane and its velocity. What a car may cover
grows with time. A way of setting off is safe if the own car's region meets no other one until it is across.

Traffic drives on two lanes along the x axis, so that a region is an interval on a lane. When the own car's region
covers which part of which lane does not depend on traffic and is worked out once; then a scene takes one comparison a
car and step.
"""

from dataclasses import dataclass

import numpy as np

from lifelong_lib.environments.crossing import LENGTH, ROW, STEP_SECONDS, WIDTH

PROFILES = (0.5, 1.0, 1.5)  # [m/s^2] of the own car, section 7.7.2
LIMIT = 13.4  # [m/s] on all roads, section 7.7.2
FASTEST = 1.1 * LIMIT  # [m/s] of the traffic, as data/safe_junction has it
VIEW = 100.0  # [m] to both sides, section 7.7.2
DIRECTIONS = (1, -1)  # of the lanes: eastwards in the south, westwards in the north
APART = 1e6  # [m] more than any place


@dataclass(frozen=True)
class Margins:
    """How far cars may be from where they are predicted [m]. Raises ValueError for a negative one.

    After t seconds a car of the traffic may be ``fixed + growth t^2`` ahead or behind, and ``extra`` besides if it is
    seen; the own car may be ``own`` ahead or behind. All may be ``aside`` to the left or right.
    """

    fixed: float = 2.0  # section 7.7.1
    growth: float = 0.15  # [m/s^2] six standard deviations of measured errors; chapter 7's notebook fits them
    extra: float = 0.0
    own: float = 1.0
    aside: float = 0.5

    def __post_init__(self):
        for name, value in vars(self).items():
            if not value >= 0:
                raise ValueError(f"the margin {name!r} must be 0 or more, not {value}")

    def of_traffic(self, seconds: np.ndarray) -> np.ndarray:
        """What a car may be ahead or behind after so many seconds, without the extra."""
        return self.fixed + self.growth * seconds**2


STANDARD = Margins()


class Prediction:
    """Says which profiles are safe in a scene.

    ``path`` (n, 2): the own car's; its front stands ``line`` metres before the path's beginning, on a straight road
    from the south, and the car is across when its front is ``across`` metres along the path. ``middle`` (2,): of the
    junction. ``view``: metres to both sides that are seen. ``unseen``: as fast a car as there may be is assumed at
    the end of the view on each lane. ``horizon``: steps that are predicted at most.

    ``poses``: of the own car at every step of each profile until it is across, a list of (steps + 1, 3).
    Raises ValueError for a horizon below 1 and for a profile that is not across by then.
    """

    def __init__(self, path: np.ndarray, line: float, across: float, middle: np.ndarray, margins: Margins,
                 unseen: bool = True, view: float = VIEW, horizon: int = 60, profiles: tuple = PROFILES):  # fmt: skip
        if horizon < 1:
            raise ValueError(f"a prediction needs a horizon of 1 step or more, not {horizon}")
        self.margins, self.middle, self.view, self.poses = margins, np.asarray(middle, float), view, []
        for profile in profiles:
            fronts = travelled(profile, horizon) - line
            if not fronts[-1] >= across:
                seconds = horizon * STEP_SECONDS
                raise ValueError(f"a car that speeds up by {profile} m/s^2 is not across within {seconds:g} s")
            self.poses.append(poses_along(path, fronts[: np.argmax(fronts >= across) + 1]))
        self._work_out()
        ends = self.middle[0] - view * np.array(DIRECTIONS)
        self._unseen = np.column_stack([ends, self.lanes(), np.arccos(DIRECTIONS), [FASTEST] * 2])[: 2 * unseen]
        self._free = ~self._met(self._unseen, 0.0)

    def lanes(self) -> np.ndarray:
        """Heights y of the middles of both lanes (2,) [m]."""
        return self.middle[1] - np.array(DIRECTIONS) * ROW / 2

    def safe(self, cars: np.ndarray) -> np.ndarray:
        """Return which profiles (profiles,) are safe, given cars (n, 4) as in `Crossing`. Only those in view count.

        Raises ValueError for a car without a place or a speed.
        """
        cars = np.asarray(cars, float)
        if not np.isfinite(cars).all():
            raise ValueError("a car of the scene has no place, heading or speed: all four numbers must be finite")
        return self._free & ~self._met(self._seen(cars), self.margins.extra)

    def regions(self, cars: np.ndarray, step: int) -> np.ndarray:
        """Return what traffic may cover after so many steps: x, y, length and width [m] of each region (n, 4).

        First come the cars in view, then those that are assumed at its end.
        """
        seen, seconds = self._seen(np.asarray(cars, float)), step * STEP_SECONDS
        cars = np.concatenate([seen, self._unseen])
        extra = np.repeat([self.margins.extra, 0.0], [len(seen), len(self._unseen)])
        length = LENGTH + 2 * (self.margins.of_traffic(seconds) + extra)
        width = np.full(len(cars), WIDTH + 2 * self.margins.aside)
        lanes = self.lanes()[(cars[:, 1] > self.middle[1]).astype(int)]
        return np.column_stack([cars[:, 0] + velocities(cars) * seconds, lanes, length, width])

    def _seen(self, cars):
        return cars[np.abs(cars[:, 0] - self.middle[0]) <= self.view]

    def _met(self, cars, extra):
        """On which profiles (profiles,) the own car meets any of the cars (n, 4), with an extra margin of theirs."""
        places = cars[:, 0] + APART * (cars[:, 1] > self.middle[1])
        places = places + velocities(cars) * self._seconds  # (moments, cars)
        meets = (places >= self._low - extra) & (places <= self._high + extra)
        return np.logical_or.reduceat(meets.any(axis=1), self._begins)

    def _work_out(self):
        """Note all moments at which the own car's region covers a part of a lane, profile after profile.

        A car meets it if its middle is from ``_low`` to ``_high`` at ``_seconds``, (moments, 1) each. Places on the
        second lane are APART from those on the first, so that one comparison tells lanes apart too.
        """
        size = LENGTH + 2 * self.margins.own, WIDTH + 2 * self.margins.aside
        half = WIDTH / 2 + self.margins.aside
        moments = []
        for number, poses in enumerate(self.poses):
            seconds = np.arange(len(poses)) * STEP_SECONDS
            reach = LENGTH / 2 + self.margins.of_traffic(seconds)
            for lane, y in enumerate(self.lanes()):
                low, high = (covered(corners(poses, size), y - half, y + half) + APART * lane).T
                rows = np.column_stack([np.full(len(poses), number), seconds, low - reach, high + reach])
                moments.append(rows[low <= high])
        numbers, *columns = np.concatenate(moments).T
        self._seconds, self._low, self._high = (column[:, None] for column in columns)
        self._begins = np.searchsorted(numbers, np.arange(len(self.poses)))


def velocities(cars: np.ndarray) -> np.ndarray:
    """Speeds of cars (n, 4) along the x axis [m/s]."""
    return cars[:, 3] * np.cos(cars[:, 2])


def travelled(acceleration: float, steps: int) -> np.ndarray:
    """Metres after 0 to ``steps`` steps (steps + 1,) of a car that speeds up to the limit, as SUMO reckons them."""
    speeds = np.minimum(acceleration * STEP_SECONDS * np.arange(steps + 1), LIMIT)
    return np.cumsum(speeds) * STEP_SECONDS


def poses_along(path: np.ndarray, fronts: np.ndarray) -> np.ndarray:
    """Poses x, y, heading (n, 3) of a car with its front ``fronts`` (n,) metres along a path, and its back behind.

    Before the path is a straight road from the south.
    """
    points = np.concatenate([[path[0] - [0, 2 * LENGTH]], path])
    along = np.cumsum(np.r_[-2 * LENGTH, np.linalg.norm(np.diff(points, axis=0), axis=1)])

    def at(distances):
        return np.column_stack([np.interp(distances, along, points[:, axis]) for axis in (0, 1)])

    front = at(fronts)
    x, y = (front - at(fronts - LENGTH)).T
    heading = np.arctan2(y, x)
    return np.column_stack([front - LENGTH / 2 * np.column_stack([np.cos(heading), np.sin(heading)]), heading])


def corners(poses: np.ndarray, size: tuple) -> np.ndarray:
    """Corners (n, 4, 2), in order, of boxes with poses (n, 3 or more): x, y, heading; ``size``: length and width."""
    ahead = np.array([1, 1, -1, -1]) * size[0] / 2
    aside = np.array([1, -1, -1, 1]) * size[1] / 2
    cos, sin = np.cos(poses[:, 2:3]), np.sin(poses[:, 2:3])
    return np.stack([poses[:, :1] + cos * ahead - sin * aside, poses[:, 1:2] + sin * ahead + cos * aside], axis=-1)


def covered(boxes: np.ndarray, low: float, high: float) -> np.ndarray:
    """Lowest and highest x (n, 2) of boxes (n, 4, 2) within low <= y <= high; +inf and -inf where there is none."""
    x, y = boxes[..., 0], boxes[..., 1]
    candidates, within = [x], [(y >= low) & (y <= high)]
    rise = np.roll(y, -1, axis=1) - y
    for height in (low, high):  # where an edge crosses the border
        share = (height - y) / np.where(rise == 0, np.inf, rise)
        candidates.append(x + share * (np.roll(x, -1, axis=1) - x))
        within.append((rise != 0) & (share >= 0) & (share <= 1))
    candidates, within = np.concatenate(candidates, axis=1), np.concatenate(within, axis=1)
    lowest = np.where(within, candidates, np.inf).min(axis=1)
    return np.column_stack([lowest, np.where(within, candidates, -np.inf).max(axis=1)])
