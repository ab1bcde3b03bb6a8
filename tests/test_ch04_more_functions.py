"""Chapter 4: the functions that decide C4.9 to C4.15 (classification, costs, theory), on numbers made by hand."""

from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
from notebook_functions import Recorder, judge, load, runs
from notebook_functions import same as same_in_each

from lifelong_lib.reproduction.statistics import interquartile_mean

same = partial(same_in_each, trials=24)  # fewer decide nothing where the centre is the interquartile mean
SYSTEMS = ["spring-mass-damper", "cart-pole", "bicycle", "quadrotor"]


# ----------------------------------------------------------------------------------------- C4.9, C4.10: classification

def test_shuffled_classifiers_get_a_neighbours_description():
    domain = SimpleNamespace(descriptors=np.array([[0.0], [1], [2], [3]]))
    space = load(4, "learn_classifiers", ELLA=Recorder, TaDeLL=Recorder)
    alone = [(np.array([10.0 * t]), np.eye(1)) for t in range(4)]
    config = {"k": 2, "sparsity": 0.1, "ridge": 0.1, "weight": 7.0, "tasks": 3}
    methods = space.learn_classifiers(config, domain, alone)
    described = {name: [told[-1] for told in methods[name].told] for name in ("TaDeLL", "shuffled")}
    assert described == {"TaDeLL": [[0], [1], [2]], "shuffled": [[2], [0], [1]]}  # 3 is a new task
    assert [told[:2] for told in methods["ELLA"].told] == [(0, [0]), (1, [10]), (2, [20])]


def test_accuracies_are_of_old_tasks_as_learned_and_of_new_ones_as_predicted():
    """Old tasks have the label True at x = 1, new ones False: a model of 1 is right on old ones, -1 on new ones."""
    class Domain:
        descriptors = np.zeros((4, 1))

        def draw_samples(self, task, count, rng):
            return np.ones((count, 1)), np.full(count, task < 2)

    right, wrong = (SimpleNamespace(policy=lambda t, model=model: np.array([model]),
                                    predict=lambda m, model=model: np.array([-model])) for model in (1.0, -1.0))
    space = load(4, "synthetic_trial", domain_one=lambda count, rng: Domain(), domain_two=None, shared_subspace=None,
                 fit_classifier=lambda X, y, C: (np.array([1.0]), None),
                 learn_classifiers=lambda *given: {"ELLA": right, "TaDeLL": right, "shuffled": wrong})
    found = space.synthetic_trial({"domain": 1, "tasks": 2, "samples": 3, "C": 1.0}, np.random.SeedSequence(0))
    assert found == {"STL": 1, "new STL": 0, "ELLA": 1, "TaDeLL": 1, "new TaDeLL": 1, "shuffled": 0, "new shuffled": 0}


PRINTED = {1: {"TaDeLL": 0.926, "new TaDeLL": 0.93, "STL": 0.755, "new STL": 0.762, "ELLA": 0.814},
           2: {"TaDeLL": 0.889, "new TaDeLL": 0.87, "STL": 0.752, "new STL": 0.751, "ELLA": 0.821}}


def accuracies(**change):
    """As printed, but for changes such as ELLA=0.7 (in both domains); shuffled is below everything."""
    values = {domain: numbers | {"shuffled": 0.5, "new shuffled": 0.5} | change for domain, numbers in PRINTED.items()}
    return runs(*(({"domain": domain, "samples": 10}, {key: same(value) for key, value in values[domain].items()})
                  for domain in values))


@pytest.mark.parametrize("change, verdict", [
    ({}, "holds"), ({"ELLA": 0.74}, "contradicted"), ({"ELLA": 0.95}, "contradicted"),
    ({"new TaDeLL": 0.97}, "holds"), ({"new TaDeLL": 0.83}, "contradicted"),  # better is not against it
    ({"new STL": 0.7}, "contradicted"), ({"STL": 0.8}, "contradicted"),  # it says whether the domain is the thesis's
    ({"ELLA": 0.765}, "contradicted"),  # a hundredth is no improvement
    ({"shuffled": 0.9, "new shuffled": 0.9}, "undecided")])
