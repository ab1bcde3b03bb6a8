"""Chapter 7: the bounds, and functions that measure and decide claims, on numbers made by hand."""

from types import SimpleNamespace

import numpy as np
import pytest
from notebook_functions import judge, load

from lifelong_lib.environments.crossing import overlaps

MEASURES = ("outcome", "distance", "braking", "waited", "cars", "return", "replaced")
OUTCOMES = ("success", "collision", "timeout")
SUCCESS, COLLISION, TIMEOUT = range(3)
PENALTIES = [-1.0, -5.0, -10.0]


def measured(*rows):
    """Trials (1 seed, trials, measures) from (outcome, distance, braking, waited, cars) and a reward."""
    return np.array([[[*row, *[0.0] * (7 - len(row))] for row in rows]], float)


def of_drivers(**drivers):
    """The notebook's `of` for drivers: {name: trials (seeds, trials, measures)} at any time."""
    return lambda name, key, measure: drivers[name][..., MEASURES.index(measure)]


# ---------------------------------------------------------------------------------------------------- bounds, C7.8

BOUNDS = ("chebyshev", "halved", "cantelli", "margin_in_noise", "needed_margin")


def test_the_bounds_at_two_deviations_and_the_example_of_the_text():
    space = load(7, *BOUNDS)
    assert (space.chebyshev(2), space.halved(2), space.cantelli(2)) == (0.25, 0.125, 0.2)
    assert space.margin_in_noise(3, 0.8, 0.6, 2) == pytest.approx(4.6 / 0.6)
    assert space.margin_in_noise(3, 0.0, 1.0, 2) == 3  # nobody steers
    needed = space.needed_margin(10, 0.01)
    assert 10 * space.halved(needed) == pytest.approx(0.01)


def test_the_bounds_hold_for_the_distribution_that_is_worst_for_them():
    space = load(7, *BOUNDS)
    count = 3.0
    ends = np.array([-count, count] + [0.0] * 16)  # variance 2 * 9 / 18
    assert ends.var() == pytest.approx(1) and np.mean(np.abs(ends) >= count) == pytest.approx(space.chebyshev(count))
    assert np.mean(ends >= count) == pytest.approx(space.halved(count))
    lopsided = np.array([count] + [-1 / count] * 9)  # one side only: the halved bound fails, Cantelli's does not
    assert lopsided.mean() == pytest.approx(0) and lopsided.var() == pytest.approx(1)
    share = np.mean(lopsided >= count - 1e-12)
    assert share == pytest.approx(space.cantelli(count)) and share > space.halved(count)


def test_forecasts_leave_margins_on_either_side_at_any_step():
    errors = np.array([[0.0, 1.0], [0.0, -3.0], [0.5, 0.5], [2.0, -3.0]])
    space = load(7, "leaves", "growth_of")
    assert space.leaves(errors, np.array([1.0, 2.0])).tolist() == [0.5, 0.25, 0.5]
    seconds = np.array([1.0, 2.0, 3.0])
    assert space.growth_of(0.05 * seconds**2, seconds) == pytest.approx(0.3)


def test_errors_of_forecasts_count_forwards_for_both_directions_and_only_for_cars_that_come():
    names = {"VIEW": 100, "HORIZON": 2, "STEP_SECONDS": 0.2}
    space = load(7, "forecast_errors", **names)

    def frame(step):
        return {"steady": (-50 + 2.0 * step, -1.6, 10.0), "slower": (50 - 1.5 * step, 1.6, 10.0),
                "passed": (1.0 + 2 * step, -1.6, 10.0), "far": (-101.0, -1.6, 0.0)}  # fmt: skip

    errors = space.forecast_errors([frame(step) for step in range(3)], np.zeros(2))
    assert errors == pytest.approx(np.array([[0, 0], [-0.5, -1.0]]))


