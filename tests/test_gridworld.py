"""Four rooms: walls, doors, shortest paths by breadth-first search, rewards, time-out, and what is seen."""

from collections import deque

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from lifelong_lib.environments.gridworld import (
    GREYS,
    MAX_STEPS,
    PIXELS,
    ROOMS,
    START,
    WALLS,
    FourRooms,
    look,
    positions,
)
from lifelong_lib.learners.q_learning import q_network, run_trial

UP, DOWN, LEFT, RIGHT = range(4)
each_room = pytest.mark.parametrize("room", ROOMS)
MAP = """
###########
#....#....#
#....+....#
#....#....#
#....#....#
##+####+###
#....#....#
#....#....#
#....+....#
#....#....#
###########
""".split()  # drawn once more, with doors


def path(start, goal):
    """Actions of a shortest path over the map above; an implementation that knows nothing of the environment's."""
    before, waiting = {start: None}, deque([start])
    while goal not in before:
        row, column = waiting.popleft()
        for action, cell in enumerate([(row - 1, column), (row + 1, column), (row, column - 1), (row, column + 1)]):
            if MAP[cell[0]][cell[1]] != "#" and cell not in before:
                before[cell] = ((row, column), action)
                waiting.append(cell)
    actions = []
    while before[goal]:
        goal, action = before[goal]
        actions.insert(0, action)
    return actions


@each_room
def test_gymnasium_finds_nothing_to_complain_of(room):
    check_env(gym.make("lifelong_lib/FourRooms-v0", room=room, render_mode="rgb_array").unwrapped)


def test_there_are_four_rooms_of_sixteen_cells_and_four_doors():
    assert WALLS.shape == (11, 11) and (~WALLS).sum() == 4 * 16 + 4
    assert (WALLS == [[cell == "#" for cell in row] for row in MAP]).all()
    low, high = (1, 2, 3, 4), (6, 7, 8, 9)
    for rows, columns in [(low, low), *ROOMS.values()]:
        assert not WALLS[np.ix_(rows, columns)].any()
    assert ROOMS["top right"] == (low, high) and ROOMS["bottom left"] == (high, low)


@each_room
def test_a_shortest_path_by_breadth_first_search_is_walked_as_it_was_planned(room):
    env, goals = FourRooms(room), set()
    for seed in range(60):
        env.reset(seed=seed)
        plan = path(START, env.goal)
        steps = [env.step(action) for action in plan]
        assert [step[2] for step in steps] == [False] * (len(plan) - 1) + [True]
        assert sum(step[1] for step in steps) == pytest.approx(10 - 0.01 * len(plan))
        assert [step[4]["outcome"] for step in steps] == [""] * (len(plan) - 1) + ["success"]
        assert not any(step[3] for step in steps) and all(step[4]["steps"] == 1 for step in steps)
        goals.add(env.goal)
    rows, columns = ROOMS[room]
    assert len(goals) >= 14 and all(row in rows and column in columns for row, column in goals)


def test_walls_stop_and_doors_do_not():
    env = FourRooms("bottom right")
    for row, column in np.argwhere(~WALLS).tolist():
        for action, (there, aside) in enumerate([(-1, 0), (1, 0), (0, -1), (0, 1)]):
            env.reset(seed=0)
            env.agent = (row, column)
            env.step(action)
            ahead = (row + there, column + aside)
            assert env.agent == ((row, column) if MAP[ahead[0]][ahead[1]] == "#" else ahead)


def test_time_is_up_after_a_hundred_steps():
    env = FourRooms()
    trial = run_trial(env, lambda seen, mask: UP, 1.0, seed=0)
    assert len(trial.actions) == MAX_STEPS == 100 and trial.info == {"steps": 1, "outcome": "timeout"}
    assert trial.rewards == pytest.approx(np.full(100, -0.01)) and (trial.images == trial.images[0]).all()
    with pytest.raises(RuntimeError, match="^the trial has ended, or was never begun: reset the environment first$"):
        env.step(UP)


def test_the_goal_counts_in_the_last_step_too():
    env = FourRooms(goal=(1, 6))
    env.reset()
    for _ in range(88):
        env.step(UP)
    plan = path(START, (1, 6))
    assert len(plan) == 7
    for action in [UP] * 5 + plan:
        *_, there, late, info = env.step(action)
    assert env.steps == 100 and there and not late and info["outcome"] == "success"


def test_the_same_seed_is_the_same_trial_and_a_goal_can_be_given():
    env = FourRooms("bottom left")
    once, again = ([env.reset(seed=seed)[0].tobytes() for seed in range(9)] for _ in range(2))
    assert once == again and len(set(once)) > 3
    env = FourRooms("bottom left", goal=(8, 2))
    assert {env.reset(seed=seed)[0].tobytes() for seed in range(5)} == {look(START, (8, 2)).tobytes()}


def test_what_is_seen_tells_walls_agent_and_goal_apart():
    env = FourRooms("top right", goal=(3, 8))
    seen = env.reset(seed=0)[0]
    assert seen.shape == (11, 11, 1) and seen.dtype == np.float32
    assert np.argwhere(seen == np.float32(2 / 3)).tolist() == [[1, 1, 0]]
    assert np.argwhere(seen == np.float32(1 / 3)).tolist() == [[3, 8, 0]]
    assert ((seen[..., 0] == 1) == WALLS).all() and (seen == 0).sum() == 4 * 16 + 4 - 2
    assert q_network(4, seen.shape, 0).values(seen[None]).shape == (1, 4)


def test_positions_are_read_back_from_what_is_seen():
    cells = np.argwhere(~WALLS)
    rng = np.random.default_rng(0)
    wanted = np.array([np.concatenate(rng.permutation(cells)[:2]) for _ in range(40)])
    seen = np.stack([look(tuple(row[:2]), tuple(row[2:])) for row in wanted])
    assert (positions(seen) == wanted).all()


def test_the_picture_has_the_greys_of_the_figure_where_things_are():
    env = FourRooms("top right", goal=(3, 8), render_mode="rgb_array")
    env.reset(seed=0)
    picture = env.render()
    assert picture.shape == (220, 220, 3) and picture.dtype == np.uint8
    middles = picture[PIXELS // 2 :: PIXELS, PIXELS // 2 :: PIXELS]
    expected = np.where(WALLS[..., None], GREYS["wall"], (255, 255, 255))
    expected[1, 1], expected[3, 8] = GREYS["agent"], GREYS["goal"]
    assert (middles == expected).all()
    assert FourRooms().render() is None


@pytest.mark.parametrize(("arguments", "said"), [
    ({"room": "attic"}, "^no room 'attic' for the goal; there are top right, bottom left, bottom right$"),
    ({"goal": (8, 8)}, r"^no goal at \(8, 8\) in the room 'top right', which has rows and columns \(\(1, 2"),
    ({"render_mode": "ansi"}, "^no render mode 'ansi'; there are None and 'rgb_array'$"),
])  # fmt: skip
def test_what_cannot_be_is_refused(arguments, said):
    with pytest.raises(ValueError, match=said):
        FourRooms(**arguments)
