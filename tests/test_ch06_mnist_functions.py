"""Chapter 6, digits: what chooses its settings and decides C6.10 and C6.11, on numbers and digits made by hand."""

from functools import cache

import numpy as np
import pytest
from notebook_functions import judge, load, runs

from lifelong_lib.environments.digits import Digits
from lifelong_lib.reproduction.claims import ledger, published

METHODS = {"none": (None, "none"), "EWC": (15.0, "none"), "selective": (None, "matching"), "both": (15.0, "matching")}
PERMUTATIONS, PAIRS = [f"task {k}" for k in range(1, 6)], ["0 and 5", "1 and 6", "2 and 7", "3 and 8", "4 and 9"]


# ----------------------------------------------------------------------------------------------------------- one life

def few_digits():
    """Digits whose class can be read off one row of pixels: 300 to learn from, 100 to test on."""
    rng = np.random.default_rng(0)

    def some(n):
        labels = np.arange(n, dtype=np.uint8) % 10
        images = rng.integers(100, size=(n, 28, 28), dtype=np.uint8)
        images[np.arange(n), 2 * labels + 3] += 120
        return images.reshape(n, 784), labels

    return Digits(*some(300), *some(100))


CONFIG = {"life": "permutations", "tasks": 2, "tests": 60, "iterations": 40, "looks": 2, "rate": 0.3, "batch": 20,
          "strength": None, "memory": "none", "capacity": 30}  # fmt: skip


@cache
def life(**changes):
    """Accuracies (1 + 2 * looks, 2) of a short life with other settings than CONFIG's."""
    space = load(6, "tasks_of", "memory_of", "consolidate", "life", read_digits=few_digits)
    return space.life(CONFIG | changes, np.random.SeedSequence(3))["accuracy"]


def test_a_strength_of_0_is_no_remedy_to_the_last_bit_and_another_strength_is_one():
    without = life()
    assert life(strength=0.0).tobytes() == without.tobytes()
    assert life(strength=2.0)[:3].tobytes() == without[:3].tobytes(), "while the first task is learned nothing is held"
    assert life(strength=2.0)[3:].tobytes() != without[3:].tobytes()
    with_memory = life(memory="latest")
    assert life(memory="latest", strength=0.0).tobytes() == with_memory.tobytes(), "the control of both"


def test_looks_change_nothing_and_are_where_they_should_be():
    often, seldom = life(), life(looks=1)
    assert often.shape == (5, 2) and seldom.shape == (3, 2) and often.dtype == np.float32
    assert often[[0, 2, 4]].tobytes() == seldom.tobytes()
    assert often[2, 0] > 0.8 > 0.4 > often[2, 1], "after the first task it knows that one"
    assert often[4, 1] > 0.8


def test_methods_of_a_seed_share_weights_and_permutations():
    for changes in ({"memory": "matching"}, {"memory": "latest"}, {"strength": 2.0}):
        assert life(**changes)[0].tobytes() == life()[0].tobytes()
    assert life(life="pairs").shape == (11, 5)


def test_memories_are_as_large_as_they_should_be_and_keep_what_they_should():
    memory_of = load(6, "memory_of").memory_of
    assert memory_of(CONFIG, 0) is None
    for name, kind in {"matching": "EpisodicMemory", "latest": "ReplayBuffer"}.items():
        memory = memory_of(CONFIG | {"memory": name}, 0)
        assert type(memory).__name__ == kind and memory.images.shape == (30, 784)


def test_a_penalty_holds_the_weights_and_the_fisher_information_of_two_hundred_digits_of_the_task():
    asked = []
    space = load(6, "consolidate", diagonal_fisher=lambda network, images, rng: len(images) * np.ones(2))
    task = type("Task", (), {"draw": lambda self, n, rng: (np.full((n, 3), 7.0), np.zeros(n))})()
    network = type("Network", (), {"get_weights": lambda self: np.array([1.0, 2.0])})()
    penalty = type("Penalty", (), {"hold": lambda self, *what: asked.append([part.tolist() for part in what])})()
    space.consolidate(penalty, network, task, np.random.default_rng(0))
    assert asked == [[[1, 2], [200, 200]]]


# ------------------------------------------------------------------------------------------------------------ choices

def test_the_step_size_is_the_one_nearest_to_the_printed_accuracy_from_either_side():
    nearest = load(6, "nearest").nearest
    assert nearest({0.1: np.array([0.90, 0.94]), 0.5: np.array([0.95, 0.97]), 1.0: np.array([0.93])}, 0.971) == 0.5
    assert nearest({0.1: np.array([0.96]), 0.5: np.array([0.98])}, 0.971) == 0.5
    assert nearest({0.1: np.array([0.962]), 0.5: np.array([0.982])}, 0.971) == 0.1


def test_the_strength_has_the_highest_mean_over_lives_and_tasks():
    strongest = load(6, "strongest").strongest
    found = {1.0: np.array([[0.2, 1.0], [0.2, 1.0]]), 15.0: np.array([[0.7, 0.7], [0.7, 0.6]]), 150.0: np.zeros((2, 2))}
    assert strongest(found) == 15.0


# ------------------------------------------------------------------------------------------------------------- claims

