"""Where runs are computed: in this process, in worker processes of this machine (loky), or on a Dask cluster.

All three do the same with a run, so that its numbers cannot depend on the place. To a cluster go the experiment, the
configuration, the seed and the inputs; the library and its data are there, and must be those that are here.
"""

import contextlib
import gc
import os
import platform
import re
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, CancelledError, wait
from functools import cache, partial
from typing import NamedTuple

import cloudpickle
import numpy as np
from joblib.externals.loky import get_reusable_executor
from threadpoolctl import threadpool_info, threadpool_limits

from lifelong_lib.reproduction.files import ReproductionError, require
from lifelong_lib.reproduction.machine import checkout, versions


class Call(NamedTuple):
    """One run to compute."""

    label: str  # which an error gets
    config: Mapping
    entropy: int  # of its SeedSequence
    inputs: Mapping  # name -> array


def completed(experiment: Callable, calls: Mapping, backend: str, workers: int, address: str) -> Iterator[tuple]:
    """(key, values, wall seconds, versions there) of every call, as they end. Closing it early stops the workers.

    calls: key -> Call; backend: loky or dask; workers: number of processes of loky, 1 being this one; address: of a
    running Dask scheduler.
    """
    blob, installed = cloudpickle.dumps(experiment), versions()  # by value: workers cannot import a notebook
    if not calls or (backend == "loky" and workers == 1):
        yield from ((key, *_compute(installed, blob, *call)) for key, call in calls.items())
        return
    waiting, running = list(reversed(calls.items())), {}
    with _loky(workers) if backend == "loky" else _dask(address, installed) as (executor, compute, size):
        while waiting or running:
            while waiting and len(running) < 2 * size():  # a short queue, which loky takes over at once: see _loky
                key, call = waiting.pop()
                running[executor.submit(compute, installed, blob, *call)] = key
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                yield running.pop(future), *future.result()


def _compute(installed, blob, label, config, entropy, inputs) -> tuple[dict, float, dict]:
    """Values, wall seconds and what is installed, of one run on one thread. An error says which run failed."""

    def name_the_run(kind, error, trace):
        if isinstance(error, Exception):
            raise ReproductionError(f"{label}: {kind.__name__}: {' '.join(str(error).split())}") from error

    with contextlib.ExitStack() as stack, threadpool_limits(1):
        stack.push(name_the_run)
        if torch := sys.modules.get("torch"):
            torch.set_num_threads(1)
        start = time.perf_counter()
        own = {name: array.copy() for name, array in inputs.items()}  # a run may change what it is given
        values = _arrays(cloudpickle.loads(blob)(dict(config), np.random.SeedSequence(entropy), **own))
        seconds = time.perf_counter() - start
        busy = [f"{pool['prefix']} {pool['num_threads']}" for pool in threadpool_info() if pool["num_threads"] > 1]
        require(not busy, f"a run must use one thread, this one used more: {', '.join(busy)}")
    return values, seconds, installed


def _arrays(values) -> dict[str, np.ndarray]:
    """The values as arrays of numbers or texts in one memory layout; anything else is refused by its name."""
    require(isinstance(values, dict) and values, f"it must return a dict of arrays and numbers, not {values!r}")
    arrays = {}
    for key, value in values.items():
        named = isinstance(key, str) and re.fullmatch(r"(?!(file|allow_pickle)$)[\w .+=-]+", key)  # these are savez's
        require(named, f"{key!r} cannot be the name of a result")
        with contextlib.suppress(ValueError, TypeError):  # e.g. lists of different lengths
            arrays[key] = np.asarray(value, order="C")
        good = key in arrays and arrays[key].dtype.kind in "biufcU"
        require(good, f"result {key!r} ({type(value).__name__}) is not an array of numbers or texts")
    return arrays


@contextlib.contextmanager
def _loky(workers):
    """Worker processes on this machine, kept for the next grid, stopped at once after an error or Ctrl-C."""
    # After Ctrl-C loky's resource tracker, a process of its own, may warn of what the workers have tidied up already.
    filters = os.environ.get("PYTHONWARNINGS", "")
    if "ignore:resource_tracker" not in filters:
        os.environ["PYTHONWARNINGS"] = f"{filters},ignore:resource_tracker".strip(",")
    pool, failed = get_reusable_executor(workers, timeout=60, initializer=_prepare_worker), True
    try:
        yield pool, _compute, lambda: workers
        failed = False
    except BrokenExecutor as error:
        raise ReproductionError("a worker process died (a crash, or no memory left): use fewer workers") from error
    finally:
        if failed:
            with contextlib.suppress(BrokenExecutor):
                last, end = pool.submit(int), time.monotonic() + 1  # loky's thread fails on calls it has not yet taken
                while not (last.running() or last.done()) and time.monotonic() < end:
                    time.sleep(0.001)
            pool.shutdown(kill_workers=True)


def _prepare_worker():
    """Leave Ctrl-C to the parent process, and end when that was killed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = os.getppid()

    def watch():
        while os.getppid() == parent:
            time.sleep(0.5)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


@contextlib.contextmanager
def _dask(address, installed):
    """The cluster at the given address, whose workers may come and go."""
    from distributed import Client, KilledWorker  # slow to import, and rarely wanted
    from distributed.comm import CommClosedError

    client = None
    with contextlib.suppress(OSError, ValueError):
        client = Client(address, timeout=10)
    if client is None:
        gc.collect()  # found only while the next client starts, the failed one would make that wait forever
        raise ReproductionError(f"no Dask scheduler answers at {address}: start it, or use loky")

    mend = "start its scheduler and workers in the checkout, with PYTHONPATH=."
    stranger = f"Dask at {address} does not know lifelong_lib: {mend}"

    def size(least=0):
        threads = list(client.nthreads().values())
        right = set(threads) <= {1} and len(threads) >= least
        require(right, f"Dask at {address}: workers need --nthreads 1, it has {set(threads) or 'none'}")
        return max(1, len(threads))  # none for a moment: what is submitted waits for the next one

    with client:
        size(least=1)
        for found in client.run(_require_alike, installed, checkout(), on_error="return").values():
            if not isinstance(found, dict):
                raise found if isinstance(found, ReproductionError) else ReproductionError(f"{stranger} ({found})")
        try:
            yield client.get_executor(), partial(_compute_there, checkout()), size
        except KilledWorker as error:
            raise ReproductionError("Dask workers died again and again (out of memory, or a crash)") from error
        except (CancelledError, CommClosedError) as error:  # the second where it is being asked something
            raise ReproductionError(f"the Dask scheduler at {address} is gone: start it and run again") from error
        except RuntimeError as error:  # so Dask says that its scheduler cannot import what was sent
            require("deserialization" not in str(error), stranger)
            raise


def _compute_there(code, installed, *run):
    """What `_compute` does, on a worker that may have come later than the others."""
    return _compute(_require_alike(installed, code), *run)


def _require_alike(installed, code) -> dict:
    """The versions of this worker, which must be those `installed` where the command runs, but for the processor."""
    own, mend = _own_versions(), "start it again in the same checkout, with the same environment.txt"
    other = [f"{name} {own.get(name, 'none')}, not {version}" for name, version in installed.items()
             if name != "processor" and own.get(name) != version]  # fmt: skip
    other += [f"lifelong_lib and data {checkout()}, not {code}"] * (checkout() != code)
    require(not other, f"the Dask worker on {platform.node()} has {'; '.join(other)}: {mend}")
    return own


_own_versions = cache(versions)  # a worker asks at every run
