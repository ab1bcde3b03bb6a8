"""Policy gradients against numerical derivatives, closed forms and learning one task after another."""

from copy import deepcopy
from dataclasses import dataclass
from functools import partial

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lifelong_lib.environments.dynamical_systems import SYSTEMS, Trajectories, draw_tasks
from lifelong_lib.learners.policy_gradient import (
    PolicyGradient,
    discounted_returns,
    finite_difference_gradient,
    generators,
    natural_gradient,
    order_of_tasks,
    power_step,
    reinforce_gradient,
    reward_weighted_hessian,
    scores,
)

NOISE = 0.6
POLICY = np.array([0.4, -0.3])


@dataclass
class Line:
    """A small world of T equal tasks: x in R^2, one action, x' = 0.8 x + (0.5, 1) a, reward -|x'|^2 over H steps."""

    count: int = 1
    H: int = 2

    def __getitem__(self, chosen):
        return Line(len(np.atleast_1d(chosen)), self.H)

    def roll_out(self, policies, n, rngs, noise):
        states = np.empty((self.count, n, self.H + 1, 2))
        actions = np.empty((self.count, n, self.H, 1))
        for t, rng in enumerate(rngs):
            states[t, :, 0] = [1.0, -0.5] + 0.3 * rng.standard_normal((n, 2))
            actions[t] = noise * rng.standard_normal((n, self.H, 1))
        for h in range(self.H):
            actions[:, :, h] += np.einsum("tnx,tx->tn", states[:, :, h], policies)[..., None]
            states[:, :, h + 1] = 0.8 * states[:, :, h] + actions[:, :, h] * [0.5, 1.0]
        return Trajectories(states, actions, -(states[:, :, 1:] ** 2).sum(axis=-1))


def many(H, discount, batches=60, n=3000):
    """Roll-outs at POLICY in independent batches, and the true gradient of the expected return.

    Numerical derivative with common random numbers: on fixed noise the return is a smooth function of the policy.
    """
    world, policies = Line(batches, H), np.tile(POLICY, (batches, 1))

    def expected_return(change):
        rngs = [np.random.default_rng([7, t]) for t in range(batches)]
        done = world.roll_out(policies + change, n, rngs, NOISE)
        return discounted_returns(done.rewards, discount).mean()

    gradient = [(expected_return(step) - expected_return(-step)) / 2e-4 for step in 1e-4 * np.eye(2)]
    rollouts = world.roll_out(policies, n, [np.random.default_rng([8, t]) for t in range(batches)], NOISE)
    return rollouts, policies, np.array(gradient)


def assert_unbiased(estimates, truth):
    """The mean of independent estimates (batches, d) lies within 4 standard errors, which are small enough to tell."""
    error = estimates.std(axis=0, ddof=1) / np.sqrt(len(estimates))
    assert error.max() < 0.02 * np.linalg.norm(truth), "the test would not see a wrong factor"
    assert (np.abs(estimates.mean(axis=0) - truth) < 4 * error).all(), (estimates.mean(axis=0), truth, error)


# ----------------------------------------------------------------------------------------------- finite differences

def linear(slope):
    return lambda policies: 3.0 + policies @ slope


@given(seed=st.integers(0, 10**6), d=st.integers(1, 6), size=st.floats(1e-3, 10))
@settings(max_examples=30, deadline=None)
def test_finite_differences_are_exact_on_a_linear_function(seed, d, size):
    rng = np.random.default_rng(seed)
    slope, policy = rng.standard_normal(d), rng.standard_normal(d)
    gradient = finite_difference_gradient(linear(slope), policy, 2 * (d + 3) + 1, size, rng)
    assert np.allclose(gradient, slope, atol=1e-6)


class OrthogonalDraws:
    """A stand-in generator whose `uniform` gives one delta of size 0.2 along each axis."""

    def uniform(self, low, high, shape):
        assert (low, high) == (-0.2, 0.2)
        return 0.2 * np.eye(*shape)


