"""Audits: what comes out again is told from what does not."""

from dataclasses import replace

import experiments
import numpy as np
import pytest
from experiments import CONFIGS, chapter, experiment, grid_store, report, run_and_read, stored

from lifelong_lib.reproduction.audits import differences
from lifelong_lib.reproduction.files import ReproductionError
from lifelong_lib.reproduction.runs import NotStored, run_card, run_grid


def audited(root, options, monkeypatch, number):
    """Audits two stored grids; before the second the code changes, so that its curves come out differently."""
    for name in ("grid", "second"):
        run_grid(chapter(), name, experiment, CONFIGS)
    before = stored(root)
    options(audit=number)
    for name in ("grid", "second"):
        run_grid(chapter(), name, experiment, CONFIGS)
        monkeypatch.setattr(experiments, "SCALE", 4.0)
    assert stored(root) == before
    return report(root)["audited"], report(root, name="second")["audited"]


def test_audit_tells_equal_from_different(root, options, monkeypatch):
    found = [[(row["same"], row["stale"], [text[:8] for text in row["differs"]]) for row in rows]
             for rows in audited(root, options, monkeypatch, 8)]
    assert found == [[(True, False, [])] * 4, [(False, True, ["curve by"])] * 4]
    with pytest.raises(NotStored, match="2 of 6"):
        run_and_read(root, seeds=3)


def test_audit_draws_k_runs_of_the_chapter(root, options, monkeypatch):
    first, second = audited(root, options, monkeypatch, 3)
    assert len(first) + len(second) == 3


def doubled(x):
    return (x + x) * (experiments.SCALE / 2)


def test_a_refactoring_that_changes_no_number_is_stamped_and_then_nothing_is_stale(root, options, monkeypatch):
    run_grid(chapter("paper"), "grid", experiment, CONFIGS)
    before = stored(root, profile="paper")
    monkeypatch.setattr(experiments, "helper", doubled)
    run_grid(chapter("paper"), "grid", experiment, CONFIGS)
    assert report(root, "paper")["stale"] == 4
    options(audit=2, stamp=True)
    run_grid(chapter("paper"), "grid", experiment, CONFIGS)
    said = report(root, "paper")
    assert [row["same"] for row in said["audited"]] == [True, True] and said["stale"] == 0
    assert len({row["run"].partition("-s")[0] for row in said["audited"]}) == 2  # one of each configuration
    ((stamp, count),) = said["stamps"].items()
    assert count == 4 and stamp.startswith("audited 2 of 4 at commit ")
    assert {run.stamp for run in grid_store(root, profile="paper").read().values()} == {stamp}
    assert stored(root, profile="paper") == before
    options()
    card = chapter("paper")
    run_grid(card, "grid", experiment, CONFIGS)
    assert "stale" not in run_card(card) and "stamped:  4 of 4 runs" in run_card(card)


def test_a_changed_formula_is_not_stamped(root, options, monkeypatch):
    before = run_and_read(root, profile="paper")
    files = [path.read_bytes() for path in sorted(grid_store(root, profile="paper").folder.iterdir())]
    monkeypatch.setattr(experiments, "SCALE", np.nextafter(2.0, 3.0).item())
    options(audit=1, stamp=True)
    assert run_and_read(root, profile="paper") == before
    said = report(root, "paper")
    assert not said["audited"][0]["same"] and said["stale"] == 4 and said["stamps"] == {}
    assert files == [path.read_bytes() for path in sorted(grid_store(root, profile="paper").folder.iterdir())]


def test_only_stale_runs_are_audited_for_a_stamp_and_get_it(root, options, monkeypatch):
    run_grid(chapter("paper"), "grid", experiment, CONFIGS[:1])
    monkeypatch.setattr(experiments, "helper", doubled)
    run_grid(chapter("paper"), "grid", experiment, CONFIGS)
    store = grid_store(root, profile="paper")
    for run in store.read().values():
        store.add(run)  # what a kill left beside the packed grid does not undo the stamp
    options(audit=3, stamp=True)
    run_grid(chapter("paper"), "grid", experiment, CONFIGS)
    assert len(report(root, "paper")["audited"]) == 2 and report(root, "paper")["stale"] == 0
    stamps = {run.config["domain"]: run.stamp != "" for run in store.read().values()}
    assert stamps == {"cart-pole": True, "bicycle": False} and store.packed


