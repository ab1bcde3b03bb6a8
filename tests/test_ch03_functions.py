"""Chapter 3: the functions that decide C3.1 to C3.9, on curves and robots made by hand."""

from types import SimpleNamespace

import numpy as np
import pytest
from notebook_functions import judge, load, runs

FLEETS = 3


def fleets_of(*curve):
    """The same curve (or number) for each fleet."""
    return np.array([curve] * FLEETS, float)


# ------------------------------------------------------------------------------------------ leads over learning alone

CURVES = {"PG": fleets_of(-1, 1, 2, 3), "PG-ELLA": fleets_of(0, 4, 4, 4), "mean start": fleets_of(0, 3, 5, 4),
          "random basis": fleets_of(0, 0, 0, 0), "other task": fleets_of(0, 2, 1, 1)}
STRANGERS = {"PG": fleets_of(0, 1, 1, 1), "PG-ELLA": fleets_of(0, 0.5, 0, 0)}


def measures(curves=CURVES, strangers=STRANGERS, **given):
    names = ("lead", "jump", "advantage", "final", "parts_of", "controls_of", "JUMP", "ADVANTAGE", "LATE")
    return load(3, *names, early=1, turtlebots=curves, drones=curves,
                without_right_sources=lambda kind: strangers, **given)


def test_leads_are_taken_at_after_and_at_the_end_of_learning_in_units_of_pgs_gain():
    space = measures()
    assert space.jump(CURVES, "PG-ELLA").tolist() == [3 / 4] * FLEETS  # PG gains 4
    assert space.jump(CURVES, "PG-ELLA", "mean start").tolist() == [1 / 4] * FLEETS
    assert space.advantage(CURVES, "PG-ELLA").tolist() == [2 / 4] * FLEETS  # (3 + 2 + 1) / 3
    long = {"PG": np.linspace(0, 1, 30)[None], "PG-ELLA": np.linspace(0, 1, 30)[None] + np.arange(30.0)}
    assert space.final(long, "PG-ELLA") == pytest.approx([24.5])  # the mean of 20 to 29
    uneven = {"PG": np.array([[0, 1.0], [0, 3]]), "PG-ELLA": np.array([[0, 2.0], [0, 5]])}
    assert space.jump(uneven, "PG-ELLA").tolist() == [0.5, 1]  # over the mean gain of 2


def test_both_controls_are_handed_over():
    space = measures()
    # random basis: 0 - 1 = -1 of 4; others' start and dictionary: 0.5 - 1 = -0.5 of the 1 that those five gain
    basis, others = space.controls_of("turtlebot", CURVES, {"label": space.jump})
    assert basis["label"].tolist() == [-1 / 4] * FLEETS and others["label"].tolist() == [-0.5] * FLEETS


def test_c3_1_is_the_jump_after_the_first_iterations(tmp_path):
    claim = judge(3, "C3.1", measures(), tmp_path)
    label = "return at iteration 10: PG-ELLA minus PG"
    assert claim.measured == {label: 3 / 4, "return at iteration 10: PG-ELLA minus mean start": 1 / 4,
                              "return at iteration 10: right start, other task's dictionary, minus PG": 1 / 4}
    assert claim.control == {label: -1 / 4}
    assert (claim.verdict, claim.control_verdict) == ("holds", "contradicted")


@pytest.mark.parametrize("method, curve, verdict", [
    ("PG-ELLA", (0, 0, 9, 9), "contradicted"),  # ahead later, but not at once
    ("PG-ELLA", (0, 1.04, 9, 9), "contradicted"),  # a hundredth of what PG gains
    ("random basis", (0, 4, 0, 0), "undecided"),  # a column that knows nothing jumps as well
    ("mean start", (0, 9, 9, 9), "holds"),  # reported only
])
def test_c3_1_can_fail(tmp_path, method, curve, verdict):
    assert judge(3, "C3.1", measures(CURVES | {method: fleets_of(*curve)}), tmp_path).verdict == verdict


