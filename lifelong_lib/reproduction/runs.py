"""A grid of runs: computed in parallel, stored one by one, resumed, planned, audited.

A notebook defines `experiment(config, seed) -> {name: array or number}` and asks for it over configurations and seeds:
what this state of the code has stored is read, the rest is computed. Only this process writes. Every run draws from its
own SeedSequence on one thread, so where and in which order runs are computed cannot change their numbers.
"""

import contextlib
import itertools
import json
import math
import os
import platform
import re
import subprocess
import sys
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from importlib import metadata
from io import BytesIO
from pathlib import Path

import numpy as np
from tqdm import tqdm

from lifelong_lib.reproduction.backends import completed
from lifelong_lib.reproduction.files import (
    ROOT,
    ReproductionError,
    read_json,
    require,
    sha256,
    write_atomically,
    write_json,
)
from lifelong_lib.reproduction.fingerprint import changes, fingerprint

PROFILES = ("smoke", "quick", "paper")
PACKAGES = ("numpy", "scipy", "scikit-learn", "torch", "gymnasium", "pybullet", "libsumo")


class NotStored(ReproductionError):
    """Runs are missing or stale, and this command (plan, why, audit) computes none."""


@dataclass(frozen=True)
class Chapter:
    """A notebook's parameters.

    Commands pass their checked options backend, address, fresh, plan and audit (a number) as JSON in the
    variable LIFELONG_OPTIONS; a notebook that was opened by hand has none.
    """

    number: int
    profile: str
    seeds: int
    workers: int = 2
    output_dir: str = ""
    options: dict = field(default_factory=lambda: json.loads(os.environ.get("LIFELONG_OPTIONS", "{}")), init=False)
    grids: dict = field(default_factory=dict, init=False)  # name -> what run_grid did

    def __post_init__(self):
        require(_whole(self.number, 1) and self.number <= 8, f"chapter {self.number!r} is not one of 1 to 8")
        require(self.profile in PROFILES, f"profile {self.profile!r} is not one of {', '.join(PROFILES)}")
        for name, value in (("seeds", self.seeds), ("workers", self.workers)):
            require(_whole(value, 1), f"{name} must be a whole number, 1 or more, not {value!r}")
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


@dataclass(frozen=True)
class Run:
    """One run: its values (name -> array, of shape () for a number), wall time [s], and what made it."""

    config: dict
    seed: int
    values: dict
    seconds: float
    made_by: dict
    versions: dict


class Results(tuple):
    """Runs in the order of the configurations, then of the seeds."""

    def stack(self, key: str, **config) -> np.ndarray:
        """One result of the configuration with these entries over all seeds, (n_seeds, ...), seeds ascending.

        Raises ReproductionError unless exactly one configuration fits, and has the key at all seeds.
        """
        runs = [run for run in self if config.items() <= run.config.items()]
        known = {entry: list(dict.fromkeys(run.config.get(entry) for run in self)) for entry in config}
        require(runs, f"no run has {config}: the runs have {known}")
        fitting = list(dict.fromkeys(_canonical(run.config) for run in runs))
        require(len(fitting) == 1, f"{len(fitting)} configurations fit {config}, e.g. {' and '.join(fitting[:2])}")
        known = list(runs[0].values)
        require(all(key in run.values for run in runs), f"no result {key!r} at {fitting[0]}, only {known}")
        return np.stack([run.values[key] for run in runs])


def run_grid(chapter: Chapter, name: str, experiment: Callable, configs, seeds=None, makes=()) -> Results:
    """Results of experiment(config, SeedSequence) for every configuration and seed: read when stored, else computed.

    name: folder of the results, part of every SeedSequence. configs: flat dicts of JSON scalars. seeds: number or list,
    default the chapter's. makes: ids of the figures, tables and claims that rest on these runs. Stale runs (made by
    another state of the code) are recomputed at smoke and quick; paper keeps and counts them unless the option `fresh`
    is given. Raises ReproductionError for bad arguments, a failing run, a full disk and Ctrl-C, and NotStored where the
    options `plan` and `audit` forbid computing. Whatever was stored stays.
    """
    require(not isinstance(makes, str), f"makes must be a list of ids, not the text {makes!r}")
    options, tasks = chapter.options, _tasks(chapter, name, configs, chapter.seeds if seeds is None else seeds)
    parts = fingerprint(experiment)
    runs = {path: run for path, task in tasks.items() if (run := _read(path, *task, keep="plan" in options))}
    stale = {path: causes for path, run in runs.items() if (causes := changes(run.made_by, parts))}
    kept = len(stale) if chapter.profile == "paper" and not options.get("fresh") else 0
    todo = {path: task for path, task in tasks.items() if path not in runs or path in stale and not kept}
    causes = Counter(itertools.chain(*stale.values()))
    grid = {"chapter": chapter.number, "name": name, "makes": list(makes), "wanted": len(tasks), "causes": causes}
    if "plan" in options:
        grid |= _plan(chapter, name, tasks, runs, stale, todo)
    elif "audit" in options:
        grid["audited"] = _audit(chapter, name, experiment, tasks, runs, stale)
    else:
        runs |= _compute_and_store(chapter, name, experiment, todo, parts)
        if kept:
            cause = f"made by another state of the code ({', '.join(causes)})"
            _warn(f"{kept} of {len(tasks)} runs of '{name}' were {cause}: kept and counted, --fresh recomputes them")
        grid |= {"computed": len(todo), "read": len(tasks) - len(todo), "stale": kept}
        grid["seconds_per_run"] = float(np.mean([run.seconds for run in runs.values()]))
        chapter.grids[name] = grid
    write_json(chapter.folder / "runs" / f"{chapter.results.name}-{name}.json", grid)
    if "plan" in options and todo:
        raise NotStored(f"{len(todo)} of {len(tasks)} runs of '{name}' are missing or stale")
    return Results(runs[path] for path in tasks)


