"""Chapter 6, grid world: functions that try networks, make memories and decide its claim, on numbers made by hand."""

from types import SimpleNamespace

import numpy as np
import pytest
from notebook_functions import judge, load, runs

from lifelong_lib.environments.gridworld import FourRooms, positions
from lifelong_lib.learners.q_learning import ReplayBuffer, run_trial
from lifelong_lib.transfer.replay import CoverageMemory, EpisodicMemory, PairOfBuffers

UP, DOWN, LEFT, RIGHT = range(4)
FIRST = "FIFO: success in the first room when it has been learned"
LEFT_OF_IT = "FIFO: share of it that is left while the second room is learned"


# -------------------------------------------------------------------------------------------------------------- looks

class Guide:
    """A network whose best action is that of a rule(row, column, row of the goal, column of the goal)."""

    def __init__(self, rule):
        self.rule = rule

    def values(self, images):
        return np.eye(4)[[self.rule(*cells) for cells in positions(images)]]


def to_the_door(row, column, goal_row, goal_column):
    """Down to the second row, then right through the door and on to the wall."""
    return DOWN if row < 2 else RIGHT


def to_the_goal(row, column, goal_row, goal_column):
    if column < 6:
        return to_the_door(row, column, goal_row, goal_column)
    if row != goal_row:
        return DOWN if row < goal_row else UP
    return RIGHT


@pytest.mark.parametrize("room, rule, share", [
    ("top right", to_the_goal, 1), ("top right", to_the_door, 4 / 16),  # the four goals of the second row
    ("bottom left", to_the_goal, 0), ("top right", lambda *cells: UP, 0)])  # fmt: skip
def test_a_look_is_the_share_of_goals_that_the_best_actions_lead_to(room, rule, share):
    assert load(6, "share_reached").share_reached(Guide(rule), room) == share


# ----------------------------------------------------------------------------------------------------------- memories

def memory(strategy):
    config = {"strategy": strategy, "kept": 6, "recent": 3, "spread": 1e-3, "eta": 2.0}
    space = load(6, "grid_memory", "cells_of", "latest")
    return space.grid_memory(config, (11, 11, 1), np.random.default_rng(0))


def walked():
    return run_trial(FourRooms("top right", (2, 9)), lambda image, mask: to_the_door(*positions(image[None])[0]), 0.5)


class Guess:
    @staticmethod
    def values(images):
        return np.zeros((len(images), 4))


def test_fifo_has_one_buffer_with_the_places_of_both():
    fifo = memory("FIFO")
    assert type(fifo) is ReplayBuffer and len(fifo.returns) == 9


@pytest.mark.parametrize("strategy, kind", [
    ("surprise", EpisodicMemory), ("reward", EpisodicMemory), ("matching", EpisodicMemory), ("latest", EpisodicMemory),
    ("coverage", CoverageMemory)])  # fmt: skip
def test_what_is_selected_stands_beside_the_latest(strategy, kind):
    pair = memory(strategy)
    assert isinstance(pair, PairOfBuffers) and type(pair.long_term) is kind
    assert (len(pair.long_term.returns), len(pair.recent.returns)) == (6, 3)


@pytest.mark.parametrize("strategy, stays", [("latest", range(3, 9)), ("reward", range(3, 9))])
def test_what_a_memory_keeps_of_nine_decisions(strategy, stays):
    pair, trial = memory(strategy), walked()
    assert len(trial.actions) == 9  # one down, eight right; returns grow towards the goal
    pair.add(trial, Guess)
    assert sorted(pair.long_term.arrivals) == list(stays)


def test_coverage_sees_cells_of_agent_and_goal():
    trial = walked()
    cells = load(6, "cells_of").cells_of(trial)
    assert cells.tolist() == [[1, 1, 2, 9], *([2, column, 2, 9] for column in range(1, 9))]


# ----------------------------------------------------------------------------------------------------------- the rule

def test_the_end_of_a_room_is_the_last_fifth_of_its_looks():
    looks = np.zeros((2, 11, 3))  # a start and ten looks
    looks[0, 9:, 1], looks[1, 8:, 2] = [0.2, 0.6], 1.0
    assert load(6, "last_fifth").last_fifth(looks) == pytest.approx(np.array([[0, 0.4, 0], [0, 0, 1]]))
    few = np.array([[[0.1], [0.9]]])  # a start and one look
    assert load(6, "last_fifth").last_fifth(few).tolist() == [[0.9]]


