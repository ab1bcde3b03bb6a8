"""The junction of chapter 7: trials, masks, and traffic that reacts."""

import hashlib

import gymnasium as gym
import libsumo
import numpy as np
import pytest
from conftest import trial
from gymnasium.utils.env_checker import check_env

from lifelong_lib.environments.crossing import overlaps
from lifelong_lib.environments.pictures import OTHER, OWN
from lifelong_lib.environments.prediction import FASTEST, LIMIT, PROFILES, Margins
from lifelong_lib.environments.safe_junction import BRAKES, FOLDER, SafeJunction, lowest_acceleration

GO = len(PROFILES)  # with the highest acceleration


@pytest.fixture
def junction():
    """Makes junctions, and closes them."""
    made = []

    def make(**more):
        made.append(SafeJunction(**more))
        return made[-1]

    yield make
    for env in made:
        env.close()


def random_trials(env, count, seed):
    """Last infos of trials in which a way to go is drawn, at random moments, of those that are allowed."""
    rng, infos = np.random.default_rng(seed), []
    for number in range(count):
        _, info = env.reset(seed=seed if number == 0 else None)
        ended = late = False
        while not (ended or late):
            go = rng.random() < 0.3
            action = int(rng.choice(np.flatnonzero(info["action_mask"]))) if go else 0
            _, _, ended, late, info = env.step(action)
        infos.append(info)
    return infos


# -------------------------------------------------------------------------------------------------------------- trials

def test_gymnasium_finds_nothing_to_complain_of():
    env = gym.make("lifelong_lib/SafeJunction-v0")
    check_env(env.unwrapped)
    env.close()


def test_the_files_are_those_of_the_list(junction):
    sums = dict(line.split()[::-1] for line in (FOLDER / "SHA256SUMS").read_text().splitlines())
    found = {path.name for kind in ("net", "rou") for path in FOLDER.glob(f"*.{kind}.xml")}
    assert found == set(sums) and len(found) == 4
    assert all(hashlib.sha256((FOLDER / name).read_bytes()).hexdigest() == known for name, known in sums.items())


@pytest.mark.parametrize(("goal", "worth"), [("margin", -5.0), ("braking", 0.0)])
def test_who_waits_is_told_100_steps_after_the_first_safe_moment_that_time_is_up(goal, worth, junction):
    env, steps, paid = junction(goal=goal, timeout=-5.0), 0, 0.0
    _, info = env.reset(seed=0)
    assert info["safe"][1:].any()  # a trial begins when there is a safe way
    late = False
    while not late:
        _, reward, ended, late, info = env.step(0)
        assert not ended and (late or info["action_mask"][1:].any())
        paid += 0.99**steps * reward
        steps += info["steps"]
    assert steps == 100 and info["outcome"] == "timeout" and info["braking"] == 0
    assert paid == pytest.approx(worth * 0.99**99)


def test_a_success_is_worth_its_smallest_distance_or_what_it_costs_in_braking(junction):
    for goal in ("margin", "braking"):
        env = junction(goal=goal, discount=1.0)
        for seed in range(6):
            _, info = env.reset(seed=seed)
            env.sumo.noted = [env.cars()]
            _, reward, ended, _, info = env.step(int(np.flatnonzero(info["action_mask"])[-1]))
            frames, env.sumo.noted = env.sumo.noted, None
            away = [np.linalg.norm(others[:, :2] - own[0, :2], axis=1) for own, others in frames[1:]]
            distance = min(distances.min(initial=50) for distances in away)
            assert ended and info["outcome"] == "success" and info["distance"] == pytest.approx(distance)
            assert reward == pytest.approx(0.1 * (distance - 10) if goal == "margin" else 1 - 0.1 * info["braking"])


def test_the_same_seed_is_the_same_trial_and_without_one_traffic_drives_on(junction):
    env = junction()

    def three():
        return [[step[0].tobytes() for step in trial(env, seed, [0, 0, GO])] for seed in (5, None, None)]

    first = three()
    random_trials(env, 5, seed=1)
    assert three() == first and len({b"".join(images) for images in first}) == 3


