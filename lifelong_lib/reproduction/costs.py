"""What a profile costs with more seeds and workers: the stored seconds of its runs, and a schedule made of them."""

import json
from collections.abc import Sequence
from heapq import heapreplace
from itertools import cycle, islice
from pathlib import Path

from lifelong_lib.reproduction.store import Store


def schedule(grids: Sequence[Sequence[float]], workers: int) -> tuple[float, float]:
    """Seconds that grids of runs take one after another, and the share of the workers' time that passes idly.

    A run goes to the worker that is free first, and a grid waits for the last run of the one before it.
    """
    total = 0.0
    for runs in grids:
        free = [0.0] * min(workers, len(runs))  # when each worker is
        for seconds in runs:
            heapreplace(free, free[0] + seconds)
        total += max(free)
    return total, 1 - sum(map(sum, grids)) / (workers * total)


def cost_table(results: Path, seeds=(10, 100, 1000), workers=(1, 10, 100, 1000)) -> list[dict]:
    """A row each for so many seeds of every configuration stored under `results` and so many workers; times in hours.

    A configuration's seconds are those of its own seeds, again and again. Chapters and grids follow one another.
    """
    stored = []
    for folder in sorted({path.parent for path in results.glob("ch*/*/record.json")}):
        own = {}
        for run in Store(folder, int(folder.parent.name[2:]), folder.name).read(keep=True).values():
            own.setdefault(json.dumps(run.config), []).append(run.seconds)
        stored.append(list(own.values()))
    rows = []
    for number in seeds if any(stored) else ():
        grids = [[second for own in configs for second in islice(cycle(own), number)] for configs in stored if configs]
        for count in workers:
            total, idle = schedule(grids, count)
            rows.append({"seeds": number, "runs": sum(map(len, grids)), "workers": count, "hours": total / 3600,
                         "idle": idle, "longest run [h]": max(map(max, grids)) / 3600})  # fmt: skip
    return rows
