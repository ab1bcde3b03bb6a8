"""Policy search by finite differences, for one task at a time (thesis section 3.1.1).

A task is a function ``returns(policies (m, d)) -> (m,)`` that tries each policy in one roll-out.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from lifelong_lib.learners.policy_gradient import finite_difference_gradient


@dataclass(frozen=True)
class FiniteDifferences:
    """theta <- theta + step * gradient (equation 3.2), each from ``n`` roll-outs with perturbations up to ``size``."""

    step: float
    n: int = 21
    size: float = 0.1

    def learn(self, returns: Callable, policy: np.ndarray, iterations: int, rng: np.random.Generator):
        """Return policies (iterations + 1, d) and their returns (iterations + 1,), entry i after i updates.

        The return of an iteration's policy is that of its unperturbed roll-out.
        """
        history, curve = [np.asarray(policy, float)], []

        def noted(policies):
            found = returns(policies)
            curve.append(found[0])
            return found

        for _ in range(iterations):
            gradient = finite_difference_gradient(noted, history[-1], self.n, self.size, rng)
            history.append(history[-1] + self.step * gradient)
        noted(history[-1][None])
        return np.stack(history), np.array(curve)


def finite_difference_hessian(returns: Callable, policy: np.ndarray, size: float) -> np.ndarray:
    """Second derivatives (d, d) of the return at a policy (d,), by d^2 + d + 1 roll-outs ``size`` apart."""
    d = len(policy)
    first, second = np.tril_indices(d)
    ways = size * (np.eye(d)[first] + np.eye(d)[second] * (first != second)[:, None])
    there, back = np.split(returns(policy + np.concatenate([ways, -ways])), 2)
    bend = np.zeros((d, d))
    bend[first, second] = there + back - 2 * returns(policy[None])[0]  # of e_i + e_j, and of e_i on the diagonal
    single = np.diag(bend)
    mixed = (bend - np.diag(single) - np.tril(single[:, None] + single, -1)) / 2
    return (np.diag(single) + mixed + mixed.T) / size**2
