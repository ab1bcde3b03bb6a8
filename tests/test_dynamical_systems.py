"""The simulated systems against closed forms, independent derivations and arithmetic by hand."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from lifelong_lib.environments import dynamical_systems
from lifelong_lib.environments.dynamical_systems import (
    GRAVITY,
    START_SPREAD,
    SYSTEMS,
    Tasks,
    Trajectories,
    draw_tasks,
    reward,
)  # fmt: skip

SPRING, CART_POLE, BICYCLE, QUADROTOR = (SYSTEMS[name] for name in
                                         ("spring-mass-damper", "cart-pole", "bicycle", "quadrotor"))
every_system = pytest.mark.parametrize("system", SYSTEMS.values(), ids=SYSTEMS)


def generators(count, seed=0):
    return [np.random.default_rng([seed, i]) for i in range(count)]


def roll_out(tasks, policies=None, n=3, noise=0.0, steps=50, seed=0):
    policies = np.zeros((len(tasks), tasks.system.policy_size)) if policies is None else policies
    return tasks.roll_out(policies, n, generators(len(tasks), seed), noise, steps)


def some_tasks(system, count=4):
    return draw_tasks(system, count, np.random.default_rng(1))


def free(system):
    """The system without limits on its states: what closed forms describe."""
    return replace(system, constrain=lambda states: None)


# ---------------------------------------------------------------------------------------------- equations of motion

@pytest.mark.parametrize("seconds", [0.02, 0.15, 3.0])
def test_an_undamped_spring_keeps_its_energy_and_follows_the_cosine(seconds):
    """Steps are exact however long they are; Euler's rule multiplies the energy by 1 + (w dt)^2 in each."""
    mass, stiffness = 0.7, 3.0
    system = replace(free(SPRING), step_seconds=seconds)
    states = roll_out(Tasks(system, np.array([[mass, 1e-300, stiffness]]), np.array([[1.0, -0.5]]))).states[0]
    energy = mass * states[..., 1] ** 2 / 2 + stiffness * states[..., 0] ** 2 / 2
    assert np.allclose(energy, energy[:, :1], rtol=1e-12, atol=0)
    w, (x, v) = np.sqrt(stiffness / mass), states[:, 0].T[:, :, None]
    cos, sin = np.cos(w * seconds * np.arange(51)), np.sin(w * seconds * np.arange(51))
    expected = np.stack([x * cos + v / w * sin, v * cos - w * x * sin], axis=-1)
    assert np.allclose(states, expected, rtol=0, atol=1e-12)


def test_a_spring_without_control_never_gains_energy():
    """Drawn tasks and the corners of their ranges, at the system's own step. By Euler's rule most diverged."""
    drawn, corners = draw_tasks(SPRING, 500, np.random.default_rng(7)), np.array(list(product(*SPRING.ranges.T)))
    tasks = Tasks(SPRING, np.concatenate([drawn.parameters, corners]), np.concatenate([drawn.starts, np.ones((8, 2))]))
    states = roll_out(tasks, n=2, steps=400).states
    mass, _, stiffness = tasks.parameters.T[:, :, None, None]
    energy = mass * states[..., 1] ** 2 / 2 + stiffness * states[..., 0] ** 2 / 2
    assert (energy[..., 1:] <= energy[..., :-1] * (1 + 1e-12)).all()
    assert (energy[..., -1] < energy[..., 0]).all()


def test_damping_takes_the_energy_that_the_damper_takes():
    """The energy lost equals the integral of damping times velocity squared (the trapezoidal rule over small steps)."""
    system = replace(free(SPRING), step_seconds=1e-3)
    states = roll_out(Tasks(system, np.array([[0.5, 0.3, 2.0]]), np.array([[1.0, 1.0]])), steps=500).states[0]
    energy = 0.5 * states[..., 1] ** 2 / 2 + 2.0 * states[..., 0] ** 2 / 2
    taken = 0.3 * np.trapezoid(states[..., 1] ** 2, dx=1e-3, axis=1)
    assert np.allclose(energy[:, 0] - energy[:, -1], taken, rtol=1e-5)


