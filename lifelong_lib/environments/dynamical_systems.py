"""Four families of dynamical systems, batched over tasks and roll-outs (thesis sections 4.5.1, 4.5.6).

A *system* is a family (all cart-poles); a *task* is one member of it with its own physical parameters, which are also
its descriptor. Task ranges stand here and nowhere else. Sources: the lab's public MATLAB systems for the spring-mass-
damper, cart-pole and bicycle (the second-order bicycle is that of Astrom, Klein and Lennartsson 2005), Bouabdallah and
Siegwart 2005 for the attitude of a quadrotor. What we changed stands in DEVIATIONS.md.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.linalg import expm

GRAVITY = 9.81  # [m/s^2]
BICYCLE_SPEED = 20.0  # [m/s] forward speed, constant
START_SPREAD = 0.01  # standard deviation of the start state about the task's own start, each coordinate in its unit


class Quantity(NamedTuple):
    """A named physical quantity with its unit and, for task parameters, the range tasks are drawn from."""

    name: str
    unit: str
    low: float = -np.inf
    high: float = np.inf


class Trajectories(NamedTuple):
    """Roll-outs of T tasks, n each, over H steps (for one task the leading axis is dropped)."""

    states: np.ndarray  # (T, n, H + 1, d_x)
    actions: np.ndarray  # (T, n, H, d_a)
    rewards: np.ndarray  # (T, n, H)

    def mean_reward(self) -> np.ndarray:
        """Reward per step, averaged over steps and roll-outs: (T,)."""
        return self.rewards.mean(axis=(-1, -2))


@dataclass(frozen=True)
class System:
    """A family of tasks that share state, actions and equations of motion.

    ``dynamics(parameters (T, p), seconds)`` returns a function of states (T, n, d_x) and actions (T, n, d_a) that gives
    the states ``seconds`` later; ``constrain`` keeps states in range in place; ``draw_start(rng, size)`` draws the
    start state of each of ``size`` tasks; ``action_cost`` is the weight of the action's norm in the reward (0 in the
    thesis, 1 in the lab's code).
    """

    name: str
    parameters: tuple[Quantity, ...]
    state: tuple[Quantity, ...]
    actions: tuple[Quantity, ...]
    step_seconds: float
    dynamics: Callable
    constrain: Callable
    draw_start: Callable
    action_cost: float = 0.0

    @property
    def ranges(self) -> np.ndarray:
        """Lower and upper ends of the task parameters' ranges: (2, p)."""
        return np.array([[quantity.low, quantity.high] for quantity in self.parameters]).T

    @property
    def policy_size(self) -> int:
        """Number of parameters d of a linear policy: one block of d_x gains for each action."""
        return len(self.state) * len(self.actions)


@dataclass(frozen=True)
class Tasks:
    """T tasks of one system: ``parameters`` (T, p) in the units of the system, ``starts`` (T, d_x)."""

    system: System
    parameters: np.ndarray
    starts: np.ndarray

    def __post_init__(self):
        for value, quantity in zip(self.parameters.T, self.system.parameters, strict=True):
            if not (np.isfinite(value).all() and (value > 0).all()):
                raise ValueError(f"{self.system.name}: {quantity.name} [{quantity.unit}] must be positive, got {value}")

    def __len__(self):
        return len(self.parameters)

    def __getitem__(self, chosen) -> "Tasks":
        chosen = np.atleast_1d(chosen)
        return Tasks(self.system, self.parameters[chosen], self.starts[chosen])

    @property
    def descriptors(self) -> np.ndarray:
        """Features phi(m) (T, p + 1): each parameter in standard deviations from the middle of its range, and a 1.

        The ranges are known beforehand, so a task's features do not depend on which other tasks there are.
        """
        low, high = self.system.ranges
        spread = (high - low) / np.sqrt(12)  # standard deviation of a uniform draw
        return np.column_stack([(self.parameters - (low + high) / 2) / spread, np.ones(len(self))])

    def roll_out(self, policies: np.ndarray, n: int, rngs: Sequence, noise: float, steps: int = 100) -> Trajectories:
        """Return ``n`` roll-outs of every task under its linear Gaussian policy, a = theta x + noise.

        ``policies``: (T, d), one row a task, gains in blocks of d_x for each action; ``rngs``: one generator a task, so
        that a task's roll-outs do not depend on which other tasks share the batch; ``noise``: standard deviation of the
        exploration noise of each action. The reward of a step is minus the norm of the state it leads to, the distance
        to the goal, less the norm of the action where actions have a cost. Raises ValueError for shapes that do not
        fit and policies that are not finite.
        """
        system, T = self.system, len(self)
        d_x, d_a = len(system.state), len(system.actions)
        if policies.shape != (T, system.policy_size) or len(rngs) != T:
            raise ValueError(f"{system.name}: {T} tasks need policies ({T}, {system.policy_size}) and {T} generators")
        if not np.isfinite(policies).all():
            raise ValueError(f"{system.name}: a policy has parameters that are not finite; was the step too large?")
        gains = policies.reshape(T, d_a, d_x).swapaxes(1, 2)
        advance = system.dynamics(self.parameters, system.step_seconds)
        states, actions = np.empty((steps + 1, T, n, d_x)), np.empty((steps, T, n, d_a))
        for t, rng in enumerate(rngs):
            states[0, t] = self.starts[t] + START_SPREAD * rng.standard_normal((n, d_x))
            actions[:, t] = noise * rng.standard_normal((steps, n, d_a))
        for h in range(steps):
            actions[h] += states[h] @ gains
            states[h + 1] = advance(states[h], actions[h])
            system.constrain(states[h + 1])
        rewards = reward(system, states[1:], actions)
        return Trajectories(states.transpose(1, 2, 0, 3), actions.transpose(1, 2, 0, 3), rewards.transpose(1, 2, 0))