def test_c4_9_asks_for_the_order_and_for_the_printed_numbers(tmp_path, change, verdict):
    space = load(4, "c49_parts", accuracies=accuracies(**change),
                 synthetic=lambda domain, samples: {"domain": domain, "samples": samples})
    claim = judge(4, "C4.9", space, tmp_path)
    if not change:
        assert claim.measured["domain 1: TaDeLL minus ELLA"] == pytest.approx(0.112)
        assert claim.measured["domain 2: ELLA minus STL"] == pytest.approx(0.069)
        assert claim.control["domain 2: TaDeLL minus ELLA"] == pytest.approx(-0.321)
    assert claim.verdict == verdict


def sizes_of_gains(lifelong, zero, shuffled=(-0.1, -0.1, 0, -0.4, -0.4)):
    """Gains over an STL of 0.5 with 3, 5, 8, 20 and 100 samples."""
    def values(i):
        numbers = {"STL": 0.5, "new STL": 0.5, "TaDeLL": 0.5 + lifelong[i], "new TaDeLL": 0.5 + zero[i],
                   "shuffled": 0.5 + shuffled[i], "new shuffled": 0.5 + shuffled[i]}
        return {key: same(value) for key, value in numbers.items()}
    sizes = [3, 5, 8, 20, 100]
    found = runs(*(({"domain": 2, "samples": samples}, values(i)) for i, samples in enumerate(sizes)))
    return load(4, "by_samples", "gains", accuracies=found, sizes=sizes,
                synthetic=lambda domain, samples: {"domain": domain, "samples": samples})


FALLING_GAINS = (0.2, 0.3, 0.9, 0.1, 0.05)


@pytest.mark.parametrize("lifelong, zero, shuffled, verdict", [
    (FALLING_GAINS, FALLING_GAINS, (-0.1,) * 5, "holds"),
    ((0.2, 0.3, 0.1, 0.28, 0.05), FALLING_GAINS, (-0.1,) * 5, "contradicted"),  # more with 20 samples, not with 100
    ((0.2, 0.3, 0.1, 0.05, 0.28), FALLING_GAINS, (-0.1,) * 5, "contradicted"),
    (FALLING_GAINS, (-0.1, -0.2, 0, -0.5, -0.6), (-0.1,) * 5, "contradicted"),  # a loss with few
    (FALLING_GAINS, FALLING_GAINS, (-0.1, -0.1, 0, -0.4, -0.4), "holds"),  # a loss that grows is no control
    (FALLING_GAINS, FALLING_GAINS, (0.2, 0.2, 0.2, 0.2, 0.2), "undecided")])
def test_c4_10_compares_gains_left_and_right_of_the_number_of_features(tmp_path, lifelong, zero, shuffled, verdict):
    claim = judge(4, "C4.10", sizes_of_gains(lifelong, zero, shuffled), tmp_path)
    few, largest = (np.mean(gain[:2]) for gain in (lifelong, zero)), (max(gain[3:]) for gain in (lifelong, zero))
    expected = [number for each, most in zip(few, largest, strict=True) for number in (each, each - most)]
    assert list(claim.measured.values()) == pytest.approx(expected)
    assert claim.verdict == verdict


# ------------------------------------------------------------------------------------------ C4.11: which features tell

