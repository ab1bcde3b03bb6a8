"""A small project in a temporary folder: one chapter notebook, its ledger, and the real library."""

import json
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import nbformat
import pytest

from lifelong_lib.reproduction import runs
from lifelong_lib.reproduction.book import build_book
from lifelong_lib.reproduction.comparison import compare
from lifelong_lib.reproduction.report import accept

REPOSITORY = Path(__file__).resolve().parents[1]

signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs, and their children, ignore it

TITLE = "# Chapter 4: a demonstration\nMakes F4.1, T4.1 and C4.1. A formula: $\\theta = L s$.\n\n$$ a^2 \\tag{4.1} $$"
PARAMETERS = """profile = "quick"   # smoke, quick or paper
seeds = 0           # 0: the profile's own
workers = 1
output_dir = ""
scale = 1.0         # slope [1/s]
tasks = [1, 2]  # numbers of tasks, any number of them
limits = [0.0, 1.0]  # lowest and highest
broken = False      # whether the last cell fails"""
SET_UP = """from lifelong_lib.reproduction.claims import check_claim
from lifelong_lib.reproduction.figures import draw_curves, panels, save_figure
from lifelong_lib.reproduction.runs import Chapter, run_grid
from lifelong_lib.reproduction.tables import save_table

chapter = Chapter(4, profile=profile, seeds=seeds or 4, workers=workers, output_dir=output_dir)"""
EXPERIMENT = """import numpy as np

def experiment(config, seed):
    return {"curve": config["tasks"] * (5 + np.random.default_rng(seed).random(3)) * config["scale"]}

grid = [{"tasks": n, "scale": scale} for n in tasks]
results = run_grid(chapter, "slopes", experiment, grid, makes=("F4.1", "C4.1"))"""
SECOND = """best = [{"tasks": int(np.argmax([run.values["curve"].sum() for run in results])), "scale": scale}]
chosen = run_grid(chapter, "chosen", experiment, best, makes=["T4.1"])"""
FIGURE = """fig, axes = panels(1)
rows = draw_curves(axes[0], [0, 1, 2], results.stack("curve", tasks=tasks[0]), "PG")
save_figure(chapter, "F4.1", fig, rows)"""
TABLE = """rows = [{"tasks": n, "mean": float(results.stack("curve", tasks=n).mean())} for n in tasks]
save_table(chapter, "T4.1", rows)"""
CLAIM = """check_claim(chapter, "C4.1", {"slope": results.stack("curve", tasks=tasks[0]).mean(axis=1)})"""
BROKEN = """if broken:
    raise ValueError("broken on demand")"""
LEDGER = """[[claim]]
id = "C4.1"
chapter = 4
statement = "The slope is above 2."
source = "section 4.9"
kind = "sign"
profile = "quick"
control = "none: there is nothing to switch off"
tolerance_origin = "the sign alone"
[claim.parts.slope]
at_least = 2.0
"""


def write_notebook(path: Path, cells: list[str], parameters: str | None = PARAMETERS) -> Path:
    """A notebook whose cells starting with `#` are text; the parameters cell comes second."""
    new_text, new_code = nbformat.v4.new_markdown_cell, nbformat.v4.new_code_cell
    made = [new_text(cell) if cell.startswith("#") else new_code(cell) for cell in cells]
    if parameters is not None:
        made.insert(1, new_code(parameters, metadata={"tags": ["parameters"]}))
    for number, cell in enumerate(made):
        cell.id = f"cell-{number}"
    path.parent.mkdir(parents=True, exist_ok=True)
    nbformat.write(nbformat.v4.new_notebook(cells=made), path)
    return path


def make_project(root: Path) -> Path:
    cells = [TITLE, SET_UP, "## The slopes", EXPERIMENT, "## A curve", FIGURE, "## A table", SECOND, TABLE, CLAIM,
             BROKEN]
    write_notebook(root / "notebooks" / "ch04_demonstration.ipynb", cells)
    (root / "data" / "thesis").mkdir(parents=True)
    (root / "data" / "thesis" / "claims.toml").write_text(LEDGER)
    for name in ("environment.txt", "DEVIATIONS.md", "data/thesis/chapters.toml", "data/thesis/readers.toml"):
        shutil.copyfile(REPOSITORY / name, root / name)
    return root


def command(root: Path, *arguments: str, **variables: str) -> subprocess.CompletedProcess:
    """One command of the library, with `root` as the repository."""
    environment = os.environ | {"LIFELONG_ROOT": str(root), "PYTHONPATH": str(REPOSITORY)} | variables
    return subprocess.run([sys.executable, "-m", "lifelong_lib", *arguments], cwd=root, env=environment,
                          capture_output=True, text=True, timeout=300)


@pytest.fixture(scope="session")
def project(tmp_path_factory) -> Path:
    """A project whose chapter was run by the command, accepted as the reference, and compared with it."""
    root = make_project(tmp_path_factory.mktemp("project"))
    done = command(root, "run")
    assert done.returncode == 0, done.stderr
    (root / "run.txt").write_text(done.stdout + done.stderr)
    folder, reference = (root / "figures" / kind / "quick" for kind in ("latest", "reference"))
    accept(folder, reference)
    compare(folder, reference)
    build_book(folder, reference)
    return root


@pytest.fixture
def root(tmp_path, monkeypatch):
    """An empty repository."""
    monkeypatch.setattr(runs, "ROOT", tmp_path)
    monkeypatch.delenv("LIFELONG_OPTIONS", raising=False)
    return tmp_path


@pytest.fixture
def options(monkeypatch):
    """Sets the options that a command would pass to run_grid."""
    return lambda **given: monkeypatch.setenv("LIFELONG_OPTIONS", json.dumps(given))


def trial(env, seed, actions):
    """Everything that a trial with these actions gives, until it ends."""
    seen = [env.reset(seed=seed)]
    for action in actions:
        seen.append(env.step(action))
        if seen[-1][2] or seen[-1][3]:
            break
    return seen