@pytest.mark.parametrize("power", [2, 3])
def test_finite_differences_with_orthogonal_deltas_are_central_differences(power):
    policy, curvature = np.array([0.3, -1.0, 2.0]), np.array([1.0, 2.0, -0.5])

    def f(policies):
        return (curvature * policies**power).sum(axis=1)

    central = [(f(policy[None] + delta) - f(policy[None] - delta))[0] / 0.4 for delta in 0.2 * np.eye(3)]
    gradient = finite_difference_gradient(f, policy, 7, 0.2, OrthogonalDraws())
    assert np.allclose(gradient, central, rtol=1e-12)
    assert np.allclose(gradient, 2 * curvature * policy) == (power == 2), "exact on a quadratic, not on a cubic"


def test_finite_differences_use_mirrored_pairs_and_the_policy_itself():
    seen = []

    def evaluate(policies):
        seen.append(policies)
        return policies.sum(axis=1)

    policy = np.array([1.0, 2.0, 3.0])
    finite_difference_gradient(evaluate, policy, 8, 0.5, np.random.default_rng(0))
    (policies,) = seen
    assert policies.shape == (7, 3) and np.array_equal(policies[0], policy)
    deltas = policies[1:4] - policy
    assert np.allclose(deltas, -(policies[4:] - policy)) and np.abs(deltas).max() <= 0.5


def test_with_fewer_pairs_than_parameters_the_gradient_has_the_least_norm():
    """It is the projection of the true gradient onto the directions that were tried (7 pairs, 9 parameters)."""
    slope, tried = np.arange(1.0, 10.0), []
    gradient = finite_difference_gradient(lambda policies: tried.append(policies[1:8]) or policies @ slope,
                                          np.zeros(9), 15, 0.1, np.random.default_rng(1))
    directions = np.linalg.svd(tried[0], full_matrices=False)[2]
    assert np.allclose(gradient, directions.T @ directions @ slope)
    assert np.linalg.norm(gradient) < 0.99 * np.linalg.norm(slope)


def test_finite_differences_refuse_fewer_than_three_roll_outs():
    with pytest.raises(ValueError, match="at least 3 roll-outs .*, got 2"):
        finite_difference_gradient(linear(np.ones(2)), np.zeros(2), 2, 0.1, np.random.default_rng(0))


# ------------------------------------------------------------------------------------------------ likelihood ratios

def test_discounted_returns_by_hand():
    assert discounted_returns(np.array([[[1.0, 2.0, 4.0], [0.0, 0.0, 8.0]]]), 0.5).tolist() == [[3.0, 2.0]]


@pytest.mark.parametrize("discount", [1.0, 0.7])
def test_scores_are_the_derivative_of_the_log_probability_of_the_actions(discount):
    tasks = draw_tasks(SYSTEMS["bicycle"], 2, np.random.default_rng(0))  # two actions, so that blocks matter
    policies = np.random.default_rng(1).normal(0, 0.2, (2, 4))
    done = tasks.roll_out(policies, 3, generators(np.random.SeedSequence(2), 2), NOISE, steps=4)

    def log_probability(theta):
        means = done.states[:, :, :-1] @ theta.reshape(2, 1, 2, 2).swapaxes(-1, -2)
        each = -((done.actions - means) ** 2).sum(axis=-1) / (2 * NOISE**2)
        return (each * discount ** np.arange(4)).sum(axis=-1)

    numeric = [(log_probability(policies + step) - log_probability(policies - step)) / 2 for step in np.eye(4)]
    assert np.allclose(scores(done, policies, NOISE, discount), np.stack(numeric, axis=-1)), "quadratic: exact"


@pytest.mark.parametrize(("H", "discount"), [(1, 1.0), (2, 1.0), (2, 0.5)])
def test_reinforce_is_unbiased(H, discount):
    rollouts, policies, truth = many(H, discount)
    assert_unbiased(reinforce_gradient(rollouts, policies, NOISE, discount), truth)


@pytest.mark.parametrize("H", [1, 2])
def test_the_natural_gradient_is_unbiased(H):
    """The truth is the inverse Fisher information, here the mean of sum_h x x^T / noise^2, times the true gradient."""
    rollouts, policies, truth = many(H, 1.0)
    states = rollouts.states[:, :, :-1]
    fisher = np.einsum("tnhi,tnhj->ij", states, states) / (states.shape[0] * states.shape[1] * NOISE**2)
    assert_unbiased(natural_gradient(rollouts, policies, NOISE, 1.0), np.linalg.solve(fisher, truth))


