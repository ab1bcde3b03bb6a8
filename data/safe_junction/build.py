"""Builds the junction of chapter 7: plain XML sources, a SUMO network, and traffic of three densities.

Run: python build.py. Like the script of data/intersections, on which it stands, it needs netconvert
(`pip install eclipse-sumo==1.28.0`), and everything that it writes is committed.
"""

import hashlib
import re
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path

HERE = Path(__file__).parent
SPEED = 13.4  # [m/s] limit on every road, section 7.7.2
CHAPTER_5, SLOWER = "normc(1,0.1,0.5,1.5)", "normc(1,0.1,0.5,1.1)"  # wished speeds: nobody is 10 % above the limit
RATES = ("0.1", "0.15", "0.4")  # cars a second on each lane: the thesis's two densities, and one beyond them


def junctions():
    """The script of data/intersections, set to this folder and this limit."""
    spec = spec_from_file_location("build", HERE.parent / "intersections" / "build.py")
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    module.HERE, module.SPEED = HERE, SPEED
    return module


def write_traffic(folder: Path) -> None:
    """Write the traffic of three densities beside that of chapter 5."""
    traffic = (folder / "left.rou.xml").read_text().replace(CHAPTER_5, SLOWER)
    # an own car without SUMO's random slowness, which would draw from the numbers that move the traffic
    traffic = traffic.replace('id="ego" length', 'id="ego" sigma="0" length')
    for rate in RATES:
        (folder / f"left-{rate}.rou.xml").write_text(re.sub('probability="[^"]*"', f'probability="{rate}"', traffic))


if __name__ == "__main__":
    script = junctions()
    script.build("left")
    write_traffic(HERE)
    (HERE / "left.rou.xml").unlink()
    files = sorted(HERE.glob("*.net.xml")) + sorted(HERE.glob("*.rou.xml"))
    sums = [f"{hashlib.sha256(file.read_bytes()).hexdigest()}  {file.name}" for file in files]
    (HERE / "SHA256SUMS").write_text("\n".join(sums) + "\n")
