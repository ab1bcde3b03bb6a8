"""Finite differences against closed forms."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lifelong_lib.learners.finite_differences import FiniteDifferences, finite_difference_hessian


def quadratic(seed, d):
    """A bowl upside down: returns (m,) of policies (m, d), its Hessian and its top."""
    rng = np.random.default_rng(seed)
    root, top = rng.normal(size=(d, d)), rng.normal(size=d)
    hessian = -(root @ root.T + np.eye(d))
    return lambda policies: np.einsum("md,de,me->m", policies - top, hessian, policies - top) / 2, hessian, top


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 1000), st.integers(1, 9), st.floats(1e-3, 1))
def test_hessian_of_a_quadratic_is_exact(seed, d, size):
    returns, hessian, _ = quadratic(seed, d)
    tried = []
    policy = np.random.default_rng(seed).normal(size=d)
    found = finite_difference_hessian(lambda p: tried.append(len(p)) or returns(p), policy, size)
    assert found == pytest.approx(hessian, rel=1e-4, abs=1e-4 / size)
    assert sum(tried) == d**2 + d + 1 and (found == found.T).all()


def test_learning_climbs_a_bowl_to_its_top():
    returns, hessian, top = quadratic(1, 4)
    step = 0.5 / np.abs(np.linalg.eigvalsh(hessian)).max()
    learner = FiniteDifferences(step, n=21)
    policies, curve = learner.learn(returns, np.zeros(4), 400, np.random.default_rng(0))
    assert policies.shape == (401, 4) and curve.shape == (401,)
    assert policies[-1] == pytest.approx(top, abs=1e-3)
    assert curve == pytest.approx(returns(policies)) and (np.diff(curve) > -1e-12).all()


def test_one_step_is_equation_3_2():
    slope = np.array([1.0, -2.0, 3.0])
    policies, curve = FiniteDifferences(0.1, n=9).learn(lambda p: p @ slope, np.ones(3), 1, np.random.default_rng(0))
    assert policies[1] == pytest.approx(1 + 0.1 * slope) and curve == pytest.approx([2, policies[1] @ slope])


def test_the_same_seed_gives_the_same_bytes_and_every_iteration_has_its_roll_outs():
    tried = []
    returns = quadratic(2, 3)[0]
    runs = [FiniteDifferences(0.01, n=7).learn(lambda p: tried.append(len(p)) or returns(p), np.zeros(3), 5,
                                               np.random.default_rng(4)) for _ in range(2)]  # fmt: skip
    assert runs[0][0].tobytes() == runs[1][0].tobytes()
    assert tried[:6] == [7] * 5 + [1]