TIMES = 1


def timed(config, seed):
    return {"seconds of nothing": TIMES * 0.5}


def test_a_grid_of_measured_times_is_stamped_but_says_so(root, options, monkeypatch):
    run_grid(chapter("paper"), "grid", timed, CONFIGS)
    monkeypatch.setitem(globals(), "TIMES", 2)
    options(audit=1, stamp=True)
    run_grid(chapter("paper"), "grid", timed, CONFIGS)
    assert report(root, "paper")["stale"] == 0
    assert next(iter(report(root, "paper")["stamps"])).endswith("with nothing to compare but measured times")


def test_differences_say_where_and_how_much():
    old = {"a": np.arange(3.0), "b": np.array([1, 2]), "c": np.zeros(2), "seconds x": np.ones(1), "n": np.array(np.nan)}
    new = {"a": np.arange(3.0) + [0, 0, 0.5], "b": np.array([1, 3]), "d": np.zeros(2), "n": np.array(np.nan)}
    said = ["a by 0.5 at most", "b at 1 of 2 places", "c is gone", "d is new"]
    assert differences(old, new) == (5, said) and differences(old, old) == (4, [])
    assert differences({"a": np.zeros(2)}, {"a": -np.zeros(2)})[1] == ["a by 0 at most"]
    assert differences({"a": np.zeros(2)}, {"a": np.zeros(3)})[1] == ["a of float64 (3,), not float64 (2,)"]


@pytest.fixture
def elsewhere(root, options, tmp_path):
    """A grid whose stored values another processor rounded, and a folder that its code has filled here."""
    run_grid(chapter("paper"), "grid", experiment, CONFIGS)
    store = grid_store(root, profile="paper")
    store.pack({key: replace(run, values=run.values | {"gram": np.nextafter(run.values["gram"], 9)})
                for key, run in store.read().items()})  # fmt: skip
    options(audit=2, values=str(tmp_path / "kept"))
    run_grid(chapter("paper"), "grid", experiment, CONFIGS)
    assert len(list((tmp_path / "kept").rglob("*.npz"))) == 2
    return stored(root, profile="paper")


def stamp_beside(root, options, folder, number=2):
    options(audit=number, stamp=True, beside=str(folder))
    run_grid(chapter("paper"), "grid", experiment, CONFIGS)
    return report(root, "paper")


def test_another_processor_gives_no_stored_bytes_back_but_both_codes_do_the_same_there(
    root, options, monkeypatch, tmp_path, elsewhere
):
    monkeypatch.setattr(experiments, "helper", doubled)  # a refactoring
    options(audit=2, stamp=True)
    run_grid(chapter("paper"), "grid", experiment, CONFIGS)
    assert report(root, "paper")["stale"] == 4
    said = stamp_beside(root, options, tmp_path / "kept")
    assert [row["same"] for row in said["audited"]] == [True, True] and said["stale"] == 0
    ((stamp, count),) = said["stamps"].items()
    assert count == 4 and stamp.startswith("audited 2 of 4 beside the code that made them, on one machine at commit ")
    assert stored(root, profile="paper") == elsewhere
    assert stamp_beside(root, options, tmp_path / "nothing")["audited"] == []  # nothing is stale any more


def test_beside_the_code_that_made_it_a_changed_formula_is_not_stamped(root, options, monkeypatch, tmp_path, elsewhere):
    monkeypatch.setattr(experiments, "SCALE", np.nextafter(2.0, 3.0).item())
    said = stamp_beside(root, options, tmp_path / "kept")
    assert not any(row["same"] for row in said["audited"]) and said["stale"] == 4 and said["stamps"] == {}


def test_a_folder_of_other_code_or_of_too_few_runs_is_refused(root, options, monkeypatch, tmp_path, elsewhere):
    monkeypatch.setattr(experiments, "helper", doubled)
    with pytest.raises(ReproductionError, match="has 2 runs of 'grid', not 3: fill it with audit --values"):
        stamp_beside(root, options, tmp_path / "kept", 3)
    options(audit=2, values=str(tmp_path / "other"))
    run_grid(chapter("paper"), "grid", experiment, CONFIGS)
    with pytest.raises(ReproductionError, match="is not of the code that made the stored .*: function helper"):
        stamp_beside(root, options, tmp_path / "other")