def test_either_control_takes_the_verdict_away(tmp_path):
    leads = STRANGERS | {"PG-ELLA": fleets_of(0, 3, 3, 3)}
    claim = judge(3, "C3.1", measures(strangers=leads), tmp_path)
    assert (claim.verdict, claim.control_verdict) == ("undecided", "holds")
    # A mean of 4 that differs from fleet to fleet is not nearer to holding than a sure 1.
    wild = CURVES | {"random basis": np.array([[0, 11.0, 0, 0], [0, -7, 0, 0], [0, 11, 0, 0]])}
    claim = judge(3, "C3.1", measures(wild, leads), tmp_path)
    assert claim.control == {"return at iteration 10: PG-ELLA minus PG": 2}


def long_curves(ahead_until):
    """PG-ELLA leads by 1 up to an iteration, and is 1 behind from there on; early = 1, 40 iterations; PG gains 4."""
    lead = np.where(np.arange(41) < ahead_until, 1.0, -1.0)
    level = {name: fleets_of(*np.linspace(0, 4, 41)) for name in CURVES}
    return level | {"PG-ELLA": level["PG"] + lead, "random basis": level["PG"] - 1}


@pytest.mark.parametrize("ahead_until, verdict", [
    (41, "holds"),
    (31, "contradicted"),  # ahead on the whole: (30 - 10) / 40; but not in the last ten
    (15, "contradicted"),
])
def test_c3_2_asks_for_the_mean_and_for_the_end(tmp_path, ahead_until, verdict):
    behind = {"PG": fleets_of(*np.linspace(0, 4, 41)), "PG-ELLA": fleets_of(*np.linspace(0, 4, 41) - 1)}
    claim = judge(3, "C3.2", measures(long_curves(ahead_until), behind), tmp_path)
    mean = (2 * (ahead_until - 1) - 40) / 40 / 4
    assert claim.measured["mean return over iterations 10 to 100: PG-ELLA minus PG"] == pytest.approx(mean)
    assert list(claim.control) == ["mean return over iterations 10 to 100: PG-ELLA minus PG",
                                   "mean return over the last ten iterations: PG-ELLA minus PG"]
    assert claim.verdict == verdict


def test_c3_3_asks_drones_for_jump_and_lead(tmp_path):
    assert judge(3, "C3.3", measures(), tmp_path).verdict == "holds"
    late = CURVES | {"PG-ELLA": fleets_of(0, 2, 0, 0)}  # jump 1, lead (1 - 2 - 3) / 3
    claim = judge(3, "C3.3", measures(late), tmp_path)
    assert claim.measured["return at iteration 10: PG-ELLA minus PG"] == 1 / 4
    assert claim.measured["mean return over iterations 10 to 100: PG-ELLA minus PG"] == pytest.approx(-4 / 3 / 4)
    assert claim.measured[measures().LATE] == pytest.approx((1 + 1 - 2 - 3) / 4 / 4)  # four points in all
    assert list(claim.control.values()) == [-1 / 4, pytest.approx(-2 / 4)]  # the random column: (-1 - 2 - 3) / 3 of 4
    assert claim.verdict == "contradicted"


@pytest.mark.parametrize("lead, verdict", [(0.1, "holds"), (-0.1, "holds"), (0.3, "contradicted"),
                                           (-0.3, "contradicted")])
def test_c3_9_is_a_share_of_what_pg_gains(tmp_path, lead, verdict):
    measured = fleets_of(0, 4 + lead, 9, 9)  # what comes later has no vote
    claim = judge(3, "C3.9", measures(CURVES | {"measured curvature": measured}), tmp_path)
    assert claim.measured["return at iteration 10: measured curvature minus identity"] == pytest.approx(lead / 4)
    assert claim.measured["mean return: mean start minus identity"] == pytest.approx((-1 + 1 + 0) / 3 / 4)
    assert claim.verdict == verdict and claim.control_verdict == "contradicted"


def test_c3_9_needs_a_control_that_differs(tmp_path):
    alike = CURVES | {"measured curvature": fleets_of(0, 4, 4, 4), "mean start": fleets_of(0, 4.1, 4, 4)}
    assert judge(3, "C3.9", measures(alike), tmp_path).verdict == "undecided"


# --------------------------------------------------------------------------------------------------- iterations saved

def savings(**given):
    return load(3, "records", "reached", "saved", "missed", early=1, iterations=5, **given)


