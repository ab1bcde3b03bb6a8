"""Runs: the same bytes wherever they are computed, nothing lost, nothing stale or damaged used in silence."""

import inspect
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import experiments
import numpy as np
import pytest
from experiments import CONFIGS, chapter, experiment, files, grid_store, report, run_and_read, stored

from lifelong_lib.reproduction import machine, runs
from lifelong_lib.reproduction.files import ReproductionError, write_atomically
from lifelong_lib.reproduction.runs import Chapter, NotStored, run_card, run_grid

HERE = Path(__file__).parents[1]


def slow(config, seed):
    time.sleep(config["pause"])
    return {"x": np.random.default_rng(seed).normal(size=3)}


def count_calls(config, seed):
    with open(config["log"], "a") as log:
        log.write("x")
    return {"x": 1.0}


def fail_at_two(config, seed):
    if config["step"] == 2:
        raise ZeroDivisionError("no tasks\nleft")
    return {"x": config["step"]}


@pytest.fixture
def dask():
    """The address of a cluster of two single-threaded worker processes."""
    from distributed import LocalCluster  # slow to import

    own = {"host": "127.0.0.1", "n_workers": 2, "threads_per_worker": 1, "dashboard_address": None}
    with LocalCluster(**own, silence_logs=50) as cluster:
        yield cluster.scheduler_address


@pytest.mark.parametrize("backend", ["loky", "dask"])
def test_worker_processes_give_the_bytes_of_a_serial_run(root, monkeypatch, options, backend, request):
    expected = run_and_read(root)
    configs = ("domain=bicycle,tasks=2", "domain=cart-pole,tasks=3")
    assert sorted(expected) == [f"{config}-s{seed}" for config in configs for seed in (0, 1)]
    monkeypatch.setattr(runs, "ROOT", root / backend)
    options(backend=backend, address=request.getfixturevalue("dask") if backend == "dask" else "")
    results = run_grid(chapter(workers=2), "grid", experiment, CONFIGS)
    assert stored(root / backend) == expected
    order = [("cart-pole", 0), ("cart-pole", 1), ("bicycle", 0), ("bicycle", 1)]
    assert [(run.config["domain"], run.seed) for run in results] == order


def test_resume_computes_only_what_is_missing(root):
    expected = run_and_read(root)
    forget(root, "domain=bicycle,tasks=2-s1")
    results = run_grid(chapter(), "grid", experiment, CONFIGS)
    assert stored(root) == expected and report(root)["computed"] == 1
    assert results[0].values["gram"].flags.c_contiguous  # wherever and however it was made
    assert results[0].values["n"].shape == () and results[0].values["names"].tolist() == ["a", "bc"]


def forget(root, key):
    """Take one run out of the store."""
    runs_left = grid_store(root).read()
    del runs_left[key]
    grid_store(root).pack(runs_left)


SCRIPT = f"""
import sys, time
import numpy as np
from lifelong_lib.reproduction.files import ReproductionError
from lifelong_lib.reproduction.runs import Chapter, run_grid
{inspect.getsource(slow)}
if __name__ == "__main__":
    try:
        run_grid(Chapter(4, "quick", 10, 2), "slow", slow, [{{"pause": 0.3}}])
    except ReproductionError as error:
        sys.exit(f"error: {{error}}")
"""


def stop_in_the_middle(root, more, send):
    """Starts 10 slow runs as a script of its own, stops it after some more are stored; returns code, errors, stored."""
    (root / "script.py").write_text(SCRIPT)
    process = subprocess.Popen([sys.executable, str(root / "script.py")], stderr=subprocess.PIPE, text=True,
                               env=os.environ | {"LIFELONG_ROOT": str(root), "PYTHONPATH": str(HERE)},
                               start_new_session=True)  # fmt: skip
    before = len(files(root / "data", "*.json"))
    while len(files(root / "data", "*.json")) < before + more:
        assert process.poll() is None, process.stderr.read()
        time.sleep(0.02)
    send(process.pid)
    _, errors = process.communicate(timeout=120)
    return process.returncode, errors, seconds_of_runs(root)


def seconds_of_runs(root):
    """Wall time of every stored run: one that was computed anew would have another."""
    return {key: run.seconds for key, run in grid_store(root, "slow").read(keep=True).items()}


