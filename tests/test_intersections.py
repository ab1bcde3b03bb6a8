"""The junctions: trials, traffic, collisions and what the car sees of them."""

import hashlib
import os
import subprocess
import sys

import gymnasium as gym
import libsumo
import numpy as np
import pytest
from conftest import REPOSITORY, trial
from gymnasium.utils.env_checker import check_env
from scipy import stats

from lifelong_lib.environments.crossing import GO, SPEED, overlaps
from lifelong_lib.environments.intersections import FOLDER, TASKS, Intersection

each_task = pytest.mark.parametrize("task", TASKS)


@pytest.fixture
def junction():
    """Makes junctions, and closes the last one."""
    made = []

    def make(task="left", **more):
        made.append(Intersection(task, **more))
        return made[-1]

    yield make
    for env in made:
        env.close()


def digest(seen):
    return b"".join(step[0].tobytes() for step in seen), [step[1:] for step in seen]


# ------------------------------------------------------------------------------------------------------------- trials

@each_task
def test_gymnasium_finds_nothing_to_complain_of(task, junction):
    env = gym.make("lifelong_lib/Intersection-v0", task=task)
    check_env(env.unwrapped)
    env.close()


def test_waiting_ends_after_20_seconds_with_the_discounted_cost_of_every_step(junction):
    env, steps, seen = junction("challenge"), 0, []
    env.reset(seed=0)
    while not seen or not seen[-1][3]:
        seen.append(env.step(3))
        took = seen[-1][4]["steps"]
        assert seen[-1][1] == pytest.approx(-0.01 * (1 - 0.99**took) / 0.01)
        steps += took
    assert steps == 100 and [step[4]["steps"] for step in seen] == [8] * 12 + [4]
    assert seen[-1][4]["outcome"] == "timeout" and not seen[-1][2]


@each_task
def test_a_car_that_goes_blindly_collides_and_not_always(task, junction):
    env = junction(task, discount=1.0)
    ends = [trial(env, seed, [GO])[-1] for seed in range(60)]
    outcomes = [info["outcome"] for *_, info in ends]
    assert set(outcomes) == {"success", "collision"}
    assert outcomes.count("collision") >= 6
    for _, reward, ended, late, info in ends:
        assert ended and not late
        assert reward == pytest.approx(-0.01 * info["steps"] + (1 if info["outcome"] == "success" else -1))
    # From standstill at 2.6 m/s^2, 15 to 45 m take between 3 and 6 seconds.
    assert all(15 <= info["steps"] <= 30 for *_, info in ends if info["outcome"] == "success")


@each_task
def test_a_car_is_across_as_soon_as_it_and_five_metres_more_are_on_the_new_road(task, junction):
    env = junction(task)
    seed = next(seed for seed in range(60) if trial(env, seed, [GO])[-1][4]["outcome"] == "success")
    at_end = env.sumo.way_on(TASKS[task])
    assert 10 <= at_end < 10 + 0.2 * env.cars()[0][0, 3] + 1e-6, seed


@each_task
def test_a_waiting_car_changes_nothing_for_the_traffic(task, junction):
    env, paths = junction(task), []
    for present in (True, False):
        env.reset(seed=3)
        if not present:
            libsumo.vehicle.remove("ego")
        paths.append([])
        for _ in range(60):
            libsumo.simulationStep()
            paths[-1].append(env.cars()[1])
    assert all(np.array_equal(*pair) for pair in zip(*paths, strict=True))
    assert len(paths[0][-1]) > 0


def test_the_same_seed_is_the_same_trial_after_a_thousand_others_and_in_another_process(junction):
    actions = [1, 3, 2, GO]
    env = junction("right")
    first = digest(trial(env, 7, actions))
    assert first != digest(trial(env, 8, actions))
    for seed in range(1000):
        trial(env, seed, [GO])
    assert digest(trial(env, 7, actions)) == first
    here = "import hashlib, test_intersections as t; env = t.Intersection('right')\n"
    here += f"print(hashlib.sha256(repr(t.digest(t.trial(env, 7, {actions}))).encode()).hexdigest())"
    search = os.pathsep.join([str(REPOSITORY), str(REPOSITORY / "tests")])
    there = subprocess.run([sys.executable, "-c", here], env=os.environ | {"PYTHONPATH": search}, capture_output=True,
                           text=True, check=True).stdout  # fmt: skip
    assert there.split()[-1] == hashlib.sha256(repr(first).encode()).hexdigest()


def test_without_a_seed_the_same_traffic_drives_on_and_so_does_the_order_of_chance(junction):
    env = junction("left2")

    def three():
        return [digest(trial(env, seed, [1, GO])) for seed in (5, None, None)]

    first = three()
    assert first == three() and len({repr(found) for found in first}) == 3
    env.reset(seed=5)
    ids = set(libsumo.vehicle.getIDList())
    env.step(GO)
    env.reset()
    assert "ego" in libsumo.vehicle.getIDList() and ids & set(libsumo.vehicle.getIDList()) > {"ego"}
    assert libsumo.vehicle.getSpeed("ego") == 0 and env.steps == 0