def test_records_begin_at_twice_the_first_iterations():
    space = savings()
    assert space.records(np.array([0, 5, 4, 6, 6, 7])) == [3, 5]  # 5 at iteration 1 comes too early, a tie is no record
    assert space.records(np.array([0, 1, 2, 3, 4, 5])) == [2, 3, 4, 5]
    assert space.records(np.array([9, 1, 2, 3, 4, 5])) == []


@pytest.mark.parametrize("method, saved, missed", [
    ((0, 6, 6, 6, 7, 7), 1.5, 0),  # 6 at iteration 1 for 3, 7 at 4 for 5: (2 + 1) / 2
    ((7, 0, 0, 6, 6, 7), 0, 0),  # what came before the first iterations were over does not count
    ((0, 6, 6, 6, 6, 6), 1, 0.5),  # 7 never: as if at the very end, (2 + 0) / 2
    ((0, 0, 0, 0, 0, 0), -1, 1),  # (3 - 5 + 5 - 5) / 2
])
def test_iterations_saved_at_pgs_records(method, saved, missed):
    curves = {"PG": np.array([[0, 5, 4, 6, 6, 7.0]]), "PG-ELLA": np.array([method], float)}
    space = savings()
    assert space.saved(curves, "PG-ELLA") == [saved]
    assert space.missed(curves, "PG-ELLA") == [missed]


def test_without_records_pgs_best_return_counts_at_its_own_iteration():
    curves = {"PG": np.array([[0, 9, 1, 2, 3, 4.0]]), "PG-ELLA": np.array([[0, 4, 4, 4, 4, 4.0]])}
    space = savings()
    assert space.saved(curves, "PG-ELLA") == [-4] and space.missed(curves, "PG-ELLA") == [1]  # 9 at 1, and never
    curves["PG-ELLA"][0, 3] = 9
    assert space.saved(curves, "PG-ELLA") == [-2] and space.missed(curves, "PG-ELLA") == [0]


def test_each_fleet_has_records_of_its_own():
    curves = {"PG": np.array([[0, 0, 1, 1, 1, 1.0], [0, 0, 0, 0, 0, 1.0]]), "PG-ELLA": np.ones((2, 6))}
    assert savings().saved(curves, "PG-ELLA").tolist() == [1, 4]  # records at 2 and at 5, reached at 1


@pytest.mark.parametrize("there, verdict", [(11, "holds"), (25, "contradicted")])
def test_c3_4_counts_iterations_and_rollouts(tmp_path, there, verdict):
    """PG rises at iteration 30 only; a method that is as good from iteration `there` saves 30 - there."""
    def steps(*places):
        return np.array([np.arange(41) >= place for place in places], float)
    curves = {"PG": steps(30, 30, 30), "PG-ELLA": steps(there, there, there), "mean start": steps(12, 12, 12),
              "other task": steps(30, 30, 30), "random basis": steps(41, 41, 41)}
    strangers = {"PG": steps(30, 30, 30), "PG-ELLA": steps(32, 32, 32)}
    space = load(3, "records", "reached", "saved", "missed", "controls_of", "NAMES", early=10, iterations=40,
                 turtlebots=curves, drones=curves, turtlebot_rollouts=21, drone_rollouts=15,
                 without_right_sources=lambda kind: strangers)
    claim = judge(3, "C3.4", space, tmp_path)
    assert claim.measured["Turtlebots: iterations saved"] == 30 - there
    assert claim.measured["AR.Drones: roll-outs saved"] == 15 * (30 - there)
    assert claim.measured["Turtlebots: iterations saved by the mean start alone"] == 18
    assert claim.measured["Turtlebots: share of levels never reached"] == 0
    assert claim.control == {"Turtlebots: iterations saved": -2, "AR.Drones: iterations saved": -2}  # not -10
    assert claim.verdict == verdict


# --------------------------------------------------------------------------------------------------- good controllers

