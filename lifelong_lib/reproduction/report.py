"""What a run leaves for its readers: the provenance, where every claim stands, and what is accepted as the reference.

Everything here is made from files that a run left in `figures/latest/<profile>`. Nothing is measured again.
"""

import csv
import math
import platform
import re
import shutil
from pathlib import Path
from textwrap import shorten

from lifelong_lib.reproduction.claims import ledger, within_bounds
from lifelong_lib.reproduction.files import ROOT, read_json, require, sha256, write_json
from lifelong_lib.reproduction.grid import read_reports
from lifelong_lib.reproduction.labels import VERDICTS, order
from lifelong_lib.reproduction.machine import commit, pace, versions
from lifelong_lib.reproduction.runs import PROFILES
from lifelong_lib.reproduction.tables import Table

RESULTS = "[FT]*.*"  # the files of figures and tables


def write_provenance(folder: Path, profile: str, parameters: dict[int, dict], took: dict[int, float]) -> None:
    """Writes provenance.json (what made the results; no dates) and unit_costs.json (as in `machine.unit_costs`).

    parameters: the full parameter values of the chapters that were just run; other chapters keep their entry. took: the
    seconds of these chapters.
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
    costs = read_json(folder / "unit_costs.json", {}) | {"pace": pace()}
    costs |= {f"ch{grid.chapter:02d}/{grid.name}": [grid.seconds_per_run, grid.wanted] for grid in grids}
    for number, seconds in took.items():
        rounds = [math.ceil(grid.computed / parameters[number]["workers"]) * (grid.seconds_per_run or 0)
                  for grid in grids if grid.chapter == number]  # fmt: skip
        costs[f"ch{number:02d}"] = max(0.0, seconds - sum(rounds))
    write_json(folder / "unit_costs.json", costs)


def standings(folder: Path, references: Path) -> list[dict]:
    """Every claim of the ledger as it was judged at the largest scale, by the run in `folder` or for `references`.

    Rows of claims.json, in the ledger's order; at the same scale this run's. What nobody judged is not tested.
    """
    places = [*(references / profile for profile in PROFILES), folder]
    rows = [row for place in places for row in read_json(place / "claims.json", [])]
    judged = {row["id"]: row for row in sorted(rows, key=_scale)}
    return [judged.get(name, entry | {"verdict": "not tested", "profile": "", "because": "it was never judged"})
            for name, entry in ledger().items()]  # fmt: skip


def chapter_verdicts(number: int) -> Table:
    """Return what the committed references say of a chapter's claims, for the top of its notebook: results first.

    ValueError for a chapter without claims.
    """
    references = ROOT / "figures" / "reference"
    rows = [row for row in standings(references / PROFILES[-1], references) if row["chapter"] == number]
    require(rows, f"chapter {number} has no claims")
    return Table([{"claim": row["id"], "the thesis says": row["statement"],
                   "verdict": f"{row['verdict']} {row['profile'] and 'at ' + row['profile']}",
                   "because": shorten(row.get("because", ""), 240, placeholder=" ...")} for row in rows])  # fmt: skip


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


def reading(file: Path) -> str:
    """Return a sentence that reads a figure's data: what is highest and what is lowest in each panel, where lines end.

    Bars are compared label by label, or with each other if there is one series. Empty for pictures and maps.
    """
    with open(file, newline="") as lines:
        rows = list(csv.DictReader(lines))
    if "series" not in rows[0]:
        return ""
    ends = {}
    for row in rows:  # the last row of each series stays, where x is a number
        place = row["x"] if re.search("[a-z]", row["x"], re.IGNORECASE) else ""
        ends.setdefault((row["panel"], place), {})[row["series"]] = row
    if all(len(group) == 1 for group in ends.values()):
        groups = {}
        for (panel, place), group in ends.items():
            groups.setdefault(panel, {}).update({place or name: row for name, row in group.items()})
        ends = {(panel, ""): group for panel, group in groups.items()}
    return "; ".join(_extremes(*where, group) for where, group in ends.items() if len(group) > 1).removeprefix(": ")


def _extremes(panel: str, place: str, group: dict[str, dict]) -> str:
    ordered = sorted(group, key=lambda name: -float(group[name]["mean"]))
    high, low = (f"{name} ({float(group[name]['mean']):.3g})" for name in (ordered[0], ordered[-1]))
    return "".join(f"{part}, " for part in (panel, place) if part)[:-2] + f": highest {high}, lowest {low}"


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
    theirs, ours = (read_json(folder / "unit_costs.json", {}) for folder in (reference, latest))
    slower = theirs["pace"] / ours["pace"] if "pace" in theirs and "pace" in ours else 1.0
    scaled = {name: [cost[0] and cost[0] * slower, cost[1]] if isinstance(cost, list) else cost * slower
              for name, cost in ours.items()}  # fmt: skip
    write_json(reference / "unit_costs.json", theirs | scaled)
    about, old = (read_json(folder / "provenance.json", {}) for folder in (latest, reference))
    write_json(reference / "provenance.json", about | {"chapters": old.get("chapters", {}) | about.get("chapters", {})})
    return len(made)