def test_traffic_that_drives_on_does_not_depend_on_where_cars_lie_in_memory(junction):
    """SUMO's drivers remember other cars by their address; with its own thresholds one of these trials has two ends."""
    env, waits = junction("right"), {9: [0], 25: [1], 43: [2], 44: [0], 124: [1]}

    def drive():
        return [digest(trial(env, None if k else 1359935555, [*waits.get(k, []), GO])) for k in range(145)]

    first = drive()
    for number in range(10):
        pieces = [bytes(size) for size in np.random.default_rng(number).integers(600, 3000, 20_000)]
        pieces = pieces[::2]  # what is left has gaps of the size of cars
        assert drive() == first and pieces


@pytest.mark.parametrize("task", ["right", "challenge"])
def test_trials_with_and_without_a_seed_are_equally_hard(task, junction):
    env, counts = junction(task), []
    for seeded in (True, False):
        ends = [trial(env, k if seeded or k == 0 else None, [3, GO])[-1][4]["outcome"] for k in range(250)]
        counts.append([ends.count("success"), ends.count("collision")])
    assert stats.fisher_exact(counts).pvalue > 0.001


# ------------------------------------------------------------------------------------------------------------ traffic

@each_task
def test_cars_are_emitted_as_a_poisson_process_on_every_lane(task, junction):
    """0.2 a second on each lane, 20 minutes long; counts a minute vary as Poisson counts do."""
    env = junction(task)
    env.reset(seed=1)
    lanes = 2 * {"left2": 2, "challenge": 3}.get(task, 1)
    counts = {}
    for minute in range(20):
        for _ in range(300):
            libsumo.simulationStep()
            for name in libsumo.simulation.getDepartedIDList():
                counts.setdefault(name.rpartition(".")[0], np.zeros(20))[minute] += 1
    assert len(counts) == lanes
    for lane in counts.values():
        assert 0.001 < stats.poisson.cdf(lane.sum(), 20 * 60 * 0.2) < 0.999
        dispersion = ((lane - lane.mean()) ** 2).sum() / lane.mean()
        assert 0.0005 < stats.chi2.cdf(dispersion, 19) < 0.9995


def test_traffic_keeps_its_distance_and_its_speeds_differ(junction):
    env = junction("challenge")
    env.reset(seed=2)
    speeds = []
    for _ in range(100):
        libsumo.simulationStep()
        _, others = env.cars()
        speeds.extend(others[:, 3])
        assert not any(overlaps(car, np.delete(others, i, axis=0)).any() for i, car in enumerate(others))
    assert 12 < np.mean(speeds) < SPEED * 1.1 and 1 < np.std(speeds) < 6


# --------------------------------------------------------------------------------------------------------- collisions

@each_task
def test_whatever_sumo_calls_a_collision_is_one_here(task, junction):
    env, hits = junction(task), 0
    for seed in range(40):
        env.reset(seed=seed)
        libsumo.vehicle.setSpeed("ego", SPEED)
        ours = theirs = False
        for _ in range(40):
            libsumo.simulationStep()
            outcome = env._outcome()
            ours |= outcome == "collision"
            theirs |= any("ego" in (hit.collider, hit.victim) for hit in libsumo.simulation.getCollisions())
            if outcome == "success":
                break
        assert ours or not theirs
        hits += theirs
    assert hits > 0


# -------------------------------------------------------------------------------------------------------- observations

def rows_of_traffic(env):
    rows = set()
    for seed in range(5):
        rows |= set(np.flatnonzero(env.reset(seed=seed)[0][:, :, 2].any(axis=1)).tolist())
        env.close()
    return rows


def test_single_lanes_are_the_same_rows_in_local_coordinates_only(junction):
    local = {task: rows_of_traffic(junction(task)) for task in TASKS}
    assert local["right"] == local["left"] == local["forward"] == {4, 5}
    assert local["left2"] == {4, 5, 6, 7} and local["challenge"] == {4, 5, 6, 7, 8, 9}
    centred = {task: rows_of_traffic(junction(task, coordinates="global")) for task in TASKS}
    assert centred["right"] == {8, 9} and centred["challenge"] == {6, 7, 8, 9, 10, 11}


# ----------------------------------------------------------------------------------------------------------- bad input

def test_bad_input_is_one_clear_line(junction, tmp_path):
    with pytest.raises(ValueError, match=r"no junction 'up' in 'local' coordinates; there are right, left, left2"):
        junction("up")
    with pytest.raises(ValueError, match=r"no junction 'left' in 'polar' coordinates"):
        junction("left", coordinates="polar")
    with pytest.raises(ValueError, match=r"left.net.xml is missing; data/intersections/build.py makes it"):
        junction("left", folder=tmp_path)
    for name in ("SHA256SUMS", "left.rou.xml"):
        (tmp_path / name).write_bytes((FOLDER / name).read_bytes())
    (tmp_path / "left.net.xml").write_bytes((FOLDER / "challenge.net.xml").read_bytes())
    with pytest.raises(ValueError, match=r"left.net.xml is not the file that build.py made; run .*build.py again"):
        junction("left", folder=tmp_path)


def test_a_trial_that_has_ended_is_not_stepped(junction):
    env = junction("forward")
    with pytest.raises(RuntimeError, match="the trial has ended, or was never begun: reset the environment first"):
        env.step(0)
    trial(env, 0, [GO])
    with pytest.raises(RuntimeError, match="the trial has ended"):
        env.step(GO)
    env.reset(seed=0)
    env.close()
    with pytest.raises(RuntimeError, match="the trial has ended"):
        env.step(0)
