"""SUMO in this process: who holds it, several at a time, checked files, poses and roads."""

import gymnasium as gym
import numpy as np
import pytest
from conftest import trial

from lifelong_lib.environments.crossing import GO, LENGTH, ROW
from lifelong_lib.environments.intersections import FOLDER, TASKS, Intersection
from lifelong_lib.environments.sumo import BEYOND, poses, read_roads

NAME = "lifelong_lib/Intersection-v0"
LOST = (r"this environment does not hold the SUMO simulation, of which a process has one and the last reset takes it: "
        r"reset it again, .* gym.make_vec\(..., vectorization_mode=\"async\"\), which gives each a process$")
ACTIONS = [0, 3, 1, GO]


@pytest.fixture
def make():
    """Makes junctions as everybody does, and closes them all at the end."""
    made = []

    def one(task="left", **more):
        made.append(gym.make(NAME, task=task, **more))
        return made[-1]

    yield one
    for env in made:
        env.close()


def same(one, other):
    return all(np.array_equal(a[0], b[0]) and a[1:] == b[1:] for a, b in zip(one, other, strict=True))


# -------------------------------------------------------------------------------------------------- one simulation each

def test_a_second_environment_takes_the_simulation_over_at_its_reset_and_the_first_takes_it_back(make):
    alone = {}
    for task in ("left", "challenge"):
        env = make(task)
        alone[task] = trial(env, 3, ACTIONS)
        env.close()
    first = make("left")
    assert same(trial(first, 3, ACTIONS), alone["left"])
    second = make("challenge")  # nobody closed the first
    assert same(trial(second, 3, ACTIONS), alone["challenge"])
    assert same(trial(first, 3, ACTIONS), alone["left"]) and same(trial(second, 3, ACTIONS), alone["challenge"])


def test_a_reset_without_seed_takes_it_back_in_traffic_of_its_own(make):
    first, second, counts = make("left"), make("right"), []
    for _ in range(2):
        first.reset(seed=3)
        second.reset(seed=4)
        counts.append(first.reset()[0])
        assert first.step(GO)[4]["steps"] > 0
    assert np.array_equal(*counts)


def test_making_one_takes_nothing_and_stepping_one_that_has_lost_it_is_one_clear_line(make):
    first, second = make("left", render_mode="rgb_array"), make("right")
    first.reset(seed=0)
    assert first.step(0)[4]["steps"] == 1
    second.reset(seed=0)
    for lost in (lambda: first.step(0), lambda: first.step(GO), first.render, first.unwrapped.cars):
        with pytest.raises(RuntimeError, match=LOST) as caught:
            lost()
        assert "\n" not in str(caught.value)
    assert second.step(0)[4]["steps"] == 1


def test_closing_one_that_has_lost_it_leaves_the_other_alone(make):
    first, second = make("left"), make("right")
    first.reset(seed=0)
    second.reset(seed=0)
    first.close()
    assert second.step(0)[4]["steps"] == 1
    second.close()
    second.close()
    first.reset(seed=0)
    assert first.step(0)[4]["steps"] == 1


def test_a_synchronous_vector_of_two_is_refused_with_a_line_that_names_the_other_kind():
    both = gym.make_vec(NAME, num_envs=2, vectorization_mode="sync", task="left")
    both.reset(seed=0)
    with pytest.raises(RuntimeError, match=LOST):
        both.step([0, 0])
    both.close()


@pytest.mark.parametrize("context", ["fork", "spawn"])
def test_an_asynchronous_vector_gives_the_trials_of_single_ones(context, make):
    env = make("left")
    singles = [trial(env, seed, ACTIONS[:-1]) for seed in (3, 4)]  # and this process holds a simulation meanwhile
    both = gym.make_vec(NAME, num_envs=2, vectorization_mode="async", vector_kwargs={"context": context}, task="left")
    images, _ = both.reset(seed=[3, 4])
    assert np.array_equal(images, [single[0][0] for single in singles])
    for place, action in enumerate(ACTIONS[:-1], 1):
        images, rewards, *_, info = both.step([action, action])
        assert np.array_equal(images, [single[place][0] for single in singles])
        assert rewards.tolist() == [single[place][1] for single in singles]
        assert info["steps"].tolist() == [single[place][4]["steps"] for single in singles]
    both.close()
    assert env.step(GO)[4]["steps"] > 0


