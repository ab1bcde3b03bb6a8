"""Two runs side by side: what differs in data, pictures, verdicts and in what made them, in words and as a web page.

Everything here is made from files that runs left in `figures/latest/<profile>`, or that were accepted as a reference.
"""

import csv
import math
import shutil
from pathlib import Path

import numpy as np
from matplotlib import image

from lifelong_lib.reproduction.configurations import flat
from lifelong_lib.reproduction.files import read_json, write_json
from lifelong_lib.reproduction.labels import order
from lifelong_lib.reproduction.templates import PAGES, page

PICTURES = ("A", "B", "difference")
ROUNDING = 1e-9  # two numbers as near to each other, in parts of the largest one of their column, are equal


def compare(latest: Path, reference: Path, tolerance: float = ROUNDING) -> dict:
    """Compares all chapters that `latest` made something of; returns, and writes to `latest`/comparison.json:

    results: [{id, data, picture, cells, matters}], the first two in words; cells that differ, the largest difference
    first (at most ten), but for rows headed seconds; matters: whether one is beyond the ``tolerance``, in parts of
    the largest number of its column.
    verdicts: [{id, reference, latest}] of those that changed. moved: [{id, label, reference, latest, interval}] of
    numbers outside the other run's interval. made: [{what, reference, latest}] of what differs in versions, processor
    and settings. not_made_now: {latest, reference: [words]} about stale and stamped runs. rounding: whether another
    processor explains what differs, as no verdict and no number of a claim moved. same: whether nothing matters.
    """
    now, before = ({path.stem for path in folder.glob("[FT]*.csv")} for folder in (latest, reference))
    names = now | {name for name in before if order(name)[1] in {order(other)[1] for other in now}}
    results = [_compare_result(latest, reference, name, tolerance) for name in sorted(names, key=order)]
    verdicts, moved = _compare_claims(*(read_json(folder / "claims.json", []) for folder in (latest, reference)))
    about = [read_json(folder / "provenance.json", {}) for folder in (latest, reference)]
    made = _differing(*(_said(each) for each in about))
    missing = any(row["data"] in ("not made", "no reference") for row in results)
    rounding = any(row["what"] == "versions processor" for row in made) and not (missing or verdicts or moved)
    same = not verdicts and not missing and (rounding or not any(row["matters"] for row in results))
    found = {"results": results, "verdicts": verdicts, "moved": moved, "made": made, "rounding": rounding, "same": same,
             "not_made_now": {name: _stale(each) for name, each in zip(("latest", "reference"), about, strict=True)}}
    write_json(latest / "comparison.json", found)
    return found


def _compare_result(latest: Path, reference: Path, name: str, tolerance: float) -> dict:
    data, cells = _compare_files(latest, reference, f"{name}.csv", _compare_data)
    picture, _ = _compare_files(latest, reference, f"{name}.png", _compare_pictures)
    beyond = any(_beyond(cell, tolerance) for cell in cells) or data == "other rows or columns"
    return {"id": name, "data": data, "picture": picture, "cells": cells[:10], "matters": beyond}


def _compare_files(latest: Path, reference: Path, name: str, differ) -> tuple[str, list]:
    """One of: identical, what `differ` says, not made, no reference; empty for a table's missing picture."""
    ours, theirs = latest / name, reference / name
    if not theirs.exists():
        return "no reference" if ours.exists() else "", []
    if not ours.exists():
        return "not made", []
    return ("identical", []) if ours.read_bytes() == theirs.read_bytes() else differ(ours, theirs)


