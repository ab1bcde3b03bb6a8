"""Builds junctions of your own, for chapters 5 to 7: from a plan, or from a map in the format of OpenStreetMap.

Write a line into PLANS or MAPS, then run: python build.py NAME. The files go to a folder of that name, which
`Intersection(task, folder=...)` takes. Where the ego car drives to says which task it is: east is "right", west "left",
north "forward". For "left" there is the traffic of `SafeJunction(folder=...)` as well.

Like the script of data/intersections, on which it stands, it needs netconvert (`pip install eclipse-sumo==1.28.0`).
"""

import itertools
import sys
import tempfile
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree

import numpy as np

HERE = Path(__file__).parent
PLANS = {  # name: (lanes a direction on the main road, the arm that the ego car drives to)
    "wide": (2, "north"),
}
MAPS = {  # name: (file, number of the junction's node, bearing of the arm that the ego car comes from, and drives to)
    "village": ("village.osm", "1", 320, 65),  # bearings in degrees: 0 is north, 90 east
}
TASKS = {"east": "right", "west": "left", "north": "forward"}
PLACES = {"east": 90, "north": 0, "west": -90}  # [degree] bearings of the other arms, once the ego car's is the south
NEAR = 30  # [degree] that an arm may be off


class Arm(NamedTuple):
    """A road at the junction."""

    bearing: float  # [degree] in which it leaves
    line: np.ndarray  # (n, 2) [m] outwards, from (0, 0)
    arriving: int  # lanes towards the junction
    leaving: int
    speed: float  # [m/s] limit


def script(folder: str):
    """The script of data/intersections, or of data/safe_junction."""
    spec = spec_from_file_location("build", HERE.parent / folder / "build.py")
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def refuse(condition: bool, message: str) -> None:
    if condition:
        sys.exit(f"error: {message}")


def read_arms(nodes: str, edges: str, junction: str) -> list[Arm]:
    """The arms of a junction in netconvert's plain files of nodes and edges."""
    places = {node.get("id"): [float(node.get(axis)) for axis in "xy"] for node in ElementTree.fromstring(nodes)
              if node.tag == "node"}  # fmt: skip
    refuse(junction not in places, f"no junction {junction!r} on the map; it has {', '.join(sorted(places))}")
    found = {}
    for edge in ElementTree.fromstring(edges).iter("edge"):
        ends = [edge.get("from"), edge.get("to")]
        if junction in ends:
            points = [point.split(",")[:2] for point in edge.get("shape", "").split()] or [places[end] for end in ends]
            line = np.array(points, float)[:: 1 if ends[0] == junction else -1]
            found.setdefault(ends[1 - ends.index(junction)], []).append((edge, line - places[junction]))
    arms = []
    for other, roads in found.items():
        lanes = {way: sum(int(edge.get("numLanes")) for edge, _ in roads if edge.get(way) == junction)
                 for way in ("to", "from")}  # fmt: skip
        line = roads[0][1]
        speed = max(float(edge.get("speed")) for edge, _ in roads)
        refuse(len(roads) > 2, f"two roads lead from the junction to {other}: a single one is wanted")
        arms.append(Arm(bearing_of(line[1] - line[0]), line, lanes["to"], lanes["from"], speed))
    return arms


def bearing_of(step: np.ndarray) -> float:
    return float(np.rad2deg(np.arctan2(step[0], step[1])) % 360)


def between(one: float, other: float) -> float:
    """The angle [degree] between two bearings, 0 to 180."""
    return abs((one - other + 180) % 360 - 180)


def nearest(arms: list[Arm], bearing: float) -> Arm:
    arm = min(arms, key=lambda arm: between(arm.bearing, bearing))
    there = ", ".join(f"{bearing:.0f}" for bearing in sorted(arm.bearing for arm in arms))
    refuse(between(arm.bearing, bearing) > NEAR, f"no arm near bearing {bearing}; there are {there}")
    return arm


def placed(arms: list[Arm], start: Arm) -> tuple[dict[str, Arm], float]:
    """The arms by where they are once the ego car comes from the south, and the main road's bearing to the east."""
    others = [arm for arm in arms if arm is not start]
    refuse(len(arms) not in (3, 4), f"a junction of 3 or 4 arms is wanted, this one has {len(arms)}")

    def off(names):
        return sum(between(arm.bearing - start.bearing - 180, PLACES[name])
                   for arm, name in zip(others, names, strict=True))  # fmt: skip

    names = min(itertools.permutations(PLACES, len(others)), key=off)
    found = dict(zip(names, others, strict=True)) | {"south": start}
    main = {"west", "east"} <= found.keys()
    refuse(not main, "the main road must pass from the left to the right of where the ego car comes from")
    along = [found[name].line[1] / np.hypot(*found[name].line[1]) for name in ("west", "east")]
    return found, bearing_of(along[1] - along[0])


