"""The bodies of the dynamical systems as polylines in metres, z upwards, x to the right of a viewer at (0, -1, 0)."""

import numpy as np
from scipy.spatial.transform import Rotation

from lifelong_lib.environments.dynamical_systems import Tasks

WALL = -2.0  # [m] where the spring is fixed; the mass rests at 0
WHEEL = 0.3  # [m] radius of the bicycle's wheels, which its equations do not have
SQUARE = np.array([[-1, 0, -1], [1, 0, -1], [1, 0, 1], [-1, 0, 1], [-1, 0, -1]])
CIRCLE = np.stack([np.cos(turn := np.linspace(0, 2 * np.pi, 25)), np.sin(turn), 0 * turn], axis=1)


def body(tasks: Tasks, index: int, states: np.ndarray) -> tuple[dict, dict]:
    """Return what to draw of task ``index`` along ``states`` (H + 1, d_x): (parts, fixed).

    ``parts``: {name: (H + 1, m, 3)}, polylines that move; ``fixed``: {name: (m, 3)}, polylines that stay. Raises
    ValueError if the states are not those of the tasks' system or not finite.
    """
    system, states = tasks.system, np.asarray(states, float)
    if states.ndim != 2 or states.shape[1] != len(system.state) or not np.isfinite(states).all():
        raise ValueError(f"{system.name}: states must be finite and (H + 1, {len(system.state)}), got {states.shape}")
    parts, reach = _BODIES[system.name](tasks.parameters[index], states)
    return parts, {"level": np.array([[-reach, 0, 0], [reach, 0, 0]])}


def _spring_mass_damper(parameters, states):
    """A zigzag from the wall to a square mass; the damper is not drawn."""
    mass = 0.15 * SQUARE + states[:, :1, None] * [1, 0, 0]
    x = WALL + np.linspace(0, 1, 14) * (mass[:, :1, 0] - WALL)
    return {"spring": np.stack([x, 0 * x, 0 * x + 0.1 * np.array([0, *(-1, 1) * 6, 0])], axis=2), "mass": mass}, 2.0


def _cart_pole(parameters, states):
    """The parameter `pole length` is the half-length of the rod; a positive angle leans to the left (minus x)."""
    foot, angle = states[:, :1, None] * [1, 0, 0], states[:, 2]
    tip = foot + 2 * parameters[2] * np.stack([-np.sin(angle), 0 * angle, np.cos(angle)], axis=1)[:, None]
    return {"cart": [0.2, 0, 0.1] * SQUARE + foot, "pole": np.concatenate([foot, tip], axis=1)}, 5.0


def _bicycle(parameters, states):
    """Seen from behind, a positive tilt to the right; steering is not part of the state, so the wheels are in line."""
    _, x, z, wheelbase, _, head_angle = parameters
    rear, front, wheel = np.array([0, 0, WHEEL]), np.array([0, wheelbase, WHEEL]), WHEEL * CIRCLE[:, [2, 0, 1]]
    head = front + z * np.array([0, -1 / np.tan(head_angle), 1])
    upright = {"rear wheel": rear + wheel, "front wheel": front + wheel, "frame": [rear, (0, x, z), head, front]}
    upright["handlebar"] = head + np.array([[-0.3, 0, 0], [0.3, 0, 0]])
    return _turned(upright, "Y", states[:, :1]), 1.0


def _quadrotor(parameters, states):
    """Two arms with a rotor at each end and a mast that shows where up is; only the attitude is simulated."""
    arm = parameters[3]
    ends = arm * np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]])
    level = {"roll axis": ends[:2], "pitch axis": ends[2:], "mast": [(0, 0, 0), (0, 0, arm / 2)]}
    level |= {f"rotor {number}": end + 0.4 * arm * CIRCLE for number, end in enumerate(ends, 1)}
    return _turned(level, "ZYX", states[:, [2, 1, 0]]), 1.5 * arm


def _turned(parts, axes, angles):
    turns = Rotation.from_euler(axes, angles).as_matrix().swapaxes(1, 2)
    return {name: np.asarray(points) @ turns for name, points in parts.items()}


_BODIES = {"spring-mass-damper": _spring_mass_damper, "cart-pole": _cart_pole,
           "bicycle": _bicycle, "quadrotor": _quadrotor}  # fmt: skip