def test_subsets_and_their_control_choose_columns_and_tasks():
    class Tasks:
        def __init__(self, descriptors):
            self.descriptors = np.array(descriptors, float)

        def __len__(self):
            return len(self.descriptors)

    made = []

    class Method(Recorder):
        def __init__(self, *settings):
            super().__init__()
            self.columns = settings[0]
            made.append(self)

    met = None, Tasks([[1, 2, 3, 1], [4, 5, 6, 1]]), Tasks([[7, 8, 9, 1]]), None, [(0, [0.0], [[1.0]])]
    space = load(4, "subset_trial", "learn_online", "SUBSETS", meet_tasks=lambda config, seed: met, TaDeLL=Method,
                 mean_reward=lambda *given: 0.0)
    found = space.subset_trial({"k": 4, "sparsity": 0, "ridge": 0, "weight": 1}, np.random.SeedSequence(0))
    assert list(found) == [kind + name for kind in ("", "shuffled ") for name in space.SUBSETS]
    described = {name: method.told[0][-1] for name, method in zip(found, made, strict=True)}
    assert described["MK"] == [1, 3, 1] and described["shuffled MK"] == [4, 6, 1] and described["D"] == [2, 1]
    assert [method.columns for method in made[:7]] == [2, 2, 2, 3, 3, 3, 4]  # no more than features, with the constant
    assert all(method.asked == [[[7, 8, 9][i] for i in chosen] + [1]]
               for method, chosen in zip(made, [*space.SUBSETS.values()] * 2, strict=True))


def subset_space(jump, shuffled=None):
    names = ("subset_parts", "order_of_sizes", "features_used", "SUBSETS")
    space = load(4, *names, systems=SYSTEMS, interquartile_mean=interquartile_mean, pg_gain=lambda *which: 10.0)
    space.jump = {"": np.array(jump, float), "shuffled ": np.array(jump if shuffled is None else shuffled, float)}
    return space


#        M   D   K  MD  MK  DK  MDK
RISING = [[-9, -8, -7, -6, -5, -4, -1]] * 24
FALLING = [[-1, -2, -3, -4, -5, -6, -9]] * 24


def test_subset_parts_by_hand():
    rewards = np.array([[-9, -9, -9, -5, -5, -5, -1], [-9, -9, -9, -3, -9, -9, -6]], float)
    uneven = np.array([[-9, -6, -3, -5, -5, -2, 0], [-9, -9, -9, -3, -4, -8, 0]], float)
    parts = subset_space(uneven).subset_parts(uneven)
    assert parts["pairs minus single features"] == pytest.approx([0.2, 0.4])  # -4 less -6 and -5 less -9, of 10
    assert parts["full set minus the best other subset"].tolist() == [0.5, 0.3]  # MD: -4 on average, not DK with its -2

    parts = subset_space(rewards).subset_parts(rewards)
    # Ranks of sizes: 2 2 2 5 5 5 7. Those of the first trial's rewards are the same, of the second's 3 3 3 7 3 3 6.
    # Less their means of 4: -2 -2 -2 1 1 1 3 and -1 -1 -1 3 -1 -1 2; products add to 13, squares to 24 and 18.
    assert parts["rank correlation of subset size and jump-start"] == pytest.approx([1, 13 / np.sqrt(24 * 18)])
    assert parts["full set minus the best other subset"] == pytest.approx([0.4, -0.3])  # MD in both, -4 on average


def test_a_trial_in_which_all_subsets_are_alike_shows_no_order(tmp_path):
    space = subset_space(np.ones((24, 7)))
    assert space.subset_parts(np.ones((2, 7)))["rank correlation of subset size and jump-start"].tolist() == [0, 0]
    assert judge(4, "C4.11", space, tmp_path).verdict == "contradicted"  # pairs are no better


@pytest.mark.parametrize("jump, shuffled, verdict", [
    (RISING, FALLING, "holds"), (FALLING, FALLING, "contradicted"), (RISING, RISING, "undecided"),
    ([[-9, -8, -7, -6, -5, -1, -4]] * 24, FALLING, "contradicted"),  # two features are better than three
    ([[-9, -8, -7, -6, -5, -1, -1.1]] * 24, FALLING, "holds"),  # by a hundredth of PG's gain they may
    ([[-5, -4, -3, -9, -8, -7, -1]] * 24, FALLING, "contradicted")])  # pairs behind single features
