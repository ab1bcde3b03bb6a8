"""The store: the same values and bytes, loose and packed; nothing lost, nothing damaged used in silence."""

import contextlib
import errno
import json
import os
import shutil
from dataclasses import replace
from pathlib import Path

import experiments
import numpy as np
import pytest
from experiments import CONFIGS, files, grid_store, report, run_and_read
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from lifelong_lib.reproduction import store as module
from lifelong_lib.reproduction.files import ReproductionError, require
from lifelong_lib.reproduction.machine import processor
from lifelong_lib.reproduction.packed import Run, from_npz, pack, to_npz
from lifelong_lib.reproduction.store import Store

VALUES = {"curve": np.arange(3.0), "gap": np.array(np.nan), "names": np.array(["a", "bc"]), "n": np.array(7)}
OTHERS = {"curve": np.arange(8.0).reshape(2, 4), "gap": np.array(-0.0), "n": np.array(7, dtype=np.int8)}
RUNS = [
    Run({"a": 1}, 10, VALUES, 0.25, {"function f": "1", "input w": "aa"}, {"processor": "x"}),
    Run({"a": 1}, 9, VALUES | {"n": np.array(8)}, 0.1 + 0.2, {"function f": "1", "input w": "bb"}, {"processor": "x"}),
    Run({"a": "1", "b": ""}, 0, OTHERS, 1e-9, {"function f": "1"}, {"processor": "y"}, "audited"),
    Run({}, 0, {"text": np.array("a,\n")}, 3.0, {"function f": "2"}, {"processor": "y"}),
]
WANTED = {run.key: run for run in RUNS}
PACKED = ["record.json", "runs.csv", "values.npz"]


def content(run):
    """Everything a run holds, comparable: types, shapes and bytes."""
    return run.config, run.seed, repr(run.seconds), run.made_by, run.versions, run.stamp, to_npz(run.values)


def same(found):
    return {key: content(run) for key, run in found.items()} == {key: content(run) for key, run in WANTED.items()}


@pytest.fixture
def store(tmp_path):
    return Store(tmp_path / "grid", 4, "grid")


def test_every_value_comes_back_loose_and_packed(store):
    for run in RUNS:
        store.add(run)
    assert same(store.read()) and not store.packed
    store.pack(store.read())
    assert store.packed and same(store.read())
    assert sorted(path.name for path in store.folder.iterdir()) == PACKED and not store.loose.exists()
    for run in store.read().values():
        assert all(array.flags.c_contiguous and isinstance(array, np.ndarray) for array in run.values.values())


def test_bytes_depend_on_the_runs_only():
    first, second = pack(RUNS, {"name": "grid"}), pack(RUNS[::-1], {"name": "grid"})
    assert first == second != pack([replace(RUNS[0], seconds=0.5), *RUNS[1:]], {"name": "grid"})
    values = {name: np.arange(float(i)) for i, name in enumerate("hgfedcba")}
    data = to_npz(values)
    assert data == to_npz(dict(reversed(values.items()))) != to_npz(values | {"a": np.arange(7.0) + 1})
    assert list(from_npz(data)) == sorted(values) and from_npz(data)["c"].tolist() == [0, 1, 2, 3, 4]


def test_a_person_can_read_a_packed_grid(store):
    store.pack(WANTED)
    lines = (store.folder / "runs.csv").read_text().splitlines()
    assert lines[0] == "group,config.a,config.b,seed,seconds,input.w,result.gap,result.n,result.text"
    assert lines[1:3] == ["0,1,,9,0.30000000000000004,bb,nan,8,", "0,1,,10,0.25,aa,nan,7,"]
    record = json.loads((store.folder / "record.json").read_text())
    assert [group["versions"]["processor"] for group in record["groups"]] == ["x", "y", "y"]
    assert [group["stamp"] for group in record["groups"]] == ["", "audited", ""]
    with np.load(store.folder / "values.npz", allow_pickle=False) as members:
        assert members["curve/0"].shape == (2, 3) and members["curve/1"].shape == (1, 2, 4)
        assert members["curve/0/runs"].tolist() == [0, 1] and members["curve/1/runs"].tolist() == [2]


class Killed(BaseException):
    """Nothing catches it, as nothing catches kill -9."""


