"""Grids: what a run is, what it draws from and what it depends on."""

import json

import numpy as np
import pytest
from experiments import CONFIGS, chapter, experiment, report

from lifelong_lib.reproduction.configurations import canonical, file_name, from_cell, to_cell
from lifelong_lib.reproduction.files import ReproductionError, sha256
from lifelong_lib.reproduction.runs import Chapter, run_card, run_grid

ARRAYS = {"sources": np.array([[0.5, -1.0], [2.0, 3.25]]), "others": np.zeros(0)}


def draw(config, seed, **inputs):
    return {"x": np.random.default_rng(seed).random(3), "sum": sum(array.sum() for array in inputs.values())}


def greedy(config, seed, w):
    w += 1
    return {"w": w}


def drawn_as_before(config, text_entries):
    """What a run drew when arrays stood in its configuration as JSON text."""
    entropy = int(sha256(json.dumps([4, "grid", canonical(config | text_entries), 0])), 16)
    return np.random.default_rng(np.random.SeedSequence(entropy)).random(3)


def test_draws_depend_on_chapter_name_config_and_seed_only(root):
    first = run_grid(chapter(), "grid", experiment, CONFIGS, seeds=[5])
    turned = dict(reversed(CONFIGS[0].items()))
    again = run_grid(Chapter(4, "smoke", 1, 1), "grid", experiment, [turned], seeds=[5, 3])
    np.testing.assert_array_equal(first[0].values["curve"], again[1].values["curve"])
    others = [again[0], run_grid(chapter(), "other", experiment, CONFIGS, seeds=[5])[0],
              run_grid(Chapter(3, "quick", 1, 1), "grid", experiment, CONFIGS, seeds=[5])[0]]  # fmt: skip
    config = CONFIGS[0] | {"step": 0.1}
    others.append(run_grid(chapter(), "grid", experiment, [config], seeds=[5])[0])
    for other in others:
        assert not np.array_equal(first[0].values["curve"], other.values["curve"])


@pytest.mark.parametrize("configs", [
    [], [{"a": [1]}], [{"a": np.nan}], [{"a": 1}, {"a": 1}], [{"a": 1, "b": 2}, {"b": 2, "a": 1}], ["a"], [{"a b": 1}],
    [{"a": "x"}, {"a": "X"}], [{"a": np.int64(1)}],
])  # fmt: skip
def test_bad_configurations_are_refused(root, configs):
    with pytest.raises(ReproductionError, match="config"):
        run_grid(chapter(), "grid", experiment, configs)


@pytest.mark.parametrize("seeds", [0, -1, 1.5, "3", [], [1, 1], [-1], [True]])
def test_bad_seeds_names_and_ids_are_refused(root, seeds):
    with pytest.raises(ReproductionError, match="seeds"):
        run_grid(chapter(), "grid", experiment, CONFIGS, seeds=seeds)
    with pytest.raises(ReproductionError, match="grid name"):
        run_grid(chapter(), "../grid", experiment, CONFIGS)
    with pytest.raises(ReproductionError, match="makes"):
        run_grid(chapter(), "grid", experiment, CONFIGS, makes="F4.2")


def test_different_configurations_never_share_a_file():
    values = [1, 1.0, "1", True, "true", "True", None, "null", "", "a b", "a_b", "a,c=1", "1.0", "é", "~", -0.0, 0.0]
    configs = [{"a": value} for value in [*values, "0.0", "x" * 300, "x" * 301]]
    configs += [{}, {"a": "run"}, {"a": "a", "c": 1}, {"a": 1, "b": 1}, {"a": "a-s1"}, {"a": "a"}]
    names = [file_name(config) for config in configs]
    assert len({f"{name}-s{seed}" for name in names for seed in (0, 1, 11)}) == 3 * len(names)
    assert all(len(name) <= 120 and name.isascii() and "/" not in name for name in names)
    assert file_name({"tasks": 40, "domain": "cart-pole"}) == "domain=cart-pole,tasks=40"


def test_every_value_survives_a_cell():
    texts = ["1", "true", "null", "", "a b", "a,\n\"b", "é", "NaN", "x"]
    for value in [1, 1.0, True, None, -0.0, 0.1 + 0.2, 10**20, *texts]:
        back = from_cell(to_cell(value))
        assert repr(back) == repr(value)