def run_card(chapter: Chapter) -> str:
    """What a chapter is made with, a line each: profile, seeds, workers, backend, commit, versions; no date."""
    card = {"profile": chapter.profile, "seeds": chapter.seeds, "workers": chapter.workers}
    card |= {"backend": chapter.options.get("backend", "loky"), "commit": commit()}
    card["versions"] = ", ".join(f"{package} {version}" for package, version in versions().items())
    if stale := sum(grid["stale"] for grid in chapter.grids.values()):
        card["stale"] = f"{stale} of {sum(grid['wanted'] for grid in chapter.grids.values())} runs"
    return "\n".join(f"{key + ':':10}{value}" for key, value in card.items())


def commit() -> str:
    """The commit that the repository is at, and whether files differ from it."""
    describe = ["git", "-C", str(ROOT), "describe", "--always", "--exclude=*", "--abbrev=40", "--dirty= with changes"]
    try:
        return subprocess.run(describe, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return "unknown (no git history here)"


def versions(*more: str) -> dict[str, str]:
    """Of Python, the processor, what learning runs compute with, and more packages."""
    found = {"python": platform.python_version(), "processor": processor()}
    for package in PACKAGES + more:
        with contextlib.suppress(metadata.PackageNotFoundError):  # of a simulator that another chapter needs
            found[package] = metadata.version(package)
    return found


def processor() -> str:
    """Vendor, family and model: linear algebra rounds differently on different ones. "GenuineIntel 6 143", "arm64"."""
    linux = Path("/proc/cpuinfo")
    entries = re.findall(r"(?m)^(vendor_id|cpu family|model)\s*: (.+)", linux.read_text() if linux.exists() else "")
    return " ".join(dict(entries).values()) or platform.processor() or platform.machine()


def _warn(message: str):
    print(f"warning: {message}", file=sys.stderr)  # warnings.warn would put this machine's paths into the notebook


def _whole(value, least: int = 0) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and value >= least


def _tasks(chapter, name, configs, seeds) -> dict[Path, tuple[dict, int]]:
    """File of every wanted run -> (configuration, seed), in the order of configurations, then seeds."""
    require(re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_-]*", name), f"grid name {name!r} may hold letters, digits, - and _")
    seeds = range(seeds) if _whole(seeds) else seeds
    good = isinstance(seeds, (list, tuple, range)) and all(map(_whole, seeds)) and len(set(seeds)) == len(seeds) > 0
    require(good, f"seeds of '{name}' must be a number above 0 or a list of different whole numbers, not {seeds!r}")
    require(configs, f"grid '{name}' has no configurations")
    names = Counter(_file_name(config).lower() for config in configs)  # some file systems ignore the case
    twice = [text for text, number in names.items() if number > 1]
    require(not twice, f"grid '{name}' has a configuration twice (or two that differ in case only): {twice}")
    return {chapter.results / name / f"{_file_name(config)}-s{seed}.npz": (dict(config), seed)
            for config in configs for seed in sorted(seeds)}  # fmt: skip


def _canonical(config) -> str:
    """One text per configuration, whatever the order of its entries; it must be flat and plain."""
    require(isinstance(config, dict), f"a configuration must be a dict, not {config!r}")
    for key, value in config.items():
        require(isinstance(key, str) and key.isascii() and key.isidentifier(), f"configuration entry {key!r}: no name")
        plain = math.isfinite(value) if isinstance(value, float) else value is None or isinstance(value, (int, str))
        require(plain, f"configuration entry {key}={value!r} must be a number, a text, True, False or None")
    return json.dumps(config, sort_keys=True)


def _file_name(config) -> str:
    """Readable name, e.g. domain=cart-pole,tasks=40, with a digest where that could mean another configuration too."""
    text = _canonical(config)
    words = {key: value if isinstance(value, str) else json.dumps(value) for key, value in sorted(config.items())}
    name = ",".join(f"{key}={re.sub('[^A-Za-z0-9_.+-]', '_', word)}" for key, word in words.items()) or "run"
    sure = r"(?!(true|false|null)$)[A-Za-z][A-Za-z0-9_.+-]*"  # a text "1" must not be taken for the number 1
    exact = all(re.fullmatch(sure, value) for value in config.values() if isinstance(value, str))
    return name if exact and len(name) <= 120 else f"{name[:100]}~{sha256(text)[:16]}"


def _read(path, config, seed, keep) -> Run | None:
    """A stored run. A damaged one is named and, unless keep, set aside."""
    record_path = path.with_suffix(".json")
    if not record_path.exists():
        return None
    try:
        record, data = json.loads(record_path.read_bytes()), path.read_bytes()
        require(sha256(data) == record["sha256"], "its bytes are not those that were written")
        require((_canonical(record["config"]), record["seed"]) == (_canonical(config), seed), "it holds another run")
        with np.load(BytesIO(data), allow_pickle=False) as arrays:
            return Run(config, seed, dict(arrays), float(record["seconds"]), dict(record["fingerprint"]),
                       dict(record["versions"]))
    except (ValueError, KeyError, TypeError, FileNotFoundError) as error:
        _warn(f"stored run {path} is damaged and not used: {error}")
    for file in (path, record_path):
        if file.exists() and not keep:
            os.replace(file, f"{file}.damaged")


def _npz(values) -> bytes:
    """An npz file with the same bytes for the same values: names sorted, no dates, no pickle."""
    buffer = BytesIO()
    np.savez(buffer, allow_pickle=False, **dict(sorted(values.items())))
    return buffer.getvalue()


def _compute_and_store(chapter, name, experiment, tasks, parts) -> dict[Path, Run]:
    """Compute runs and store each as it comes. A run counts once its record is there: half a pair is never read."""
    done, installed, title = {}, versions(), f"{chapter.results.name} {name}"
    try:
        with contextlib.closing(_completed(chapter, name, experiment, tasks)) as results, _bar(title, tasks) as bar:
            for path, values, seconds in results:
                config, seed = tasks[path]
                data, record = _npz(values), {"chapter": chapter.number, "name": name, "config": config, "seed": seed}
                record |= {"seconds": seconds, "versions": installed, "fingerprint": parts, "sha256": sha256(data)}
                path.with_suffix(".json").unlink(missing_ok=True)
                write_atomically(path, data)
                write_json(path.with_suffix(".json"), record)
                done[path] = Run(config, seed, values, seconds, parts, installed)
                bar.update()
    except KeyboardInterrupt:
        message = f"interrupted: {len(done)} of {len(tasks)} runs of '{name}' are stored, run again for the rest"
        raise ReproductionError(message) from None
    return done


def _bar(title, tasks):
    """Progress with the time left, on this process's own standard error: a notebook must not keep it in its outputs."""
    own = getattr(sys.stderr, "_original_stdstream_copy", None)  # where ipykernel keeps it
    stream = sys.__stderr__ if own is None else open(own, "w", closefd=False)
    pace = 0.5 if stream.isatty() else 15  # seconds
    return tqdm(total=len(tasks), desc=title, unit="run", file=stream, disable=not tasks, mininterval=pace)


def _plan(chapter, name, tasks, runs, stale, todo) -> dict:
    """How much of a grid is stored, and the seconds that the rest would take; None if that is not known."""
    costs = read_json(ROOT / "figures" / "reference" / chapter.profile / "unit_costs.json", {})
    each = np.mean([run.seconds for run in runs.values()]) if runs else costs.get(f"{chapter.results.name}/{name}")
    seconds = None if each is None else float(each) * math.ceil(len(todo) / chapter.workers)
    counts = {"stored": len(runs) - len(stale), "stale": len(stale), "missing": len(tasks) - len(runs)}
    return counts | {"seconds": seconds}


def _audit(chapter, name, experiment, tasks, runs, stale) -> list[dict]:
    """Recompute this grid's share of K stored runs drawn from the whole chapter; a verdict for each.

    Values whose names begin with `seconds` are measured times and not compared.
    """
    if missing := len(tasks) - len(runs):
        raise NotStored(f"{missing} of {len(tasks)} runs of '{name}' are not stored: run the chapter before its audit")
    files, number = sorted(chapter.results.glob("*/*.npz")), chapter.options["audit"]  # the same for every grid
    drawn, rows = set(np.random.default_rng(number).permutation(files)[:number]), []
    share = {path: task for path, task in tasks.items() if path in drawn}
    for path, values, _ in _completed(chapter, name, experiment, share):
        old, new = ({key: _npz({"": array}) for key, array in found.items() if not key.startswith("seconds")}
                    for found in (runs[path].values, values))  # fmt: skip
        differs = [key for key in sorted(old.keys() | new.keys()) if old.get(key) != new.get(key)]
        rows.append({"run": f"{name}/{path.stem}", "same": not differs, "differs": differs, "stale": path in stale,
                     "made_on": runs[path].versions.get("processor", "one unknown")})
    return sorted(rows, key=lambda row: row["run"])


def _completed(chapter, name, experiment, tasks):
    """(path, values, seconds) of every task in order of completion."""
    calls = {}
    for path, (config, seed) in tasks.items():
        text = _canonical(config)
        entropy = int(sha256(json.dumps([chapter.number, name, text, seed])), 16)
        calls[path] = (f"experiment '{name}' failed at {text}, seed {seed}", config, entropy)
    options = chapter.options
    return completed(experiment, calls, options.get("backend", "loky"), chapter.workers, options.get("address", ""))
