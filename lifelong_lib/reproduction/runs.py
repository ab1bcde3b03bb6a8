"""Runs for a notebook: a chapter's parameters, a grid of runs computed or read, and the run card.

A notebook defines `experiment(config, seed) -> {name: array or number}` and asks for it over configurations and seeds:
what this state of the code has stored is read, the rest is computed. Only this process writes. Every run draws from its
own SeedSequence on one thread, so where and in which order runs are computed cannot change their numbers.
"""

import contextlib
import json
import math
import os
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from tqdm import tqdm

from lifelong_lib.reproduction.audits import audit, stamped
from lifelong_lib.reproduction.children import terminal, warn
from lifelong_lib.reproduction.configurations import canonical
from lifelong_lib.reproduction.files import ROOT, ReproductionError, require
from lifelong_lib.reproduction.fingerprint import checksums, fingerprint
from lifelong_lib.reproduction.grid import Grid, make_tasks, whole
from lifelong_lib.reproduction.machine import commit, unit_costs, versions
from lifelong_lib.reproduction.packed import Run
from lifelong_lib.reproduction.store import Store

PROFILES = ("smoke", "quick", "paper")


class NotStored(ReproductionError):
    """Runs are missing or stale, and this command (plan, why, audit) computes none."""


@dataclass(frozen=True)
class Chapter:
    """A notebook's parameters.

    Commands pass their checked options backend, address, fresh, plan, audit (a number), stamp, values and beside as
    JSON in the variable LIFELONG_OPTIONS; a notebook that was opened by hand has none.
    """

    number: int
    profile: str
    seeds: int
    workers: int = 2
    output_dir: str = ""
    options: dict = field(default_factory=lambda: json.loads(os.environ.get("LIFELONG_OPTIONS", "{}")), init=False)
    grids: dict = field(default_factory=dict, init=False)  # name -> report on what run_grid did

    def __post_init__(self):
        require(whole(self.number, 1) and self.number <= 8, f"chapter {self.number!r} is not one of 1 to 8")
        require(self.profile in PROFILES, f"profile {self.profile!r} is not one of {', '.join(PROFILES)}")
        for name, value in (("seeds", self.seeds), ("workers", self.workers)):
            require(whole(value, 1), f"{name} must be a whole number, 1 or more, not {value!r}")
        require(isinstance(self.output_dir, str), f"output_dir must be a text, not {self.output_dir!r}")

    @property
    def folder(self) -> Path:
        """Where figures, tables and claims go."""
        return Path(self.output_dir) if self.output_dir else ROOT / "figures" / "latest" / self.profile

    @property
    def results(self) -> Path:
        """Where raw results are stored."""
        return ROOT / "data" / "results" / self.profile / f"ch{self.number:02d}"

    def pick(self, *, smoke, quick, paper):
        """The value for the current profile."""
        return {"smoke": smoke, "quick": quick, "paper": paper}[self.profile]


class Results(tuple):
    """Runs in the order of the configurations, then of the seeds."""

    def stack(self, key: str, **config) -> np.ndarray:
        """One result of the configuration with these entries over all seeds, (n_seeds, ...), seeds ascending.

        Raises ReproductionError unless exactly one configuration fits, and has the key at all seeds.
        """
        runs = [run for run in self if config.items() <= run.config.items()]
        known = {entry: list(dict.fromkeys(run.config.get(entry) for run in self)) for entry in config}
        require(runs, f"no run has {config}: the runs have {known}")
        fitting = list(dict.fromkeys(canonical(run.config) for run in runs))
        require(len(fitting) == 1, f"{len(fitting)} configurations fit {config}, e.g. {' and '.join(fitting[:2])}")
        known = list(runs[0].values)
        require(all(key in run.values for run in runs), f"no result {key!r} at {fitting[0]}, only {known}")
        return np.stack([run.values[key] for run in runs])


def run_grid(chapter: Chapter, name: str, experiment: Callable, configs, seeds=None, makes=(), inputs=None, files=(),
             luck=None) -> Results:  # fmt: skip
    """Results of experiment(config, SeedSequence, **inputs) for every configuration and seed: read, else computed.

    name: folder of the results, part of every SeedSequence. configs: flat dicts of JSON scalars. seeds: number or list,
    default the chapter's. makes: ids of the figures, tables and claims that rest on these runs. inputs: arrays by name
    that the experiment is given, the same for all runs or a list with one mapping a configuration. files: paths, from
    the repository's folder, of what the experiment reads. luck: names of the entries of a configuration (and of inputs)
    that its random numbers are drawn from, default all of them: runs that differ in other entries only have the same
    luck and can be compared in pairs.

    Runs that were made by other code, inputs or files are stale: recomputed at smoke and quick, kept and counted at
    paper unless the option `fresh` is given. Raises ReproductionError for bad arguments, a failing run, a full disk and
    Ctrl-C, and NotStored where the options `plan` and `audit` forbid computing. Whatever was stored stays.
    """
    require(not isinstance(makes, str), f"makes must be a list of ids, not the text {makes!r}")
    depends = fingerprint(experiment) | checksums(files, ROOT)
    seeds = chapter.seeds if seeds is None else seeds
    tasks = make_tasks(chapter.number, name, configs, seeds, depends, inputs, luck)
    store = Store(chapter.results / name, chapter.number, name)
    grid = Grid(chapter.number, name, experiment, list(makes), tasks, store.read(keep="plan" in chapter.options))
    if "plan" in chapter.options:
        runs = _plan(chapter, grid)
    elif "audit" in chapter.options:
        runs = _audit(chapter, grid, store)
    else:
        runs = _complete(chapter, grid, store)
    return Results(runs[key] for key in tasks)


