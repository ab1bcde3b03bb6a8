"""A grid: which runs are wanted, what each draws from and depends on, how much of it is stored, and a report on it."""

import contextlib
import json
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from types import SimpleNamespace

import numpy as np

from lifelong_lib.reproduction.backends import Call, completed
from lifelong_lib.reproduction.configurations import canonical, file_name, run_key
from lifelong_lib.reproduction.files import read_json, require, sha256, write_json
from lifelong_lib.reproduction.fingerprint import changes, digests
from lifelong_lib.reproduction.packed import Run


@dataclass(frozen=True)
class Task:
    """One wanted run: what the experiment is given, and everything that the result depends on."""

    config: dict
    seed: int
    call: Call
    depends: dict  # part of the code, input or file -> digest

    def run(self, values: dict, seconds: float, versions: dict) -> Run:
        """The run that came to these values, made now."""
        return Run(self.config, self.seed, values, seconds, self.depends, versions)


@dataclass(frozen=True)
class Grid:
    """An experiment over its tasks (by the names of their runs), beside all runs that are stored under its name."""

    chapter: int
    name: str
    experiment: Callable
    makes: list[str]  # ids of the figures, tables and claims that rest on it
    tasks: dict[str, Task]
    stored: dict[str, Run]

    @cached_property
    def runs(self) -> dict[str, Run]:
        """The stored runs that are wanted."""
        return {key: self.stored[key] for key in self.tasks if key in self.stored}

    @cached_property
    def missing(self) -> list[str]:
        """Names of the wanted runs that are not stored."""
        return [key for key in self.tasks if key not in self.stored]

    @cached_property
    def stale(self) -> dict[str, list[str]]:
        """Names of the wanted runs that are stored but were made by something else, each with the causes."""
        causes = {key: changes(run.made_by, self.tasks[key].depends) for key, run in self.runs.items()}
        return {key: found for key, found in causes.items() if found}

    @property
    def causes(self) -> dict[str, int]:
        """How many runs are stale because of what."""
        return dict(Counter(cause for found in self.stale.values() for cause in found))

    def computed(self, keys: Iterable[str], workers: int, options: Mapping) -> Iterator[Run]:
        """These runs, computed now, in order of completion."""
        calls, place = {key: self.tasks[key].call for key in keys}, options.get("backend", "loky")
        with contextlib.closing(completed(self.experiment, calls, place, workers, options.get("address", ""))) as found:
            yield from (self.tasks[key].run(*made) for key, *made in found)

    @property
    def seconds_per_run(self) -> float | None:
        """Mean wall time of the stored runs; None if there are none."""
        seconds = [run.seconds for run in self.runs.values()]
        return float(np.mean(seconds)) if seconds else None

    def report(self, folder: Path, **more) -> SimpleNamespace:
        """What there is to say of the grid, also left in `folder` for the command, which runs in another process.

        chapter, name, makes, seconds_per_run: those of the grid. wanted, stored (made by this state of the code, or
        stamped), stale, missing, stamped: numbers of runs. causes, stamps: numbers of stale runs by cause, of stamped
        ones by stamp. `more` of what was done: computed, the number of runs; seconds that computing the rest will take,
        None if that is not known; audited, a row a recomputed run.
        """
        stamps = Counter(run.stamp for key, run in self.runs.items() if run.stamp and key not in self.stale)
        said = {"chapter": self.chapter, "name": self.name, "makes": self.makes, "wanted": len(self.tasks),
                "stored": len(self.runs) - len(self.stale), "stale": len(self.stale), "missing": len(self.missing),
                "stamped": sum(stamps.values()), "causes": self.causes, "stamps": dict(stamps),
                "seconds_per_run": self.seconds_per_run, "computed": 0, "seconds": None, "audited": []}  # fmt: skip
        write_json(folder / "runs" / f"ch{self.chapter:02d}-{self.name}.json", said | more)
        return SimpleNamespace(**said | more)


def read_reports(folder: Path) -> list[SimpleNamespace]:
    """What `Grid.report` left in `folder`, one a grid."""
    return [SimpleNamespace(**read_json(path, {})) for path in sorted((folder / "runs").glob("*.json"))]


def make_tasks(chapter: int, name: str, configs, seeds, depends: dict, inputs=None, luck=None) -> dict[str, Task]:
    """Every wanted run by name, in the order of configurations, then seeds; the arguments are those of run_grid.

    depends: what all runs depend on, {part: digest}. A run draws from chapter, name, configuration, inputs and seed,
    or from the entries named by `luck` in place of configuration and inputs.
    """
    require(re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_-]*", name), f"grid name {name!r} may hold letters, digits, - and _")
    require(configs, f"grid '{name}' has no configurations")
    names = Counter(file_name(config).lower() for config in configs)  # some file systems ignore the case
    twice = [text for text, number in names.items() if number > 1]
    require(not twice, f"grid '{name}' has a configuration twice (or two that differ in case only): {twice}")
    if luck is not None:
        require(not isinstance(luck, str), f"luck must be a list of names, not the text {luck!r}")
        depends = depends | {"luck": ", ".join(sorted(luck))}
    tasks, seeds = {}, _sorted_seeds(name, seeds)
    for config, arrays in zip(configs, _inputs_of_each(name, configs, inputs), strict=True):
        drawn_from, parts = _drawn_from(name, config, arrays, luck), depends | digests(arrays)
        for seed in seeds:
            entropy = int(sha256(json.dumps([chapter, name, drawn_from, seed])), 16)
            label = f"experiment '{name}' failed at {canonical(config)}, seed {seed}"
            tasks[run_key(config, seed)] = Task(dict(config), seed, Call(label, config, entropy, arrays), parts)
    return tasks


def whole(value, least: int = 0) -> bool:
    """Whether a value is a whole number, `least` or more."""
    return isinstance(value, int) and not isinstance(value, bool) and value >= least


def _sorted_seeds(name, seeds) -> list[int]:
    seeds = range(seeds) if whole(seeds) else seeds
    good = isinstance(seeds, (list, tuple, range)) and all(map(whole, seeds)) and len(set(seeds)) == len(seeds) > 0
    require(good, f"seeds of '{name}' must be a number above 0 or a list of different whole numbers, not {seeds!r}")
    return sorted(seeds)


def _inputs_of_each(name, configs, inputs) -> list[dict[str, np.ndarray]]:
    """The arrays of every configuration: the same for all, or as many mappings as there are configurations."""
    each = [inputs or {}] * len(configs) if inputs is None or isinstance(inputs, Mapping) else list(inputs)
    require(len(each) == len(configs), f"grid '{name}' has {len(configs)} configurations but {len(each)} inputs")
    for config, arrays in zip(configs, each, strict=True):
        for key, array in arrays.items():
            good = isinstance(array, np.ndarray) and array.dtype.kind in "biufU"
            require(good, f"input {key!r} of '{name}' must be an array of numbers or texts, not {type(array).__name__}")
            require(key not in config, f"{key!r} is both an input and an entry of a configuration of '{name}'")
    return each


def _drawn_from(name, config, inputs, luck) -> str:
    """What, beside chapter, name and seed, decides the random numbers: an input counts as an entry with its numbers."""
    entries = config | {key: json.dumps(array.tolist()) for key, array in inputs.items()}
    if luck is None:
        return canonical(entries)
    unknown = [key for key in luck if key not in entries]
    require(not unknown, f"luck of '{name}' names {', '.join(unknown)}, which a configuration lacks: {config}")
    return canonical({key: entries[key] for key in luck})
