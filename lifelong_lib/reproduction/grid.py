"""A grid: which runs are wanted, what each draws from and depends on, how much of it is stored, and its summary."""

import json
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path

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

    def computed(self, keys: Iterable[str], workers: int, options: Mapping) -> Iterator[tuple]:
        """(name, values, wall seconds) of these runs, computed now, in order of completion."""
        calls = {key: self.tasks[key].call for key in keys}
        return completed(self.experiment, calls, options.get("backend", "loky"), workers, options.get("address", ""))

    def summary(self, **more) -> "Summary":
        """What there is to say of it."""
        stamps = Counter(run.stamp for key, run in self.runs.items() if run.stamp and key not in self.stale)
        found = {"wanted": len(self.tasks), "stored": len(self.runs) - len(self.stale), "stale": len(self.stale)}
        found |= {"missing": len(self.missing), "causes": self.causes, "stamps": dict(stamps)}
        seconds = [run.seconds for run in self.runs.values()]
        found["seconds_per_run"] = float(np.mean(seconds)) if seconds else None
        return Summary(self.chapter, self.name, self.makes, **found | more)


@dataclass(frozen=True)
class Summary:
    """What a command did with a grid, or found: numbers of runs, and what they cost."""

    chapter: int
    name: str
    makes: list[str]
    wanted: int
    stored: int  # made by this state of the code, or stamped
    stale: int
    missing: int
    causes: dict[str, int]  # stale runs by cause
    stamps: dict[str, int]  # stamped runs by stamp
    seconds_per_run: float | None
    computed: int = 0
    seconds: float | None = None  # that computing the rest will take; None if not known
    audited: list[dict] = field(default_factory=list)  # a row a recomputed run

    @property
    def stamped(self) -> int:
        """Number of stamped runs."""
        return sum(self.stamps.values())

    def write(self, folder: Path) -> None:
        """Leave it for the command, which runs in another process."""
        write_json(folder / "runs" / f"ch{self.chapter:02d}-{self.name}.json", asdict(self))


def read_summaries(folder: Path) -> list[Summary]:
    """What run_grid left in `folder` about each grid."""
    return [Summary(**read_json(path, {})) for path in sorted((folder / "runs").glob("*.json"))]


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