def test_on_the_same_roll_outs_the_natural_gradient_is_inverse_fisher_times_vanilla_exactly():
    """Least squares with a constant = the scores' own covariance, inverted, times REINFORCE with its mean baseline."""
    tasks = draw_tasks(SYSTEMS["cart-pole"], 3, np.random.default_rng(0))
    policies = np.random.default_rng(1).normal(0, 0.2, (3, 4))
    done = tasks.roll_out(policies, 40, generators(np.random.SeedSequence(2), 3), NOISE, steps=10)
    vanilla, natural = (rule(done, policies, NOISE, 1.0) for rule in (reinforce_gradient, natural_gradient))
    for t, own in enumerate(scores(done, policies, NOISE)):
        fisher = np.cov(own.T, bias=True)
        assert np.allclose(natural[t], np.linalg.solve(fisher, vanilla[t]), rtol=1e-6)


def test_a_parameter_that_nothing_depends_on_gets_no_natural_gradient():
    """A state that is always zero leaves a column of zeros, which must not become a division by zero."""
    rollouts, policies, _ = many(1, 1.0, batches=2, n=50)
    rollouts.states[..., 1] = 0
    gradient = natural_gradient(rollouts, policies, NOISE)
    assert np.isfinite(gradient).all() and np.allclose(gradient[:, 1], 0)


def test_a_baseline_leaves_reinforce_unchanged_by_a_constant_reward():
    rollouts, policies, _ = many(2, 1.0, batches=3, n=100)
    shifted = rollouts._replace(rewards=rollouts.rewards + 100.0)
    for rule in (reinforce_gradient, natural_gradient):
        assert np.allclose(rule(rollouts, policies, NOISE), rule(shifted, policies, NOISE))


# ------------------------------------------------------------------------------------------------------------ PoWER

def test_power_moves_to_the_reward_weighted_mean_of_the_actions():
    actions, rewards = np.array([1.0, 2.0, 4.0]), np.array([-3.0, -2.0, 0.0])  # shifted: 0, 1, 3
    done = Trajectories(np.ones((1, 3, 2, 1)), actions.reshape(1, 3, 1, 1), rewards.reshape(1, 3, 1))
    policy = np.array([[0.5]])
    assert policy + power_step(done, policy, NOISE) == pytest.approx((1 * 2 + 3 * 4) / 4)


@pytest.mark.parametrize("discount", [1.0, 0.8])
def test_power_is_the_regression_weighted_by_the_reward_to_come(discount):
    tasks = draw_tasks(SYSTEMS["bicycle"], 2, np.random.default_rng(0))
    policies = np.random.default_rng(1).normal(0, 0.2, (2, 4))
    done = tasks.roll_out(policies, 20, generators(np.random.SeedSequence(3), 2), NOISE, steps=5)
    change = power_step(done, policies, NOISE, discount)
    for t in range(2):
        rewards = done.rewards[t] - done.rewards[t].min()
        to_come = [[sum(discount**j * rewards[i, j] for j in range(h, 5)) for h in range(5)] for i in range(20)]
        root = np.sqrt(np.ravel(to_come))[:, None]
        states, actions = done.states[t, :, :-1].reshape(-1, 2), done.actions[t].reshape(-1, 2)
        gains = np.linalg.lstsq(root * states, root * actions, rcond=None)[0]
        assert np.allclose(policies[t] + change[t], gains.T.ravel())


# ---------------------------------------------------------------------------------------------------------- Hessian

@pytest.mark.parametrize(("name", "d_a"), [("cart-pole", 1), ("bicycle", 2)])
def test_the_hessian_is_the_second_derivative_of_the_reward_weighted_log_likelihood(name, d_a):
    tasks = draw_tasks(SYSTEMS[name], 2, np.random.default_rng(0))
    policies = np.random.default_rng(1).normal(0, 0.2, (2, tasks.system.policy_size))
    done = tasks.roll_out(policies, 6, generators(np.random.SeedSequence(4), 2), NOISE, steps=8)
    d = policies.shape[1]

    def weighted_log_likelihood(theta):
        means = done.states[:, :, :-1] @ theta.reshape(len(theta), 1, d_a, -1).swapaxes(-1, -2)
        log_likelihood = -((done.actions - means) ** 2).sum(axis=(-1, -2)) / (2 * NOISE**2)
        return (done.rewards.sum(axis=-1) * log_likelihood).mean(axis=1)

    steps, numeric = np.eye(d), np.empty((2, d, d))  # quadratic in theta: differences of any size are exact
    for i in range(d):
        for j in range(d):
            corners = [sign * weighted_log_likelihood(policies + one * steps[i] + sign * one * steps[j])
                       for one in (1, -1) for sign in (1, -1)]
            numeric[:, i, j] = (corners[0] + corners[1] + corners[2] + corners[3]) / 4
    hessian = reward_weighted_hessian(done, NOISE)
    assert hessian.shape == (2, d, d)
    assert np.allclose(hessian, numeric, rtol=1e-6, atol=1e-6 * np.abs(numeric).max())
    assert (np.linalg.eigvalsh(hessian) > 0).all(), "rewards are negative"