def test_success_alone_is_that_in_the_room_that_was_learned():
    shares = np.zeros((1, 6, 3))
    shares[0, -1] = [0.1, 0.2, 0.7]
    found = runs(({"rooms": "bottom right", "rate": 1}, {"shares": [shares, shares / 7]}))
    space = load(6, "alone_in", "last_fifth")
    assert space.alone_in(found, "bottom right", rate=1) == pytest.approx([0.7, 0.1])


def test_the_setting_with_most_goals_over_both_rooms_is_taken():
    rooms = {"top right": 0, "bottom right": 2}
    success = {("top right", 4): 0.9, ("bottom right", 4): 0.0, ("top right", 10): 0.6, ("bottom right", 10): 0.5}
    entries = []
    for (room, pace), share in success.items():
        shares = np.zeros((1, 3, 3))
        shares[0, -1, rooms[room]] = share
        entries.append(({"rooms": room, "pace": pace}, {"shares": [shares, shares]}))
    space = load(6, "best_knobs", "alone_in", "last_fifth", searched_rooms=tuple(rooms))
    assert space.best_knobs(runs(*entries), [{"pace": 4}, {"pace": 10}]) == {"pace": 10}


def test_a_learner_that_is_slowed_down_learns_at_every_third_decision():
    learned = []
    learner = SimpleNamespace(learn=lambda: learned.append("once"))
    load(6, "slow_down").slow_down(learner, 3)
    met = []
    for _ in range(7):
        learner.learn()
        met.append(len(learned))
    assert met == [0, 0, 1, 1, 1, 2, 2]


# ---------------------------------------------------------------------------------------------------------- the claim

def life(first, second, third, looks=10):
    """Shares (3, 1 + looks, 3) that stay as they are while a room is learned."""
    return np.repeat(np.array([first, second, third], float)[:, None], 1 + looks, axis=1)


def lives(**of):
    """Two lives a strategy, both alike."""
    return {"grid_lives_of": runs(*(({"strategy": name}, {"shares": [shares] * 2}) for name, shares in of.items()))}


FORGETS = life([0.8, 0, 0], [0.1, 0.7, 0], [0.0, 0.2, 0.6])
KEEPS = life([0.8, 0, 0], [0.7, 0.7, 0], [0.5, 0.6, 0.6])
NAMES = ("earlier_rooms", "present_room", "in_earlier_rooms", "in_present_room", "fall_of", "lead_of", "last_fifth",
         "LEARNED", "LEFT")


def test_parts_of_the_claim_by_hand():
    forgets = FORGETS.copy()
    forgets[1, :2, 0] = 0.8  # the start, and the first look: not yet "at once" of ten looks
    space = load(6, *NAMES, **lives(FIFO=forgets, matching=KEEPS))
    assert space.earlier_rooms("matching") == pytest.approx([(0.7 + 0.5 + 0.6) / 3] * 2)
    assert space.earlier_rooms("FIFO") == pytest.approx([((9 * 0.1 + 0.8) / 10 + 0.0 + 0.2) / 3] * 2)
    assert space.present_room("matching") == pytest.approx([(0.8 + 0.7 + 0.6) / 3] * 2)
    assert space.fall_of("FIFO")[FIRST] == pytest.approx([0.8] * 2)
    assert space.fall_of("FIFO")[LEFT_OF_IT] == pytest.approx([(9 * 0.1 + 0.8) / 10 / 0.8] * 2)


def verdict(tmp_path, **of):
    shares = {name: [found] * 5 for name, found in of.items()}
    made = runs(*(({"strategy": name}, {"shares": each}) for name, each in shares.items()))
    return judge(6, "C6.6", load(6, *NAMES, grid_lives_of=made), tmp_path)


def test_the_claim_holds_where_fifo_forgets_and_matching_keeps_most(tmp_path):
    some = (FORGETS + KEEPS) / 2
    found = verdict(tmp_path, FIFO=FORGETS, surprise=FORGETS, reward=FORGETS, coverage=some, matching=KEEPS,
                    latest=FORGETS)
    assert found.verdict == "holds" and found.control_verdict == "undecided"  # it forgets as surprise and reward do


def test_it_does_not_where_the_latest_do_as_well_or_nothing_is_forgotten_or_learned(tmp_path):
    others = dict.fromkeys(("surprise", "reward", "coverage"), FORGETS)
    assert verdict(tmp_path, FIFO=KEEPS, matching=KEEPS, latest=FORGETS, **others).verdict == "contradicted"
    assert verdict(tmp_path, FIFO=FORGETS, matching=FORGETS, latest=FORGETS, **others).verdict == "contradicted"
    nothing = FORGETS * 0.1
    assert verdict(tmp_path, FIFO=nothing, matching=KEEPS, latest=FORGETS, **others).verdict == "contradicted"
