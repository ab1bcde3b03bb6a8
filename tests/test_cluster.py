"""A Dask cluster on loopback: the same bytes when a worker is killed, and no run by one that has other versions."""

import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from conftest import REPOSITORY
from experiments import CONFIGS, chapter, experiment, grid_store, patient, stored

from lifelong_lib.reproduction import runs
from lifelong_lib.reproduction.files import ReproductionError
from lifelong_lib.reproduction.machine import versions
from lifelong_lib.reproduction.runs import run_grid

HERE = f"{REPOSITORY}{os.pathsep}{REPOSITORY / 'tests'}"  # workers import these experiments, which are no notebook's
FEW = range(6)  # configurations of `patient`, each with two seeds
MANY = range(60)  # of which not all are computed before the test has done what it tests


class Cluster:
    """A scheduler and workers, each a process of its own, as the README starts them."""

    def __init__(self, folder, stack):
        self.known, self.stack, self.workers = folder / "scheduler.json", stack, []
        self.scheduler = self.start("scheduler", "--port", "0", "--scheduler-file", self.known)
        wait_for(self.known.exists)
        self.address = json.loads(self.known.read_text())["address"]

    def start(self, *words, path=HERE):
        command = [sys.executable, "-m", "dask", *map(str, words), "--host", "127.0.0.1", "--no-dashboard"]
        process = subprocess.Popen(command, env=os.environ | {"PYTHONPATH": path}, stderr=subprocess.DEVNULL,
                                   cwd=self.known.parent)  # fmt: skip
        self.stack.callback(process.wait)
        self.stack.callback(process.kill)
        return process

    def set_workers(self, *paths, threads=1):
        """End all workers, and start others with these search paths."""
        self.workers, ended = [], self.workers
        for worker in ended:
            worker.kill()
            worker.wait()
        for path in paths:
            self.add_worker(path, threads)
        self.wait_until_known()

    def add_worker(self, path=HERE, threads=1):
        words = ("worker", self.address, "--nthreads", threads, "--no-nanny")
        self.workers.append(self.start(*words, path=path))

    def wait_until_known(self):
        from distributed import Client  # slow to import

        with Client(self.address, timeout=180, set_as_default=False) as client:
            wait_for(lambda: len(client.scheduler_info(n_workers=-1)["workers"]) == len(self.workers))


def wait_for(what, seconds=120):
    end = time.monotonic() + seconds
    while not what():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.02)


@pytest.fixture(scope="module")
def cluster(tmp_path_factory):
    with contextlib.ExitStack() as stack:
        yield Cluster(tmp_path_factory.mktemp("cluster"), stack)


@pytest.fixture
def ask(root, options, cluster, monkeypatch):
    """Runs a grid on the cluster; its results are stored under `root`/there."""
    monkeypatch.setattr(runs, "ROOT", root / "there")
    options(backend="dask", address=cluster.address)

    def run(numbers=(), hurry=9):
        configs = [{"log": str(root / "log"), "hurry": hurry, "n": n} for n in numbers]
        function, configs = (patient, configs) if numbers else (experiment, CONFIGS)
        return run_grid(chapter(), "grid", function, configs)

    return run


@contextlib.contextmanager
def meanwhile(log, function):
    """Runs a function once a run has begun, beside what is inside, and then raises what it raised."""
    def wait_and_call():
        wait_for(log.exists)
        function()

    with ThreadPoolExecutor(1) as pool:
        beside = pool.submit(wait_and_call)
        yield
        beside.result()


def who(log):
    """The processes that began a run, one a run."""
    return log.read_text().split()


@pytest.fixture
def other_numpy(tmp_path):
    """A search path on which there seems to be another numpy."""
    (tmp_path / "numpy-1.99.0.dist-info").mkdir()
    (tmp_path / "numpy-1.99.0.dist-info" / "METADATA").write_text("Name: numpy\nVersion: 1.99.0\n")
    return f"{tmp_path}{os.pathsep}{HERE}"