def test_c4_11_asks_for_the_order_the_pairs_and_the_full_set(tmp_path, jump, shuffled, verdict):
    assert judge(4, "C4.11", subset_space(jump, shuffled), tmp_path).verdict == verdict


# -------------------------------------------------------------------------------------------------------- C4.12: costs

def costs(power_tadell=1, power_rival=2, factor=100.0, counts=(20, 40, 60)):
    entries = [({"system": name, "tasks": count},
                {"seconds TaDeLL": same(count**power_tadell / 40**power_tadell),
                 "seconds Sinapov et al.": same((1 + i) * factor * count**power_rival / 40**power_rival)})
               for i, name in enumerate(SYSTEMS) for count in counts]  # fmt: skip
    space = load(4, "seconds", "exponents", costs=runs(*entries), counts=list(counts), systems=SYSTEMS, tasks=40)
    methods = ("TaDeLL", "Sinapov et al.")
    space.per_task = {m: np.stack([space.seconds(m, name) for name in SYSTEMS], axis=1) / 40 for m in methods}
    return space


def test_exponents_are_means_over_systems_for_each_trial():
    def entry(i, name, count):
        return {"system": name, "tasks": count}, {"seconds TaDeLL": [float(count) ** power for power in (i, 2 * i)]}
    found = runs(*(entry(i, name, count) for i, name in enumerate(SYSTEMS) for count in (10, 20)))
    space = load(4, "seconds", "exponents", costs=found, counts=[10, 20], systems=SYSTEMS, tasks=20)
    assert space.exponents("TaDeLL") == pytest.approx([1.5, 3])  # of 0 1 2 3 and of 0 2 4 6


@pytest.mark.parametrize("change, verdict", [
    ({}, "holds"), ({"factor": 20.0}, "contradicted"), ({"power_rival": 1}, "contradicted"),
    ({"power_tadell": 2}, "contradicted")])
def test_c4_12_is_the_smallest_ratio_and_the_growth(tmp_path, change, verdict):
    claim = judge(4, "C4.12", costs(**change), tmp_path)
    powers = change.get("power_rival", 2), change.get("power_tadell", 1)
    # At 40 tasks the rival takes 100, 200, 300 and 400 s on the four systems, TaDeLL one.
    assert list(claim.measured.values()) == pytest.approx([change.get("factor", 100.0), *powers])
    assert claim.verdict == verdict


# ------------------------------------------------------------------------------------ C4.13: more tasks, C4.14: theory

class Tasks:
    """Tasks by number, described by it."""

    def __init__(self, numbers):
        self.numbers, self.descriptors = np.asarray(numbers), np.asarray(numbers, float)[:, None]

    def __len__(self):
        return len(self.numbers)

    def __getitem__(self, chosen):
        return Tasks(self.numbers[chosen])


def test_fewer_tasks_are_the_first_ones_and_the_control_meets_them_as_often():
    seen, met_again = [], []

    def zero_shot_rewards(config, learner, old, new, estimates, seed):
        seen.append((old.numbers.tolist(), [task for task, _ in estimates]))
        return {"TaDeLL": len(seen), "TaDeMTL": -len(seen)}

    def sessions(tasks, starts, order, rngs):
        met_again.append((tasks.numbers.tolist(), starts.tolist(), len(rngs)))
        return [(task, 0) for task in order]

    estimates = [(4, 0), (0, 0), (1, 0), (0, 0), (3, 0), (2, 0), (5, 0)]
    met = SimpleNamespace(sessions=sessions), Tasks(range(6)), Tasks(range(2)), np.arange(6) + 10, estimates
    space = load(4, "numbers_trial", meet_tasks=lambda config, seed: met, zero_shot_rewards=zero_shot_rewards)
    found = space.numbers_trial({"fewest": 2, "tasks": 6}, np.random.SeedSequence(0))
    assert seen[0] == ([0, 1], [0, 1, 0]) and seen[2] == ([0, 1, 2, 3], [0, 1, 0, 3, 2])
    assert seen[4][1] == [4, 0, 1, 0, 3, 2, 5] and found["TaDeLL"].tolist() == [1, 2, 3, 4, 5]
    assert met_again == [([0, 1], [10, 11], 2)]  # from their untrained policies
    assert seen[5] == ([0, 1], [0, 0, 1, 0, 1, 0, 1]) and found["TaDeMTL again"] == -6  # seven meetings too