def watched(iterations, early, tried):
    """A run of a robot whose policy after i iterations is 10 i, and which policies it tries in which order."""
    asked = []

    class Robot:
        POLICY_SIZE = 1

        def roll_out(self, policies, rng, noise):
            asked.append(policies.ravel().tolist())
            return policies

        def succeeded(self, policies):
            return tried[: len(policies)]

    def learn(returns, start, count, rng):
        return start + 10.0 * np.arange(count + 1)[:, None], np.arange(count + 1)

    space = load(3, "is_good", "learn_alone", "train_trial", "watched_trial", build=lambda config: Robot(),
                 returns_of=lambda *given: None, learner_of=lambda config: SimpleNamespace(learn=learn))
    config = {"iterations": iterations, "early": early, "noise": 0.0, "measured": False}
    return space.watched_trial(config, np.random.SeedSequence(0)), asked


def test_good_means_more_than_half_of_five_trials():
    found, asked = watched(3, 2, np.array([1, 1, 0, 0, 0, 1, 1, 1, 0, 0], bool))
    assert asked == [[20.0] * 5 + [30.0] * 5] * 2  # after 2 and after all 3 iterations
    assert found["good"].tolist() == found["looks"].tolist() == [False, True]


def test_looks_are_taken_after_the_first_iterations_as_often_again_and_at_the_end():
    assert watched(100, 10, np.ones(50, bool))[1][1][::5] == [100.0 * i for i in range(1, 11)]
    assert watched(18, 5, np.ones(20, bool))[1][1][::5] == [50, 100, 150, 180]


def looked_at(*robots):
    """The same fleet (of looks of each robot) three times, for both kinds of robot."""
    fleets = {kind: [[{"kind": kind, "fleet": number, "i": i} for i in range(len(robots))] for number in range(FLEETS)]
              for kind in ("turtlebot", "drone")}  # fmt: skip
    everyone = [robot for kind in fleets.values() for fleet in kind for robot in fleet]
    alone = runs(*((robot, {"looks": [np.array(robots[robot["i"]], bool)]}) for robot in everyone))
    return load(3, "NAMES", new_ones=fleets, alone=alone, early=10, iterations=30)


@pytest.mark.parametrize("robots, early, last, first, second", [
    (([0, 0, 1], [0, 0, 1], [0, 1, 0]), 0, 2 / 3, "holds", "holds"),
    (([1, 1, 1], [0, 0, 1], [0, 0, 0]), 1 / 3, 2 / 3, "contradicted", "holds"),
    (([1, 0, 1], [0, 0, 1], [0, 0, 0]), 1 / 3, 2 / 3, "contradicted", "holds"),  # between them it may fail
    (([1, 1, 0], [0, 0, 1], [0, 0, 0]), 0, 1 / 3, "holds", "contradicted"),  # good by chance, not converged
    (([0, 1, 1],) * 3, 0, 1, "holds", "contradicted"),  # all find one
])
def test_c3_5_asks_who_converged_early_and_c3_6_who_is_good_at_the_end(tmp_path, robots, early, last, first, second):
    space = looked_at(*robots)
    claim = judge(3, "C3.5", space, tmp_path)
    assert list(claim.measured.values()) == pytest.approx([early] * 2) and claim.verdict == first
    claim = judge(3, "C3.6", space, tmp_path)
    assert claim.measured == {"AR.Drones: good after 100 iterations": pytest.approx(last)}
    assert claim.verdict == second


# ------------------------------------------------------------------------------------------- robots that have to look

# Means after the first iteration 1, 2, 3, 6; fifth 7. The four gain 12 - 8 = 1 each on average.
LONE = np.array([[[2, 1, 1], [2, 2, 2], [2, 3, 3], [2, 6, 6], [9, 7, 7]]] * FLEETS, float)


def looking(strange=(0, 0, 0), **fifth):
    curves = {"PG-ELLA": (0, 7, 9), "mean start": (0, 7, 7), "random basis": (0, 0, 2), "other task": (0, 4, 4)} | fifth
    fleets = {"camera": [[{"fleet": number}] for number in range(FLEETS)]}
    others = runs(*(({"fleet": number}, {"PG-ELLA": [np.array(strange, float)]}) for number in range(FLEETS)))
    return load(3, early=1, lone=LONE, fleets=fleets, camera_other=others,
                fifth={name: fleets_of(*curve) for name, curve in curves.items()})


