"""A finished grid as three files that a person can read; nothing is pickled.

values.npz   one array a result, its first axis being the rows of the table. Where runs differ in shape, or lack the
             result, there are arrays `curve/0`, `curve/1`, ... and `curve/0/runs` has the rows that the first is for.
runs.csv     a row a run: its group in the record, configuration, seed, wall seconds, digests of its inputs, and, to
             read, its results that are single numbers or texts (exactly as they stand in values.npz).
record.json  groups of runs that were made by the same: fingerprint, versions (with the processor), and the stamp of
             an audit; the checksums of the two other files and of itself.
"""

import csv
import io
import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lifelong_lib.reproduction.configurations import file_name, from_cell, run_key, to_cell
from lifelong_lib.reproduction.files import require, seal, sha256, unseal

VALUES, TABLE, RECORD = "values.npz", "runs.csv", "record.json"
UNREADABLE = (ValueError, KeyError, TypeError, AttributeError, IndexError, FileNotFoundError)


@dataclass(frozen=True)
class Run:
    """One run: its values (name -> array, of shape () for a number), wall time [s], and what made it."""

    config: dict
    seed: int
    values: dict
    seconds: float
    made_by: dict  # the fingerprint: part of the code, input or file -> digest
    versions: dict
    stamp: str = ""  # how an audit found the runs of other code to be those of `made_by`; empty if that made them

    @property
    def key(self) -> str:
        """Its name within the grid."""
        return run_key(self.config, self.seed)


def pack(runs: Iterable[Run], identity: Mapping) -> dict[str, bytes]:
    """The files of a grid by name, the record last; the same runs in any order give the same bytes.

    identity: entries of the record that say which grid it is.
    """
    runs = sorted(runs, key=lambda run: (file_name(run.config), run.seed))
    groups, rows = {}, []
    for run in runs:
        content = json.dumps(group_of(run), sort_keys=True)
        number = groups.setdefault(content, len(groups))
        rows.append({"group": number} | _row_of(run))
    values, table = to_npz(_stacked(runs)), _to_csv(rows)
    record = {"groups": [json.loads(content) for content in groups]}
    record["files"] = {VALUES: sha256(values), TABLE: sha256(table)}
    return {VALUES: values, TABLE: table.encode(), RECORD: seal(dict(identity) | record).encode()}


def unpack(folder: Path, identity: Mapping) -> list[Run]:
    """The runs of a packed grid. Raises an error of UNREADABLE if a byte of a file is not as written."""
    record = unseal((folder / RECORD).read_bytes())
    data = {name: (folder / name).read_bytes() for name in (VALUES, TABLE)}
    for name, content in data.items():
        require(sha256(content) == record["files"][name], f"the bytes of {name} are not those that were written")
    require(identity.items() <= record.items(), "it holds another grid")
    rows = list(csv.DictReader(io.StringIO(data[TABLE].decode(), newline="")))
    values = _unstacked(from_npz(data[VALUES]), len(rows))
    return [_run_of(row, found, record["groups"]) for row, found in zip(rows, values, strict=True)]


def to_npz(values: Mapping) -> bytes:
    """An npz file with the same bytes for the same values: names sorted, no dates, no pickle."""
    buffer = io.BytesIO()
    np.savez_compressed(buffer, allow_pickle=False, **dict(sorted(values.items())))
    return buffer.getvalue()


def from_npz(data: bytes) -> dict[str, np.ndarray]:
    """The arrays of an npz file by name."""
    with np.load(io.BytesIO(data), allow_pickle=False) as arrays:
        return dict(arrays)


def group_of(run: Run) -> dict:
    """What made a run, and many others of its grid: without its inputs, which stand in the table."""
    parts = {part: digest for part, digest in run.made_by.items() if not part.startswith("input ")}
    return {"fingerprint": parts, "versions": run.versions, "stamp": run.stamp}


def _row_of(run: Run) -> dict:
    row = {f"config.{name}": to_cell(value) for name, value in run.config.items()}
    row |= {"seed": run.seed, "seconds": repr(run.seconds)}
    row |= {f"input.{part[6:]}": digest for part, digest in run.made_by.items() if part.startswith("input ")}
    return row | {f"result.{name}": array.item() for name, array in run.values.items() if array.ndim == 0}


def _run_of(row: Mapping, values: dict, groups: list) -> Run:
    """The run of a row of the table; an empty cell is an entry that it does not have."""
    group = groups[int(row["group"])]
    cells = {column: cell for column, cell in row.items() if cell}
    config = {column[7:]: from_cell(cell) for column, cell in cells.items() if column.startswith("config.")}
    inputs = {f"input {column[6:]}": cell for column, cell in cells.items() if column.startswith("input.")}
    return Run(config, int(row["seed"]), values, float(row["seconds"]), group["fingerprint"] | inputs,
               group["versions"], group["stamp"])  # fmt: skip


def _to_csv(rows: list[dict]) -> str:
    """The table, its columns in a fixed order: group, configuration, seed, seconds, inputs, results."""
    kinds = ("group", "config.", "seed", "seconds", "input.", "result.")
    found = sorted({column for row in rows for column in row})
    columns = [column for kind in kinds for column in found
               if column == kind or kind.endswith(".") and column.startswith(kind)]  # fmt: skip
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def _stacked(runs: list[Run]) -> dict[str, np.ndarray]:
    members = {}
    for name in sorted({name for run in runs for name in run.values}):
        alike = {}  # (type, shape) -> rows
        for row, run in enumerate(runs):
            if name in run.values:
                alike.setdefault((run.values[name].dtype.str, run.values[name].shape), []).append(row)
        for number, rows in enumerate(alike.values()):
            array = np.stack([runs[row].values[name] for row in rows])
            if len(rows) == len(runs):
                members[name] = array
            else:
                members |= {f"{name}/{number}": array, f"{name}/{number}/runs": np.array(rows)}
    return members


def _unstacked(members: Mapping, count: int) -> list[dict[str, np.ndarray]]:
    """The values of each of `count` runs."""
    values = [{} for _ in range(count)]
    for member, array in members.items():
        name, *parts = member.split("/")
        if parts[1:]:  # the rows that another member is for
            continue
        rows = members[f"{member}/runs"] if parts else range(count)
        for place, row in enumerate(rows):
            values[row][name] = array[place, ...]
    return values