def test_both_methods_learn_from_the_latest_results_and_one_from_its_start():
    made = []

    class Method(Recorder):
        def __init__(self, *args, **settings):
            super().__init__(*args, **settings)
            made.append(self)

    estimates = [(1, np.array([10.0]), np.eye(1)), (0, np.array([20.0]), np.eye(1)), (1, np.array([30.0]), np.eye(1))]
    space = load(4, "zero_shot_rewards", "learn_online", TaDeLL=Method, MultiTask=Method,
                 mean_reward=lambda learner, tasks, policies, rngs: len(policies))
    config = {"k": 4, "sparsity": 0, "ridge": 1, "weight": 7, "start": "random"}
    found = space.zero_shot_rewards(config, None, Tasks([5, 6]), Tasks([7, 8, 9]), estimates, np.random.SeedSequence(1))
    batch, online = made
    assert batch.told == [[[20], [30]], [[[1]], [[1]]], [[5], [6]]]
    assert [(task, where) for task, _, _, where in online.told] == [(1, [6]), (0, [5]), (1, [6])]
    assert online.settings["start"] == "random" and online.settings["random_state"] > 0
    assert batch.asked == online.asked == [[7], [8], [9]] and found == {"TaDeMTL": 3, "TaDeLL": 3}


def numbers(again=-9.0, **curves):
    """Curves of three trials (with two numbers of tasks), eight times; PG gains 10."""
    values = {"TaDeLL": [(-9, -4), (-9, -2), (-9, 0)], "TaDeMTL": [(-9, -3), (-9, -2), (-9, -1)]} | curves
    curves = {name: [np.array(curve, float) for curve in found * 8] for name, found in values.items()}
    curves |= {f"{name} again": [again] * len(found) for name, found in curves.items()}
    found = runs(*(({"start": begin}, curves) for begin in ("random", "tasks")))
    names = ("by_number", "growth", "growth_of_control", "spread", "STARTS")
    return load(4, *names, numbers=found, systems=SYSTEMS, pg_gain=lambda *which: 10.0,
                interquartile_mean=interquartile_mean)


def test_growth_and_spread_by_hand():
    space = numbers(again=-8.0)
    assert space.growth("TaDeLL", "random")[:3].tolist() == pytest.approx([0.5, 0.7, 0.9])
    assert space.growth_of_control("TaDeLL", "tasks")[:3].tolist() == pytest.approx([0.1] * 3)
    spread = space.spread("TaDeLL", "tasks")[:3]  # distances 0 and 2, 0 and 0, 0 and 2 from the centre, of 10
    assert spread == pytest.approx([0.1, 0, 0.1])


STEADY, UNSTEADY = [(-9, -2)] * 3, [(-9, -5), (-9, -4), (-9, 1)]


@pytest.mark.parametrize("change, verdict", [
    ({"TaDeMTL": STEADY, "TaDeLL": UNSTEADY}, "holds"),
    ({"TaDeMTL": [(-9, -8), (-9, 2), (-9, 6)], "TaDeLL": STEADY}, "contradicted"),  # the batch spreads more
    ({"TaDeMTL": STEADY, "TaDeLL": STEADY}, "holds"),  # an order may be missed
    ({"TaDeLL": [(-2, -9)] * 3}, "contradicted"),
    ({"TaDeMTL": STEADY, "TaDeLL": UNSTEADY, "again": -3.0}, "undecided")])  # few tasks met as often do as well
