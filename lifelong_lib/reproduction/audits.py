"""Audits: stored runs are computed again and must come out the same."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from lifelong_lib.reproduction.grid import Grid
from lifelong_lib.reproduction.store import Store


def audit(grid: Grid, results: Path, workers: int, options: Mapping) -> list[dict]:
    """A row for each of this grid's share of the options["audit"] runs drawn from all under `results`, by name.

    {run, same, differs (names of results, and by how much), stale, made_on}. Values whose names begin with `seconds`
    are measured times and not compared.
    """
    share = _share(grid, results, options["audit"])
    rows = []
    for key, values, _ in grid.computed(share, workers, options):
        stored = grid.runs[key]
        differs = differences(stored.values, values)
        rows.append({"run": f"{grid.name}/{key}", "same": not differs, "differs": differs, "stale": key in grid.stale,
                     "made_on": stored.versions.get("processor", "one unknown")})  # fmt: skip
    return sorted(rows, key=lambda row: row["run"])


def differences(old: Mapping, new: Mapping) -> list[str]:
    """What is not identical in two runs' values, e.g. ["curve by 2e-16 at most"]."""
    names = sorted(name for name in old.keys() | new.keys() if not name.startswith("seconds"))
    found = {name: _difference(old.get(name), new.get(name)) for name in names}
    return [f"{name} {said}" for name, said in found.items() if said]


def _difference(old, new) -> str:
    if old is None or new is None:
        return "is new" if old is None else "is gone"
    if old.dtype != new.dtype or old.shape != new.shape:
        return f"of {new.dtype} {new.shape}, not {old.dtype} {old.shape}"
    if old.tobytes() == new.tobytes():
        return ""
    if old.dtype.kind != "f":
        return f"at {np.sum(old != new)} of {old.size} places"
    return f"by {np.max(np.abs(old - new)):.2g} at most"


def _share(grid, results, number) -> list[str]:
    """The runs of this grid among `number` drawn from the whole chapter: the same draw for every grid."""
    folders = sorted(path for path in results.iterdir() if path.is_dir())
    names = [(folder.name, key) for folder in folders for key in Store(folder, grid.chapter, folder.name).keys()]
    order = np.random.default_rng(number).permutation(len(names))[:number]
    drawn = [names[i] for i in order]
    return [key for key in grid.tasks if (grid.name, key) in drawn]
