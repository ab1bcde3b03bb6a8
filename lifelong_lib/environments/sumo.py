"""SUMO inside this process (libsumo), which holds one simulation at a time: traffic, poses, checked files, roads.

Every network here has one plan: a junction "centre", a main road from west to east with right of way, and a minor road
from the south, on whose line the car "ego" waits. data/intersections has the files.
"""

import hashlib
from functools import cached_property
from pathlib import Path
from typing import ClassVar, NamedTuple
from xml.etree import ElementTree

import libsumo
import numpy as np
from libsumo import constants

from lifelong_lib.environments.crossing import LENGTH, ROW, STEP_SECONDS, Crossing

WARM_UP = 150  # steps of traffic before the first trial, until there are cars all along the 250 m of each road
PAUSE = 50  # steps between trials of one simulation, after which the cars near the junction are other ones
AROUND = 130  # [m] from the junction, within which cars are read
BEYOND = 9  # [m] of the new road that an own car's path shows
OPTIONS = {
    "step-length": STEP_SECONDS, "time-to-teleport": -1, "collision.action": "warn", "collision.check-junctions": True,
    "collision.mingap-factor": 0, "xml-validation": "never", "no-step-log": True, "no-warnings": True,
}  # fmt: skip
SPEED_MODE = 0b100110  # the ego car keeps its limits of acceleration and braking; no safe speed, no right of way
READ = (constants.VAR_POSITION, constants.VAR_ANGLE, constants.VAR_SPEED)
NOT_HELD = (
    "this environment does not hold the SUMO simulation, of which a process has one and the last reset takes it: reset "
    'it again, or, for several at once, use gym.make_vec(..., vectorization_mode="async"), which gives each a process'
)


class Roads(NamedTuple):
    """What of a network is drawn and measured [m]."""

    lanes: list[np.ndarray]  # polylines (n, 2) of all lanes, those inside the junction included
    path: np.ndarray  # (n, 2) of the own car, from its line to BEYOND on its new road
    middle: np.ndarray  # (2,) of the junction


class Simulation:
    """The traffic on one network. Who begins a trial takes the process's simulation over from whoever held it.

    Raises ValueError for files that are missing or not those of build.py, and, in all that needs the simulation,
    RuntimeError if another one has taken it over. ``noted``: None, or a list that holds `cars` at the beginning of the
    trial and after every step.
    """

    holder: ClassVar = None

    def __init__(self, network: Path, routes: Path):
        self.network, self.routes, self.noted = checked(network), checked(routes), None

    @property
    def held(self) -> bool:
        """Whether the process's simulation is this one."""
        return Simulation.holder is self

    def load(self, seed: int) -> None:
        """Begin the simulation with SUMO's own ``seed``, on empty roads."""
        words = ["sumo", "--net-file", str(self.network), "--route-files", str(self.routes), "--seed", str(seed)]
        for option, value in OPTIONS.items():
            words += [f"--{option}", str(value)]
        if Simulation.holder:
            libsumo.load(words[1:])
        else:
            libsumo.start(words)
        Simulation.holder = self

    def drive_on(self, steps: int) -> None:
        """Let so many steps pass."""
        self._require_held()
        for _ in range(steps):
            libsumo.simulationStep()
            if self.noted is not None:
                self.noted.append(self.cars())

    def begin_trial(self, seed: int | None) -> np.ndarray:
        """Place the own car on its line, standing, in new traffic or, with None, in what drove on for 10 s.

        Returns the place (2,) [m] of the middle of its front.
        """
        if seed is None:
            self._require_held()
            if "ego" in libsumo.vehicle.getIDList():
                libsumo.vehicle.remove("ego")
            self.drive_on(PAUSE)
        else:
            self.load(seed)
            self.drive_on(WARM_UP)
        libsumo.vehicle.add("ego", "ego", typeID="ego", departPos="last", departSpeed="0")
        libsumo.simulationStep()
        libsumo.vehicle.setSpeedMode("ego", SPEED_MODE)
        libsumo.vehicle.setSpeed("ego", 0)
        libsumo.junction.subscribeContext("centre", constants.CMD_GET_VEHICLE_VARIABLE, AROUND, READ)
        libsumo.simulationStep()
        if self.noted is not None:
            self.noted[:] = [self.cars()]
        return np.array(libsumo.vehicle.getPosition("ego"))

    def set_off(self, speed: float) -> None:
        """Have the own car speed up to ``speed`` [m/s], as its type in the traffic's file can."""
        self._require_held()
        libsumo.vehicle.setSpeed("ego", speed)

    def cars(self) -> tuple[np.ndarray, np.ndarray]:
        """Poses of the own car (1, 4), or (0, 4) once it has left, and of others within AROUND (n, 4)."""
        self._require_held()
        found = libsumo.junction.getContextSubscriptionResults("centre")
        own = [found.pop("ego")] if "ego" in found else []
        cars = poses([(*car[READ[0]], car[READ[1]], car[READ[2]]) for car in (*own, *found.values())])
        return cars[: len(own)], cars[len(own) :]

    def way_on(self, road: str) -> float:
        """Metres of ``road`` behind the front of the own car, 0 while it is on another."""
        self._require_held()
        return libsumo.vehicle.getLanePosition("ego") if libsumo.vehicle.getRoadID("ego") == road else 0.0

    def close(self) -> None:
        """End the simulation, unless it is another one's by now."""
        if self.held:
            libsumo.close()
            Simulation.holder = None

    def _require_held(self):
        if not self.held:
            raise RuntimeError(NOT_HELD)


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


def read_roads(network: Path) -> Roads:
    """Read the lanes of a network's file, the own car's path out of the south, and the junction's middle."""
    tree = ElementTree.parse(network)
    lanes = {}
    for lane in tree.iter("lane"):
        lanes[lane.get("id")] = np.array([point.split(",") for point in lane.get("shape").split()], float)
    link, path = tree.find("connection[@from='from_south']"), [lanes["from_south_0"][-1:]]
    while link.get("via"):  # a turn may be cut into several lanes within the junction
        inner = link.get("via")
        path.append(lanes[inner])
        link = tree.find(f"connection[@from='{inner.rpartition('_')[0]}']")
    start, end = lanes[f"{link.get('to')}_{link.get('toLane')}"][[0, -1]]
    path.append([start, start + BEYOND * (end - start) / np.linalg.norm(end - start)])
    centre = tree.find("junction[@id='centre']")
    return Roads(list(lanes.values()), np.concatenate(path), np.array([centre.get("x"), centre.get("y")], float))


class SumoCrossing(Crossing):
    """A crossing of this process's simulation: ``network`` and ``routes`` are its files, the rest as in `Crossing`."""

    def __init__(self, network: Path, routes: Path, discount: float, render_mode: str | None):
        super().__init__(discount, render_mode)
        self.sumo = Simulation(network, routes)

    @cached_property
    def roads(self) -> Roads:
        """Lanes, the own car's path and the middle of the junction."""
        return read_roads(self.sumo.network)

    def cars(self) -> tuple[np.ndarray, np.ndarray]:
        """Poses of the own car (1, 4), or (0, 4) once it has left, and of others within 130 m of the middle (n, 4)."""
        return self.sumo.cars()

    def close(self):
        """Set this process's simulation free, unless another environment has taken it over."""
        self._ended = True
        self.sumo.close()

    def _ground(self):
        return self.roads.lanes, ROW - 0.3  # [m] what is left out shows as the line between lanes