def spring_matrices(mass, damping, stiffness):
    return np.array([[0, 1], [-stiffness / mass, -damping / mass]]), np.array([[0], [1 / mass]])


def cart_pole_matrices(cart, pole, length, friction):
    """Newton for the cart and the rod's angular momentum about its foot, solved for both accelerations.

    The rod's middle is at x - length * angle: (cart + pole) x'' - pole length angle'' = u - friction x' and
    (4/3) pole length^2 angle'' - pole length x'' = pole g length angle.
    """
    inertias = np.array([[cart + pole, -pole * length], [-pole * length, 4 / 3 * pole * length**2]])
    forces = np.array([[0, -friction, 0, 0, 1], [0, 0, pole * GRAVITY * length, 0, 0]])
    rows = np.zeros((4, 5))
    rows[0, 1] = rows[2, 3] = 1
    rows[[1, 3]] = np.linalg.solve(inertias, forces)
    return rows[:, :4], rows[:, 4:]


linear_system = pytest.mark.parametrize(("system", "matrices"), [(SPRING, spring_matrices),
                                                                 (CART_POLE, cart_pole_matrices)],
                                        ids=["spring-mass-damper", "cart-pole"])


def held_step(A, B, seconds):
    """(F, G) of x -> F x + G u for an action held for ``seconds``: upper blocks of exp([[A, B], [0, 0]] seconds)."""
    block = np.vstack([np.hstack([A, B]), np.zeros((B.shape[1], len(A) + B.shape[1]))])
    upper = expm(block * seconds)[: len(A)]
    return upper[:, : len(A)], upper[:, len(A) :]


@linear_system
@pytest.mark.parametrize("gain", [0.0, -0.4])
def test_linear_roll_outs_equal_matrix_powers(system, matrices, gain):
    tasks = some_tasks(free(system))
    policies = np.full((4, system.policy_size), gain)
    states = roll_out(tasks, policies).states
    for parameters, policy, own in zip(tasks.parameters, policies, states, strict=True):
        F, G = held_step(*matrices(*parameters), system.step_seconds)
        powers = np.stack([np.linalg.matrix_power(F + G @ policy[None], h) for h in range(51)])
        expected = np.einsum("hij,nj->nhi", powers, own[:, 0])
        assert np.allclose(own, expected, rtol=1e-9, atol=1e-12 * np.abs(expected).max())


@linear_system
def test_steps_and_their_halves_solve_the_equations_with_the_action_held(system, matrices):
    tasks, rng = some_tasks(system), np.random.default_rng(8)
    starts, actions = rng.normal(size=(4, 3, len(system.state))), rng.normal(size=(4, 3, 1))
    expected = np.empty_like(starts)
    for t, i in np.ndindex(4, 3):
        A, B = matrices(*tasks.parameters[t])

        def derivative(_, state, A=A, Bu=B @ actions[t, i]):
            return A @ state + Bu
        solved = solve_ivp(derivative, (0, system.step_seconds), starts[t, i], "DOP853", rtol=1e-12, atol=1e-12)
        expected[t, i] = solved.y[:, -1]
    assert np.abs(expected - starts).max() > 0.05, "a step is long enough to see"
    for parts in (1, 2, 4):
        advance, states = system.dynamics(tasks.parameters, system.step_seconds / parts), starts
        for _ in range(parts):
            states = advance(states, actions)
        assert np.allclose(states, expected, rtol=1e-10, atol=1e-10), f"{parts} parts"


