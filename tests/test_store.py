"""The store: nothing lost, nothing damaged used in silence."""

import errno
import io
import json
import os
from pathlib import Path

import experiments
import numpy as np
import pytest
from experiments import CONFIGS, files, report, run_and_read

from lifelong_lib.reproduction import store
from lifelong_lib.reproduction.files import ReproductionError, require
from lifelong_lib.reproduction.machine import processor
from lifelong_lib.reproduction.store import to_npz


@pytest.mark.parametrize("suffix", [".npz", ".json"])
@pytest.mark.parametrize("damage", [lambda old: old[:50], lambda old: b"", lambda old: old[:-1] + bytes([old[-1] ^ 1])])
def test_damaged_files_are_named_set_aside_and_recomputed(root, capsys, suffix, damage):
    expected = run_and_read(root)
    victim = next(root.rglob(f"*cart-pole*s1{suffix}"))
    victim.write_bytes(damage(victim.read_bytes()))
    assert run_and_read(root) == expected and report(root)["computed"] == 1
    assert "domain=cart-pole,tasks=3-s1.npz is damaged" in capsys.readouterr().err
    assert victim.with_name(victim.name + ".damaged").exists()


def test_a_file_of_another_run_and_a_record_without_arrays_are_not_read(root):
    expected = run_and_read(root)
    for suffix in (".npz", ".json"):
        one, other = (next(root.rglob(f"*cart-pole*s{seed}{suffix}")) for seed in (0, 1))
        other.write_bytes(one.read_bytes())
    next(root.rglob("*bicycle*s1.npz")).unlink()
    assert run_and_read(root) == expected and report(root)["computed"] == 2


def test_half_a_pair_counts_as_missing(root):
    expected = run_and_read(root)
    next(root.rglob("*s1.json")).unlink()  # killed between the two files
    assert run_and_read(root) == expected and report(root)["computed"] == 1 and not files(root, "*.damaged")


def test_a_full_disk_between_the_two_files_leaves_no_false_pair(root, monkeypatch, capsys):
    run_and_read(root)
    monkeypatch.setattr(experiments, "SCALE", 4.0)
    with monkeypatch.context() as patch:
        patch.setattr(store, "write_json", lambda path, content: require(False, "no space for the record"))
        with pytest.raises(ReproductionError, match="no space"):
            run_and_read(root)
    run_and_read(root)
    assert report(root)["computed"] == 4 and "damaged" not in capsys.readouterr().err


def test_npz_bytes_depend_on_the_values_only():
    values = {name: np.arange(float(i)) for i, name in enumerate("hgfedcba")}
    data = to_npz(values)
    assert data == to_npz(dict(reversed(values.items()))) != to_npz(values | {"a": np.arange(7.0) + 1})
    with np.load(io.BytesIO(data), allow_pickle=False) as stored:
        assert stored.files == sorted(values) and stored["c"].tolist() == [0, 1, 2, 3, 4]


def test_record_says_what_made_the_run(root):
    run_and_read(root)
    record = json.loads(next(root.rglob("*cart-pole*s1.json")).read_text())
    assert (record["config"], record["seed"], record["chapter"]) == (CONFIGS[0], 1, 4)
    assert record["versions"]["numpy"] == np.__version__ and record["seconds"] > 0
    assert record["versions"]["processor"] == processor() != ""
    assert set(record["fingerprint"]) >= {"function experiment", "function helper", "global SCALE"}


@pytest.mark.parametrize("cause, word", [(errno.ENOSPC, "disk is full"), (errno.EACCES, "Permission denied")])
def test_full_disk_is_one_line_and_leaves_no_part_behind(root, monkeypatch, cause, word):
    def refuse(part, path):
        assert Path(part).exists()
        raise OSError(cause, os.strerror(cause))

    monkeypatch.setattr(os, "replace", refuse)
    with pytest.raises(ReproductionError, match=word) as caught:
        run_and_read(root)
    assert "\n" not in str(caught.value) and not files(root, "*.part")