def test_c4_13_asks_for_growth_and_steadiness(tmp_path, change, verdict):
    claim = judge(4, "C4.13", numbers(**change), tmp_path)
    assert claim.verdict == verdict
    if "again" in change:
        assert claim.control_verdict == "holds"
        label = "TaDeLL from random columns: most tasks minus fewest, met as often"
        assert claim.measured[label] == pytest.approx((interquartile_mean([-5, -4, 1] * 8) + 3) / 10)


def test_a_life_notes_steps_and_an_objective_over_what_it_remembers():
    """A stand-in whose dictionary is the policy of the task met; the code of task 2 is 3, all others are 1."""
    class Method:
        def __init__(self, *settings):
            assert settings == (1, 0.5, 0.1, 7)
            self.codes_, self.names = {}, []

        def partial_fit(self, name, alpha, gamma, description):
            self.names.append(name)
            self.basis_, self.codes_[name] = alpha[:, None].copy(), np.full(1, 3.0 if alpha == 4 else 1.0)

    estimates = [(t, np.array([float(t**2)]), np.eye(1)) for t in range(4)]
    space = load(4, "live", TaDeLL=Method)
    config = {"k": 1, "sparsity": 0.5, "ridge": 0.1, "weight": 7}
    method, steps, objectives = space.live(config, estimates, np.zeros((4, 1)), memory=2)
    assert method.names == [0, 1, 0, 1]  # a name met before is exchanged
    assert steps.tolist() == [0, 1, 3, 5]  # of L = 0, 1, 4, 9
    # The last two tasks, with their codes in the latest L: mean fit, 0.5 times the mean code, 0.1 L^2.
    # L = 1: (1 + 0) / 2; L = 4: (1 - 4)^2 and (4 - 12)^2, codes 1 and 3; L = 9: (4 - 27)^2 and (9 - 9)^2.
    assert objectives == pytest.approx([0.5, 0.5 + 0.5 + 0.1, 36.5 + 1 + 1.6, 264.5 + 1 + 8.1])
    all_four = space.live(config, estimates, np.zeros((4, 1)), memory=4)[2][-1]
    assert all_four == pytest.approx((81 + 64 + 529) / 4 + 0.75 + 8.1)


def theory(slope=-1.0, change=0.01, coherence=-0.2, late=1.0, growth=1.0, alike=0.0):
    """A life that settles and one that does not (`window`); `alike` is the coherence where all descriptions are."""
    lives = {"slope": same(slope), "change": same(change), "coherence": same(coherence), "alike coherence": same(alike),
             "window slope": same(0.0), "window change": same(0.5)}
    grown = {"T": [{"T": T} for T in (10, 1000)], "k": [{"k": k} for k in (4, 8, 16)],
             "d": [{"d": d} for d in (8, 16, 32)]}
    times = {"T": (1.0, late), "k": np.array([4.0, 8, 16]) ** growth, "d": np.array([8.0, 16, 32]) ** growth}
    updates = runs(*((config, {"seconds": same(seconds)}) for key in grown
                     for config, seconds in zip(grown[key], times[key], strict=True)))  # fmt: skip
    return load(4, "settling_parts", "update_growth", "LABELS", theory=runs(({}, lives)), updates=updates, grown=grown)


def test_c4_14_reads_slopes_and_shares(tmp_path):
    claim = judge(4, "C4.14", theory(), tmp_path)
    assert list(claim.measured.values()) == pytest.approx([-0.2, -1, 0.01, 1, 1, 1], abs=1e-6)
    assert list(claim.control.values()) == [0, 0, 0.5]
    assert (claim.verdict, claim.control_verdict) == ("holds", "contradicted")


@pytest.mark.parametrize("change", [{"slope": -0.5}, {"slope": -2.0}, {"change": 0.05}, {"coherence": -0.01},
                                    {"late": 1.3}, {"growth": 3.5}])
def test_every_part_of_c4_14_can_fail(tmp_path, change):
    assert judge(4, "C4.14", theory(**change), tmp_path).verdict == "contradicted"