def test_bicycle_by_hand(monkeypatch):
    """With g = V = 10 and sin, cos of the head angle 0.6, 0.8: q = 100 * 0.6 - 2 * 10 * 0.8 = 44, J = D = 2.5."""
    monkeypatch.setattr(dynamical_systems, "GRAVITY", 10.0)
    monkeypatch.setattr(dynamical_systems, "BICYCLE_SPEED", 10.0)
    parameters = np.array([[10, 0.5, 0.5, 2, 0.1, np.arctan2(0.6, 0.8)]])
    A, B = np.array([[0, 1], [-7, -25 / 11]]), np.array([[0, 0], [18, 10 / 11]])
    one, none, tiny = np.eye(2)[None], np.zeros((1, 2, 2)), 1e-6
    advance = BICYCLE.dynamics(parameters, tiny)
    assert np.allclose((advance(one, none) - one) / tiny, A.T, atol=1e-4)
    assert np.allclose(advance(none, one) / tiny, B.T, atol=1e-4)
    advance, (F, G) = BICYCLE.dynamics(parameters, 0.3), held_step(A, B, 0.3)
    assert np.allclose(advance(one, none), F.T, atol=1e-12) and np.allclose(advance(none, one), G.T, atol=1e-12)


def test_every_bicycle_of_a_batch_has_its_own_equations():
    tasks = some_tasks(BICYCLE)
    states, actions = np.ones((4, 1, 2)), np.ones((4, 1, 2))
    together = BICYCLE.dynamics(tasks.parameters, 0.02)(states, actions)
    alone = [BICYCLE.dynamics(tasks.parameters[t : t + 1], 0.02)(states[:1], actions[:1])[0] for t in range(4)]
    assert np.array_equal(together, alone) and len(np.unique(together[:, 0, 1])) == 4


def test_quadrotor_conserves_angular_momentum_up_to_the_step():
    """Without torques |I omega| is constant; Euler's error over a fixed time halves with the step."""
    inertias, start = np.array([4e-3, 7e-3, 1.5e-2]), np.array([[0, 0, 0, 2.0, -1.0, 1.5]])
    drift = []
    for steps in (100, 200, 400):
        system = replace(free(QUADROTOR), step_seconds=1 / steps)
        states = roll_out(Tasks(system, np.array([[*inertias, 0.3]]), start), steps=steps).states[0]
        momentum = np.linalg.norm(states[..., 3:] * inertias, axis=-1)
        drift.append(np.abs(momentum[:, -1] / momentum[:, 0] - 1).mean())
        assert np.abs(states[:, -1, 3:] - states[:, 0, 3:]).max() > 0.5, "the body does tumble"
    assert drift[0] < 0.05
    assert np.allclose(np.divide(drift[:-1], drift[1:]), 2, rtol=0.1)


@pytest.mark.parametrize("seconds", [1e-6, 0.5])
def test_quadrotor_torques_by_hand(seconds):
    """Euler's rule: the change over any step is the step times the derivative."""
    states, actions = np.array([[[0.1, 0.2, 0.3, 1.0, 2.0, 3.0]]]), np.array([[[8.0, 16.0, 20.0]]])
    advance = QUADROTOR.dynamics(np.array([[2.0, 4.0, 5.0, 0.5]]), seconds)
    change = (advance(states, actions) - states)[0, 0] / seconds
    # p' = q r (4 - 5) / 2 + 0.5 * 8 / 2, q' = p r (5 - 2) / 4 + 0.5 * 16 / 4, r' = p q (2 - 4) / 5 + 20 / 5
    assert np.allclose(change, [1, 2, 3, -3 + 2, 9 / 4 + 2, -4 / 5 + 4], rtol=1e-8)


# -------------------------------------------------------------------------------------------------------- roll-outs

@every_system
def test_a_batch_equals_its_tasks_one_by_one_bit_for_bit(system):
    tasks, policies = some_tasks(system), np.random.default_rng(2).normal(0, 0.3, (4, system.policy_size))
    together = tasks.roll_out(policies, 5, generators(4), 0.3)
    for t in range(4):
        alone = tasks[t].roll_out(policies[t : t + 1], 5, [generators(4)[t]], 0.3)
        for whole, part in zip(together, alone, strict=True):
            assert whole[t].tobytes() == part[0].tobytes()