# ----------------------------------------------------------------------------------------------------- poses and roads

def test_poses_are_of_the_middle_and_headings_count_from_the_x_axis():
    found = poses([(10, 20, 90, 3), (10, 20, 0, 4), (10, 20, 180, 5)])  # east, north, south
    due = [[10 - LENGTH / 2, 20, 0, 3], [10, 20 - LENGTH / 2, np.pi / 2, 4], [10, 20 + LENGTH / 2, -np.pi / 2, 5]]
    np.testing.assert_allclose(found, due, atol=1e-12)
    assert poses([]).shape == (0, 4)


@pytest.mark.parametrize("task", TASKS)
def test_roads_are_read_from_the_file_without_a_simulation(task):
    lanes, path, middle = read_roads(FOLDER / f"{task}.net.xml")
    goal = {"to_east": [1, 0], "to_west": [-1, 0], "to_north": [0, 1]}[TASKS[task]]
    np.testing.assert_allclose((path[-1] - path[-2]) / BEYOND, goal, atol=1e-9)
    main = [line for line in lanes if np.ptp(line[:, 0]) > 200]
    assert len(main) == 4 * {"left2": 2, "challenge": 3}.get(task, 1)
    rows = np.unique([line[0, 1] - middle[1] for line in main]) / ROW
    np.testing.assert_allclose(rows, np.arange(len(rows)) - (len(rows) - 1) / 2, atol=1e-6)


def test_a_turn_may_be_cut_in_two(tmp_path):
    (tmp_path / "net.xml").write_text("""<net>
        <edge id="from_south"><lane id="from_south_0" shape="2,-60 2,-8"/></edge>
        <edge id=":centre_0"><lane id=":centre_0_0" shape="2,-8 2,-1"/></edge>
        <edge id=":centre_1"><lane id=":centre_1_0" shape="2,-1 1,2 -8,2"/></edge>
        <edge id="to_west"><lane id="to_west_0" shape="-8,2 -200,2"/></edge>
        <junction id="centre" x="0.5" y="-0.5"/>
        <connection from="from_south" to="to_west" toLane="0" via=":centre_0_0"/>
        <connection from=":centre_0" to="to_west" toLane="0" via=":centre_1_0"/>
        <connection from=":centre_1" to="to_west" toLane="0"/>
    </net>""")
    lanes, path, middle = read_roads(tmp_path / "net.xml")
    pieces = [[2, -8], [2, -8], [2, -1], [2, -1], [1, 2], [-8, 2], [-8, 2], [-8 - BEYOND, 2]]
    assert path.tolist() == pieces and middle.tolist() == [0.5, -0.5] and len(lanes) == 4


@pytest.mark.parametrize("task", TASKS)
def test_the_own_car_begins_where_its_path_does_and_drives_along_it(task):
    env = Intersection(task)
    path = env.roads.path
    env.reset(seed=0)
    assert path[0] == pytest.approx(env.origin + [0, 3 * ROW], abs=0.2)  # its front is at its line
    path = np.concatenate([path, [path[-1] + 5 * (path[-1] - path[-2])]])
    dense = np.concatenate([np.linspace(*ends, 500) for ends in zip(path, path[1:], strict=False)])
    env.sumo.set_off(20)
    for _ in range(20):
        env.sumo.drive_on(1)
        x, y, heading, _ = env.cars()[0][0]
        front = [x + LENGTH / 2 * np.cos(heading), y + LENGTH / 2 * np.sin(heading)]
        assert np.linalg.norm(dense - front, axis=1).min() < 0.05
    assert np.linalg.norm(front - path[0]) > 15
    env.close()