def test_inputs_reach_the_experiment_and_count_as_entries_for_its_luck(root):
    (run,) = run_grid(chapter(seeds=1), "grid", draw, [{"a": 1}], inputs=ARRAYS)
    assert run.values["sum"] == 4.75 and run.config == {"a": 1}
    texts = {"sources": "[[0.5, -1.0], [2.0, 3.25]]", "others": "[]"}
    np.testing.assert_array_equal(run.values["x"], drawn_as_before({"a": 1}, texts))


def test_each_configuration_can_have_its_own_inputs_and_a_changed_one_is_named(root):
    configs, inputs = [{"a": 1}, {"a": 2}], [{"w": np.arange(3)}, {"w": np.ones(2)}]
    first = run_grid(chapter(seeds=1), "grid", draw, configs, inputs=inputs)
    assert [float(run.values["sum"]) for run in first] == [3, 2]
    inputs[1] = {"w": np.ones(3)}
    again = run_grid(chapter(seeds=1), "grid", draw, configs, inputs=inputs)
    assert [float(run.values["sum"]) for run in again] == [3, 3]
    assert (report(root)["computed"], report(root)["causes"]) == (1, {"input w changed": 1})
    run_grid(chapter(seeds=1), "grid", draw, configs)
    assert report(root)["causes"] == {"input w is gone": 2}


@pytest.mark.parametrize("workers", [1, 2])
def test_a_run_that_changes_its_input_does_not_change_that_of_the_next(root, workers):
    results = run_grid(chapter(workers=workers), "grid", greedy, [{}], inputs={"w": np.zeros(2)})
    assert results.stack("w").tolist() == [[1, 1], [1, 1]]


@pytest.mark.parametrize("inputs, word", [
    ({"a": np.ones(2)}, "both an input and an entry"), ({"w": [1.0]}, "'w'.*not list"),
    ([{}] * 3, "1 config.* 3 inputs"), ({"w": np.array([object()])}, "'w'.*array of numbers"),
])  # fmt: skip
def test_bad_inputs_are_refused(root, inputs, word):
    with pytest.raises(ReproductionError, match=word):
        run_grid(chapter(), "grid", draw, [{"a": 1}], inputs=inputs)


def test_a_changed_file_makes_runs_stale_by_its_name(root, monkeypatch):
    (root / "data").mkdir()
    (root / "data" / "left.net.xml").write_text("<net/>")
    (root / "data" / "right.net.xml").write_text("<net/>")
    files = ["data/left.net.xml", root / "data" / "right.net.xml"]
    run_grid(chapter("paper"), "grid", draw, CONFIGS, files=files)
    run_grid(chapter("paper"), "grid", draw, CONFIGS, files=files)
    assert report(root, "paper")["stale"] == 0
    (root / "data" / "right.net.xml").write_text("<net />")
    changed = chapter("paper")
    run_grid(changed, "grid", draw, CONFIGS, files=files)
    assert report(root, "paper")["causes"] == {"file data/right.net.xml changed": 4}
    assert "stale:    4 of 4 runs" in run_card(changed)


@pytest.mark.parametrize("files, word", [(["data/no.csv"], "no.csv.* is missing: restore"), ("data", "list of paths")])
def test_bad_files_are_refused(root, files, word):
    with pytest.raises(ReproductionError, match=word):
        run_grid(chapter(), "grid", draw, CONFIGS, files=files)


def test_runs_with_the_same_luck_draw_the_same_numbers(root):
    configs = [{"task": task, "method": method, "looks": looks}
               for task in "ab" for method in ("PG", "ELLA") for looks in (1, 2)]  # fmt: skip
    results = run_grid(chapter(), "grid", draw, configs, luck=["task"])
    by_task = {task: [run.values["x"] for run in results if run.config["task"] == task] for task in "ab"}
    for draws in by_task.values():
        assert len(np.unique(draws, axis=0)) == 2  # one a seed
    assert not np.array_equal(by_task["a"][0], by_task["b"][0])
    run_grid(chapter(), "grid", draw, configs, luck=["task", "method"])
    assert report(root)["causes"] == {"luck changed": 16}


def test_luck_of_all_entries_is_the_luck_without_a_word(root):
    plain = run_grid(chapter(), "grid", draw, CONFIGS)
    named = run_grid(chapter("smoke"), "grid", draw, CONFIGS, luck=("tasks", "domain"))
    np.testing.assert_array_equal(plain[0].values["x"], named[0].values["x"])


@pytest.mark.parametrize("luck, word", [(["colour"], "colour, which a configuration lacks"), ("tasks", "list of n")])
def test_bad_luck_is_refused(root, luck, word):
    with pytest.raises(ReproductionError, match=word):
        run_grid(chapter(), "grid", draw, CONFIGS, luck=luck)