@every_system
def test_the_same_seed_gives_the_same_bytes_and_another_one_does_not(system):
    tasks = some_tasks(system)
    first, again, other = (roll_out(tasks, noise=0.3, seed=seed) for seed in (0, 0, 1))
    assert [part.tobytes() for part in first] == [part.tobytes() for part in again]
    assert not np.isin(first.actions, other.actions).any() and not np.isin(first.states[:, :, 0], other.states).any()


@every_system
def test_shapes_and_the_policy_in_blocks(system):
    tasks = some_tasks(system)
    policies = np.random.default_rng(3).normal(0, 0.1, (4, system.policy_size))
    done = roll_out(tasks, policies, n=6, steps=7)
    d_x, d_a = len(system.state), len(system.actions)
    assert done.states.shape == (4, 6, 8, d_x) and done.actions.shape == (4, 6, 7, d_a)
    assert done.rewards.shape == (4, 6, 7) and system.policy_size == policies.shape[1] == d_x * d_a
    for action in range(d_a):
        block = policies[:, action * d_x : (action + 1) * d_x]
        assert np.allclose(done.actions[..., action], np.einsum("tnhx,tx->tnh", done.states[:, :, :-1], block))


def test_exploration_and_starts_have_the_spread_they_claim():
    tasks = replace(some_tasks(SPRING, 2), starts=np.array([[3.0, 4.0], [-1.0, 0.0]]))
    done = roll_out(tasks, n=4000, noise=0.7, steps=5)
    assert done.actions.std() == pytest.approx(0.7, rel=0.02) and abs(done.actions.mean()) < 0.02
    assert np.allclose(done.states[:, :, 0].mean(axis=1), tasks.starts, atol=4 * START_SPREAD / np.sqrt(4000))
    assert np.allclose(done.states[:, :, 0].std(axis=1), START_SPREAD, rtol=0.05)
    correlation = np.corrcoef(done.actions[..., 0].reshape(-1, 5).T) - np.eye(5)
    assert np.abs(correlation).max() < 0.05, "noise is fresh at every step"


@every_system
def test_states_out_of_range_are_clipped_or_wrapped(system):
    wild = np.random.default_rng(4).uniform(-40, 40, (200, len(system.state)))
    kept = wild.copy()
    system.constrain(kept)
    for i, quantity in enumerate(system.state):
        if quantity.unit == "rad":
            assert (kept[:, i] >= -np.pi).all() and (kept[:, i] <= np.pi).all()
            assert np.allclose(np.exp(1j * kept[:, i]), np.exp(1j * wild[:, i])), "the same angle"
        else:
            limit = np.abs(kept[:, i]).max()
            assert np.array_equal(kept[:, i], np.clip(wild[:, i], -limit, limit))
    unstable = np.full((4, system.policy_size), 500.0)
    states = roll_out(some_tasks(system), unstable, steps=30).states
    again = states.copy()
    system.constrain(again)
    assert np.isfinite(states).all() and np.allclose(again[..., 1:, :], states[..., 1:, :])


# ---------------------------------------------------------------------------------------- rewards, tasks, descriptors

def test_rewards_by_hand():
    states, actions = np.array([[3.0, 4.0], [0.0, 0.0], [-5.0, 12.0]]), np.array([[0.0, 2.0], [3.0, 4.0], [0.0, 0.0]])
    assert reward(replace(BICYCLE, action_cost=0.0), states, actions).tolist() == [-5, 0, -13]
    assert reward(replace(BICYCLE, action_cost=1.0), states, actions).tolist() == [-7, -5, -13]
    assert reward(replace(BICYCLE, action_cost=0.5), states, actions).tolist() == [-6, -2.5, -13]


