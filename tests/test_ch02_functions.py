"""Chapter 2: the functions that decide its claims and table 2.1, on problems small enough to be solved by hand."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from notebook_functions import judge, load, runs, same

from lifelong_lib.environments.corridor import CELLS, STEPS, Corridors
from lifelong_lib.transfer.ella import ELLA


def test_the_objective_of_a_learner_falls_into_fit_codes_and_size():
    """L = I and Gamma = I: a code is its target, moved by mu / 2 = 0.1 towards zero."""
    learner = SimpleNamespace(basis_=np.eye(2), sparsity=0.2, ridge=0.5)
    solutions = [(np.array([3.0, 0.05]), np.eye(2)), (np.array([0.0, -1.1]), np.eye(2))]
    parts = load(2, "parts_of_objective").parts_of_objective(learner, solutions)
    # Codes (2.9, 0) and (0, -1). Fit: (0.1^2 + 0.05^2 + 0.1^2) / 2. Codes: 0.2 (2.9 + 1) / 2. Size: 0.5 (1 + 1).
    assert parts == pytest.approx((0.01125, 0.39, 1.0))


def test_all_learners_are_looked_at_after_five_ten_and_twenty_tasks_met_so_far():
    rng = np.random.default_rng(5)
    solutions = [(rng.standard_normal(3), np.eye(3)) for _ in range(21)]
    space = load(2, "live", "parts_of_objective")
    found = space.live({"k": 2, "mu": 0.01, "ridge": 1e-3, "rounds": 5}, solutions, np.random.default_rng(0))
    assert {name: parts.shape for name, parts in found.items()} == dict.fromkeys(
        ("ELLA", "random start", "random", "GO-MTL"), (3, 3))
    alone = ELLA(2, 0.01, 1e-3, random_state=0)
    for t, solution in enumerate(solutions[:10]):
        alone.partial_fit(t, *solution)
    assert found["ELLA"][1] == pytest.approx(space.parts_of_objective(alone, solutions[:10]))  # no task after the tenth
    total = {name: parts.sum(axis=1) for name, parts in found.items()}
    assert (total["random"] > total["ELLA"]).all()  # its dictionary does not learn
    assert np.ptp(found["random"][:, 2]) == 0 < np.ptp(found["ELLA"][:, 2])  # size of L


def lifetimes(ella, batch=1.0, random=9.0):
    """Results of three lifetimes at two moments; three equal parts make up each objective."""
    def parts(*objectives):
        return [np.full((2, 3), 1 / 3) * np.array(objectives)[:, None]] * 3
    values = {"ELLA": parts(50.0, ella), "GO-MTL": parts(10.0, batch), "random": parts(80.0, random)}
    return runs(({"ridge": 1e-7}, values), ({"ridge": 1e-3}, values | {"ELLA": parts(99.0, 99.0)}))


def test_ratio_is_of_sums_at_one_moment():
    ratio = load(2, "ratio").ratio(lifetimes(ella=2.5, batch=2.0), "ELLA", ridge=1e-7)
    assert ratio == pytest.approx(np.array([[5.0, 1.25]] * 3))  # 50 / 10 and 2.5 / 2


@pytest.mark.parametrize("ella, random, verdict, control", [
    (1.05, 9.0, "holds", "contradicted"),
    (1.2, 9.0, "contradicted", "contradicted"),
    (0.9, 9.0, "holds", "contradicted"),  # the batch learner is no oracle
    (1.05, 1.05, "undecided", "holds"),  # a dictionary that need not be learned shows nothing
])
def test_c2_1_is_the_excess_after_the_last_task_at_the_lightest_ridge(tmp_path, ella, random, verdict, control):
    space = load(2, "ratio", regressions=lifetimes(ella, random=random), ridges=[1e-7, 1e-3])
    claim = judge(2, "C2.1", space, tmp_path)
    (excess,), (left,) = claim.measured.values(), claim.control.values()
    assert (excess, left) == pytest.approx((ella - 1, random - 1))
    assert (claim.verdict, claim.control_verdict) == (verdict, control)


def test_noiseless_regressions_find_the_hidden_models():
    config = {"tasks": 3, "d": 4, "k": 2, "samples": 30, "noise": 0.0, "penalty": 1e-12}
    models, solutions = load(2, "draw_regressions").draw_regressions(config, np.random.default_rng(0))
    assert np.stack([alpha for alpha, _ in solutions]) == pytest.approx(models, abs=1e-6)


# ------------------------------------------------------------------------------------------------- an option and a game

def test_an_option_earns_discounted_rewards_on_its_way():
    after = np.array([[max(x - 1, 0), min(x + 1, 4)] for x in range(5)])
    space = load(2, "follow", after=after, rewards=(after == 4) * 1.0)
    assert space.follow({"does": 1, "ends": [4]}, 1) == pytest.approx((0.81, 0.729, 4))
    assert space.follow({"does": 0, "ends": [0]}, 2) == pytest.approx((0.0, 0.81, 0))


def test_beside_a_learner_no_policy_lasts_and_beside_a_still_player_one_does():
    space = load(2, "play", "about")
    still, moving = (space.about("", space.play(learns)) for learns in (0, 1))
    assert still["changes of sign"] == 0 and still["highest worth"] == pytest.approx(still["lowest worth"])
    assert still["heads at the end"] < 0.01  # the other shows tails more often
    assert moving["changes of sign"] > 5 and moving["lowest, second half"] < 0.3 < 0.7 < moving["highest, second half"]


# ---------------------------------------------------------------------------------------------------------------- HORDE

def test_the_true_answers_are_the_means_of_roll_outs_of_each_policy():
    """From cell 2 to the right, for five of the questions: discounted by stopping, which is the same in the mean."""
    space = load(2, "questions", "true_answers")
    policies, rewards, goes_on, ends = space.questions()
    answers, rng, n = space.true_answers(policies, rewards, goes_on, ends), np.random.default_rng(0), 20_000
    for d in (0, 5, 10, 15, 19):
        place, earned, on, total = np.full(n, 14), np.zeros(n), np.ones(n, bool), np.zeros(n)
        for _ in range(200):
            earned = rewards[d, place]
            stops = on & (rng.random(n) >= goes_on[d, place])
            total += on * earned + stops * ends[d, place]
            on &= ~stops
            choice = (rng.random(n)[:, None] >= policies[d][place].cumsum(axis=1)[:, :2]).sum(axis=1)
            place = np.where((place == 0) | (place == 22), place, place + choice - 1)
        assert total.mean() == pytest.approx(answers[d, 3 * 13 + 2], abs=5 * total.std() / np.sqrt(n) + 1e-9)


def test_a_stream_moves_by_its_actions_and_begins_anew_after_a_fall():
    stream = load(2, "stream_of").stream_of(3000, np.random.default_rng(1))
    cells, actions, reached = stream.T
    fell = (reached == 0) | (reached == 22)
    assert (reached == cells + actions - 1).all() and fell.any() and not ((cells == 0) | (cells == 22)).any()
    assert (cells[1:][~fell[:-1]] == reached[:-1][~fell[:-1]]).all()
    assert np.bincount(actions) == pytest.approx(1000, abs=150)


def test_errors_are_in_units_of_the_spread_of_the_truth_and_leave_pits_out():
    truth = np.zeros((1, 69))
    truth[:, 3:66:2], truth[:, :3] = 2.0, 99.0
    assert load(2, "errors").errors(truth + 0.5, truth) == pytest.approx(0.5 / truth[:, 3:66].std())
    assert load(2, "errors").errors(np.where(truth == 99, 0, truth), truth) == pytest.approx(0)


def answered(error=0.05, blind=0.6, difference=0.0, shared=0.3):
    return runs(({}, {"error": same(error, error), "error without ratios": same(blind, blind),
                      "difference": same(difference), "difference when shared": same(shared)}))  # fmt: skip


@pytest.mark.parametrize("given, verdict, control", [
    ({}, "holds", "contradicted"),
    ({"error": 0.2}, "contradicted", "contradicted"),
    ({"difference": 1e-3}, "contradicted", "contradicted"),  # something passes between demons
    ({"blind": 0.05, "shared": 0.0}, "undecided", "holds"),  # nothing would be shown
])
def test_c2_2_is_the_error_of_the_answers_and_nothing_shared(tmp_path, given, verdict, control):
    claim = judge(2, "C2.2", SimpleNamespace(demons=answered(**given)), tmp_path)
    assert (claim.verdict, claim.control_verdict) == (verdict, control)


# ----------------------------------------------------------------------------------------------------------------- MAML

POLICY = ("losses_of", "above_usual", "logs_of", "score")


def test_the_loss_of_roll_outs_has_the_gradient_of_the_exact_return():
    """Six parameters of a linear policy, nudged: differences of exact returns against many roll-outs."""
    space = load(2, *POLICY)
    worlds = Corridors(np.array([4.0]), np.ones((1, 23), int))
    theta = torch.tensor([[0.3, -0.2, 0.1, 0.2, 0.0, -0.1]], dtype=torch.double, requires_grad=True)
    loss = space.losses_of(worlds, 40_000, [np.random.default_rng(0)], [])(theta)
    (gradient,) = torch.autograd.grad(loss.sum(), theta)

    def exact(parameters):
        return -STEPS * worlds.expected(space.logs_of(parameters).detach().exp().numpy())[0]

    nudges = 1e-5 * torch.eye(6, dtype=torch.double)
    slopes = [(exact(theta + nudge) - exact(theta - nudge)) / 2e-5 for nudge in nudges]
    assert gradient[0].numpy() == pytest.approx(slopes, abs=0.05 * np.abs(slopes).max())


def test_above_the_usual_leaves_nothing_of_what_place_and_time_explain():
    rng, space = np.random.default_rng(0), load(2, "above_usual")
    states = rng.integers(1, 22, (2, 50, 20))
    usual = 3 + CELLS[states] / 10 - 2 * np.linspace(0, 1, 20) + (CELLS[states] / 10) ** 2
    assert np.abs(space.above_usual(states, usual)).max() < 1e-3  # a very small ridge
    noise = rng.standard_normal(states.shape)
    assert space.above_usual(states, usual + noise) == pytest.approx(space.above_usual(states, noise), abs=1e-3)


def test_meta_training_finds_the_start_that_a_step_makes_good():
    """Two parabolas of curvatures 1 and 3 around 1 and -1, step 0.2: the start that is best has the slope zero."""
    curves, centres = torch.tensor([[1.0], [3.0]]).double(), torch.tensor([[1.0], [-1.0]]).double()

    def draw():
        return (lambda theta: (curves * (theta - centres) ** 2).sum(dim=1) / 2), 2

    train, start = load(2, "meta_train").meta_train, torch.zeros(1, dtype=torch.double)
    weight = (curves * (1 - 0.2 * curves) ** 2).numpy()
    assert train(draw, start, 400, 0.1, 0.2) == pytest.approx((weight * centres.numpy()).sum() / weight.sum(), abs=1e-3)
    assert train(draw, start, 400, 0.1, 0.0, second_order=False) == pytest.approx(-0.5, abs=1e-3)  # for all at once


def shot(maml=0.7, sines=0.9, for_all=0.3, random=0.2):
    """PG goes from 0 to 0.8; a start's score before and after its step."""
    scores = {"MAML": same(0.1, maml), "first-order": same(0.1, 0.5), "for all": same(0.2, for_all)}
    scores |= {"random": same(0.0, random), "PG": same(0.0, 0.4, 0.8)}
    explained = {"MAML": same(0.0, sines), "first-order": same(0.0, 0.7), "for all": same(0.1, 0.2)}
    return runs(({}, scores)), runs(({}, explained | {"random": same(-1.0, 0.1)}))