def test_c3_7_leads_over_the_mean_and_the_best_of_four(tmp_path):
    claim = judge(3, "C3.7", looking(), tmp_path)
    assert list(claim.measured.values()) == [5, 2, 1, 1, 1]  # 8 less 3, the best 6, the fifth 7, mean start 7; 4 less 3
    assert list(claim.control.values()) == [-2, -5]  # random basis 1; the other control is farther from holding
    assert (claim.verdict, claim.control_verdict) == ("holds", "contradicted")


def test_c3_7_can_fail(tmp_path):
    claim = judge(3, "C3.7", looking(**{"PG-ELLA": (0, 5, 5)}), tmp_path)  # above the mean, not above the best
    assert (claim.verdict, claim.measured["PG-ELLA minus best PG robot"]) == ("contradicted", -1)
    claim = judge(3, "C3.7", looking(strange=(0, 8, 8)), tmp_path)  # whoever knows another task leads as well
    assert (claim.verdict, claim.control_verdict) == ("undecided", "holds")


def test_c3_8_counts_the_four_sources_only(tmp_path):
    rising, falling = [0, 9, 0, 20, -20, 4, 4, 4], [5, 5, 5, 0, 0, 0, 9, 0]  # means of three: 3 and 4, 5 and 3
    lone = np.array([[rising, rising, rising, rising, falling]] * FLEETS, float)
    robots = [{"robot": i} for i in range(5)]
    good = runs(*((robot, {"good": [np.array([True, robot["robot"] == 0])]}) for robot in robots))
    fleets = {"camera": [robots] * FLEETS}
    claim = judge(3, "C3.8", SimpleNamespace(lone=lone, fleets=fleets, camera_alone=good), tmp_path)
    assert claim.measured == {"share of sources that improve": 1, "share that reach the goal": 0.25}
    assert claim.verdict == "holds"
    lone[:, 0] = falling
    claim = judge(3, "C3.8", SimpleNamespace(lone=lone, fleets=fleets, camera_alone=good), tmp_path)
    assert (claim.measured["share of sources that improve"], claim.verdict) == (0.75, "contradicted")


# ----------------------------------------------------------------------------------------- experiments, with stand-ins

def test_a_curve_is_the_first_iterations_and_then_the_methods_own():
    class Robot:
        def roll_out(self, policies, rng, noise):
            return policies

        def succeeded(self, tried):
            return tried[:, 0] > 100

    def learn(returns, start, iterations, rng):
        policies = start + np.arange(iterations + 1.0)[:, None]
        return policies, policies[:, 0]

    def starting_policies(config, policies, returns, seed, others, gammas):
        assert policies.tolist() == [[1], [3], [4]]  # the sources, and the new robot: their mean 2, and two iterations
        return {"PG-ELLA": policies[-1] + 100, "mean start": policies[-1]}

    space = load(3, "transfer_trial", build=lambda config: Robot(), returns_of=lambda *given: None,
                 learner_of=lambda config: SimpleNamespace(learn=learn), starting_policies=starting_policies)
    config, sources = {"early": 2, "iterations": 4, "noise": 0.0}, np.array([[1.0], [3.0]])
    found = space.transfer_trial(config, np.random.SeedSequence(0), sources, None, None)
    assert found["mean start"].tolist() == [2, 3, 4, 5, 6]  # entry 2 = early is the start of what follows
    assert found["PG-ELLA"].tolist() == [2, 3, 104, 105, 106]
    assert found["start PG-ELLA"].tolist() == [104] and found["last PG-ELLA"].tolist() == [106]
    assert (found["good PG-ELLA"], found["good mean start"]) == (True, False)


def test_each_start_differs_in_one_thing_only():
    asked = []

    def reconstruct(config, policies, gammas, seed, **changes):
        asked.append((policies.tolist(), [gamma.tolist() for gamma in gammas], changes))
        return len(asked)

    space = load(3, "starting_policies", reconstruct=reconstruct, curvature=lambda *given: np.array([[5.0]]))
    others, gammas = np.array([[8.0], [9.0]]), np.array([[[2.0]], [[3.0]]])
    found = space.starting_policies({"perturbation": 0.1}, np.array([[1.0], [2.0], [7.0]]), None, 0, others, gammas)
    own, ones = [[1], [2], [7]], [[[1]]] * 3
    assert found["mean start"] == [7]
    assert asked[found["PG-ELLA"] - 1] == (own, ones, {})
    assert asked[found["random basis"] - 1] == (own, ones, {"n_components": 1, "learn_dictionary": False})
    assert asked[found["other task"] - 1] == ([[8], [9], [7]], ones, {})
    assert asked[found["measured curvature"] - 1] == (own, [[[2]], [[3]], [[5]]], {})


