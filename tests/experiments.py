"""A small grid that several tests run, in a repository of their own."""

import json
import os
import time
from pathlib import Path

import numpy as np

from lifelong_lib.reproduction.packed import to_npz
from lifelong_lib.reproduction.runs import Chapter, run_grid
from lifelong_lib.reproduction.store import Store

CONFIGS = [{"domain": "cart-pole", "tasks": 3}, {"tasks": 2, "domain": "bicycle"}]
SCALE = 2.0


def helper(x):
    return SCALE * x


def experiment(config, seed):
    draws = np.random.default_rng(seed).normal(size=(config["tasks"], 4))
    gram = (draws @ draws.T).T
    return {"curve": helper(draws), "gram": gram, "n": config["tasks"], "names": ["a", "bc"], "gap": np.nan}


def patient(config, seed):
    """Tells in which process, and takes its time until there are enough processes."""
    with open(config["log"], "a+") as log:
        print(os.getpid(), file=log, flush=True)
        log.seek(0)
        time.sleep(0.3 * (len(set(log)) < config["hurry"]))
    return {"x": np.random.default_rng(seed).normal(size=5)}


def chapter(profile="quick", seeds=2, workers=1):
    return Chapter(4, profile, seeds, workers)


def files(folder, pattern):
    return {path.name: path.read_bytes() for path in Path(folder).rglob(pattern)}


def grid_store(root, name="grid", profile="quick"):
    return Store(root / "data" / "results" / profile / "ch04" / name, 4, name)


def stored(root, name="grid", profile="quick"):
    """The bytes of the values of every stored run, by the run's name."""
    return {key: to_npz(run.values) for key, run in grid_store(root, name, profile).read(keep=True).items()}


def run_and_read(root, **more):
    run_grid(chapter(**more), "grid", experiment, CONFIGS)
    return stored(root, profile=more.get("profile", "quick"))


def report(root, profile="quick", name="grid"):
    return json.loads((root / "figures" / "latest" / profile / "runs" / f"ch04-{name}.json").read_text())
