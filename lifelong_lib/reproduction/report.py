"""A run beside the committed reference: the comparison, what is accepted as the new reference, and the provenance.

Everything here is made from files that a run left in `figures/latest/<profile>`. Nothing is measured again.
"""

import csv
import math
import platform
import shutil
from itertools import chain
from pathlib import Path

from matplotlib.image import imread

from lifelong_lib.reproduction.claims import ledger, within_bounds
from lifelong_lib.reproduction.files import ROOT, read_json, require, sha256, write_json
from lifelong_lib.reproduction.grid import read_reports
from lifelong_lib.reproduction.labels import VERDICTS, order
from lifelong_lib.reproduction.machine import commit, versions
from lifelong_lib.reproduction.runs import PROFILES

RESULTS = "[FT]*.*"  # the files of figures and tables


def write_provenance(folder: Path, profile: str, parameters: dict[int, dict]) -> None:
    """Writes provenance.json (what made the results; no dates) and unit_costs.json (seconds a run of each grid).

    parameters: the full parameter values of the chapters that were just run; other chapters keep their entry.
    """
    grids = read_reports(folder)
    chapters = read_json(folder / "provenance.json", {}).get("chapters", {})
    for number, values in parameters.items():
        counts = {grid.name: {"wanted": grid.wanted, "computed": grid.computed, "read": grid.wanted - grid.computed,
                              "stale": grid.stale, "stamped": grid.stamped}
                  for grid in grids if grid.chapter == number}  # fmt: skip
        chapters[f"ch{number:02d}"] = {"parameters": values, "runs": counts}
    write_json(folder / "provenance.json", {
        "profile": profile, "commit": commit(), "lock": sha256((ROOT / "environment.txt").read_bytes()),
        "chapters": chapters, "versions": versions("matplotlib", "rerun-sdk", "joblib", "papermill"),
        "machine": f"{platform.system()} {platform.machine()}",
    })
    costs = {f"ch{grid.chapter:02d}/{grid.name}": grid.seconds_per_run for grid in grids}
    write_json(folder / "unit_costs.json", costs)


def compare(latest: Path, reference: Path) -> dict:
    """Compares every figure and table with the reference: the data first, then the picture, then the verdicts.

    Returns, and writes to `latest`/comparison.json, {"results": [{id, data, picture}], "verdicts": [{id, reference,
    latest}] (those that changed)}.
    """
    names = sorted({path.stem for folder in (latest, reference) for path in folder.glob("[FT]*.csv")}, key=order)
    results = [{"id": name, "data": _compare_files(latest, reference, f"{name}.csv", _compare_data),
                "picture": _compare_files(latest, reference, f"{name}.png", _compare_pictures)} for name in names]
    now, before = ({row["id"]: row["verdict"] for row in read_json(folder / "claims.json", [])}
                   for folder in (latest, reference))
    verdicts = [{"id": name, "reference": before[name], "latest": now[name]}
                for name in sorted(now.keys() & before.keys(), key=order) if now[name] != before[name]]
    comparison = {"results": results, "verdicts": verdicts}
    write_json(latest / "comparison.json", comparison)
    return comparison


def _compare_files(latest: Path, reference: Path, name: str, differ) -> str:
    """One of: identical, what `differ` says, not made, no reference; empty for a table's missing picture."""
    ours, theirs = latest / name, reference / name
    if not theirs.exists():
        return "no reference" if ours.exists() else ""
    if not ours.exists():
        return "not made"
    return "identical" if ours.read_bytes() == theirs.read_bytes() else differ(ours, theirs)


