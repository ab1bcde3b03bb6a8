"""Chapter 1: what is measured on the road, by hand, and lives that share what they should."""

from types import SimpleNamespace

import numpy as np
import pytest
from notebook_functions import load

FUNCTIONS = ("values_at", "make_memory", "learn", "errors", "task", "life")
CONFIG = {"stretches": 2, "amount": 20, "kept": 5, "raised": 0.5}


def test_errors_are_zero_for_the_values_themselves_and_what_all_are_raised_by():
    space = load(1, "values_at", "errors", stretches=3)
    right = SimpleNamespace(values=lambda inputs: space.values_at((inputs + 1) / 2))
    assert space.errors(right) == pytest.approx([0, 0, 0], abs=1e-6)
    assert space.errors(right, 0.5) == pytest.approx([0.5] * 3)
    nothing = SimpleNamespace(values=lambda inputs: 0 * inputs)
    assert space.errors(nothing) == pytest.approx([np.sqrt(0.5)] * 3, abs=0.01)  # a half wave each


def test_ten_experiences_bring_ten_updates_and_none_is_lost():
    stored, updates = [], []
    learner = SimpleNamespace(network=None, update=lambda: updates.append(len(stored)), memory=SimpleNamespace(
        add=lambda trial, network: stored.extend(zip(trial.images[:-1, 0], trial.returns, strict=True))))
    load(1, "learn").learn(learner, np.linspace(0, 1, 25), np.arange(25.0))
    assert updates == [10] * 10 + [20] * 10 + [25] * 5
    assert np.array(stored) == pytest.approx(np.column_stack([np.linspace(-1, 1, 25), np.arange(25)]), abs=1e-6)


def test_memories_differ_in_what_they_keep_and_lives_in_nothing_else():
    space = load(1, *FUNCTIONS, stretches=2)
    found = {name: space.life(CONFIG | {"memory": name}, np.random.SeedSequence(4))
             for name in ("FIFO", "matching", "unlimited")}
    assert {name: curves["curve"].shape for name, curves in found.items()} == dict.fromkeys(found, (21, 2))
    assert all(curves["curve"][0].tobytes() == found["FIFO"]["curve"][0].tobytes() for curves in found.values())
    again = space.life(CONFIG | {"memory": "matching"}, np.random.SeedSequence(4))
    assert again["curve"].tobytes() == found["matching"]["curve"].tobytes() and again["after"].shape == (11,)
    assert found["FIFO"]["curve"][-1].tobytes() != found["unlimited"]["curve"][-1].tobytes()