def test_a_worker_killed_in_the_middle_costs_its_runs_again_and_no_byte(root, cluster, ask, monkeypatch):
    cluster.set_workers(HERE, HERE)
    log, (victim, other) = root / "log", cluster.workers

    def kill():
        wait_for(lambda: str(victim.pid) in who(log))
        victim.kill()

    with meanwhile(log, kill):
        ask(FEW)
    assert victim.wait() == -signal.SIGKILL and other.poll() is None
    begun, there = who(log), stored(root / "there")
    assert set(begun) == {str(victim.pid), str(other.pid)} and len(begun) > 12 == len(there)
    monkeypatch.setattr(runs, "ROOT", root / "here")
    monkeypatch.delenv("LIFELONG_OPTIONS")
    ask(FEW)
    assert stored(root / "here") == there


def test_a_worker_that_comes_later_takes_its_share(root, cluster, ask):
    cluster.set_workers(HERE)
    with meanwhile(root / "log", cluster.add_worker):
        ask(MANY, hurry=2)
    assert set(who(root / "log")) == {str(worker.pid) for worker in cluster.workers}


def test_a_worker_with_other_versions_is_refused_and_nothing_is_stored(root, cluster, ask, other_numpy):
    cluster.set_workers(HERE, other_numpy)
    said = rf"^the Dask worker on \S+ has numpy 1.99.0, not {np.__version__}: start it again in the same checkout"
    with pytest.raises(ReproductionError, match=said) as caught:
        ask()
    assert "\n" not in str(caught.value) and not list((root / "there").rglob("*.*"))


def test_one_that_comes_later_is_refused_before_it_computes(root, cluster, ask, other_numpy):
    cluster.set_workers(HERE)
    with meanwhile(root / "log", lambda: cluster.add_worker(other_numpy)):
        with pytest.raises(ReproductionError, match="has numpy 1.99.0, not"):
            ask(MANY)
    assert set(who(root / "log")) == {str(cluster.workers[0].pid)}
    assert {run.versions["numpy"] for run in grid_store(root / "there").read().values()} == {np.__version__}


def test_a_worker_of_another_checkout_is_refused(root, cluster, ask, tmp_path):
    shutil.copytree(REPOSITORY / "lifelong_lib", tmp_path / "lifelong_lib")
    with open(tmp_path / "lifelong_lib" / "transfer" / "ella.py", "a") as file:
        file.write("# another line\n")
    cluster.set_workers(f"{tmp_path}{os.pathsep}{HERE}")
    with pytest.raises(ReproductionError, match=r"has lifelong_lib and data [0-9a-f]{12}, not [0-9a-f]{12}: start it"):
        ask()


def test_versions_and_processor_are_those_of_where_a_run_was_computed(root, cluster, ask, monkeypatch):
    cluster.set_workers(HERE)
    monkeypatch.setattr("lifelong_lib.reproduction.machine.processor", lambda: "a desk")
    ask()
    found = [run.versions for run in grid_store(root / "there").read().values()]
    monkeypatch.undo()
    assert found == [versions()] * 4


@pytest.mark.parametrize(("paths", "threads", "said"), [
    ([HERE], 2, "workers need --nthreads 1, it has .2.$"), ([], 1, "workers need --nthreads 1, it has none$"),
    ([""], 1, "does not know lifelong_lib: start its scheduler and workers in the checkout, with PYTHONPATH.*No mod"),
])  # fmt: skip
def test_a_cluster_that_cannot_compute_is_one_line(cluster, ask, paths, threads, said):
    cluster.set_workers(*paths, threads=threads)
    with pytest.raises(ReproductionError, match=said):
        ask()


def test_a_scheduler_that_is_gone_is_one_line_and_what_was_stored_stays(root, cluster, ask):
    cluster.set_workers(HERE)

    def kill():
        wait_for(lambda: len(who(root / "log")) > 5)  # of which at most four are not stored yet
        cluster.scheduler.kill()

    said = "the Dask scheduler at tcp://.* is gone: start it and run again"
    with meanwhile(root / "log", kill), pytest.raises(ReproductionError, match=said):
        ask(MANY)
    assert grid_store(root / "there").read()