def reward(system: System, states: np.ndarray, actions: np.ndarray) -> np.ndarray:
    """Return minus the distance of ``states`` (..., d_x) to the goal, the origin, less the cost of ``actions``."""
    distance = -np.linalg.norm(states, axis=-1)
    return distance - system.action_cost * np.linalg.norm(actions, axis=-1) if system.action_cost else distance


def draw_tasks(system: System, count: int, rng: np.random.Generator) -> Tasks:
    """Return ``count`` tasks with parameters uniform in the system's ranges and a start state of their own."""
    low, high = system.ranges
    return Tasks(system, rng.uniform(low, high, (count, len(low))), system.draw_start(rng, count))


def _linear(matrices: Callable) -> Callable:
    """Turn ``matrices(parameters) -> (A, B)`` into exact steps of x' = A x + B u, the action held (no Euler error)."""

    def steps(parameters, seconds):
        A, B = matrices(*parameters.T)
        d_x, d_a = B.shape[1:]
        block = np.zeros((len(parameters), d_x + d_a, d_x + d_a))
        block[:, :d_x] = np.concatenate([A, B], axis=2) * seconds
        held = expm(block)[:, :d_x].swapaxes(1, 2)
        return lambda states, actions: states @ held[:, :d_x] + actions @ held[:, d_x:]

    return steps


def _stack(rows: list[list]) -> np.ndarray:
    """Matrices (T, r, c) from rows of numbers and arrays (T,)."""
    T = max(np.size(entry) for row in rows for entry in row)
    return np.stack([np.stack([np.broadcast_to(entry, T) for entry in row], -1) for row in rows], 1).astype(float)


def _spring_mass_damper(mass, damping, stiffness):
    return _stack([[0, 1], [-stiffness / mass, -damping / mass]]), _stack([[0 * mass], [1 / mass]])


def _cart_pole(cart, pole, length, friction):
    """The cart-pole, linear about the upright; the pole is a uniform rod of half-length ``length``."""
    inertia = pole * length**2 / 3
    D = inertia * (cart + pole) + cart * pole * length**2
    A = _stack([
        [0, 1, 0, 0],
        [0, -(inertia + pole * length**2) * friction / D, pole**2 * GRAVITY * length**2 / D, 0],
        [0, 0, 0, 1],
        [0, -pole * length * friction / D, pole * GRAVITY * length * (cart + pole) / D, 0],
    ])  # fmt: skip
    return A, _stack([[0], [(inertia + pole * length**2) / D], [0], [pole * length / D]])


def _bicycle(mass, x, z, wheelbase, trail, head_angle):
    """The second-order bicycle with its front fork; tilt is driven by the handlebar torque and the torque's rate."""
    V, sin, cos = BICYCLE_SPEED, np.sin(head_angle), np.cos(head_angle)
    J, D = mass * z**2, mass * x * z
    q = V**2 * sin - wheelbase * GRAVITY * cos
    tilt = -mass * GRAVITY**2 * (wheelbase * z * cos - x * trail * sin) / q
    torque = wheelbase * (V**2 * z - x * trail * GRAVITY) / (x * trail * q)
    torque_rate = D * V * wheelbase / (x * trail * mass * q)
    return _stack([[0, 1], [tilt / J, -D * V * GRAVITY / q / J]]), _stack([[0 * J, 0], [torque / J, torque_rate / J]])