def fitted(line: np.ndarray, length: float, east: float) -> np.ndarray:
    """A line turned until the bearing `east` is the x axis, and made `length` long: cut, or continued straight on."""
    turn = np.deg2rad(east - 90)
    line = line @ np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    steps = np.hypot(*np.diff(line, axis=0).T)
    before = np.concatenate([[0], np.cumsum(steps)])
    last = int(np.searchsorted(before[1:-1], length))  # the piece in which it ends
    end = line[last] + (line[last + 1] - line[last]) * (length - before[last]) / steps[last]
    return np.concatenate([line[: last + 1], [end]]).round(2)


def map_sources(arms: list[Arm], start: float, goal: float, plan) -> tuple[str, dict[str, str]]:
    """The task, and the plain XML, of a junction whose ego car drives between the arms at these two bearings.

    plan: the script of data/intersections, which says how long arms are and what drives on them.
    """
    come, go = nearest(arms, start), nearest(arms, goal)
    refuse(come is go, f"bearings {start} and {goal} are the same arm")
    found, east = placed(arms, come)
    end = next(name for name, arm in found.items() if arm is go)
    refuse(not (come.arriving and go.leaving), "the ego car would drive against a one-way road")
    nodes, edges = ['<node id="centre" x="0" y="0" type="priority"/>'], []
    for name, arm in found.items():
        line = fitted(arm.line, np.hypot(*plan.ENDS[name]), east)
        nodes.append(f'<node id="{name}" x="{line[-1][0]:.2f}" y="{line[-1][1]:.2f}"/>')
        for edge, ends, lanes, way in ((f"from_{name}", (name, "centre"), arm.arriving, -1),
                                       (f"to_{name}", ("centre", name), arm.leaving, 1)):  # fmt: skip
            shape = " ".join(f"{x:.2f},{y:.2f}" for x, y in line[::way])
            what = f'numLanes="{lanes}" priority="{2 if name in ("west", "east") else 1}" speed="{arm.speed}"'
            edges += [f'<edge id="{edge}" from="{ends[0]}" to="{ends[1]}" {what} shape="{shape}"/>'] * (lanes > 0)
    straight = [(f"from_{one}", f"to_{other}", lane, lane) for one, other in (("west", "east"), ("east", "west"))
                for lane in range(min(found[one].arriving, found[other].leaving))]  # fmt: skip
    refuse(not straight, "no lane leads along the main road")
    turn = "from_south", f"to_{end}", 0, go.leaving - 1 if end == "west" else 0
    return TASKS[end], plan.texts(nodes, edges, straight, turn)


def build(name: str) -> Path:
    """Make a junction's folder; return its network."""
    plan = script("intersections")
    if name in PLANS:
        lanes, goal = PLANS[name]
        task, parts = TASKS[goal], plan.sources(lanes, goal)
    else:
        refuse(name not in MAPS, f"no junction {name!r} in PLANS or MAPS; they have {', '.join([*PLANS, *MAPS])}")
        file, junction, start, goal = MAPS[name]
        refuse(not (HERE / file).is_file(), f"{file} is not in this folder")
        with tempfile.TemporaryDirectory() as temporary:
            plan.netconvert("--osm-files", str(HERE / file), "--plain-output-prefix", f"{temporary}/plain",
                            "--keep-edges.by-vclass", "passenger", "--no-turnarounds", "true")  # fmt: skip
            texts = [Path(temporary, f"plain.{kind}.xml").read_text() for kind in ("nod", "edg")]
        task, parts = map_sources(read_arms(*texts, junction), start, goal, plan)
    plan.HERE = HERE / name
    plan.HERE.mkdir(exist_ok=True)
    plan.convert(task, parts)
    if task == "left":
        script("safe_junction").write_traffic(plan.HERE)
    plan.write_checksums()
    return plan.HERE / f"{task}.net.xml"


if __name__ == "__main__":
    for name in sys.argv[1:] or [*PLANS, *MAPS]:
        print(build(name))