def test_pg_ella_meets_all_others_and_then_the_new_robot():
    met = []

    class Learner:
        def __init__(self, **settings):
            assert settings.keys() == {"n_components", "sparsity", "ridge", "random_state"}

        def partial_fit(self, task, policy, gamma):
            met.append((task, policy[0]))

        def policy(self, task):
            return f"policy {task}"

    space = load(3, "reconstruct", ELLA=Learner)
    policies = np.array([[10.0], [11.0], [12.0], [13.0]])
    assert space.reconstruct({"k": 4, "sparsity": 0, "ridge": 1}, policies, [1] * 4, 0) == "policy 3"
    assert {task for task, _ in met[:-1]} == {0, 1, 2} and met[-1] == (3, 13.0)
    assert all(number == 10 + task for task, number in met)


def test_the_new_robot_is_not_among_its_sources():
    fleet = [{"robot": i} for i in range(3)]
    right = runs(*((robot, {"policies": [np.array([[0.0], [1.0 + robot["robot"]]])]}) for robot in fleet))
    other = runs(*((robot, {"policies": [np.array([[0.0], [-1.0 - robot["robot"]]])]}) for robot in fleet))
    space = load(3, "new_robot", "learned", "nothing_right", other_task=other, shared={}, components=4,
                 kinds={"camera": {}}, sparsity=0.1)
    config, known = space.new_robot("camera", fleet, 1, right, 1.0)
    assert config["robot"] == 1
    assert known["sources"].tolist() == [[1], [3]] and known["others"].tolist() == [[-1], [-3]]  # last policies
    wrong = space.nothing_right(known)
    assert wrong["sources"].tolist() == [[-1], [-3]] and not len(wrong["others"])


def test_means_are_over_the_robots_of_a_fleet():
    fleets = [[{"robot": 0}, {"robot": 1}], [{"robot": 2}, {"robot": 3}]]
    found = runs(*(({"robot": i}, {"curve": [np.array([i, 10.0 * i])]}) for i in range(4)))
    assert load(3, "by_fleet").by_fleet(fleets, found, "curve").tolist() == [[0.5, 5], [2.5, 25]]


def test_the_other_task_is_to_turn_or_to_climb():
    class Drone:
        pass

    space = load(3, "rewards_of", ARDrone=Drone, Turtlebot=SimpleNamespace(STEP=0.2))
    poses = np.zeros((1, 4, 7))
    turns = np.array([3.0, 3.2, 3.4, 3.4])  # [rad]: twice 1 rad/s, through the seam at pi, then none
    poses[0, :, 5], poses[0, :, 6] = np.sin(turns / 2), np.cos(turns / 2)
    poses[0, :, 2] = [0, 2.6, 2.5, 3.6]
    out = SimpleNamespace(poses=poses, rewards="own")
    assert space.rewards_of(None, {"task": "own"}, out) == "own"
    assert space.rewards_of(None, {"task": "other"}, out) == pytest.approx(np.array([[0, 0, -10]]), abs=1e-9)
    assert space.rewards_of(Drone(), {"task": "other"}, out) == pytest.approx(np.array([[0, -1, -10]]))


@pytest.mark.parametrize("bend, expected", [((2, 1), (4 / 3, 2 / 3)), ((2, -1), (2 / 1.001, 0.002 / 1.001))])
def test_curvature_has_mean_diagonal_one_and_no_direction_in_which_returns_rise(bend, expected):
    """Returns -b0 x^2 - b1 y^2 fall by 2 b; where they rise, a thousandth of the largest fall stands."""
    gamma = load(3, "curvature").curvature(lambda theta: -(theta**2) @ bend, np.zeros(2), 0.1)
    assert gamma == pytest.approx(np.diag(expected))


def test_shares_are_of_the_whole_gain():
    found = load(3, "shares").shares(np.array([-100.0, -60, -40, -20]), [1, 2])
    assert found == pytest.approx([0.5, 0.75])  # 40 and 60 of 80