def test_c4_14_a_constant_description_that_lowers_the_coherence_as_well_shows_nothing(tmp_path):
    assert judge(4, "C4.14", theory(alike=-0.2), tmp_path).verdict == "undecided"


def test_settling_reads_the_second_half_and_the_last_tenth():
    T, objectives = np.arange(1, 101), np.ones(100)
    objectives[[89, 90]] += 9, 0.01  # the last tenth begins at 90
    found = load(4, "settling").settling(np.where(T <= 50, 1.0, 1 / T), objectives)
    assert found == pytest.approx({"slope": -1, "change": 0.01})


def test_each_life_of_c4_14_is_told_and_remembers_something_else():
    asked = []

    def live(config, estimates, descriptors, memory):
        asked.append((descriptors.tolist(), memory))
        method = SimpleNamespace(basis_=np.full((1, 1), len(asked)), descriptor_basis_=np.full((1, 1), 10.0))
        return method, len(asked), None

    learner = SimpleNamespace(sessions=lambda *given: "estimates")

    class Old:
        descriptors = np.array([[5.0], [6.0]])

        def __len__(self):
            return 2

    space = load(4, "theory_trial", live=live, learner_for=lambda config: learner, SYSTEMS={"x": None},
                 draw_tasks=lambda *given: Old(), first_policies=lambda *given: None,
                 settling=lambda steps, objectives: {"slope": steps}, mutual_coherence=np.sum)
    found = space.theory_trial({"system": "x", "tasks": 2}, np.random.SeedSequence(0))
    assert asked == [([[5], [6]], 20), ([[1], [1]], 2), ([[5], [6]], 2)]
    assert (found["window slope"], found["slope"]) == (1, 3)
    assert found["coherence"] == found["alike coherence"] == 10  # of K less that of L


# ------------------------------------------------------------------------------------------------------ C4.15: Hessians

def test_the_numerical_hessian_of_a_quadratic_by_hand():
    """Returns R, one action and one state x: the loss is the mean of R (a - theta x)^2 / 2 sigma^2, bent by R x^2."""
    states = np.array([[[[1.0], [0]], [[2.0], [0]]]])  # (1 policy, 2 roll-outs, H + 1, 1)
    actions, rewards = np.array([[[[0.5]], [[1.0]]]]), np.array([[[-3.0], [-1.0]]])
    paths = SimpleNamespace(states=states, actions=actions, rewards=rewards)
    hessian = load(4, "numerical_hessian").numerical_hessian(paths, np.array([0.3]), noise=0.5)
    assert hessian == pytest.approx(np.array([[(3 * 1 + 1 * 4) / 2 / 0.25]]))  # minus the return is the weight


def test_different_parameters_of_the_numerical_hessian_mix():
    states = np.array([[[[1.0, 2.0], [0, 0]]]])
    paths = SimpleNamespace(states=states, actions=np.array([[[[0.0]]]]), rewards=np.array([[[-1.0]]]))
    hessian = load(4, "numerical_hessian").numerical_hessian(paths, np.zeros(2), noise=1.0)
    assert hessian == pytest.approx(np.array([[1, 2], [2, 4]]))


@pytest.mark.parametrize("ours, printed, verdict", [(0.01, 0.9, "holds"), (0.5, 0.9, "contradicted"),
                                                    (0.01, 0.02, "undecided")])
def test_c4_15_names_both_learners(tmp_path, ours, printed, verdict):
    at = {"bicycle": ours, "quadrotor": ours / 2}
    found = runs(*(({"system": name}, {"ours": same(at[name]), "printed": same(printed)}) for name in at))
    space = load(4, "differences", hessians=found, systems=SYSTEMS)
    claim = judge(4, "C4.15", space, tmp_path)
    assert claim.measured == {"REINFORCE: relative difference": pytest.approx(ours / 2),
                              "eNAC: relative difference": pytest.approx(ours)}
    assert claim.verdict == verdict
