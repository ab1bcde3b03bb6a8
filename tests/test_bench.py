"""The bench at a toy scale: rows, verdicts and equal results. No test looks at a clock."""

import bench
import numpy as np
import pytest
import torch
from bench import Row


def test_a_row_is_judged_by_its_bound():
    assert Row("", 30, "at least", 30).ok and not Row("", 29.9, "at least", 30).ok
    assert Row("", 1.1, "at most", 1.1).ok and not Row("", 1.11, "at most", 1.1).ok


def test_medians_come_from_alternating_calls_without_the_warming_up(monkeypatch):
    clock, calls = [0.0], []
    monkeypatch.setattr(bench, "perf_counter", lambda: clock[0])

    def side(name, durations):
        def call():
            calls.append(name)
            clock[0] += next(durations)
        return call

    first, second = side("a", iter([100, 1, 9, 2])), side("b", iter([100, 5, 3, 4]))
    assert bench.medians(3, first, second).tolist() == [2, 4]
    assert calls == ["a", "b"] * 4


@pytest.mark.filterwarnings("ignore:Objective did not converge")
def test_every_promise_is_measured_and_dense_and_fast_updates_agree(monkeypatch, capsys):
    small = {"batched_roll_outs": {"count": 2, "n": 2, "repetitions": 1}, "many_tasks": {"many": 12, "repetitions": 2},
             "dense_inverse": {"tasks": 6, "columns": 2, "repetitions": 2}, "junction": {"repetitions": 1},
             "q_update": {"repetitions": 2}, "q_learning": {"iterations": 2, "repetitions": 1},
             "inserts": {"sizes": (12, 30), "decisions": 2, "repetitions": 2}, "digit_update": {"repetitions": 2},
             "mask": {"repetitions": 1}}
    for name, sizes in small.items():
        measure = getattr(bench, name)
        monkeypatch.setattr(bench, name, lambda *given, measure=measure, sizes=sizes: measure(*given, **sizes))
    monkeypatch.setattr(bench.shutil, "which", lambda program: None)  # no SUMO but that inside libsumo
    rows = bench.main()
    assert [(row.bound, row.limit) for row in rows] == [
        *[("at least", 30)] * 4, ("at most", 1.1),
        ("at least", 3), ("at most", 1e-8), ("at least", 10), ("at most", 1e-8),
        ("at least", 0.8), ("at most", 1.8), ("at most", 0.85), ("at most", 0.6), ("at least", 1.6),
        ("at most", 0.05), ("at most", 0.1), *[("at most", 0.02), ("at most", 0.05)] * 2, ("at most", 0.1),
        ("at most", 5), ("at most", 1),
        ("at least", 100), ("at most", 0.1)]
    assert all(np.isfinite(row.measured) and row.measured > 0 for row in rows)
    assert all(row.ok for row in rows if row.limit == 1e-8), "results are equal"
    printed = capsys.readouterr().out.splitlines()
    left_out = [line for line in printed if line.startswith("no program `sumo` here")]
    assert len(left_out) == 1 and "eclipse-sumo==1.28.0" in left_out[0]
    printed.remove(left_out[0])
    assert len(printed) == len(rows) + 1 and all(row.what in line for row, line in zip(rows, printed, strict=False))
    assert printed[-1].startswith("load before: ")


@pytest.mark.parametrize("name", ["surprise", "reward", "matching", "coverage"])
def test_every_insert_that_is_measured_is_one_into_a_full_memory(name):
    memory, network = bench.full_memory(name, 30), bench.learner().network
    trial = bench.random_trial(memory.images.shape[1:], 10)
    assert len(memory) == 30 and not memory.images.any()
    memory.add(trial, network)
    assert len(memory) == 30 and memory.added == 40
    stored = sum(any((image == held).all() for held in memory.images) for image in trial.images[:-1])
    assert stored == 10


def test_the_plain_loop_learns_what_the_classifier_learns():
    network = bench.digit_network(seed=0)
    twin, rng = bench.torch_twin(network), np.random.default_rng(0)
    ours = bench.Classifier(network, 0.1, 100, np.random.SeedSequence(0))
    optimiser = torch.optim.SGD(twin.parameters(), lr=0.1)
    images, labels = rng.random((100, 784), np.float32), rng.integers(10, size=100)
    for _ in range(3):
        ours.update(images, labels)
        optimiser.zero_grad()
        torch.nn.functional.cross_entropy(twin(torch.from_numpy(images)), torch.from_numpy(labels)).backward()
        optimiser.step()
    np.testing.assert_allclose(network.values(images), twin(torch.from_numpy(images)).detach(), atol=1e-5)


@pytest.mark.parametrize(("load", "said"), [(0.1, False), (1.7, True)])
def test_a_loaded_machine_is_named(load, said, monkeypatch, capsys):
    for name in ("batched_roll_outs", "many_tasks", "dense_inverse", "junction", "traci_loop", "q_update",
                 "q_learning", "inserts", "digit_update", "mask"):
        monkeypatch.setattr(bench, name, lambda *_: iter(()))
    monkeypatch.setattr(bench.os, "getloadavg", lambda: (load, 0, 0))
    assert bench.main() == []
    assert ("loaded: measure again when nothing else runs" in capsys.readouterr().out) == said


@pytest.mark.parametrize("measured, code", [((2, 1), 0), ((2, 9), 1), ((0, 1), 1)])
def test_a_missed_promise_is_told_by_the_exit_code(monkeypatch, measured, code):
    rows = [Row("fast", measured[0], "at least", 1), Row("even", measured[1], "at most", 1)]
    monkeypatch.setattr(bench, "main", lambda: rows)
    assert bench.exit_code() == code
