"""The corridors of table 2.1: moves and pits by hand, exact returns against roll-outs, Gymnasium's own checker."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from lifelong_lib.environments.corridor import CELLS, FALLEN, PITS, STEPS, Corridor, Corridors

LEFT, STAY, RIGHT = np.eye(3)


def corridors(*goals, wires=1):
    return Corridors(np.array(goals, float), np.full((len(goals), 23), wires))


def everywhere(*actions):
    """A table a task: the same action in every cell."""
    return np.repeat(np.array(actions)[:, None], 23, axis=1)


def test_actions_move_one_cell_wires_turn_them_round_and_nobody_leaves_a_pit():
    (after,), (backwards,) = corridors(0).after, corridors(0, wires=-1).after
    assert after[11].tolist() == [10, 11, 12] and backwards[11].tolist() == [12, 11, 10]
    assert after[PITS].tolist() == backwards[PITS].tolist() == [[0, 0, 0], [22, 22, 22]]


def test_a_step_costs_a_tenth_of_the_distance_and_the_pit_two():
    (rewards,) = corridors(5).rewards
    assert rewards[[11, 16, 1]].tolist() == [-0.5, 0.0, -1.5] and rewards[PITS].tolist() == [FALLEN, FALLEN]


def test_who_stays_earns_its_distance_and_who_always_walks_left_falls_from_every_cell():
    stay, walk = corridors(0, 0).expected(everywhere(STAY, LEFT))
    assert stay == pytest.approx(-np.abs(CELLS[1:-1]).mean() / 10)
    rows = [[min(k, 99) for k in range(place - 1, place - 1 - STEPS, -1)] for place in range(1, 22)]
    earned = [[FALLEN if place <= 0 else -abs(CELLS[place]) / 10 for place in row] for row in rows]
    assert walk == pytest.approx(np.mean(earned))


def test_expected_returns_are_those_of_many_roll_outs():
    rng = np.random.default_rng(0)
    tables, worlds = rng.dirichlet(np.ones(3), (3, 23)), corridors(-7, 0.5, 9, wires=-1)
    found = worlds.roll_out(tables, 20_000, rng.spawn(3)).rewards.mean(axis=2)
    error = found.std(axis=1) / np.sqrt(20_000)
    assert (np.abs(found.mean(axis=1) - worlds.expected(tables)) < 4 * error).all()


def test_roll_outs_take_the_steps_of_the_tables_and_do_not_depend_on_other_tasks():
    worlds = corridors(3, -4)
    tables = np.random.default_rng(1).dirichlet(np.ones(3), (2, 23))
    both = worlds.roll_out(tables, 5, [np.random.default_rng(s) for s in (7, 8)])
    alone = worlds[1].roll_out(tables[1:], 5, [np.random.default_rng(8)])
    assert both.states.shape == (2, 5, STEPS + 1) and both.actions.shape == both.rewards.shape == (2, 5, STEPS)
    assert (both.states[1] == alone.states[0]).all() and (both.rewards[1] == alone.rewards[0]).all()
    assert (worlds.after[0][both.states[0][:, :-1], both.actions[0]] == both.states[0][:, 1:]).all()


def test_the_score_is_0_for_drawn_actions_and_1_for_going_to_the_goal_whatever_the_wires():
    towards = np.eye(3)[1 + np.sign(5 - CELLS)]
    worlds = Corridors(np.array([5.0, 5.0]), np.array([[1], [-1]]) * np.ones((1, 23), int))
    assert worlds.score(np.stack([towards, towards[:, ::-1]])) == pytest.approx([1, 1])
    assert worlds.score(np.full((2, 23, 3), 1 / 3)) == pytest.approx([0, 0])
    assert (worlds.score(everywhere(LEFT, LEFT)) < 0).all()


def test_descriptions_are_the_goal_the_wires_in_the_middle_and_a_constant():
    wires = np.where(np.abs(CELLS) > 5, -1, 1)
    assert Corridors(np.array([4.0]), wires[None]).descriptions.tolist() == [[0.4, 1, 1]]


def test_the_environment_takes_the_same_steps_and_passes_the_checker():
    task = corridors(5, wires=-1)
    env = gym.make("lifelong_lib/Corridor-v0", task=task)
    check_env(env.unwrapped, skip_render_check=True)
    (position, goal, wires), _ = env.reset(seed=3)
    place = round(10 * position) + 11
    assert (goal, wires) == (0.5, -1)
    for step in range(STEPS):
        seen, reward, terminated, truncated, _ = env.step(2)
        place = task.after[0, place, 2]
        assert (seen[0], reward) == pytest.approx((CELLS[place] / 10, task.rewards[0, place]))
        assert not terminated and truncated == (step == STEPS - 1)


@pytest.mark.parametrize("goals, wires", [([11.0], np.ones((1, 23))), ([np.nan], np.ones((1, 23))),
                                          ([0.0], np.zeros((1, 23))), ([0.0], np.ones((1, 5)))])  # fmt: skip
def test_impossible_corridors_are_refused(goals, wires):
    with pytest.raises(ValueError, match="every corridor needs a goal within -10 and 10"):
        Corridors(np.array(goals), wires)


def test_an_environment_is_one_corridor():
    with pytest.raises(ValueError, match="one corridor, not 2: choose one"):
        Corridor(corridors(1, 2))