def test_killed_interrupted_resumed_gives_the_bytes_of_an_uninterrupted_run(root, monkeypatch):
    first = {}
    for _ in range(3):
        code, _, found = stop_in_the_middle(root, 1, lambda pid: os.kill(pid, signal.SIGKILL))
        assert code == -signal.SIGKILL and first.items() < found.items() and len(found) < 8
        first = found
    code, errors, second = stop_in_the_middle(root, 1, lambda pid: os.killpg(pid, signal.SIGINT))
    last = errors.replace("\r", "\n").strip().splitlines()[-1]
    assert code == 1 and "Traceback" not in errors and len(first) < len(second) < 10
    new = len(second) - len(first)  # one more than was counted, if the signal came right after the last record
    lines = [f"error: interrupted: {n} of {10 - len(first)} runs of 'slow' are stored" for n in (new, new - 1)]
    assert last.startswith(tuple(lines))
    monkeypatch.setattr(time, "sleep", lambda seconds: None)
    run_grid(chapter(seeds=10), "slow", slow, [{"pause": 0.3}])
    assert report(root, name="slow")["computed"] == 10 - len(second) and not list(root.rglob("*.part"))
    third = seconds_of_runs(root)
    assert first.items() <= second.items() <= third.items()
    monkeypatch.setattr(runs, "ROOT", root / "whole")
    run_grid(chapter(seeds=10), "slow", slow, [{"pause": 0.3}])
    assert stored(root, "slow") == stored(root / "whole", "slow") and len(third) == 10


@pytest.mark.parametrize("workers", [1, 2])
def test_a_failing_run_is_named_and_what_was_stored_stays(root, workers):
    run_grid(chapter(workers=workers), "steps", fail_at_two, [{"step": 1}], seeds=1)
    message = "^experiment 'steps' failed at {.step.: 2}, seed 0: ZeroDivisionError: no tasks left$"
    with pytest.raises(ReproductionError, match=message):
        run_grid(chapter(workers=workers), "steps", fail_at_two, [{"step": 2}, {"step": 1}, {"step": 3}], seeds=1)
    assert "step=1-s0" in stored(root, "steps") and "step=2-s0" not in stored(root, "steps")


@pytest.mark.parametrize("profile", ["smoke", "quick"])
def test_stale_runs_are_recomputed(root, monkeypatch, profile):
    run_and_read(root, profile=profile)
    monkeypatch.setattr(experiments, "SCALE", 4.0)
    doubled = run_grid(chapter(profile), "grid", experiment, CONFIGS)
    assert report(root, profile)["computed"] == 4 and report(root, profile)["causes"] == {"global SCALE changed": 4}
    monkeypatch.setattr(experiments, "SCALE", 2.0)
    single = run_grid(chapter(profile), "grid", experiment, CONFIGS)
    np.testing.assert_array_equal(doubled[0].values["curve"], 2 * single[0].values["curve"])


def test_paper_keeps_and_counts_stale_runs_unless_fresh(root, monkeypatch, options, capsys):
    before = run_and_read(root, profile="paper")
    monkeypatch.setattr(experiments, "SCALE", 4.0)
    kept = chapter("paper")
    run_grid(kept, "grid", experiment, CONFIGS)
    assert stored(root, profile="paper") == before and report(root, "paper")["stale"] == 4
    assert "4 of 4 runs of 'grid'" in capsys.readouterr().err and "stale:    4 of 4 runs" in run_card(kept)
    options(fresh=True)
    assert run_and_read(root, profile="paper") != before and report(root, "paper")["stale"] == 0


def test_plan_computes_nothing_and_predicts(root, options):
    log, said = root / "log", []
    configs = [{"log": str(log), "n": n} for n in range(4)]
    run_grid(chapter(), "count", count_calls, configs[:1])
    store = grid_store(root, "count")
    store.pack({key: replace(run, seconds=3.0) for key, run in store.read().items()})
    options(plan=True)
    with pytest.raises(NotStored, match="6 of 8"):
        run_grid(chapter(workers=2), "count", count_calls, configs, makes=["F4.2", "C4.2"])
    said.append(report(root, name="count"))
    assert len(run_grid(chapter(), "count", count_calls, configs[:1])) == 2
    said.append(report(root, name="count"))
    for costs in ({}, {"ch04/never": [0.5, 8], "pace": machine.pace()}):
        write_atomically(root / "figures" / "reference" / "quick" / "unit_costs.json", json.dumps(costs))
        with pytest.raises(NotStored):
            run_grid(chapter(), "never", count_calls, configs)
        said.append(report(root, name="never"))
    first, *others = said
    assert log.read_text() == "xx" and first["makes"] == ["F4.2", "C4.2"]
    assert [first[key] for key in ("wanted", "stored", "stale", "missing", "seconds")] == [8, 2, 0, 6, 9.0]
    assert [line["seconds"] for line in others] == [0.0, None, pytest.approx(4.0)]