def _complete(chapter, grid, store) -> dict[str, Run]:
    """Compute what is missing or, unless it is kept, stale."""
    kept = grid.stale if chapter.profile == "paper" and not chapter.options.get("fresh") else {}
    wanted = [key for key in grid.tasks if key in grid.missing or key in grid.stale and key not in kept]
    done = _compute_and_store(chapter, grid, store, wanted)
    if kept:
        cause = f"made by another state of the code ({', '.join(grid.causes)})"
        warn(f"{len(kept)} of {len(grid.tasks)} runs of '{grid.name}' were {cause}: kept and counted, --fresh "
             "recomputes them, audit --stamp may find them the same")  # fmt: skip
    now = replace(grid, stored=grid.stored | done)
    if not store.packed:
        store.pack(now.stored)
    chapter.grids[grid.name] = now.report(chapter.folder, computed=len(done), causes=grid.causes)
    return now.runs


def _compute_and_store(chapter, grid, store, keys) -> dict[str, Run]:
    """Compute runs and store each as it comes."""
    done, title = {}, f"{chapter.results.name} {grid.name}"
    results = grid.computed(keys, chapter.workers, chapter.options)
    try:
        with contextlib.closing(results), _bar(title, len(keys)) as bar:
            for run in results:
                store.add(run)
                done[run.key] = run
                bar.update()
    except KeyboardInterrupt:
        message = f"interrupted: {len(done)} of {len(keys)} runs of '{grid.name}' are stored, run again for the rest"
        raise ReproductionError(message) from None
    return done


def _bar(title, total):
    """Progress with the time left, on the terminal: a notebook must not keep it in its outputs."""
    stream = terminal()
    pace = 0.5 if stream.isatty() else 15  # seconds
    return tqdm(total=total, desc=title, unit="run", file=stream, disable=not total, mininterval=pace)


def _plan(chapter, grid) -> dict[str, Run]:
    """Say how much is stored and what the rest costs; NotStored if there is a rest, for nothing is computed."""
    kept = chapter.profile == "paper" and not chapter.options.get("fresh")
    rest = len(grid.missing) + (0 if kept else len(grid.stale))
    costs = unit_costs(ROOT / "figures" / "reference" / chapter.profile)
    each, _ = costs.get(f"{chapter.results.name}/{grid.name}", (None, 0))
    each = grid.seconds_per_run or each
    seconds = None if each is None else float(each) * math.ceil(rest / chapter.workers)
    grid.report(chapter.folder, seconds=seconds)
    if rest:
        raise NotStored(f"{rest} of {len(grid.tasks)} runs of '{grid.name}' are missing or stale")
    return grid.runs


def _audit(chapter, grid, store) -> dict[str, Run]:
    """Recompute some stored runs and say whether they come out the same; with the option `stamp`, stamp the grid."""
    if grid.missing:
        cause = f"{len(grid.missing)} of {len(grid.tasks)} runs of '{grid.name}' are not stored"
        raise NotStored(f"{cause}: run the chapter before its audit")
    rows = audit(grid, chapter.results, chapter.workers, chapter.options)
    if chapter.options.get("stamp") and grid.stale and all(row["same"] for row in rows):
        if not store.packed:  # loose runs would count as newer than what is stamped
            store.pack(grid.stored)
        grid = replace(grid, stored=stamped(grid, rows, "beside" in chapter.options))
        store.pack(grid.stored)
    grid.report(chapter.folder, audited=rows)
    return grid.runs


def best_stored(chapter: Chapter, grids: dict[str, Results], choose: Callable):
    """What `choose(*results)` takes of grids to be shown: at quick of the runs at paper, where it finds them stored.

    grids: this run's own, by their names. Nothing that is measured may come from here.
    """
    if chapter.profile == "quick":
        folder = replace(chapter, profile="paper").results
        stored = [Store(folder / name, chapter.number, name).read(keep=True).values() for name in grids]
        with contextlib.suppress(ReproductionError):  # none is stored, or not what this notebook asks for
            require(all(stored), "not stored")
            return choose(*(Results(sorted(runs, key=lambda run: run.seed)) for runs in stored))
    return choose(*grids.values())


def run_card(chapter: Chapter) -> str:
    """What a chapter was made with, a line each: profile, seeds, workers, backend, commit, versions; no date.

    It counts the runs that were read although other code made them, so it stands at the end of a notebook.
    """
    card = {"profile": chapter.profile, "seeds": chapter.seeds, "workers": chapter.workers}
    card |= {"backend": chapter.options.get("backend", "loky"), "commit": commit()}
    card["versions"] = ", ".join(f"{package} {version}" for package, version in versions().items())
    grids = chapter.grids.values()
    wanted = sum(grid.wanted for grid in grids)
    meanings = {"stale": "made by other code, inputs or files",
                "stamped": "made by other code, and found the same by an audit of some"}  # fmt: skip
    for kind, meaning in meanings.items():
        number = sum(getattr(grid, kind) for grid in grids)
        if number:
            card[kind] = f"{number} of {wanted} runs: {meaning}"
    return "\n".join(f"{key + ':':10}{value}" for key, value in card.items())