def _compare_data(ours: Path, theirs: Path) -> tuple[str, list]:
    """What to say of two tables, and their cells that differ: {share, size, place, column, reference, latest}."""
    first, second = (list(csv.reader(path.read_text().splitlines())) for path in (ours, theirs))
    if [len(row) for row in first] != [len(row) for row in second] or first[:1] != second[:1]:
        return "other rows or columns", []
    header, cells = first[0], []
    timed = [now[0].startswith("seconds") for now in first]  # rows headed so were measured: no two runs take the same
    columns = zip(*second[1:], strict=True)
    sizes = [max(abs(_number(text)) for text in column) or 1.0 for column in columns]
    for now, before, passed_over in zip(first[1:], second[1:], timed[1:], strict=True):
        for column, (one, other) in enumerate(zip(now, before, strict=True)):
            if one != other and not passed_over:
                gap = _gap(one, other)
                place = ", ".join(f"{header[i]} {now[i]}" for i in range(min(column, 3)))
                cells.append({"share": None if gap is None else gap / sizes[column], "size": gap, "place": place,
                              "column": header[column], "reference": other, "latest": one})  # fmt: skip
    cells.sort(key=lambda cell: -math.inf if cell["share"] is None else -cell["share"])
    if cells and cells[0]["share"] is None:
        return f"other text: '{cells[0]['latest']}' for '{cells[0]['reference']}'", cells
    if not any(_beyond(cell, ROUNDING) for cell in cells):
        return "equal within 1e-9" + " but for measured seconds" * any(timed), cells
    return f"different by at most {max(cell['size'] for cell in cells):.3g}", cells


def _beyond(cell: dict, tolerance: float) -> bool:
    return cell["share"] is None or cell["share"] > tolerance


def _gap(one: str, other: str) -> float | None:
    """How far apart two cells such as "0.5 ± 0.1" are in any of their numbers; None if anything else differs."""
    words = list(zip(one.split(), other.split(), strict=False))
    if len(one.split()) != len(other.split()):
        return None
    gaps = [abs(_number(a, math.nan) - _number(b, math.nan)) for a, b in words if a != b]
    return None if any(map(math.isnan, gaps)) else max(gaps, default=0.0)


def _number(text: str, otherwise: float = 0.0) -> float:
    """The number that a cell begins with."""
    try:
        number = float(text.partition(" ")[0])
    except ValueError:
        return otherwise
    return number if math.isfinite(number) else otherwise


def _compare_pictures(ours: Path, theirs: Path) -> tuple[str, list]:
    first, second = image.imread(ours), image.imread(theirs)
    if first.shape != second.shape:
        return "other size", []
    return f"{100 * (first != second).any(axis=-1).mean():.2g} % of its points differ", []


def _compare_claims(latest: list[dict], reference: list[dict]) -> tuple[list[dict], list[dict]]:
    """Verdicts that changed, and numbers that are outside the other run's interval."""
    now, before = ({row["id"]: row for row in rows} for rows in (latest, reference))
    both = sorted(now.keys() & before.keys(), key=order)
    verdicts = [{"id": name, "reference": before[name]["verdict"], "latest": now[name]["verdict"]}
                for name in both if now[name]["verdict"] != before[name]["verdict"]]  # fmt: skip
    pairs = [(name, part, {old["label"]: old for old in before[name].get("parts", [])}.get(part["label"]))
             for name in both for part in now[name].get("parts", [])]  # fmt: skip
    moved = [{"id": name, "label": part["label"], "reference": old["measured"], "latest": part["measured"],
              "interval": old["interval"]}
             for name, part, old in pairs if old and not (_inside(part, old) and _inside(old, part))]  # fmt: skip
    return verdicts, moved


def _inside(part: dict, other: dict) -> bool:
    low, high = other["interval"] or (-math.inf, math.inf)
    slack = ROUNDING * max(1.0, abs(part["measured"]))
    return low - slack <= part["measured"] <= high + slack


def _said(about: dict) -> dict[str, str]:
    """Provenance as {words: value}, without what is told elsewhere."""
    said = {key: str(about[key]) for key in ("profile", "commit", "lock", "machine") if key in about}
    said |= {f"versions {package}": version for package, version in about.get("versions", {}).items()}
    for chapter, made in about.get("chapters", {}).items():
        said |= {f"{chapter} {name}": str(value) for name, value in flat(made["parameters"]).items()}
    return {name: value for name, value in said.items() if not name.endswith((" output_dir", " workers"))}


