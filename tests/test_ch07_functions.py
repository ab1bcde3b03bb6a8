"""Chapter 7: the bounds, and functions that measure and decide claims, on numbers made by hand."""

from types import SimpleNamespace

import numpy as np
import pytest
from notebook_functions import judge, load

from lifelong_lib.environments.crossing import overlaps
from lifelong_lib.reproduction.files import ReproductionError

MEASURES = ("outcome", "distance", "braking", "waited", "cars", "return", "replaced")
OUTCOMES = ("success", "collision", "timeout")
SUCCESS, COLLISION, TIMEOUT = range(3)
PENALTIES = [-1.0, -5.0, -10.0]


def measured(*rows):
    """Trials (1 seed, trials, measures) from (outcome, distance, braking, waited, cars) and a reward."""
    return np.array([[[*row, *[0.0] * (7 - len(row))] for row in rows]], float)


def driving(*names, key_of=None, **given):
    """Functions of the notebook, for drivers that are {name: trials (seeds, trials, measures)} at any time.

    ``key_of``: {(name, when): trials} where a driver's trials depend on when.
    """
    drivers, key_of = given.pop("drivers"), key_of or {}
    space = load(7, "column", "of", "finite", *names, MEASURES=MEASURES, OUTCOMES=OUTCOMES,
                 chapter=SimpleNamespace(profile="paper"), **given)  # fmt: skip
    space.trials_of = lambda name, key: key_of.get((name, key), drivers.get(name))
    return space


def transfers(**found):
    """The notebook's `transferred`: {what is asked for of the pre-trained network, or "scratch": trials}."""
    return SimpleNamespace(stack=lambda key, start: found["scratch" if start == "from scratch" else key])


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
    info = {"outcome": "success", "distance": 12.0, "braking": 3, "replaced": 2}
    trial = SimpleNamespace(images=images, steps=np.array([4, 6, 25]), returns=np.array([0.7, 0.8, 0.9]), info=info)
    assert space.measures_of(trial) == [0, 12.0, 3, pytest.approx(2.0), 3, 0.7, 2]
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

def test_c7_1_counts_collisions_of_all_seeds_together(tmp_path):
    space = load(7, "collisions", "all_collisions", "column", MEASURES=MEASURES, OUTCOMES=OUTCOMES)
    clean, crash = measured((SUCCESS, 9), (TIMEOUT, -1)), measured((SUCCESS, 9), (COLLISION, 3), (COLLISION, 2))
    assert space.collisions(clean).tolist() == [0] and space.collisions(crash).tolist() == [2]
    none = np.repeat(clean, 3, axis=0)
    once = np.concatenate([measured((SUCCESS, 9), (COLLISION, 3)), clean, clean])  # at one seed of three
    assert space.collisions(once).tolist() == [1, 0, 0] and space.all_collisions([once, none]).tolist() == [1, 1, 1]
    label = "collisions of all networks, rules and random drivers with a mask or a shield"
    names = SimpleNamespace(**vars(space), label=label)
    names.masked, names.all_trials = [none, none], lambda which: [once, none]
    claim = judge(7, "C7.1", names, tmp_path)
    assert (claim.verdict, claim.control_verdict) == ("holds", "contradicted")
    assert (claim.measured[names.label], claim.control[names.label]) == (0, 1)
    names.masked = [none, once]
    claim = judge(7, "C7.1", names, tmp_path)
    assert claim.verdict == "contradicted" and claim.measured[names.label] == 1
    names.masked, names.all_trials = [none, none], lambda which: [none]  # a control without collisions shows nothing
    assert judge(7, "C7.1", names, tmp_path).verdict == "undecided"


def test_trials_that_are_the_same_count_once_and_time_outs_are_no_crossings():
    configs = {name: {"driver": "network"} for name in ("M, z = -1", "M, z = -5", "B", "not learning", "shield")}
    space = load(7, "counted", "all_trials", "number_of", "column", MEASURES=MEASURES, OUTCOMES=OUTCOMES,
                 configs=configs | {"random": {"driver": "random"}}, trials_of=lambda *asked: asked)  # fmt: skip
    everything = {"before", "training", "after"}
    when = {name: set(space.counted(name)) for name in space.configs}
    assert when == {"M, z = -1": everything, "shield": everything, "M, z = -5": {"training", "after"},
                    "B": {"training", "after"}, "not learning": {"training"}, "random": {"after"}}  # fmt: skip
    assert space.all_trials(["B", "random"]) == [("B", "training"), ("B", "after"), ("random", "after")]
    assert space.number_of([measured((SUCCESS, 9), (TIMEOUT, -1)), measured((COLLISION, 2))]) == (3, 2)


