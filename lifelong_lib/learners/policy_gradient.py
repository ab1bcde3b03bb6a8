"""Policy-gradient learners for linear Gaussian policies, batched over tasks (thesis sections 2.1.2, 3.2, 4.2).

Every function takes roll-outs with leading task axis T (see ``states`` (T, n, H + 1, d_x), ``actions`` (T, n, H, d_a),
``rewards`` (T, n, H)) and policies (T, d), d = d_a d_x with one block of d_x gains for each action. Gradients point
towards more reward. ``noise`` is the standard deviation of the exploration noise.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np


def discounted_returns(rewards: np.ndarray, discount: float) -> np.ndarray:
    """R(tau) = sum_h discount^h r_h: (T, n)."""
    return rewards @ discount ** np.arange(rewards.shape[-1])


def scores(trajectories, policies: np.ndarray, noise: float, discount: float = 1.0) -> np.ndarray:
    """Return sum_h discount^h grad log pi(a_h | x_h), the score of each roll-out: (T, n, d)."""
    states = trajectories.states[:, :, :-1]
    T, n, H, d_x = states.shape
    gains = policies.reshape(T, 1, -1, d_x)
    residuals = trajectories.actions - states @ gains.swapaxes(-1, -2)
    weights = (discount ** np.arange(H) / noise**2)[:, None]
    return ((weights * residuals).swapaxes(-1, -2) @ states).reshape(T, n, -1)


def advantages(trajectories, discount: float, standardise: bool = False) -> np.ndarray:
    """Return each roll-out's return minus the task's mean return, the baseline: (T, n).

    ``standardise`` divides by the spread of the returns, so that one step size serves tasks whose returns differ by
    orders of magnitude. The direction of a gradient stays the same.
    """
    returns = discounted_returns(trajectories.rewards, discount)
    returns -= returns.mean(axis=1, keepdims=True)
    return returns / np.maximum(returns.std(axis=1, keepdims=True), np.finfo(float).tiny) if standardise else returns


def reinforce_gradient(
    trajectories, policies: np.ndarray, noise: float, discount: float = 1.0, standardise: bool = False
) -> np.ndarray:
    """Episodic REINFORCE with the mean return as baseline (Williams 1992): (T, d)."""
    gains = advantages(trajectories, discount, standardise)
    return (gains[:, None] @ scores(trajectories, policies, noise))[:, 0] / gains.shape[1]


def natural_gradient(
    trajectories, policies: np.ndarray, noise: float, discount: float = 0.9, standardise: bool = False
) -> np.ndarray:
    """Episodic natural actor-critic (Peters and Schaal 2008): (T, d).

    Least squares of the returns on the roll-outs' scores and a constant; the slope is the natural gradient. Columns are
    scaled by their spread first, as states of different units would make the system ill-conditioned.
    """
    features = scores(trajectories, policies, noise, discount)
    spread = features.std(axis=1, keepdims=True)
    spread[spread == 0] = 1.0
    design = np.concatenate([features / spread, np.ones_like(features[:, :, :1])], axis=2)
    slope = np.linalg.pinv(design) @ advantages(trajectories, discount, standardise)[..., None]
    return slope[:, :-1, 0] / spread[:, 0]


def power_step(trajectories, policies: np.ndarray, noise: float, discount: float = 1.0) -> np.ndarray:
    """Policy change of PoWER (Kober and Peters 2009), a reward-weighted regression of the noise on the state: (T, d).

    PoWER needs rewards that are not negative, so each task's rewards are shifted by their smallest value.
    """
    T, n, H, d_x = trajectories.states[:, :, :-1].shape
    rewards = trajectories.rewards - trajectories.rewards.min(axis=(1, 2), keepdims=True)
    weighted = rewards * discount ** np.arange(H)
    to_go = weighted[..., ::-1].cumsum(axis=-1)[..., ::-1].reshape(T, -1, 1)
    states = trajectories.states[:, :, :-1].reshape(T, n * H, d_x)
    actions = trajectories.actions.reshape(T, n * H, -1)
    residuals = actions - states @ policies.reshape(T, -1, d_x).swapaxes(1, 2)
    moments = (states * to_go).swapaxes(1, 2) @ states
    change = np.linalg.pinv(moments) @ ((states * to_go).swapaxes(1, 2) @ residuals)
    return change.swapaxes(1, 2).reshape(T, -1)


def finite_difference_gradient(evaluate: Callable, policy: np.ndarray, n: int, size: float, rng: np.random.Generator):
    """Central finite differences in random directions (thesis equations 3.1-3.3): gradient (d,).

    ``evaluate(policies (m, d)) -> returns (m,)`` runs the mirrored pairs theta +- delta, delta uniform in
    [-size, size]; ``n`` roll-outs make (n - 1) // 2 pairs and one at theta itself, as in the authors' code. With fewer
    pairs than parameters the pseudo-inverse gives the gradient of least norm.
    """
    if n < 3:
        raise ValueError(f"finite differences need at least 3 roll-outs (one pair and the policy itself), got {n}")
    deltas = rng.uniform(-size, size, ((n - 1) // 2, policy.size))
    returns = evaluate(np.concatenate([policy[None], policy + deltas, policy - deltas]))
    forward, backward = np.split(returns[1:], 2)
    return np.linalg.pinv(deltas) @ (forward - backward) / 2


def reward_weighted_hessian(trajectories, noise: float) -> np.ndarray:
    """Second derivative Gamma of the loss of episodic REINFORCE and eNAC (thesis section 4.2): (T, d, d).

    The mean over roll-outs of -R(tau) sum_h x_h x_h^T / noise^2, one equal block an action: the Hessian of the
    reward-weighted log-likelihood, which bounds the log of the expected return (section 2.1.2). Rewards here are
    negative, so it is positive semi-definite.
    """
    states = trajectories.states[:, :, :-1]
    T, n, H, d_x = states.shape
    weights = -trajectories.rewards.sum(axis=2)[:, :, None, None] / (n * noise**2)
    weighted = (states * weights).reshape(T, n * H, d_x)
    block = weighted.swapaxes(1, 2) @ states.reshape(T, n * H, d_x)
    return np.kron(np.eye(trajectories.actions.shape[-1])[None], block)


def generators(seed: np.random.SeedSequence, count: int) -> list[np.random.Generator]:
    """Return ``count`` independent generators, the next children of ``seed``."""
    return [np.random.default_rng(child) for child in seed.spawn(count)]


@dataclass(frozen=True)
class PolicyGradient:
    """A single-task learner: theta <- theta + step * gradient, each from ``n`` fresh roll-outs.

    ``gradient(trajectories, policies, noise)`` is one of the functions above; ``noise`` the exploration's standard
    deviation; ``iterations`` the length of one learning session.
    """

    gradient: Callable
    step: float
    noise: float
    n: int = 100
    iterations: int = 30

    def learn(self, tasks, policies: np.ndarray, rngs: list, iterations: int | None = None):
        """Return policies (iterations + 1, T, d) and rewards per step (iterations + 1, T), row i after i updates.

        ``tasks`` has ``roll_out(policies, n, rngs, noise)``; ``policies`` (T, d) is where learning starts.
        """
        iterations = self.iterations if iterations is None else iterations
        history, rewards = [policies], []
        for iteration in range(iterations + 1):
            trajectories = tasks.roll_out(history[-1], self.n, rngs, self.noise)
            rewards.append(trajectories.mean_reward())
            if iteration < iterations:
                history.append(history[-1] + self.step * self.gradient(trajectories, history[-1], self.noise))
        return np.stack(history), np.stack(rewards)

    def evaluate(self, tasks, policies: np.ndarray, rngs: list) -> np.ndarray:
        """Return the reward per step (T,) of ``n`` fresh roll-outs of each policy."""
        return tasks.roll_out(policies, self.n, rngs, self.noise).mean_reward()

    def curvature(self, tasks, policies: np.ndarray, rngs: list) -> np.ndarray:
        """Return Gamma (T, d, d) at ``policies``, scaled to mean diagonal 1 and averaged with I.

        Returns of different tasks have no common scale, so that the worst policies, with the largest states, would
        decide the dictionary alone, and few of them leave the direction of their fall, so that the others would go
        without any weight.
        """
        hessians = reward_weighted_hessian(tasks.roll_out(policies, self.n, rngs, self.noise), self.noise)
        scale = np.trace(hessians, axis1=1, axis2=2)[:, None, None] / hessians.shape[1]
        return (hessians / scale + np.eye(hessians.shape[1])) / 2

    def sessions(self, tasks, policies: np.ndarray, order: list[int], rngs: list) -> list[tuple]:
        """Learn tasks in the ``order`` they are met and return (task, alpha (d,), Gamma (d, d)) for each meeting.

        A task met again goes on from its own policy. As a single-task learner owes nothing to other tasks, the v-th
        meetings of all tasks run as one batch; generators of their own make that equal to one after another.
        """
        current, met = policies.copy(), np.bincount(order, minlength=len(policies))
        learned = {}
        for visit in range(1, met.max() + 1):
            chosen = np.flatnonzero(met >= visit)
            batch, own = tasks[chosen], [rngs[t] for t in chosen]
            current[chosen] = self.learn(batch, current[chosen], own)[0][-1]
            for t, hessian in zip(chosen, self.curvature(batch, current[chosen], own), strict=True):
                learned[t, visit] = current[t].copy(), hessian
        visits = [order[: i + 1].count(t) for i, t in enumerate(order)]
        return [(t, *learned[t, visit]) for t, visit in zip(order, visits, strict=True)]


def order_of_tasks(count: int, rng: np.random.Generator) -> list[int]:
    """Return tasks drawn with repetition until each of ``count`` was seen (thesis section 4.5.2)."""
    order: list[int] = []
    while len(set(order)) < count:
        order.append(int(rng.integers(count)))
    return order