@pytest.mark.parametrize("given, verdict, control", [
    ({}, "holds", "contradicted"),
    ({"maml": 0.5}, "contradicted", "contradicted"),
    ({"sines": 0.6}, "contradicted", "contradicted"),
    ({"for_all": 0.69}, "contradicted", "holds"),  # one start serves all robots, so that no step of their own is needed
    ({"random": 0.69}, "contradicted", "holds"),  # any weights would do
])
def test_c2_3_is_one_step_in_units_of_policy_gradients_gain(tmp_path, given, verdict, control):
    one_step, sine_step = shot(**given)
    space = load(2, "gain", "c23_parts", one_step=one_step, sine_step=sine_step)
    claim = judge(2, "C2.3", space, tmp_path)
    assert claim.measured["corridors: gain after one step"] == pytest.approx(given.get("maml", 0.7) / 0.8)
    assert claim.measured["corridors: gain before the step"] == pytest.approx(0.125)
    assert (claim.verdict, claim.control_verdict) == (verdict, control)


# ----------------------------------------------------------------------------------------------------------------- T2.1

def test_the_curvature_of_drawn_actions_is_that_of_a_softmax():
    """One roll-out that stays in cell 5, where the position is 1: costs cancel, as the mean diagonal is made 1."""
    rolled = SimpleNamespace(states=np.full((1, 1, 21), 16), rewards=np.full((1, 1, 20), -0.3))
    space = load(2, "curvature", "logs_of")
    gamma = space.curvature(None, torch.zeros(1, 6, dtype=torch.double), [rolled])[0]
    softmax = np.eye(3) / 3 - 1 / 9
    assert gamma == pytest.approx((np.kron(np.ones((2, 2)), softmax) * 9 / 2 + np.eye(6)) / 2)