def test_what_cannot_be_compared_is_an_error_where_claims_are_tested():
    space = load(7, "finite", chapter=SimpleNamespace(profile="paper"))
    assert space.finite(np.array([1.0, 2.0]), "B").tolist() == [1, 2]
    with pytest.raises(ReproductionError, match="B: no trial gets across"):
        space.finite(np.array([1.0, np.nan]), "B")
    space.chapter.profile = "quick"
    assert space.finite(np.array([1.0, np.nan]), "B").tolist() == [1, 0]


def by_distance(distances):
    """Trials (seeds, trials, measures) with these distances (seeds, trials), below 0 for a time-out."""
    trials = np.zeros((*distances.shape, len(MEASURES)))
    trials[..., 0], trials[..., 1] = np.where(distances < 0, TIMEOUT, SUCCESS), distances
    return trials


def test_c7_2_compares_the_last_fifth_with_the_first_and_evaluations_beside_it(tmp_path):
    early, late = [5.0, 5.0, 20.0, 20.0], [5.0, 20.0, 20.0, -1.0]
    distances = np.array([early + [30.0] * 12 + late] * 3)
    drivers = {"M, z = -1": by_distance(distances), "not learning": by_distance(np.full_like(distances, 30.0))}
    looks = {("M, z = -1", "before"): by_distance(np.array([[-1.0, -1.0, -1.0, 5.0]] * 3)),
             ("M, z = -1", "after"): by_distance(np.array([[-1.0, 5.0, 5.0, 30.0]] * 3))}  # fmt: skip
    space = driving("first_and_last_fifth", "fifths", "share_between", "lateness", "closeness", "evaluated_parts",
                    "training_parts", drivers=drivers, key_of=looks)  # fmt: skip
    parts = space.training_parts("M, z = -1")
    assert parts["share of successes under 10 m, last fifth minus first"] == pytest.approx([1 / 3 - 1 / 2] * 3)
    assert parts["share of successes from 15 to 25 m, last fifth minus first"] == pytest.approx([2 / 3 - 1 / 2] * 3)
    assert parts["share of time-outs, last fifth minus first"] == pytest.approx([0.25] * 3)
    claim = judge(7, "C7.2", space, tmp_path)
    assert claim.verdict == "holds" and claim.control_verdict == "contradicted"  # whatever the evaluations say
    assert claim.measured["share of time-outs, after minus before training"] == pytest.approx(-0.5)
    assert claim.measured["share of trials that get across under 10 m, after minus before training"] == 0.25
    assert np.isnan(space.share_between(0, 10)(np.array([-1.0, -1.0])))


def test_fifths_are_of_trials_and_one_trial_at_least():
    fifths = load(7, "first_and_last_fifth").first_and_last_fifth
    assert [part.tolist() for part in fifths(np.arange(11)[None])] == [[[0, 1]], [[9, 10]]]
    assert [part.tolist() for part in fifths(np.arange(3)[None])] == [[[0]], [[2]]]


def penalised(*shares):
    """Drivers of each penalty with so many time-outs of ten trials, in three seeds."""
    made = {}
    for z, late in zip(PENALTIES, shares, strict=True):
        trials = measured(*[(TIMEOUT, -1)] * late, *[(SUCCESS, 20.0)] * (10 - late))
        made[f"M, z = {z:g}"] = np.repeat(trials, 3, axis=0)
    return made


def late_in(*shares):
    """Training of three seeds with so many time-outs of ten trials in the last fifth of fifty, none before."""
    return by_distance(np.array([[20.0] * 40 + [-1.0] * late + [20.0] * (10 - late) for late in shares]))