# --------------------------------------------------------------------------------------------------------- learning

@dataclass
class Guess:
    """A world that cannot fail: the state is always 1, the reward is -(a - 2)^2; the best gain is 2."""

    count: int

    def roll_out(self, policies, n, rngs, noise):
        noises = np.stack([rng.standard_normal(n) for rng in rngs])[:, :, None, None]
        actions = policies[:, :, None, None] + noise * noises
        return Trajectories(np.ones((self.count, n, 2, 1)), actions, -(actions[..., 0] - 2) ** 2)


@pytest.mark.parametrize(("gradient", "step"), [(reinforce_gradient, 0.1), (natural_gradient, 0.5), (power_step, 1.0)])
def test_every_learner_solves_the_easy_world(gradient, step):
    learner = PolicyGradient(gradient, step, noise=0.3, n=200, iterations=80)
    start = np.array([[-1.0], [0.0], [5.0]])
    policies, rewards = learner.learn(Guess(3), start, generators(np.random.SeedSequence(0), 3))
    assert policies.shape == (81, 3, 1) and rewards.shape == (81, 3)
    assert np.array_equal(policies[0], start)
    assert np.allclose(rewards[0], [-9.09, -4.09, -9.09], rtol=0.1), "row 0 is the reward before learning"
    assert np.allclose(policies[-1], 2, atol=0.1) and np.allclose(rewards[-1], -0.09, atol=0.05)
    evaluated = learner.evaluate(Guess(3), policies[-1], generators(np.random.SeedSequence(1), 3))
    assert np.allclose(evaluated, -0.09, atol=0.05)


def test_learning_goes_up_the_gradient_by_the_step():
    learner = PolicyGradient(lambda done, policies, noise: 10 * policies, 0.01, noise=0.1, n=2, iterations=5)
    policies, rewards = learner.learn(Guess(1), np.ones((1, 1)), generators(np.random.SeedSequence(0), 1), iterations=2)
    assert np.allclose(policies[:, 0, 0], [1, 1.1, 1.21]) and rewards.shape == (3, 1)
    nothing = learner.learn(Guess(1), np.ones((1, 1)), generators(np.random.SeedSequence(0), 1), iterations=0)
    assert len(nothing[0]) == len(nothing[1]) == 1


@pytest.mark.parametrize("name", ["spring-mass-damper", "bicycle"])
def test_sessions_in_a_batch_equal_learning_one_task_after_another(name):
    order, seed = [0, 1, 0, 2, 1, 0], np.random.SeedSequence(5)
    tasks = draw_tasks(SYSTEMS[name], 3, np.random.default_rng(0))
    start = np.random.default_rng(1).random((3, tasks.system.policy_size))
    learner = PolicyGradient(natural_gradient, 0.01, noise=0.5, n=10, iterations=3)
    met = learner.sessions(tasks, start, order, generators(seed, 3))
    assert [t for t, _, _ in met] == order

    current, rngs = start.copy(), generators(np.random.SeedSequence(5), 3)
    for (t, alpha, gamma), expected in zip(met, order, strict=True):
        learned = learner.learn(tasks[expected], current[[t]], [deepcopy(rngs[expected])])[0][-1, 0]
        [(_, alone, gamma_alone)] = learner.sessions(tasks, current, [expected], rngs)
        current[t] = alone
        assert np.array_equal(alpha, alone) and np.array_equal(alpha, learned)
        assert np.array_equal(gamma, gamma_alone)
    assert np.array_equal(start, np.random.default_rng(1).random(start.shape)), "the start is not written into"


