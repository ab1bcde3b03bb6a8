"""Audits: stored runs are computed again and must come out the same. Where they do, a stamp says so.

Linear algebra rounds differently on other processors, so a machine of another family cannot give stored bytes back.
There the code that made the runs computes some of them again (`audit --values`), and today's is held against those.
"""

import json
from collections import Counter
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from lifelong_lib.reproduction.configurations import canonical
from lifelong_lib.reproduction.files import require, sha256
from lifelong_lib.reproduction.fingerprint import changes
from lifelong_lib.reproduction.grid import Grid
from lifelong_lib.reproduction.machine import commit
from lifelong_lib.reproduction.packed import Run, group_of
from lifelong_lib.reproduction.store import Store


def audit(grid: Grid, results: Path, workers: int, options: Mapping) -> list[dict]:
    """A row for each run of the grid that was computed again, by name: {run, same, differs, compared, stale, made_on}.

    options["audit"]: their number, drawn from all runs under `results` or, with options["stamp"] or ["values"], from
    this grid alone. options["values"]: a folder that keeps what was computed. options["beside"]: such a folder, which
    the code that made the stored runs has filled on this machine; it stands in the place of the stored values.
    Values whose names begin with `seconds` are measured times and not compared.
    """
    number, rows = options["audit"], []
    alone = options.get("stamp") or options.get("values")
    share = _spread(grid, number) if alone else _share(grid, results, number)
    known = grid.runs
    folder = Path(options.get("values") or options.get("beside") or "")  # never both
    kept = Store(folder / results.name / grid.name, grid.chapter, grid.name)
    if options.get("beside"):
        if not grid.stale:
            return []
        known = _made_here(grid, kept, number)
        share = list(known)
    for run in grid.computed(share, workers, options):
        key = run.key
        compared, differs = differences(known[key].values, run.values)
        rows.append({"run": f"{grid.name}/{key}", "same": not differs, "differs": differs, "compared": compared,
                     "stale": key in grid.stale, "made_on": known[key].versions.get("processor", "one unknown")})
        if options.get("values"):
            kept.add(run)
    return sorted(rows, key=lambda row: row["run"])


def stamped(grid: Grid, rows: list[dict], beside: bool = False) -> dict[str, Run]:
    """All stored runs of a grid whose audit found no difference: stale ones count as made by today's code from now on.

    Their stamp says how many runs were computed again, at which commit, and whether `beside` the code that made them.
    """
    how = " beside the code that made them, on one machine" if beside else ""
    stamp = f"audited {len(rows)} of {len(grid.tasks)}{how} at commit {commit()}"
    if not any(row["compared"] for row in rows):
        stamp += ", with nothing to compare but measured times"
    new = {key: replace(grid.runs[key], made_by=grid.tasks[key].depends, stamp=stamp) for key in grid.stale}
    return grid.stored | new


def differences(old: Mapping, new: Mapping) -> tuple[int, list[str]]:
    """How many results were compared, and which are not identical, e.g. ["curve by 2e-16 at most"]."""
    names = sorted(name for name in old.keys() | new.keys() if not name.startswith("seconds"))
    found = {name: _difference(old.get(name), new.get(name)) for name in names}
    return len(names), [f"{name} {said}" for name, said in found.items() if said]


def _made_here(grid: Grid, store: Store, number: int) -> dict[str, Run]:
    """`number` runs of the grid that `store` has. Raises ReproductionError if they are fewer, or of other code."""
    found = {key: run for key, run in store.read(keep=True).items() if key in grid.tasks}
    require(len(found) >= min(number, len(grid.tasks)),
            f"{store.folder} has {len(found)} runs of '{grid.name}', not {number}: fill it with audit --values")
    for key, run in found.items():
        others = changes(grid.runs[key].made_by, run.made_by)
        require(not others, f"{store.folder} is not of the code that made the stored {key}: {', '.join(others)}")
    return dict(list(found.items())[:number])


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


def _spread(grid, number) -> list[str]:
    """Names of `number` runs, stale ones if there are any: another draw at every commit, spread over the codes and
    machines that made them and over configurations."""
    names = sorted(grid.stale or grid.runs)
    traits = {name: (json.dumps(group_of(grid.runs[name]), sort_keys=True), canonical(grid.tasks[name].config))
              for name in names}  # fmt: skip
    draw = np.random.default_rng(int(sha256(f"{commit()} {grid.name}"), 16))
    left = [names[i] for i in draw.permutation(len(names))]
    taken, drawn = Counter(), []
    for _ in range(min(number, len(left))):
        drawn.append(min(left, key=lambda name: [taken[trait] for trait in traits[name]]))
        left.remove(drawn[-1])
        taken.update(traits[drawn[-1]])
    return drawn


def _share(grid, results, number) -> list[str]:
    """The runs of this grid among `number` drawn from the whole chapter: the same draw for every grid."""
    grids = sorted({path.name.partition(".")[0] for path in results.iterdir()})
    names = [(name, key) for name in grids for key in sorted(Store(results / name, grid.chapter, name).read(keep=True))]
    order = np.random.default_rng(number).permutation(len(names))[:number]
    drawn = [names[i] for i in order]
    return [key for key in grid.tasks if (grid.name, key) in drawn]