def test_c7_3_wants_fewer_time_outs_for_larger_penalties_than_luck_makes(tmp_path):
    space = driving("first_and_last_fifth", "lateness", "late_at_last", "penalty_parts", penalties=PENALTIES,
                    drivers=penalised(5, 3, 1), key_of={("M, z = -1", "training"): late_in(2, 3, 2)},
                    transferred=transfers(low=late_in(3, 2, 3)))  # fmt: skip
    claim = judge(7, "C7.3", space, tmp_path)
    label = "share of time-outs, z = -1 minus z = -10"
    assert list(claim.measured.values()) == pytest.approx([0.4, 0.2, 0.2])
    assert claim.verdict == "holds" and claim.control_verdict == "undecided"
    assert claim.control == {label: pytest.approx(-0.1 / 3)}
    space.transferred = transfers(low=late_in(0, 1, 0))  # luck does as much
    claim = judge(7, "C7.3", space, tmp_path)
    assert claim.verdict == "undecided" and claim.control[label] == pytest.approx(0.2)


def test_c7_4_compares_at_the_same_share_of_time_outs():
    drivers = {"rule + 0 m": measured(*[(SUCCESS, 10.0)] * 4),
               "rule + 5 m": measured((TIMEOUT, -1), *[(SUCCESS, 20.0)] * 3),
               "rule + 9 m": measured(*[(TIMEOUT, -1)] * 4),
               "net": measured(*[(SUCCESS, 18.0)] * 7, (TIMEOUT, -1)),
               "late": measured(*[(TIMEOUT, -1)] * 3, (SUCCESS, 25.0)), "never": measured((TIMEOUT, -1))}  # fmt: skip
    space = driving("mean_where", "mean_of_successes", "mean_distance", "lead_over_rule", "lateness", drivers=drivers,
                    extra_margins=[0.0, 5.0, 9.0])  # fmt: skip
    assert space.mean_distance("rule + 5 m").tolist() == [20.0]
    assert space.lead_over_rule("net") == pytest.approx([18 - 15])  # an eighth is half way from 0 to a quarter
    assert space.lead_over_rule("late") == pytest.approx([25 - 20])  # the nearest margin with successes
    with pytest.raises(ReproductionError, match="never: no trial gets across"):
        space.lead_over_rule("never")


def test_c7_5_compares_successes_of_both_networks_and_the_random_driver(tmp_path):
    def three(*rows):
        return np.repeat(measured(*rows), 3, axis=0)

    drivers = {"M, z = -1": three((SUCCESS, 30.0, 2), (TIMEOUT, -1, 0)), "B": three((SUCCESS, 12.0, 1)),
               "random": three((SUCCESS, 10.0, 4))}  # fmt: skip
    looks = {("not learning", "training"): three((SUCCESS, 9.0, 3)),
             ("M, z = -1", "training"): three(*[(SUCCESS, 50.0, 0)] * 4, (SUCCESS, 20.0, 2))}  # fmt: skip
    space = driving("first_and_last_fifth", "mean_where", "mean_of_successes", "lateness", "GOALS", "BESIDE",
                    "compared", "goal_parts", drivers=drivers, key_of=looks, density=0.1)  # fmt: skip
    space.at_limit = {"0.1 cars a second": three((SUCCESS, 9.0, 5))}.get
    space.twins = looks["M, z = -1", "training"], three(*[(SUCCESS, 50.0, 0)] * 4, (SUCCESS, 21.0, 2.5))
    assert [float(part[0]) for part in space.goal_parts(space.compared).values()] == [18, 20, 2, 3, 1, 2]
    claim = judge(7, "C7.5", space, tmp_path)
    assert claim.verdict == "holds" and claim.control_verdict == "contradicted"
    assert list(claim.control.values()) == [-1, -1, -1, -1, -0.5, -1]
    assert claim.measured["share of time-outs, M"] == 0.5 and claim.measured["share of time-outs, B"] == 0
    assert claim.measured["braking, not learning minus M [steps]"] == 1
    assert claim.measured["braking, not learning minus B [steps]"] == 2
    space.twins = space.twins[0], three(*[(SUCCESS, 50.0, 0)] * 4, (SUCCESS, 11.0, 1))  # luck does as much
    assert judge(7, "C7.5", space, tmp_path).verdict == "undecided"
    drivers["B"] = three((TIMEOUT, -1, 0))
    with pytest.raises(ReproductionError, match="distance, M minus B .* no trial gets across"):
        judge(7, "C7.5", space, tmp_path)