def test_braking_without_an_own_car_counts_steps_in_which_any_car_slows_down_by_half_a_metre():
    space = load(7, "ordinary_braking", BRAKES=-0.5, STEP_SECONDS=0.2)
    frames = [{"a": (0, 0, 10.0), "b": (0, 0, 9.0)}, {"a": (0, 0, 9.95), "b": (0, 0, 9.0)},
              {"a": (0, 0, 9.95), "b": (0, 0, 8.8), "new": (0, 0, 1.0)}, {"new": (0, 0, 2.0)}, {}]  # fmt: skip
    assert space.ordinary_braking(frames) == 1 / 4


def test_c7_8_looks_at_six_deviations_and_at_the_worse_side(tmp_path):
    rates = np.zeros((3, 4, 3))
    rates[:, 3] = [0.02, 0.001, 0.01]
    names = vars(load(7, *BOUNDS, "rate_parts"))
    space = SimpleNamespace(**names, COUNTS=(2, 3, 4, 6), density=0.1, measured_seeds=3)
    space.forecasts = SimpleNamespace(stack=lambda key, density: {
        "beyond": rates, "without growth": np.full((3, 3), 0.1)}[key])  # fmt: skip
    claim = judge(7, "C7.8", space, tmp_path)
    assert claim.verdict == "holds" and claim.control_verdict == "contradicted"
    assert claim.measured["rate on both sides over Chebyshev's bound"] == pytest.approx(0.02 * 36)
    assert claim.measured["larger rate on one side over the halved bound"] == pytest.approx(0.01 * 72)
    assert claim.measured["larger rate on one side over Cantelli's bound"] == pytest.approx(0.01 * 37)


# ------------------------------------------------------------------------------------------------------------- trials

def test_what_is_measured_of_a_trial():
    space = load(7, "measures_of", "MEASURES", "column", OUTCOMES=OUTCOMES, STEP_SECONDS=0.2)
    images = np.zeros((3, 2, 26, 3))
    images[0, 1, 4:7, 2] = 1
    info = {"outcome": "success", "distance": 12.0, "braking": 3, "replaced": False}
    trial = SimpleNamespace(images=images, steps=np.array([4, 6, 25]), returns=np.array([0.7, 0.8, 0.9]), info=info)
    assert space.measures_of(trial) == [0, 12.0, 3, pytest.approx(2.0), 3, 0.7, False]
    trial.info = info | {"outcome": "timeout", "distance": 50.0}
    assert space.measures_of(trial)[:2] == [2, -1]
    assert space.column(np.arange(14).reshape(2, 7), "braking").tolist() == [2, 9]


def test_a_departure_is_drawn_among_moments_first_and_then_among_ways():
    space = load(7, "wait", "going_at", "drawn_departure")
    masks = np.array([[1, 0, 1, 1], [1, 0, 0, 0], [1, 0, 1, 0], [1, 1, 1, 1]], bool)
    rng = np.random.default_rng(0)
    drawn = [space.drawn_departure(masks, [1, 2, 3], rng) for _ in range(3000)]
    moments = np.bincount([moment for moment, _ in drawn], minlength=4) / 3000
    assert moments == pytest.approx([1 / 3, 0, 1 / 3, 1 / 3], abs=0.04)
    assert all(masks[moment, way] and way for moment, way in drawn)
    assert {space.drawn_departure(masks, [3], rng) for _ in range(50)} == {(0, 3), (3, 3)}
    assert space.drawn_departure(masks[1:2], [1, 2, 3], rng) == (-1, 0)
    policy = space.going_at(2, 3)
    assert [policy(None, None) for _ in range(4)] == [0, 0, 3, 0]
    assert not any(space.going_at(-1, 0)(None, None) for _ in range(4)) and space.wait(None, None) == 0


