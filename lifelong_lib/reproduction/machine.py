"""What computes here: the commit of the code, the versions of what learning runs use, the processor and its pace."""

import contextlib
import platform
import re
import subprocess
import timeit
from functools import cache
from importlib import metadata
from pathlib import Path

from lifelong_lib.reproduction.children import surroundings
from lifelong_lib.reproduction.files import ROOT, read_json, sha256

PACKAGES = ("numpy", "scipy", "scikit-learn", "torch", "gymnasium", "pybullet", "libsumo")


def commit() -> str:
    """The commit that the repository is at, and whether files other than results and figures differ from it."""
    code = ("--", ":/", ":(exclude,top)data/results", ":(exclude,top)figures")
    try:
        changed = _git("status", "--porcelain", "--untracked-files=no", *code)
        return _git("rev-parse", "HEAD") + (" with changes" if changed else "")
    except (OSError, subprocess.CalledProcessError):
        return "unknown (no git history here)"


def _git(*words: str) -> str:
    command = ["git", "-C", str(ROOT), *words]
    return subprocess.run(command, env=surroundings(), capture_output=True, text=True, check=True).stdout.strip()


def versions(*more: str) -> dict[str, str]:
    """Of Python, the processor, what learning runs compute with, and more packages."""
    found = {"python": platform.python_version(), "processor": processor()}
    for package in PACKAGES + more:
        with contextlib.suppress(metadata.PackageNotFoundError):  # of a simulator that another chapter needs
            found[package] = metadata.version(package)
    return found


@cache
def checkout() -> str:
    """Digest of the library and the data it reads, as this process found them: a worker goes on with what it has."""
    here = Path(__file__).resolve().parents[2]
    names = ("lifelong_lib/**/*.py", "data/*/SHA256SUMS", "data/*/*/SHA256SUMS", "data/*/*.csv")
    files = sorted(path for name in names for path in here.glob(name))
    return sha256("".join(f"{path.relative_to(here)} {sha256(path.read_bytes())}\n" for path in files))[:12]


def processor() -> str:
    """Vendor, family and model: linear algebra rounds differently on different ones. "GenuineIntel 6 143", "arm64"."""
    linux = Path("/proc/cpuinfo")
    entries = re.findall(r"(?m)^(vendor_id|cpu family|model)\s*: (.+)", linux.read_text() if linux.exists() else "")
    return " ".join(dict(entries).values()) or platform.processor() or platform.machine()


@cache
def pace() -> float:
    """Seconds that a fixed piece of work takes here, in plain Python like most of a chapter; the shortest of three."""
    return min(timeit.repeat("sum(number * number % 7 for number in range(1_000_000))", number=1, repeat=3))


def unit_costs(reference: Path) -> dict:
    """What the reference took, in seconds of this machine: {"ch02/lives": (of a run, runs), "ch02": all the rest}."""
    costs = read_json(reference / "unit_costs.json", {})
    slower = pace() / costs.pop("pace", pace())
    return {name: (cost[0] * slower, cost[1]) if isinstance(cost, list) else cost * slower
            for name, cost in costs.items() if cost != [None, 0]}  # fmt: skip