def _quadrotor(parameters, seconds):
    """Attitude of Bouabdallah and Siegwart's quadrotor, by Euler's rule; two rotor force differences and a torque."""
    Ixx, Iyy, Izz, arm = parameters.T[:, :, None]

    def derivative(states, actions):
        p, q, r = states[..., 3], states[..., 4], states[..., 5]
        change = np.empty_like(states)
        change[..., :3] = states[..., 3:]
        change[..., 3] = q * r * (Iyy - Izz) / Ixx + arm / Ixx * actions[..., 0]
        change[..., 4] = p * r * (Izz - Ixx) / Iyy + arm / Iyy * actions[..., 1]
        change[..., 5] = p * q * (Ixx - Iyy) / Izz + actions[..., 2] / Izz
        return change

    return lambda states, actions: states + seconds * derivative(states, actions)


def _limits(clipped: dict[int, float], wrapped: Sequence[int]) -> Callable:
    """Keep coordinates within +-limit and angles within [-pi, pi), in place."""

    def constrain(states):
        for i, limit in clipped.items():
            np.clip(states[..., i], -limit, limit, out=states[..., i])
        for i in wrapped:
            states[..., i] = (states[..., i] + np.pi) % (2 * np.pi) - np.pi

    return constrain


SPRING_MASS_DAMPER = System(
    name="spring-mass-damper",
    parameters=(
        Quantity("mass", "kg", 0.5, 3.0),
        Quantity("damping", "N s/m", 0.01, 0.2),
        Quantity("stiffness", "N/m", 1, 20),
    ),
    state=(Quantity("position", "m"), Quantity("velocity", "m/s")),
    actions=(Quantity("force", "N"),),
    step_seconds=0.2,
    dynamics=_linear(_spring_mass_damper),
    constrain=_limits({0: 20.0, 1: 20.0}, ()),
    draw_start=lambda rng, size: rng.random((size, 2)),
)
CART_POLE = System(
    name="cart-pole",
    parameters=(
        Quantity("cart mass", "kg", 0.2, 2.0),
        Quantity("pole mass", "kg", 0.1, 0.2),
        Quantity("pole length", "m", 0.4, 0.6),
        Quantity("damping", "N s/m", 0.01, 0.2),
    ),
    state=(
        Quantity("position", "m"),
        Quantity("velocity", "m/s"),
        Quantity("angle", "rad"),
        Quantity("angular rate", "rad/s"),
    ),
    actions=(Quantity("force", "N"),),
    step_seconds=0.02,
    dynamics=_linear(_cart_pole),
    constrain=_limits({0: 5.0, 1: 10.0, 3: 15.0}, (2,)),
    draw_start=lambda rng, size: np.pi / 8 * rng.random((size, 4)),
)
BICYCLE = System(
    name="bicycle",
    parameters=(
        Quantity("mass", "kg", 10, 14),
        Quantity("x of the centre of mass", "m", 0.2, 0.6),
        Quantity("z of the centre of mass", "m", 0.4, 0.8),
        Quantity("wheelbase", "m", 1, 2),
        Quantity("trail", "m", 0.05, 0.1),
        Quantity("head angle", "rad", np.pi / 3, np.pi * 4 / 9),
    ),
    state=(Quantity("tilt", "rad"), Quantity("tilt rate", "rad/s")),
    actions=(Quantity("handlebar torque", "N m"), Quantity("torque rate", "N m/s")),
    step_seconds=0.05,
    dynamics=_linear(_bicycle),
    constrain=_limits({1: 15.0}, (0,)),
    draw_start=lambda rng, size: rng.random((size, 2)),
)
QUADROTOR = System(
    name="quadrotor",
    parameters=(
        Quantity("inertia about x", "kg m^2", 1.5e-3, 1.2e-2),
        Quantity("inertia about y", "kg m^2", 1.5e-3, 1.2e-2),
        Quantity("inertia about z", "kg m^2", 4e-3, 3e-2),
        Quantity("arm length", "m", 0.2, 0.3),
    ),
    state=tuple(Quantity(name, unit) for unit in ("rad", "rad/s") for name in ("roll", "pitch", "yaw")),
    actions=(Quantity("roll force", "N"), Quantity("pitch force", "N"), Quantity("yaw torque", "N m")),
    step_seconds=0.05,
    dynamics=_quadrotor,
    constrain=_limits({3: 20.0, 4: 20.0, 5: 20.0}, (0, 1, 2)),
    draw_start=lambda rng, size: rng.random((size, 6)),
)
SYSTEMS = {system.name: system for system in (SPRING_MASS_DAMPER, CART_POLE, BICYCLE, QUADROTOR)}
