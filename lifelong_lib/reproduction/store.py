"""Where the runs of one grid are stored: loose while it is computed, packed when it is finished.

`<grid>.loose/` has a pair of files a run, `<grid>/` the three files of packed.py. A kill at any moment loses nothing:
packed files are written beside the old ones and renamed, and only then do the loose ones go. What is damaged is named,
set aside and never read.
"""

import contextlib
import os
import shutil
from collections.abc import Mapping
from pathlib import Path

from lifelong_lib.reproduction.children import warn
from lifelong_lib.reproduction.files import explained, require, seal, sha256, unseal, write_atomically
from lifelong_lib.reproduction.packed import UNREADABLE, Run, from_npz, pack, to_npz, unpack


class Store:
    """The runs of one grid.

    folder: of the packed grid; the others stand beside it. chapter and name: of the grid, which files must repeat.
    """

    def __init__(self, folder: Path, chapter: int, name: str):
        self.folder, self.identity = folder, {"chapter": chapter, "name": name}
        self.loose, self.part, self.old = (folder.with_name(folder.name + end) for end in (".loose", ".part", ".old"))

    def read(self, keep: bool = False) -> dict[str, Run]:
        """All stored runs by name. What is damaged is named on the terminal and, unless `keep`, set aside."""
        runs = self._read_packed(keep)
        for record in sorted(self.loose.glob("*.json")):
            run = self._read_loose(record, keep)
            if run is not None:
                runs[run.key] = run  # it was computed later
        return runs

    def add(self, run: Run) -> None:
        """Store one run, loose. It counts once its record is there: half a pair is never read."""
        values, record = self.loose / f"{run.key}.npz", self.loose / f"{run.key}.json"
        data = to_npz(run.values)
        content = {"config": run.config, "seed": run.seed, "seconds": run.seconds, "fingerprint": run.made_by}
        content |= {"versions": run.versions, "stamp": run.stamp, "sha256": sha256(data)}
        record.unlink(missing_ok=True)
        write_atomically(values, data)
        write_atomically(record, seal(content | self.identity))

    @property
    def packed(self) -> bool:
        """Whether the grid is packed, with nothing left beside it."""
        return self.folder.exists() and not any(map(Path.exists, (self.part, self.old))) and not self._loose_files()

    def pack(self, runs: Mapping[str, Run]) -> None:
        """Make `runs`, which must be all that are stored, the packed grid."""
        with explained(self.folder):
            for name, data in pack(runs.values(), self.identity).items():
                write_atomically(self.part / name, data)
            if self._place() == self.folder:
                shutil.rmtree(self.old, ignore_errors=True)
                os.replace(self.folder, self.old)
            os.replace(self.part, self.folder)
            shutil.rmtree(self.old, ignore_errors=True)
            for file in self._loose_files():
                file.unlink()
            with contextlib.suppress(OSError):  # what was set aside stays
                self.loose.rmdir()

    def _loose_files(self) -> list[Path]:
        """Records first: without them, the rest is not read."""
        return [file for end in ("json", "npz", "part") for file in sorted(self.loose.glob(f"*.{end}"))]

    def _place(self) -> Path:
        """Where the packed grid stands: still in `old` if a kill came between two renames."""
        return self.folder if self.folder.is_dir() and any(self.folder.iterdir()) else self.old

    def _read_packed(self, keep: bool) -> dict[str, Run]:
        place = self._place()
        if not place.exists():
            return {}
        try:
            return {run.key: run for run in unpack(place, self.identity)}
        except UNREADABLE as error:
            warn(f"stored grid {place} is damaged and not used ({error}): restore it, or all its runs are made again")
        if not keep:
            aside = self.folder.with_name(self.folder.name + ".damaged")
            shutil.rmtree(aside, ignore_errors=True)
            os.replace(place, aside)
        return {}

    def _read_loose(self, record: Path, keep: bool) -> Run | None:
        values = record.with_suffix(".npz")
        try:
            content, data = unseal(record.read_bytes()), values.read_bytes()
            require(sha256(data) == content["sha256"], "its bytes are not those that were written")
            require(self.identity.items() <= content.items(), "it belongs to another grid")
            run = Run(content["config"], content["seed"], from_npz(data), content["seconds"], content["fingerprint"],
                      content["versions"], content["stamp"])  # fmt: skip
            require(run.key == record.stem, "it holds another run")
            return run
        except UNREADABLE as error:
            warn(f"stored run {values} is damaged and not used: {error}")
        for file in (values, record):
            if file.exists() and not keep:
                os.replace(file, f"{file}.damaged")
        return None