def test_c7_6_counts_delays_of_successes_by_cars_in_view(tmp_path):
    rows = [(SUCCESS, 9, 0, 3.0, 1), (SUCCESS, 9, 0, 5.0, 2), (TIMEOUT, -1, 0, 20.0, 2), (SUCCESS, 9, 0, 8.0, 3),
            (SUCCESS, 9, 0, 0.6, 4), (SUCCESS, 9, 0, 1.0, 6), (TIMEOUT, -1, 0, 20.0, 5)]  # fmt: skip
    drawn = [(SUCCESS, 9, 0, 9.0, 1), (SUCCESS, 9, 0, 9.0, 5)]
    drivers = {name: np.repeat(measured(*trials), 3, axis=0)
               for name, trials in {"M, z = -1": rows, "random": drawn}.items()}  # fmt: skip
    space = driving("mean_where", "delay_parts", drivers=drivers)
    claim = judge(7, "C7.6", space, tmp_path)
    assert list(claim.measured.values()) == pytest.approx([4 - 0.8, 4, 0.8])
    assert claim.verdict == "holds" and claim.control_verdict == "contradicted"  # the delay alone has no control
    drivers["M, z = -1"][:, 4:6, 3] += 1  # not at once where many are in view
    assert judge(7, "C7.6", space, tmp_path).verdict == "contradicted"
    drivers["few"] = measured(*rows[:2])
    with pytest.raises(ReproductionError, match="few: no trial gets across"):
        space.delay_parts("few")


def test_the_reward_is_not_discounted():
    space = load(7, "rewards_of", "column", MEASURES=MEASURES, OUTCOMES=OUTCOMES, common={"timeout": -1.0})
    trials = measured((SUCCESS, 30.0, 0, 19.0, 0, 0.9), (TIMEOUT, -1.0), (COLLISION, 3.0))
    assert space.rewards_of(trials).tolist() == [[2.0, -1.0, -10.0]]


def test_c7_7_compares_the_first_tenth_and_counts_all_collisions(tmp_path):
    def results(first, crashes=0):
        """Three seeds that keep `first` metres in the first tenth; so many of them crash once, later."""
        trials = np.repeat(measured(*[(SUCCESS, first if number < 2 else 20.0) for number in range(20)]), 3, axis=0)
        trials[:crashes, -1, 0] = COLLISION
        return trials

    space = load(7, "collisions", "all_collisions", "column", "transfer_parts", "rewards_of", "dense", "DENSE",
                 MEASURES=MEASURES, OUTCOMES=OUTCOMES, learning=20, common={"timeout": -1.0})  # fmt: skip
    found = {"scratch": results(10.0), "high": results(15.0), "shuffled": results(8.0)}
    space.transferred = transfers(**found)
    claim = judge(7, "C7.7", space, tmp_path)
    label = "reward in the first tenth, pre-trained minus from scratch"
    assert claim.verdict == "holds" and claim.measured[label] == pytest.approx(0.5)
    assert claim.control_verdict == "contradicted" and claim.control[label] == pytest.approx(-0.2)
    space.transferred = transfers(**found | {"high": results(15.0, crashes=1)})  # at one seed of three
    assert judge(7, "C7.7", space, tmp_path).verdict == "contradicted"


def test_the_transfer_trains_in_sparse_traffic_once_and_all_dense_traffic_is_alike():
    seen = []

    def learn_in(traffic, config, seed, teaching, weights=None):
        seen.append((traffic, seed.spawn_key, int(teaching.generate_state(1)[0]), weights))
        return f"trained in {traffic}", np.arange(50.0)

    space = load(7, "transfer", learn_in=learn_in)
    config = {"density": 0.1, "high": 0.15}
    assert set(space.transfer(config | {"start": "from scratch"}, np.random.SeedSequence(3))) == {"high"}
    assert set(space.transfer(config | {"start": "pre-trained"}, np.random.SeedSequence(3))) == {
        "low", "high", "shuffled"}  # fmt: skip
    traffics, learners, teachings, weights = zip(*seen, strict=True)
    assert traffics == (0.15, 0.1, 0.15, 0.15)
    assert teachings[0] == teachings[2] == teachings[3] != teachings[1]
    assert learners[0] == learners[1] and len(set(learners[1:])) == 3  # alike at the beginning, then each its own
    assert weights[0] is weights[1] is None and weights[2].tolist() == list(range(50))
    assert sorted(weights[3]) == list(range(50)) and weights[3].tolist() != list(range(50))


def test_means_over_the_training():
    space = load(7, "moving_mean", "curve")
    assert space.moving_mean(np.array([1.0, 3.0, 5.0]), 2).tolist() == [2, 4]
    assert space.curve(np.array([[1.0, 3.0, 5.0, 7.0]]), 2).tolist() == [[2, 6]]