def test_an_attacker_meets_who_stands_in_its_way_in_time():
    space = load(7, "meets", STEP_SECONDS=0.2, overlaps=overlaps)
    own = np.tile([0.0, 0.0, np.pi / 2], (11, 1))  # stands for 2 s
    assert not space.meets(own, np.array([-30.0, 0, 0, 10.0]), 0.0)  # comes to 10 m
    assert space.meets(own, np.array([-30.0, 0, 0, 10.0]), 4.0)  # 8 m more
    assert space.meets(own, np.array([30.0, 0, np.pi, 10.0]), 4.0)
    assert not space.meets(own, np.array([-30.0, 5, 0, 10.0]), 9.0)  # beside it


# ------------------------------------------------------------------------------------------------------------- claims

def test_c7_1_counts_collisions_only(tmp_path):
    space = load(7, "collisions", "column", MEASURES=MEASURES, OUTCOMES=OUTCOMES)
    clean, crash = measured((SUCCESS, 9), (TIMEOUT, -1)), measured((SUCCESS, 9), (COLLISION, 3), (COLLISION, 2))
    assert space.collisions(clean).tolist() == [0] and space.collisions(crash).tolist() == [2]
    names = SimpleNamespace(**vars(space), label="collisions of all networks, rules and random drivers with a mask")
    names.masked, names.all_trials = [clean, clean], lambda which: [crash, clean]
    claim = judge(7, "C7.1", names, tmp_path)
    assert (claim.measured[names.label], claim.control[names.label]) == (0, 2)
    names.masked = [clean, crash]
    assert judge(7, "C7.1", names, tmp_path).measured[names.label] == 2


def test_c7_2_compares_the_last_fifth_with_the_first_and_shares_of_successes(tmp_path):
    early, late = [5.0, 5.0, 20.0, 20.0], [5.0, 20.0, 20.0, -1.0]
    distances = np.array([early + [30.0] * 12 + late] * 3)
    drivers = {"M, z = -1": distances, "not learning": np.full_like(distances, 30.0)}
    space = load(7, "fifths", "share_between", "training_parts", of=lambda name, key, measure: drivers[name])
    parts = space.training_parts("M, z = -1")
    assert parts["share of successes under 10 m, last fifth minus first"] == pytest.approx([1 / 3 - 1 / 2] * 3)
    assert parts["share of successes from 15 to 25 m, last fifth minus first"] == pytest.approx([2 / 3 - 1 / 2] * 3)
    assert parts["share of time-outs, last fifth minus first"] == pytest.approx([0.25] * 3)
    claim = judge(7, "C7.2", space, tmp_path)
    assert claim.verdict == "holds" and claim.control_verdict == "contradicted"


def penalised(*shares):
    """Drivers of each penalty with so many time-outs of ten trials, in three seeds."""
    made = {}
    for z, late in zip(PENALTIES, shares, strict=True):
        trials = measured(*[(TIMEOUT, -1)] * late, *[(SUCCESS, 20.0)] * (10 - late))
        made[f"M, z = {z:g}"] = np.repeat(trials, 3, axis=0)
    return made


def test_c7_3_wants_fewer_time_outs_for_larger_penalties(tmp_path):
    trained, fresh = of_drivers(**penalised(5, 3, 1)), of_drivers(**penalised(4, 4, 4))
    space = load(7, "lateness", "penalty_parts", penalties=PENALTIES,
                 of=lambda name, key, measure: (trained if key == "after" else fresh)(name, key, measure))  # fmt: skip
    claim = judge(7, "C7.3", space, tmp_path)
    assert list(claim.measured.values()) == pytest.approx([0.4, 0.2, 0.2])
    assert claim.verdict == "holds" and claim.control_verdict == "contradicted"