def test_the_worst_is_of_the_first_twenty_roll_outs():
    rewards = [np.full((1, 15, 4), -0.1), np.full((1, 15, 4), -0.1)]
    rewards[0][0, 3], rewards[1][0, 4], rewards[1][0, 9] = -0.5, [-0.8, -0.4, 0, 0], -2.0  # the last is the 25th
    assert load(2, "worst").worst([SimpleNamespace(rewards=each) for each in rewards]) == pytest.approx(-0.5)


def test_a_level_that_is_not_reached_counts_as_reached_at_the_end():
    curves = np.array([[0.0, 0.8, 0.9], [0.0, 0.1, 0.76], [0.0, 0.1, 0.2]])
    assert load(2, "needed", level=0.75).needed(curves).tolist() == [5, 10, 10]


@pytest.mark.parametrize("near, far, rewired, words", [
    (0.2, 0.1, 0.1, "rewired"), (0.2, 0.1, 0.01, "far"), (0.2, 0.0, 0.3, "near"), (0.0, 0.3, 0.3, "none")])
def test_a_method_helps_up_to_the_last_family_without_a_gap(near, far, rewired, words):
    spread = 0.001 * np.arange(4)
    gains = {"near": near + spread, "far": far + spread, "rewired": rewired + spread}
    assert load(2, "helps_up_to").helps_up_to(gains) == words
