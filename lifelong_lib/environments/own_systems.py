"""A dynamical system of your own: does it keep what `Tasks.roll_out` relies on?"""

import numpy as np

from lifelong_lib.environments.dynamical_systems import System, draw_tasks

AXES = "states are (T, n, d_x) and actions (T, n, d_a), so write parameters.T[:, :, None], of (T, 1) each"


def check_system(system: System) -> None:
    """Try a system on three tasks; ValueError, with what is wrong, unless it fits."""
    def need(right, what):
        if not right:
            raise ValueError(f"{system.name}: {what}")

    for name, unit, low, high in system.parameters:
        need(0 < low < high < np.inf, f"{name} [{unit}] needs a range 0 < low < high, not {low:g} to {high:g}")
    rng, shape = np.random.default_rng(0), (3, 2, len(system.state))
    tasks, actions = draw_tasks(system, 3, rng), rng.standard_normal((3, 2, len(system.actions)))
    need(tasks.starts.shape == shape[::2], f"draw_start gives {tasks.starts.shape}, not (tasks, d_x) = {shape[::2]}")
    states = np.repeat(tasks.starts[:, None], 2, axis=1)
    given = states.copy(), actions.copy()
    try:
        after = system.dynamics(tasks.parameters, system.step_seconds)(states, actions)
        alone = system.dynamics(tasks.parameters[:1], system.step_seconds)(states[:1], actions[:1])
    except (ValueError, IndexError) as error:
        raise ValueError(f"{system.name}: dynamics fails ({error}): {AXES}") from error
    need(np.shape(after) == shape, f"dynamics gives {np.shape(after)} for states {shape}: {AXES}")
    need(np.isfinite(after).all(), "dynamics gives numbers that are not finite")
    same = np.array_equal(states, given[0]) and np.array_equal(actions, given[1])
    need(same, "dynamics writes into the states or actions that it is given: return new ones")
    need(np.allclose(after[:1], alone), "a task moves otherwise when others share its batch")
    system.constrain(after)
    kept = after.copy()
    system.constrain(kept)
    need(np.isfinite(after).all() and np.allclose(after, kept), "constrain changes states that it has constrained")