def killed_at(monkeypatch, call, moment):
    """Calls something that dies before its n-th step that changes a file; returns whether it got so far."""
    left = [moment]

    def dying(function):
        def step(*arguments, **more):
            left[0] -= 1
            if left[0] < 0:
                raise Killed
            return function(*arguments, **more)
        return step

    with monkeypatch.context() as patch:
        for place, name in ((os, "replace"), (os, "unlink"), (os, "rmdir"), (Path, "write_bytes"), (Path, "unlink"),
                            (Path, "rmdir"), (Path, "mkdir")):  # fmt: skip
            patch.setattr(place, name, dying(getattr(place, name)))
        with contextlib.suppress(Killed):
            call()
    return left[0] < 0


def test_a_kill_at_any_step_of_packing_loses_nothing(store, monkeypatch, capsys):
    store.pack({RUNS[0].key: replace(RUNS[0], seconds=99.0), RUNS[1].key: RUNS[1]})  # an older form of two of them
    for run in (RUNS[0], *RUNS[2:]):
        store.add(run)
    start = store.folder.parent
    moment, places = 0, set()
    while True:
        root = start.with_name(f"killed{moment}")
        shutil.copytree(start, root)
        copy = Store(root / "grid", 4, "grid")
        if not killed_at(monkeypatch, lambda: copy.pack(copy.read()), moment):  # noqa: B023
            break
        places.add(tuple(sorted(path.name for path in root.iterdir())))
        assert same(copy.read()), moment
        again = killed_at(monkeypatch, lambda: copy.pack(copy.read()), moment // 2 + 1)  # noqa: B023
        assert same(copy.read()) and again in (True, False)
        copy.pack(copy.read())
        assert same(copy.read()) and [path.name for path in root.iterdir()] == ["grid"], moment
        moment += 1
    assert moment > 15 and len(places) > 3 and capsys.readouterr().err == ""


def damage(data, place, bit, cut):
    """A file's bytes with one bit turned over, or cut off at a place."""
    place = place % len(data)
    return data[:place] if cut else data[:place] + bytes([data[place] ^ 1 << bit]) + data[place + 1:]


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(loose=st.booleans(), file=st.integers(0), place=st.integers(0), bit=st.integers(0, 7), cut=st.booleans())
def test_no_damaged_file_is_read(tmp_path, capsys, loose, file, place, bit, cut):
    store = Store(tmp_path / "grid", 4, "grid")
    shutil.rmtree(store.loose, ignore_errors=True)
    store.pack(WANTED)
    if loose:
        for run in RUNS:
            store.add(run)
        shutil.rmtree(store.folder)
    paths = sorted(path for path in tmp_path.rglob("*") if path.is_file())
    victim = paths[file % len(paths)]
    victim.write_bytes(damage(victim.read_bytes(), place, bit, cut))
    capsys.readouterr()
    found = store.read(keep=True)
    lost = {victim.stem} if loose else WANTED.keys()
    assert found.keys() == WANTED.keys() - lost and same(WANTED | found)
    assert "damaged and not used" in capsys.readouterr().err


@pytest.mark.parametrize("name", PACKED)
def test_a_damaged_packed_grid_is_named_set_aside_and_computed_again(root, capsys, name):
    expected = run_and_read(root)
    victim = grid_store(root).folder / name
    victim.write_bytes(victim.read_bytes()[:-1])
    assert run_and_read(root) == expected and report(root)["computed"] == 4
    assert "ch04/grid is damaged and not used" in capsys.readouterr().err
    assert (root / "data" / "results" / "quick" / "ch04" / "grid.damaged" / name).exists()
    run_and_read(root)
    assert report(root)["computed"] == 0 and "damaged" not in capsys.readouterr().err


@pytest.mark.parametrize("suffix", [".npz", ".json"])
def test_a_damaged_loose_run_is_named_set_aside_and_computed_again(root, capsys, suffix):
    expected = run_and_read(root)
    victim = next(unpacked(root).glob(f"*cart-pole*s1{suffix}"))
    victim.write_bytes(victim.read_bytes()[:50])
    assert run_and_read(root) == expected and report(root)["computed"] == 1
    assert "domain=cart-pole,tasks=3-s1.npz is damaged" in capsys.readouterr().err
    assert victim.with_name(victim.name + ".damaged").exists()


def unpacked(root):
    """Makes the packed grid loose again; returns the folder."""
    store = grid_store(root)
    for run in store.read().values():
        store.add(run)
    shutil.rmtree(store.folder)
    return store.loose


def test_a_file_of_another_run_and_a_record_without_arrays_are_not_read(root):
    expected = run_and_read(root)
    loose = unpacked(root)
    for suffix in (".npz", ".json"):
        one, other = (next(loose.glob(f"*cart-pole*s{seed}{suffix}")) for seed in (0, 1))
        other.write_bytes(one.read_bytes())
    next(loose.glob("*bicycle*s1.npz")).unlink()
    assert run_and_read(root) == expected and report(root)["computed"] == 2


def test_a_grid_copied_over_another_is_not_read(store, tmp_path, capsys):
    store.pack(WANTED)
    other = Store(tmp_path / "other", 4, "other")
    shutil.copytree(store.folder, other.folder)
    assert other.read(keep=True) == {} and "it holds another grid" in capsys.readouterr().err


def test_half_a_pair_counts_as_missing(root):
    expected = run_and_read(root)
    next(unpacked(root).glob("*s1.json")).unlink()  # killed between the two files
    assert run_and_read(root) == expected and report(root)["computed"] == 1 and not files(root, "*.damaged")


def test_a_full_disk_between_the_two_files_leaves_no_false_pair(root, monkeypatch, capsys):
    run_and_read(root)
    monkeypatch.setattr(experiments, "SCALE", 4.0)
    with monkeypatch.context() as patch:
        patch.setattr(module, "seal", lambda content: require(False, "no space for the record"))
        with pytest.raises(ReproductionError, match="no space"):
            run_and_read(root)
    run_and_read(root)
    assert report(root)["computed"] == 4 and "damaged" not in capsys.readouterr().err


def test_more_seeds_and_runs_that_nobody_asks_for_now_are_packed_together(root):
    two = run_and_read(root)
    four = run_and_read(root, seeds=4)
    assert report(root)["computed"] == 4 and two.items() < four.items() and grid_store(root).packed
    assert run_and_read(root) == four and report(root)["wanted"] == 4 and report(root)["computed"] == 0


def test_what_a_kill_left_beside_a_packed_grid_is_cleaned_and_what_is_newer_is_packed(root):
    expected = run_and_read(root)
    store = grid_store(root)
    old, new = list(store.read().values())[:2]
    store.add(old)
    store.add(replace(new, seconds=1234.5))
    assert not store.packed
    assert run_and_read(root) == expected and report(root)["computed"] == 0 and store.packed
    assert store.read()[new.key].seconds == 1234.5


def test_a_record_says_what_made_the_runs(root):
    run_and_read(root)
    record = json.loads((grid_store(root).folder / "record.json").read_text())
    (group,) = record["groups"]
    assert (record["chapter"], record["name"]) == (4, "grid") and group["stamp"] == ""
    assert group["versions"]["numpy"] == np.__version__ and group["versions"]["processor"] == processor() != ""
    assert set(group["fingerprint"]) >= {"function experiment", "function helper", "global SCALE"}
    runs = grid_store(root).read().values()
    assert all(run.seconds > 0 for run in runs) and [run.config for run in runs][-1] == CONFIGS[0]


@pytest.mark.parametrize("cause, word", [(errno.ENOSPC, "disk is full"), (errno.EACCES, "Permission denied")])
def test_full_disk_is_one_line_and_leaves_no_part_behind(root, monkeypatch, cause, word):
    def refuse(part, path):
        assert Path(part).exists()
        raise OSError(cause, os.strerror(cause))

    monkeypatch.setattr(os, "replace", refuse)
    with pytest.raises(ReproductionError, match=word) as caught:
        run_and_read(root)
    assert "\n" not in str(caught.value) and not files(root, "*.part")


def test_a_disk_that_is_full_when_the_grid_is_packed_keeps_the_loose_runs(root, monkeypatch):
    def refuse(path, target, replace=os.replace):
        if Path(target).name == "runs.csv":
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        replace(path, target)

    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", refuse)
        with pytest.raises(ReproductionError, match="disk is full"):
            run_and_read(root)
    run_and_read(root)
    assert report(root)["computed"] == 0 and grid_store(root).packed