def test_gamma_is_the_reward_weighted_hessian_on_a_common_scale():
    """Mean diagonal 1, positive semi-definite, and but for a multiple of I proportional to the Hessian found there."""
    tasks = draw_tasks(SYSTEMS["bicycle"], 2, np.random.default_rng(0))
    learner, start = PolicyGradient(natural_gradient, 0.0, noise=0.5, n=10, iterations=0), np.zeros((2, 4))
    met = learner.sessions(tasks, start, [0, 1], generators(np.random.SeedSequence(5), 2))
    rngs = generators(np.random.SeedSequence(5), 2)
    tasks.roll_out(start, 10, rngs, 0.5)  # a session looks once before its Hessian is found from fresh roll-outs
    hessians = reward_weighted_hessian(tasks.roll_out(start, 10, rngs, 0.5), 0.5)
    for (_, _, gamma), hessian in zip(met, hessians, strict=True):
        basis = np.column_stack([hessian.ravel() / np.abs(hessian).max(), np.eye(4).ravel()])
        shares, *_ = np.linalg.lstsq(basis, gamma.ravel(), rcond=None)
        assert np.allclose(basis @ shares, gamma.ravel()) and shares[0] > 0
        assert np.diag(gamma).mean() == pytest.approx(1) and np.linalg.eigvalsh(gamma).min() > 0


def test_sessions_leave_out_tasks_that_are_not_met():
    tasks = draw_tasks(SYSTEMS["cart-pole"], 3, np.random.default_rng(0))
    learner = PolicyGradient(natural_gradient, 0.01, noise=0.5, n=10, iterations=1)
    met = learner.sessions(tasks, np.zeros((3, 4)), [2, 2], generators(np.random.SeedSequence(0), 3))
    assert [t for t, _, _ in met] == [2, 2] and not np.array_equal(met[0][1], met[1][1])


# ------------------------------------------------------------------------------------------------- order, generators

@given(count=st.integers(1, 30), seed=st.integers(0, 10**6))
@settings(max_examples=50, deadline=None)
def test_an_order_ends_when_the_last_task_was_met(count, seed):
    order = order_of_tasks(count, np.random.default_rng(seed))
    assert set(order) == set(range(count)) and order.count(order[-1]) == 1
    assert all(type(t) is int for t in order)
    assert order == order_of_tasks(count, np.random.default_rng(seed))


def test_orders_are_as_long_as_the_coupon_collectors():
    rng = np.random.default_rng(0)
    lengths = [len(order_of_tasks(5, rng)) for _ in range(4000)]
    expected = 5 * sum(1 / i for i in range(1, 6))
    assert np.mean(lengths) == pytest.approx(expected, abs=4 * np.std(lengths) / np.sqrt(4000))


def test_generators_are_independent_and_go_on_where_they_stopped():
    seed = np.random.SeedSequence(1)
    draws = [rng.random() for rng in generators(seed, 3) + generators(seed, 2)]
    assert len(set(draws)) == 5
    assert draws == [rng.random() for rng in generators(np.random.SeedSequence(1), 5)]


@pytest.mark.parametrize("gradient", [reinforce_gradient, partial(natural_gradient, discount=1.0)])
def test_standardised_gradients_keep_their_direction_and_forget_the_scale_of_rewards(gradient):
    rollouts, policies, _ = many(2, 1.0, batches=3, n=100)
    plain, ours = (gradient(rollouts, policies, NOISE, standardise=value) for value in (False, True))
    spread = rollouts.rewards.sum(axis=2).std(axis=1, keepdims=True)
    assert np.allclose(ours * spread, plain)
    scaled = rollouts._replace(rewards=1000 * rollouts.rewards)
    assert np.allclose(gradient(scaled, policies, NOISE, standardise=True), ours)


@pytest.mark.parametrize("gradient", [reinforce_gradient, natural_gradient])
def test_standardised_gradients_survive_returns_that_are_all_alike(gradient):
    rollouts, policies, _ = many(2, 1.0, batches=3, n=100)
    flat = rollouts._replace(rewards=np.zeros_like(rollouts.rewards))
    assert not gradient(flat, policies, NOISE, standardise=True).any()