@every_system
@pytest.mark.parametrize("cost", [0.0, 2.0])
def test_a_step_is_rewarded_by_the_state_it_leads_to(system, cost):
    done = roll_out(some_tasks(replace(system, action_cost=cost)), noise=0.4)
    expected = -np.sqrt((done.states[:, :, 1:] ** 2).sum(-1)) - cost * np.sqrt((done.actions**2).sum(-1))
    assert np.allclose(done.rewards, expected, rtol=1e-12)


def test_mean_reward_by_hand():
    rewards = np.array([[[-1.0, -2.0], [-3.0, -6.0]], [[0.0, 0.0], [0.0, -4.0]]])
    assert Trajectories(None, None, rewards).mean_reward().tolist() == [-3, -1]


@every_system
def test_descriptors_are_standard_deviations_from_the_middle_and_a_one(system):
    low, high = system.ranges
    tasks = Tasks(system, np.stack([(low + high) / 2, low, high]), np.zeros((3, len(system.state))))
    assert np.allclose(tasks.descriptors[:, :-1], np.outer([0, -1, 1], np.full(len(low), np.sqrt(3))))
    assert tasks.descriptors[:, -1].tolist() == [1, 1, 1]
    many = draw_tasks(system, 4000, np.random.default_rng(5))
    assert np.allclose(many.descriptors[:, :-1].std(axis=0), 1, rtol=0.05)
    assert np.array_equal(many[7].descriptors[0], many.descriptors[7]), "a task's features are its own"


@every_system
def test_drawn_tasks_fill_their_ranges_and_repeat_with_their_seed(system):
    tasks, again = (draw_tasks(system, 500, np.random.default_rng(6)) for _ in range(2))
    low, high = system.ranges
    place = (tasks.parameters - low) / (high - low)
    assert place.min() >= 0 and place.max() <= 1 and (np.ptp(place, axis=0) > 0.95).all()
    assert np.array_equal(tasks.parameters, again.parameters) and np.array_equal(tasks.starts, again.starts)
    assert tasks.starts.shape == (500, len(system.state)) and len(np.unique(tasks.starts[:, 0])) == 500
    chosen = tasks[[3, 1]]
    assert len(chosen) == 2 and np.array_equal(chosen.starts, tasks.starts[[3, 1]])


@every_system
def test_every_quantity_has_a_name_and_a_unit(system):
    for quantity in (*system.parameters, *system.state, *system.actions):
        assert quantity.name and quantity.unit
    assert len({quantity.name for quantity in system.parameters}) == len(system.parameters)
    assert (system.ranges[0] > 0).all() and (system.ranges[0] < system.ranges[1]).all()


# -------------------------------------------------------------------------------------------------------- bad input

@pytest.mark.parametrize("value", [0.0, -1.0, np.nan, np.inf])
def test_a_parameter_that_cannot_be_is_named_with_its_unit(value):
    parameters = np.array([[1.0, 0.1, 0.5, 0.1], [1.0, value, 0.5, 0.1]])
    with pytest.raises(ValueError, match=r"^cart-pole: pole mass \[kg\] must be positive"):
        Tasks(CART_POLE, parameters, np.zeros((2, 4)))


@pytest.mark.parametrize(("shape", "count"), [((3, 4), 4), ((4, 5), 4), ((4,), 4), ((4, 4), 3)])
def test_policies_and_generators_that_do_not_fit_are_refused(shape, count):
    with pytest.raises(ValueError, match=r"^cart-pole: 4 tasks need policies \(4, 4\) and 4 generators"):
        some_tasks(CART_POLE).roll_out(np.zeros(shape), 2, generators(count), 0.1)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_policy_that_is_not_finite_is_refused(value):
    policies = np.zeros((4, 4))
    policies[2, 1] = value
    with pytest.raises(ValueError, match="^cart-pole: a policy has parameters that are not finite"):
        roll_out(some_tasks(CART_POLE), policies)