def lives(ends, controls, looks=2):
    """Runs of three lives: every remedy's accuracies at the end (five), and those of strength 0 and of the latest."""
    def entry(strength, memory, end, looks):
        curve = np.full((1 + 5 * looks, 5), 0.1)
        curve[-1] = end
        return {"strength": strength, "memory": memory, "looks": looks}, {"accuracy": [curve] * 3}
    entries = [entry(*METHODS[method], end, looks) for method, end in ends.items()]
    weak, latest = controls
    return runs(*entries, entry(0.0, "none", weak, 1), entry(None, "latest", latest, 1))


NAMES = {"C6.10": PERMUTATIONS, "C6.11": PAIRS}
CLAIMS = {"C6.10": ("T6.2", "permutation_lives"), "C6.11": ("T6.3", "pair_lives")}


def printed(table):
    return {method: [mean for mean, _ in published(table)[method]] for method in METHODS}


def verdict(identity, folder, controls=None, **changes):
    """What becomes of a claim if we measure what the thesis prints, with some remedies changed."""
    table, variable = CLAIMS[identity]
    ends = printed(table) | changes
    functions = ("curves_of", "control_ends", "CONTROLS", "ends_of", "cell_parts", "contrasts", "lost_and_kept")
    space = load(6, *functions, METHODS=METHODS, PERMUTATION_NAMES=PERMUTATIONS, PAIR_NAMES=PAIRS)
    space.permutation_lives = lives(printed("T6.2"), (printed("T6.2")["none"],) * 2)  # C6.11's control of EWC
    vars(space)[variable] = lives(ends, controls or (ends["none"], ends["none"]))
    return judge(6, identity, space, folder)


@pytest.mark.parametrize("identity", CLAIMS)
def test_the_thesis_own_numbers_hold_and_no_remedy_does_not(tmp_path, identity):
    found = verdict(identity, tmp_path)
    assert found.verdict == "holds" and found.control_verdict != "holds"
    assert len(found.measured) == len(ledger()[identity]["parts"])
    for method in METHODS:
        cells = [found.measured[f"{method}, {name}"] for name in NAMES[identity]]
        assert cells == pytest.approx([mean for mean, _ in published(CLAIMS[identity][0])[method]])


@pytest.mark.parametrize("identity", CLAIMS)
def test_controls_are_taken_from_the_runs_without_the_cause(tmp_path, identity):
    found = verdict(identity, tmp_path, controls=([0.11] * 5, [0.22] * 5))
    for method, value in {"EWC": 0.11, "selective": 0.22, "both": 0.22}.items():
        cells = [found.control[label] for name in NAMES[identity] if (label := f"{method}, {name}") in found.control]
        assert cells == pytest.approx([value] * len(cells)) and (cells or method == "EWC")
    assert not [label for label in found.control if label.startswith("none, ")]


def test_contrasts_of_c6_10_by_hand(tmp_path):
    found = verdict("C6.10", tmp_path).measured
    assert found["task 1: EWC minus selective"] == pytest.approx(0.91 - 0.88)
    assert found["task 5: selective minus EWC"] == pytest.approx(0.937 - 0.91)
    both, selective = np.mean([0.92, 0.903, 0.881, 0.86, 0.88]), np.mean([0.88, 0.9, 0.91, 0.91, 0.937])
    assert found["both minus the better of the two, mean over tasks"] == pytest.approx(both - selective)


@pytest.mark.parametrize("changes", [
    {"EWC": [0.89, 0.92, 0.90, 0.86, 0.91], "selective": [0.90, 0.90, 0.91, 0.91, 0.937]},  # EWC worse on the first
    {"EWC": [0.91, 0.92, 0.90, 0.86, 0.94], "selective": [0.88, 0.90, 0.91, 0.91, 0.93]},  # and better on the last
    {"both": [0.94, 0.94, 0.925, 0.905, 0.925]},  # both are better by 0.02, while all cells are within 0.05
    {"none": [0.76, 0.76, 0.85, 0.91, 0.971]},  # a cell is too far
])  # fmt: skip
def test_c6_10_is_contradicted_by_what_it_denies(tmp_path, changes):
    assert verdict("C6.10", tmp_path, **changes).verdict == "contradicted"


def test_c6_11_by_hand(tmp_path):
    found = verdict("C6.11", tmp_path).measured
    assert found["EWC, mean of the first four pairs"] == pytest.approx((0.005 + 0.006 + 0.12) / 4)
    assert found["selective, lowest of the first four pairs"] == pytest.approx(0.69)
    for changes in ({"EWC": [0.09, 0.1, 0.1, 0.21, 0.936]}, {"selective": [0.82, 0.924, 0.45, 0.72, 0.914]}):
        assert verdict("C6.11", tmp_path, **changes).verdict == "contradicted"


# ----------------------------------------------------------------------------------------------------------- measures

def test_measures_are_taken_when_a_task_has_been_learned_and_before_any():
    curve = np.zeros((11, 5))
    curve[0] = 0.1  # before any
    for task in range(5):
        curve[2 * task + 1, task] = 0.99  # half way, which does not count
        curve[2 * task + 2 :, task] = 0.9  # when it has been learned
        curve[2 * task + 4 :, task] = 0.7  # and after the next one
    space = load(6, "measures_row", "curves_of", METHODS=METHODS)
    row = space.measures_row(runs(({"strength": None, "memory": "none"}, {"accuracy": [curve] * 3})), "pairs", "none")
    assert row == {"life": "pairs", "remedy": "none", "average accuracy": "0.740 ± 0.000",
                   "forgetting": "0.200 ± 0.000", "forward transfer": "-0.100 ± 0.000",
                   "backward transfer": "-0.200 ± 0.000"}  # fmt: skip