def test_plan_names_causes_and_leaves_damaged_files_alone(root, options, monkeypatch):
    run_and_read(root)
    store = grid_store(root)
    for run in store.read().values():  # loose, one of them damaged
        store.add(run)
    shutil.rmtree(store.folder)
    victim = next(root.rglob("*.npz"))
    victim.write_bytes(b"")
    monkeypatch.setattr(experiments, "SCALE", 4.0)
    options(plan=True)
    with pytest.raises(NotStored, match="4 of 4"):
        run_and_read(root)
    line = report(root)
    assert (line["stored"], line["stale"], line["missing"], line["causes"]) == (0, 3, 1, {"global SCALE changed": 3})
    assert victim.exists() and not files(root, "*.damaged")


@pytest.mark.parametrize("given", [
    {"number": 9}, {"number": True}, {"profile": "full"}, {"seeds": 0}, {"seeds": -1}, {"seeds": 2.0}, {"workers": 0},
    {"output_dir": None},
])  # fmt: skip
def test_bad_parameters_are_refused_by_value(root, given):
    with pytest.raises(ReproductionError, match=repr(next(iter(given.values())))):
        Chapter(**({"number": 4, "profile": "quick", "seeds": 1} | given))


def test_stack_names_what_is_missing(root):
    results = run_grid(chapter(seeds=3), "grid", experiment, CONFIGS)
    assert results.stack("curve", domain="bicycle").shape == (3, 2, 4)
    for key, config, word in [("curve", {"domain": "boat"}, "cart-pole"), ("curve", {}, "2 configurations"),
                              ("curv", {"tasks": 2}, "curve"), ("curve", {"task": 2}, "task")]:  # fmt: skip
        with pytest.raises(ReproductionError, match=word):
            results.stack(key, **config)


def test_run_card_is_the_same_twice_and_picks_follow_the_profile(root):
    card = run_card(chapter())
    assert card == run_card(chapter()) and f"numpy {np.__version__}" in card and "quick" in card and "loky" in card
    assert chapter("paper").pick(smoke=1, quick=2, paper=3) == 3


def test_what_is_shown_at_quick_is_the_paper_runs_where_they_are_stored_and_fit(root):
    def lengths(grid):
        return {task: grid.stack("curve", domain=task).shape[1] for task in ("cart-pole", "bicycle")}

    larger = [config | {"tasks": 10 * config["tasks"]} for config in CONFIGS]
    own = run_grid(chapter(), "grid", experiment, CONFIGS)
    assert runs.best_stored(chapter(), {"grid": own}, lengths) == {"cart-pole": 3, "bicycle": 2}  # nothing at paper
    run_grid(chapter("paper"), "grid", experiment, larger[:1])
    assert runs.best_stored(chapter(), {"grid": own}, lengths) == {"cart-pole": 3, "bicycle": 2}  # no bicycle there
    run_grid(chapter("paper"), "grid", experiment, larger)
    assert runs.best_stored(chapter(), {"grid": own}, lengths) == {"cart-pole": 30, "bicycle": 20}
    smoke = run_grid(chapter("smoke"), "grid", experiment, CONFIGS)
    assert runs.best_stored(chapter("smoke"), {"grid": smoke}, lengths) == {"cart-pole": 3, "bicycle": 2}


def test_a_simulator_that_is_not_installed_does_not_stop_other_chapters(root, monkeypatch):
    known = {"numpy": np.__version__}

    def version(package):
        if package in known:
            return known[package]
        raise machine.metadata.PackageNotFoundError(package)

    monkeypatch.setattr(machine.metadata, "version", version)
    card = run_card(chapter())
    assert f"numpy {np.__version__}" in card and "pybullet" not in card
    run_and_read(root)
    assert set(grid_store(root).read()["domain=bicycle,tasks=2-s1"].versions) == {"python", "processor", "numpy"}


def test_a_notebook_does_not_keep_the_progress_bar(root, monkeypatch):
    import nbformat  # here, because worker processes import this file
    from nbclient import NotebookClient

    monkeypatch.setenv("LIFELONG_ROOT", str(root))
    monkeypatch.delenv("PYTEST_CURRENT_TEST")  # ipykernel would not catch the standard error of a test
    cells = ["from lifelong_lib.reproduction.runs import Chapter, run_grid\nn = 3", "def half(x): return x / 2",
             "def learn(config, seed): return {'x': half(n)}",
             "run_grid(Chapter(4, 'smoke', 2, 1), 'learn', learn, [{'tasks': 1}]).stack('x')"]  # fmt: skip
    book = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(text) for text in cells])
    NotebookClient(book, timeout=300, resources={"metadata": {"path": str(HERE)}}).execute()
    outputs = [output for cell in book.cells for output in cell.outputs]
    assert [output["data"]["text/plain"] for output in outputs] == ["array([1.5, 1.5])"]
    (run, _) = grid_store(root, "learn", "smoke").read().values()
    assert set(run.made_by) == {"function learn", "function half", "global n"}
