"""Where a run is computed: alone, isolated, on one thread, stopped cleanly, and named when it fails."""

import contextlib
import gc
import json
import os
import re
import subprocess
import sys
import threading
import time

import pytest
from joblib.externals.loky import process_executor

from lifelong_lib.reproduction.backends import Call, completed
from lifelong_lib.reproduction.files import ReproductionError


def run(experiment, configs, workers=1, backend="loky", address=""):
    calls = {key: Call(f"run {key}", config, key, {}) for key, config in enumerate(configs)}
    return {key: values for key, values, *_ in completed(experiment, calls, backend, workers, address)}


@pytest.mark.parametrize("workers", [1, 2])
def test_runs_use_one_thread_and_say_so_when_not(workers):
    def threads(config, seed):
        import threadpoolctl

        if config["greedy"]:
            threadpoolctl.threadpool_limits(2)
        return {"threads": max(pool["num_threads"] for pool in threadpoolctl.threadpool_info())}

    assert run(threads, [{"greedy": False}], workers)[0]["threads"] == 1
    with pytest.raises(ReproductionError, match="run 0: .*one thread"):
        run(threads, [{"greedy": True}], workers)


def test_runs_do_not_see_each_other():
    memory = [0]

    def remembering(config, seed):
        memory[0] += 1
        return {"calls": memory[0]}

    assert [values["calls"] for values in run(remembering, [{}] * 3).values()] == [1, 1, 1]


def test_more_calls_than_the_queue_holds_all_come_back():
    def echo(config, seed):
        return {"pair": [config["i"], seed.entropy]}

    found = run(echo, [{"i": i} for i in range(11)], workers=2)
    assert {key: values["pair"].tolist() for key, values in found.items()} == {i: [i, i] for i in range(11)}


def test_a_failing_run_stops_the_others():
    def one_fails(config, seed):
        if not config["seconds"]:
            raise ValueError("soon")
        time.sleep(config["seconds"])
        return {"x": 1}

    with pytest.raises(ReproductionError, match="run 0: ValueError: soon"):
        run(one_fails, [{"seconds": 0}, {"seconds": 20}, {"seconds": 20}], workers=2)
    start = time.monotonic()
    run(one_fails, [{"seconds": 0.01}], workers=2)
    assert time.monotonic() - start < 15  # else both workers were still asleep


@pytest.mark.parametrize("number", [1, 4, 5, 6])  # the first four fill the queue, the others follow as runs end
def test_an_interruption_between_a_submission_and_its_takeover_leaves_no_error_in_another_thread(monkeypatch, number):
    def soon(config, seed):
        time.sleep(0.05)
        return {"x": 1}

    def wakeup(self):  # how loky tells its own thread that something was submitted
        submissions.append(sys._getframe(1).f_code.co_name == "submit")
        if submissions[-1] and sum(submissions) == number:
            raise KeyboardInterrupt
        woken(self)

    submissions, errors, woken = [], [], process_executor._ThreadWakeup.wakeup
    run(soon, [{}] * 2, workers=2)  # starts the workers
    monkeypatch.setattr(process_executor._ThreadWakeup, "wakeup", wakeup)
    monkeypatch.setattr(threading, "excepthook", errors.append)
    with pytest.raises(KeyboardInterrupt):
        run(soon, [{}] * 10, workers=2)
    assert sum(submissions) >= number and not errors


def test_a_dying_worker_is_one_line():
    def die(config, seed):
        os._exit(3)

    with pytest.raises(ReproductionError, match="a worker process died"):
        run(die, [{}], workers=2)
    assert run(lambda config, seed: {"x": 1}, [{}], workers=2)[0]["x"] == 1  # and the next grid gets new workers


@pytest.mark.parametrize("values, key", [
    ({"net": object()}, "net"), ({"ragged": [[1], [1, 2]]}, "ragged"), ({"none": None}, "none"), ({"a/b": 1}, "a/b"),
    ({3: 1}, "3"), ({"bytes": b"x"}, "bytes"), ({"huge": 10**30}, "huge"), ({"inner": {"x": 1}}, "inner"),
    ([1], "dict"), ({}, "dict"),
])  # fmt: skip
def test_values_that_are_no_arrays_are_refused_by_name(values, key):
    with pytest.raises(ReproductionError, match=f"^run 0: .*{key}") as caught:
        run(lambda config, seed: values, [{}])
    assert "\n" not in str(caught.value)


def test_an_absent_dask_scheduler_is_one_line():
    with pytest.raises(ReproductionError, match="no Dask scheduler answers at nowhere"):
        run(lambda config, seed: {"x": 1}, [{}], backend="dask", address="nowhere")


def test_a_client_that_found_no_scheduler_is_not_left_to_the_garbage_collector():
    from distributed import Client  # slow to import

    gc.disable()
    try:
        with pytest.raises(ReproductionError, match="no Dask scheduler"):
            run(lambda config, seed: {"x": 1}, [{}], backend="dask", address="nowhere")
        assert not [thing for thing in gc.get_objects() if type(thing) is Client]
    finally:
        gc.enable()


def test_a_dask_scheduler_that_cannot_import_the_library_is_one_line(tmp_path):
    outside = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    known, end = tmp_path / "scheduler.json", time.monotonic() + 60
    start = [sys.executable, "-m", "dask", "scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard"]
    worker = [sys.executable, "-m", "dask", "worker", "--nthreads", "1", "--host", "127.0.0.1", "--no-dashboard"]
    with contextlib.ExitStack() as stack:
        for command, environment in ((start, outside), (worker, os.environ)):
            options = {"env": environment, "cwd": tmp_path, "stderr": subprocess.DEVNULL}
            stack.callback(subprocess.Popen([*command, "--scheduler-file", known], **options).terminate)
        said = "none"
        while said.endswith("none") and time.monotonic() < end:  # until the worker is there
            time.sleep(0.5)
            with pytest.raises((ReproductionError, OSError)) as caught:
                address = json.loads(known.read_text())["address"]
                run(lambda config, seed: {"x": 1}, [{}], backend="dask", address=address)
            said = str(caught.value) if isinstance(caught.value, ReproductionError) else "none"
    assert re.search("does not know lifelong_lib: .* with PYTHONPATH", said)
