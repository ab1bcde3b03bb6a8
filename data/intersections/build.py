"""Builds the five junctions of chapter 5: plain XML sources, SUMO networks and traffic. Run: python build.py

Needs netconvert of the pinned release (`pip install eclipse-sumo==1.28.0`, 150 MB, for this script only). Everything
that it writes is committed, so that nobody has to run it to use the junctions.

All junctions have one plan: a main road from west to east with ``lanes`` lanes a direction and right of way, and a
minor road from the south, on whose line the ego car waits. Where it may drive on there is an arm to the north.
"""

import hashlib
import os
import shutil
import subprocess
import sys
from pathlib import Path

HERE = Path(__file__).parent
JUNCTIONS = {  # name: (lanes a direction on the main road, the arm that the ego car drives to)
    "right": (1, "east"),
    "left": (1, "west"),
    "left2": (2, "west"),
    "forward": (1, "north"),
    "challenge": (3, "north"),
}
SPEED = 20  # [m/s] limit on every road, section 5.5
RATE = 0.2  # cars a second on each lane of the main road, section 5.5
ENDS = {"west": (-250, 0), "east": (250, 0), "south": (0, -60), "north": (0, 60)}  # [m]


def xml(root: str, lines: list[str]) -> str:
    return "\n".join([f"<{root}>", *(f"    {line}" for line in lines), f"</{root}>", ""])


def sources(lanes: int, goal: str) -> dict[str, str]:
    """The plain XML of a junction: nodes, edges, connections; and its traffic."""
    arms = ["west", "east", "south"] + ["north"] * (goal == "north")
    nodes = ['<node id="centre" x="0" y="0" type="priority"/>']
    nodes += [f'<node id="{arm}" x="{ENDS[arm][0]}" y="{ENDS[arm][1]}"/>' for arm in arms]
    edges = []
    for arm in arms:
        main = arm in ("west", "east")
        shape = f'numLanes="{lanes if main else 1}" priority="{2 if main else 1}" speed="{SPEED}"'
        edges += [f'<edge id="from_{arm}" from="{arm}" to="centre" {shape}/>']
        edges += [f'<edge id="to_{arm}" from="centre" to="{arm}" {shape}/>']
    across = [("from_west", "to_east"), ("from_east", "to_west")]
    straight = [(start, end, lane, lane) for start, end in across for lane in range(lanes)]
    turn = ("from_south", f"to_{goal}", 0, lanes - 1 if goal == "west" else 0)  # a left turn takes the first lane
    return texts(nodes, edges, straight, turn)


def texts(nodes: list[str], edges: list[str], straight: list[tuple], turn: tuple) -> dict[str, str]:
    """The files of a junction: its nodes and edges, and what follows from its links (from, to, lane, onto lane).

    straight: those of the main road, on each of which cars come; turn: that of the ego car.
    """
    connections = [f'<connection from="{start}" to="{end}" fromLane="{lane}" toLane="{onto}"/>'
                   for start, end, lane, onto in [*straight, turn]]  # fmt: skip
    driver = ['<param key="has.driverstate.device" value="true"/>']
    driver += ['<param key="device.driverstate.initialAwareness" value="0.5"/>']  # drivers misjudge gaps and speeds
    # what a driver noticed last is kept by the other car's address in memory, which differs from run to run: with
    # thresholds of 0 every change is noticed at once, and nothing depends on it
    driver += [f'<param key="device.driverstate.{change}ChangePerceptionThreshold" value="0"/>'
               for change in ("headway", "speedDifference")]  # fmt: skip
    traffic = ['<vType id="car" carFollowModel="IDM" length="5" width="1.8" speedFactor="normc(1,0.1,0.5,1.5)" '
               'jmIgnoreJunctionFoeProb="1">']  # who has right of way does not brake for a car that crosses
    traffic += [f"    {line}" for line in driver] + ["</vType>"]
    traffic += ['<vType id="ego" length="5" width="1.8" accel="2.6" maxSpeed="20" speedFactor="1" color="red"/>']
    traffic += [f'<route id="ego" edges="{turn[0]} {turn[1]}"/>']
    traffic += [f'<flow id="{start}_{lane}" type="car" begin="0" end="1000000" probability="{RATE}" from="{start}" '
                f'to="{end}" departLane="{lane}" departSpeed="max"/>' for start, end, lane, _ in straight]  # fmt: skip
    parts = {"nod": ("nodes", nodes), "edg": ("edges", edges), "con": ("connections", connections)}
    return {kind: xml(*part) for kind, part in (parts | {"rou": ("routes", traffic)}).items()}


def build(name: str) -> None:
    """Write the sources of a junction and have netconvert make its network."""
    convert(name, sources(*JUNCTIONS[name]))


def convert(name: str, parts: dict[str, str]) -> None:
    """Write the files of a junction into HERE, and the network that netconvert makes of them, without its date."""
    for kind, text in parts.items():
        (HERE / f"{name}.{kind}.xml").write_text(text)
    files = [part for kind in ("nod", "edg", "con") for part in (f"--{FLAGS[kind]}", str(HERE / f"{name}.{kind}.xml"))]
    network = HERE / f"{name}.net.xml"
    options = ["--no-turnarounds", "true", "--junctions.limit-turn-speed", "-1", "--junctions.corner-detail", "5"]
    netconvert(*files, "-o", str(network), *options)
    text = network.read_text()
    head, _, rest = text.partition("<!--")
    network.write_text(head + rest.partition("-->\n\n")[2])


def netconvert(*options: str) -> None:
    """Call the program, beside this Python or on the path."""
    program = shutil.which("netconvert", path=os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]]))
    if program is None:
        sys.exit("error: netconvert is missing: pip install eclipse-sumo==1.28.0")
    if subprocess.run([program, *options], stdout=sys.stderr).returncode:
        sys.exit("error: netconvert could not make the network (see above)")


def write_checksums() -> None:
    """The list of what a simulation reads, which it checks."""
    files = sorted(file for kind in ("net", "rou") for file in HERE.glob(f"*.{kind}.xml"))
    sums = [f"{hashlib.sha256(file.read_bytes()).hexdigest()}  {file.name}" for file in files]
    (HERE / "SHA256SUMS").write_text("\n".join(sums) + "\n")


FLAGS = {"nod": "node-files", "edg": "edge-files", "con": "connection-files"}

if __name__ == "__main__":
    for name in JUNCTIONS:
        build(name)
    write_checksums()