def _differing(now: dict[str, str], before: dict[str, str]) -> list[dict]:
    names = [name for name in (*now, *(before.keys() - now.keys())) if now.get(name) != before.get(name)]
    return [{"what": name, "reference": before.get(name, "unknown"), "latest": now.get(name, "unknown")}
            for name in names if name in before or not name.startswith("ch")]  # fmt: skip


def _stale(about: dict) -> list[str]:
    return [f"{chapter} {grid}: {counts[kind]} of {counts['wanted']} runs {kind}"
            for chapter, made in about.get("chapters", {}).items() for grid, counts in made["runs"].items()
            for kind in ("stale", "stamped") if counts.get(kind)]  # fmt: skip


def comparison_lines(comparison: dict) -> list[str]:
    """The comparison as a short table for the terminal; what is identical in data and picture is only counted."""
    same = [row for row in comparison["results"] if _identical(row)]
    lines = [f"{len(same)} of {len(comparison['results'])} figures and tables are identical to the reference"]
    if comparison["rounding"] and len(same) < len(comparison["results"]):
        lines[0] += "; the others differ within what another processor gives"
    lines += [f"  {row['id']:6} data: {row['data']}" + (f"; picture: {row['picture']}" if row["picture"] else "")
              for row in comparison["results"] if row not in same]  # fmt: skip
    lines += [f"  {row['id']:6} verdict: {row['reference']} -> {row['latest']}" for row in comparison["verdicts"]]
    lines += [f"  {row['id']:6} {row['label']}: {row['reference']:.3g} -> {row['latest']:.3g}, outside the interval"
              for row in comparison["moved"]]  # fmt: skip
    return lines


def write_page(comparison: dict, latest: Path, reference: Path, folder: Path) -> Path:
    """Writes `folder`/index.html, which shows what differs first, both pictures and their difference; returns it."""
    folder.mkdir(parents=True, exist_ok=True)
    for ending in PICTURES:  # of an earlier comparison; the folder may be the reader's, and hold other things
        for old in folder.glob(f"[FT]*.*-{ending}.png"):
            old.unlink()
    differs = [row | {"pictures": _pictures(latest / f"{row['id']}.png", reference / f"{row['id']}.png", folder)}
               for row in sorted(comparison["results"], key=lambda row: not row["matters"])
               if not _identical(row)]  # fmt: skip
    text = page("comparison.html", comparison=comparison, latest=latest, reference=reference, differs=differs,
                style=(PAGES / "book.css").read_text())  # fmt: skip
    (folder / "index.html").write_text(text)
    return folder / "index.html"


def _identical(row: dict) -> bool:
    return row["data"] == "identical" and row["picture"] in ("identical", "")


def _pictures(ours: Path, theirs: Path, folder: Path) -> list[tuple[str, str]]:
    """Copies both pictures, draws where they differ, and returns (caption, file) of each that there is."""
    shown = []
    for caption, path in (("A", ours), ("B", theirs)):
        if path.exists():
            shutil.copyfile(path, folder / f"{path.stem}-{caption}.png")
            shown.append((caption, f"{path.stem}-{caption}.png"))
    if len(shown) == 2:
        first, second = (image.imread(path)[..., :3] for path in (ours, theirs))
        if first.shape == second.shape:
            away = np.abs(first - second).max(axis=-1, keepdims=True) > 0.05
            faded = (0.75 + 0.25 * second.mean(axis=-1, keepdims=True)).repeat(3, axis=-1)
            image.imsave(folder / f"{ours.stem}-difference.png", np.where(away, [0.84, 0.37, 0.0], faded))
            shown.append(("where they differ", f"{ours.stem}-difference.png"))
    return shown