def _compare_data(ours: Path, theirs: Path) -> str:
    first, second = (list(csv.reader(path.read_text().splitlines())) for path in (ours, theirs))
    if [len(row) for row in first] != [len(row) for row in second] or first[:1] != second[:1]:
        return "other rows or columns"
    worst, equal = 0.0, True
    pairs = zip(chain.from_iterable(first), chain.from_iterable(second), strict=True)
    for one, other in [pair for pair in pairs if pair[0] != pair[1]]:
        try:
            gap, size = abs(float(one) - float(other)), max(1.0, abs(float(other)))
        except ValueError:
            return f"other text: '{one}' for '{other}'"
        equal = equal and gap <= 1e-9 * size
        worst = math.inf if math.isnan(gap) else max(worst, gap)
    return "equal within 1e-9" if equal else f"different by at most {worst:.3g}"


def _compare_pictures(ours: Path, theirs: Path) -> str:
    first, second = imread(ours), imread(theirs)
    if first.shape != second.shape:
        return "other size"
    return f"{100 * (first != second).any(axis=-1).mean():.2g} % of its points differ"


def comparison_lines(comparison: dict) -> list[str]:
    """The comparison as a short table for the terminal; what is identical in data and picture is only counted."""
    same = [row for row in comparison["results"] if row["data"] == "identical" and row["picture"] in ("identical", "")]
    lines = [f"{len(same)} of {len(comparison['results'])} figures and tables are identical to the reference"]
    lines += [f"  {row['id']:6} data: {row['data']}" + (f"; picture: {row['picture']}" if row["picture"] else "")
              for row in comparison["results"] if row not in same]
    lines += [f"  {row['id']:6} verdict: {row['reference']} -> {row['latest']}" for row in comparison["verdicts"]]
    return lines


def standings(folder: Path, references: Path) -> list[dict]:
    """Every claim of the ledger as it was judged at the largest scale, by the run in `folder` or for `references`.

    Rows of claims.json, in the ledger's order; at the same scale this run's. What nobody judged is not tested.
    """
    places = [*(references / profile for profile in PROFILES), folder]
    rows = [row for place in places for row in read_json(place / "claims.json", [])]
    judged = {row["id"]: row for row in sorted(rows, key=_scale)}
    return [judged.get(name, entry | {"verdict": "not tested", "profile": "", "because": "it was never judged"})
            for name, entry in ledger().items()]  # fmt: skip


def _scale(row: dict) -> int:
    return -1 if row["verdict"] == "not tested" else PROFILES.index(row["profile"])


def directions(claims: list[dict], standing: list[dict]) -> dict[bool, list[str]]:
    """{True: claims that this run's numbers point the way of their verdict at a larger scale, False: the others}."""
    now, found = {row["id"]: row for row in claims}, {True: [], False: []}
    for row in standing:
        small = now.get(row["id"])
        if small and row["verdict"] in ("holds", "contradicted") and small["profile"] != row["profile"]:
            found[within_bounds(small) == (row["verdict"] == "holds")].append(row["id"])
    return found


def verdict_counts(claims: list[dict]) -> dict[str, int]:
    """{"holds": 3, ...} over the rows of claims.json."""
    return {verdict: sum(row["verdict"] == verdict for row in claims) for verdict in VERDICTS}


def accept(latest: Path, reference: Path) -> int:
    """Makes the results in `latest` the reference; chapters that are not in `latest` keep theirs. Returns how many."""
    made = list(latest.glob(RESULTS))
    require(made, f"there is nothing in {latest} to accept; run `./reproduce.sh run --profile {latest.name}` first")
    claims = read_json(latest / "claims.json", [])
    chapters = {order(name)[1] for name in [path.stem for path in made] + [row["id"] for row in claims]}
    reference.mkdir(parents=True, exist_ok=True)
    for path in list(reference.glob(RESULTS)):
        if order(path.stem)[1] in chapters:
            path.unlink()
    for path in made:
        shutil.copyfile(path, reference / path.name)
    kept = [row for row in read_json(reference / "claims.json", []) if order(row["id"])[1] not in chapters]
    write_json(reference / "claims.json", sorted(kept + claims, key=lambda row: order(row["id"])))
    costs = read_json(reference / "unit_costs.json", {}) | read_json(latest / "unit_costs.json", {})
    write_json(reference / "unit_costs.json", costs)
    return len(made)