def test_c7_4_compares_at_the_same_share_of_time_outs():
    drivers = {"rule + 0 m": measured(*[(SUCCESS, 10.0)] * 4),
               "rule + 5 m": measured((TIMEOUT, -1), *[(SUCCESS, 20.0)] * 3),
               "rule + 9 m": measured(*[(TIMEOUT, -1)] * 4),
               "net": measured(*[(SUCCESS, 18.0)] * 7, (TIMEOUT, -1)),
               "late": measured(*[(TIMEOUT, -1)] * 3, (SUCCESS, 25.0))}  # fmt: skip
    space = load(7, "mean_of_successes", "mean_distance", "lead_over_rule", "lateness", of=of_drivers(**drivers),
                 OUTCOMES=OUTCOMES, extra_margins=[0.0, 5.0, 9.0])  # fmt: skip
    assert space.mean_distance("rule + 5 m").tolist() == [20.0]
    assert space.lead_over_rule("net") == pytest.approx([18 - 15])  # an eighth is half way from 0 to a quarter
    assert space.lead_over_rule("late") == pytest.approx([25 - 20])  # the nearest margin with successes


def test_c7_5_compares_successes_of_both_networks_and_the_random_driver():
    drivers = {"M, z = -1": measured((SUCCESS, 30.0, 2), (TIMEOUT, -1, 0)), "B": measured((SUCCESS, 12.0, 1)),
               "random": measured((SUCCESS, 10.0, 4))}  # fmt: skip
    space = load(7, "mean_of_successes", "mean_distance", "mean_braking", "goal_parts", of=of_drivers(**drivers),
                 OUTCOMES=OUTCOMES)  # fmt: skip
    assert [float(part[0]) for part in space.goal_parts("after").values()] == [18, 20, 2, 3, 1, 2]
    space.of = of_drivers(**drivers | {"B": measured((TIMEOUT, -1, 0))})  # never across: 0 m and 100 steps
    assert [float(part[0]) for part in space.goal_parts("after").values()] == [30, 20, -10, -96, -98, 2]


def test_c7_6_counts_delays_of_successes_by_cars_in_view():
    rows = [(SUCCESS, 9, 0, 3.0, 1), (SUCCESS, 9, 0, 5.0, 2), (TIMEOUT, -1, 0, 20.0, 2), (SUCCESS, 9, 0, 8.0, 3),
            (SUCCESS, 9, 0, 1.0, 4), (SUCCESS, 9, 0, 2.0, 6)]  # fmt: skip
    space = load(7, "delay_of_few", of=of_drivers(some=measured(*rows), few=measured(*rows[:2])))
    assert space.delay_of_few("some") == pytest.approx([4 - 1.5])
    assert space.delay_of_few("few").tolist() == [0.0]


def test_c7_7_compares_the_first_tenth_and_counts_all_collisions(tmp_path):
    def results(first, crashes=0):
        rows = [(SUCCESS, 9, 0, 0, 0, first if number < 2 else 1.0) for number in range(20)]
        rows[-1] = (COLLISION, 0) if crashes else rows[-1]
        return np.repeat(measured(*rows), 3, axis=0)

    names = {"collisions", "column", "transfer_parts", "high"}
    space = load(7, *names, MEASURES=MEASURES, OUTCOMES=OUTCOMES, learning=20,
                 transferred=None)  # fmt: skip
    found = {"from scratch": results(0.0), "pre-trained": results(0.5), "shuffled": results(-0.2)}
    space.transferred = SimpleNamespace(stack=lambda key, start: found[start])
    claim = judge(7, "C7.7", space, tmp_path)
    label = "reward in the first tenth, pre-trained minus from scratch"
    assert claim.verdict == "holds" and claim.measured[label] == pytest.approx(0.5)
    assert claim.control_verdict == "contradicted"
    found["pre-trained"] = results(0.5, crashes=1)
    assert judge(7, "C7.7", space, tmp_path).verdict == "contradicted"


def test_means_over_the_training():
    space = load(7, "moving_mean", "curve")
    assert space.moving_mean(np.array([1.0, 3.0, 5.0]), 2).tolist() == [2, 4]
    assert space.curve(np.array([[1.0, 3.0, 5.0, 7.0]]), 2).tolist() == [[2, 6]]
