"""What more seeds and workers cost: schedules by hand, and the table of what is stored."""

import pytest
from experiments import CONFIGS, grid_store, run_and_read

from lifelong_lib.reproduction.costs import cost_table, schedule


@pytest.mark.parametrize(("workers", "total", "idle"), [(1, 14, 0), (2, 9, 4 / 18), (3, 7, 7 / 21), (9, 6, 40 / 54)])
def test_a_schedule_by_hand(workers, total, idle):
    """Two workers: one does 3 and then 4, the other 1 and 2; the second grid waits for 7 and takes 2 more."""
    assert schedule([[3, 1, 2, 4], [2, 2]], workers) == pytest.approx((total, idle))


def test_a_grid_waits_for_the_longest_run_of_the_one_before():
    assert schedule([[100, 1, 1], [1]], 1000) == pytest.approx((101, 1 - 103 / 101_000))


def test_the_table_repeats_the_seconds_that_are_stored(root):
    run_and_read(root, profile="paper")
    store = grid_store(root, profile="paper")
    runs = store.read()
    seconds = dict(zip(sorted(runs), (3600.0, 7200.0, 1800.0, 1800.0), strict=True))
    store.pack({key: type(run)(**vars(run) | {"seconds": seconds[key]}) for key, run in runs.items()})
    rows = cost_table(root / "data" / "results" / "paper", seeds=(1, 3), workers=(1, 2))
    assert len(CONFIGS) == 2
    by_hand = [(1, 2, 1, 1.5, 0), (1, 2, 2, 1, 0.25), (3, 6, 1, 5.5, 0), (3, 6, 2, 3, 0.5 / 6)]
    assert [tuple(row.values())[:5] for row in rows] == [pytest.approx(row) for row in by_hand]
    assert [row["longest run [h]"] for row in rows] == [1, 1, 2, 2]


def test_nothing_stored_is_no_row(root):
    assert cost_table(root / "data" / "results" / "paper") == []