def test_a_car_drives_exactly_as_predicted(junction):
    env = junction(safety="none")
    for action, predicted in enumerate(env.prediction.poses, 1):
        for seed in range(30):
            env.reset(seed=seed)
            env.sumo.noted = [env.cars()]
            info = env.step(action)[4]
            own = np.array([frame[0][0] for frame in env.sumo.noted])
            env.sumo.noted = None
            if info["outcome"] == "success":
                break
        assert len(own) == len(predicted)
        assert np.abs(own[:, :2] - predicted[:, :2]).max() < 0.01
        assert np.abs(np.sin((own[:, 2] - predicted[:, 2]) / 2)).max() < 0.01


def test_what_is_seen_are_two_lanes(junction):
    env = junction()
    image, _ = env.reset(seed=3)
    others = env.cars()[1]
    inside = others[np.abs(others[:, 0] - env.roads.middle[0]) < 100]
    assert image.shape == (2, 26, 3) and len(inside) > 0
    for x, y, heading, speed in inside:
        row, column = int(y > env.roads.middle[1]), int((x - env.roads.middle[0] + 100) // (200 / 26))
        assert image[row, column] == pytest.approx([1 - row, speed / 20, 1], abs=1e-6)
        assert np.cos(heading) * (1 - 2 * row) > 0


def test_a_picture_shows_the_own_car_and_the_others(junction):
    env = junction(render_mode="rgb_array")
    env.reset(seed=3)
    picture = env.render().reshape(-1, 3)
    assert env.render().shape == (288, 1000, 3)
    own, others = (int((picture == colour).all(axis=1).sum()) for colour in (OWN, OTHER))
    assert own == pytest.approx(5 * 1.8 * 25, rel=0.3) and others > own


# ---------------------------------------------------------------------------------------------------------------- mask

def test_masked_cars_never_collide_and_others_do(junction):
    safe, blind = (random_trials(junction(density=0.15, safety=safety), 40, seed=2) for safety in ("mask", "none"))
    assert {info["outcome"] for info in safe} <= {"success", "timeout"}
    assert sum(info["outcome"] == "collision" for info in blind) >= 2


def test_nobody_runs_into_a_car_that_is_across(junction):
    """A trial ends when the whole car is on its new road, half as fast as others. For 10 s more nobody hits it."""
    env = junction()
    for seed in range(10):
        _, info = env.reset(seed=seed)
        assert env.step(int(np.flatnonzero(info["safe"])[-1]))[4]["outcome"] == "success"
        libsumo.vehicle.setSpeedMode("ego", 31)  # SUMO drives it from here
        libsumo.vehicle.setSpeed("ego", -1)
        for _ in range(50):
            env.sumo.drive_on(1)
            own, others = env.cars()
            assert not len(own) or not overlaps(own[0], others).any()


def test_what_is_not_safe_is_replaced_by_waiting(junction):
    env = junction()
    _, info = env.reset(seed=0)
    assert not info["safe"][1] and not info["replaced"]  # the slowest profile, who may come into view
    _, _, ended, late, info = env.step(1)
    assert info["replaced"] == 1 and not ended and not late and env.cars()[0][0, 3] == 0
    assert env.step(1)[4]["replaced"] == 2 and env.step(0)[4]["replaced"] == 2  # of the trial so far
    assert env.reset()[1]["replaced"] == 0


def test_without_safety_what_is_not_safe_is_done_and_counted(junction):
    env = junction(safety="none")
    _, info = env.reset(seed=0)
    assert info["action_mask"].all() and not info["safe"][1] and info["replaced"] == 0
    _, _, ended, _, info = env.step(1)
    assert ended and info["replaced"] == 1
    env.reset(seed=0)
    assert env.step(0)[4]["replaced"] == 0


def test_a_shield_says_that_all_is_allowed_and_takes_its_penalty(junction):
    env = junction(safety="shield", shield_penalty=2.0)
    _, info = env.reset(seed=0)
    assert info["action_mask"].all() and not info["safe"][1]
    _, reward, _, _, info = env.step(1)
    assert info["replaced"] == 1 and reward == -2.0
    _, reward, _, _, info = env.step(0)
    assert reward == 0 and info["replaced"] == 1


def test_the_mask_knows_the_cars_of_its_moment_only_and_not_what_comes(junction):
    """Trials of one seed with two futures have the same masks until they part, and those follow from the cars alone."""
    env, masks = junction(safety="none"), []
    for waits in (5, 12):
        _, info = env.reset(seed=4)
        masks.append([info["safe"]])
        for action in [0] * waits + [GO]:
            assert info["safe"][1:].tolist() == env.prediction.safe(env.cars()[1].copy()).tolist()
            _, _, _, _, info = env.step(action)
            masks[-1].append(info["safe"])
    assert np.array_equal(masks[0][:6], masks[1][:6])


def test_an_extra_margin_narrows_the_mask_and_leaves_the_clock(junction):
    beginnings = []
    for extra in (0.0, 15.0):
        env = junction(margins=Margins(extra=extra))
        infos, cars = [], []
        for seed in range(12):
            infos.append(env.reset(seed=seed)[1])
            cars.append(env.cars()[1])
        beginnings.append((np.array([info["safe"] for info in infos]), cars))
    (usual, cars), (narrow, same) = beginnings
    assert all(np.array_equal(*pair) for pair in zip(cars, same, strict=True))
    assert usual[:, 1:].any(axis=1).all() and (narrow <= usual).all() and narrow.sum() < usual.sum()


# ------------------------------------------------------------------------------------------------------------- traffic

def hardest_braking(env, seed, go):
    """Lowest acceleration, in 5 s, of a car that was 3 s from the own car's path when that went, or did not."""
    env.reset(seed=seed)
    path = env.roads.middle[0] + 1.6
    for _ in range(1000):
        coming = [(path - libsumo.vehicle.getPosition(name)[0], name) for name in libsumo.vehicle.getIDList()
                  if name.startswith("from_west")]  # fmt: skip
        away, name = min((pair for pair in coming if pair[0] > 0), default=(0, ""))
        if name and 2.9 < away / libsumo.vehicle.getSpeed(name) < 3.1:
            break
        env.sumo.drive_on(1)
    accelerations, drive_on = [], env.sumo.drive_on

    def noting(steps):
        drive_on(steps)
        accelerations.append(libsumo.vehicle.getAcceleration(name))

    env.sumo.drive_on = noting
    if go:
        env.step(GO)
    else:
        for _ in range(25):
            noting(1)
    env.sumo.drive_on = drive_on
    return min(accelerations)


def test_a_car_that_is_cut_off_at_3_seconds_brakes_and_one_that_is_not_does_not(junction):
    env = junction(safety="none")
    for seed in range(4):
        assert hardest_braking(env, seed, go=False) > BRAKES
        assert -4.5 - 1e-6 <= hardest_braking(env, seed, go=True) < -1


def test_a_car_that_passes_first_does_not_brake(junction):
    """Safe crossings behind the last car: nobody is held up."""
    env, free = junction(), 0
    for seed in range(30):
        _, info = env.reset(seed=seed)
        x, y, heading, _ = env.cars()[1].T
        if not (np.cos(heading) * (env.roads.middle[0] - x) > 0).any():
            info = env.step(GO)[4]
            free += 1
            assert info["braking"] <= 2, seed
    assert free >= 3


@pytest.mark.parametrize("density", [0.1, 0.15])
def test_traffic_hardly_ever_brakes_without_the_own_car(density, junction):
    env, brakes, fastest = junction(density=density), 0, 0.0
    env.reset(seed=9)
    for _ in range(1500):
        env.sumo.drive_on(1)
        brakes += lowest_acceleration() < BRAKES
        fastest = max(fastest, env.cars()[1][:, 3].max(initial=0))
    assert brakes <= 15
    assert LIMIT < fastest <= FASTEST + 1e-9  # which the mask assumes of those that it does not see
    assert 0.8 * LIMIT < env.cars()[1][:, 3].mean() < 1.1 * LIMIT


# ----------------------------------------------------------------------------------------------------------- bad input

@pytest.mark.parametrize(("more", "known"), [
    ({"density": 0.2}, "density 0.2; there are 0.1, 0.15, 0.4"),
    ({"goal": "speed"}, "goal 'speed'; there are margin, braking"),
    ({"safety": "belt"}, "safety 'belt'; there are mask, shield, none")])
def test_an_unknown_choice_is_answered_with_those_that_there_are(more, known):
    with pytest.raises(ValueError, match=known):
        SafeJunction(**more)


def test_margins_that_never_allow_anything_are_named(junction, monkeypatch):
    monkeypatch.setattr("lifelong_lib.environments.safe_junction.PATIENCE", 600)
    with pytest.raises(RuntimeError, match="no way to go was safe for 2 minutes: narrow the margins"):
        junction(margins=Margins(fixed=60.0)).reset(seed=0)
