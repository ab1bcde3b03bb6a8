"""Where the runs of one grid are stored. Nothing is pickled; what is damaged is named and never read."""

import json
import os
import sys
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

import numpy as np

from lifelong_lib.reproduction.configurations import run_key
from lifelong_lib.reproduction.files import require, sha256, write_atomically, write_json

UNREADABLE = (ValueError, KeyError, TypeError, AttributeError, FileNotFoundError)


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


class Store:
    """The runs of one grid in a folder, a pair of files each; a run counts once its record is there."""

    def __init__(self, folder: Path, chapter: int, name: str):
        self.folder, self.identity = folder, {"chapter": chapter, "name": name}

    def keys(self) -> list[str]:
        """The names of the stored runs, sorted."""
        return sorted(path.stem for path in self.folder.glob("*.json"))

    def read(self, keep: bool = False) -> dict[str, Run]:
        """All stored runs by name. Damaged ones are named on the terminal and, unless `keep`, set aside."""
        runs = {key: self._read(key, keep) for key in self.keys()}
        return {key: run for key, run in runs.items() if run is not None}

    def add(self, run: Run) -> None:
        """Store one run: half a pair is never read, for the record is written last."""
        values, record = self._paths(run.key)
        data = to_npz(run.values)
        content = {"config": run.config, "seed": run.seed, "seconds": run.seconds, "fingerprint": run.made_by}
        content |= {"versions": run.versions, "stamp": run.stamp, "sha256": sha256(data)}
        record.unlink(missing_ok=True)
        write_atomically(values, data)
        write_json(record, content | self.identity)

    def _paths(self, key: str) -> tuple[Path, Path]:
        return self.folder / f"{key}.npz", self.folder / f"{key}.json"

    def _read(self, key: str, keep: bool) -> Run | None:
        values, record = self._paths(key)
        try:
            content, data = json.loads(record.read_bytes()), values.read_bytes()
            require(sha256(data) == content["sha256"], "its bytes are not those that were written")
            require(self.identity.items() <= content.items(), "it belongs to another grid")
            run = Run(content["config"], content["seed"], from_npz(data), float(content["seconds"]),
                      dict(content["fingerprint"]), dict(content["versions"]), content["stamp"])  # fmt: skip
            require(run.key == key, "it holds another run")
            return run
        except UNREADABLE as error:
            warn(f"stored run {values} is damaged and not used: {error}")
        for file in (values, record):
            if file.exists() and not keep:
                os.replace(file, f"{file}.damaged")
        return None


def to_npz(values: dict) -> bytes:
    """An npz file with the same bytes for the same values: names sorted, no dates, no pickle."""
    buffer = BytesIO()
    np.savez(buffer, allow_pickle=False, **dict(sorted(values.items())))
    return buffer.getvalue()


def from_npz(data: bytes) -> dict[str, np.ndarray]:
    """The arrays of an npz file by name."""
    with np.load(BytesIO(data), allow_pickle=False) as arrays:
        return dict(arrays)


def warn(message: str) -> None:
    """One line on standard error: warnings.warn would put this machine's paths into the notebook."""
    print(f"warning: {message}", file=sys.stderr)
