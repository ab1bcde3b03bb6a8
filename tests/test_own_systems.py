"""A system of one's own: what fits passes, and whatever a roll-out would stumble over is one line."""

from dataclasses import replace

import numpy as np
import pytest
from notebook_functions import load

from lifelong_lib.environments.dynamical_systems import SYSTEMS, Quantity, draw_tasks
from lifelong_lib.environments.own_systems import check_system

SPRING = SYSTEMS["spring-mass-damper"]


@pytest.mark.parametrize("system", SYSTEMS.values(), ids=SYSTEMS)
def test_the_systems_of_the_thesis_fit(system):
    check_system(system)


def test_the_ship_of_the_notebook_fits_and_turns_as_its_equation_says():
    """T r' + r = K delta has the closed form r = K delta (1 - exp(-t / T)) under a constant rudder."""
    ship = load(4, "SHIP", "ship", "off_course", SYSTEMS=SYSTEMS, Quantity=Quantity, np=np).SHIP
    check_system(ship)
    parameters, seconds, rudder = np.array([[0.2, 10.0], [0.1, 5.0]]), 0.01, 0.3
    advance = ship.dynamics(parameters, seconds)
    states = np.zeros((2, 1, 2))
    for _ in range(1000):
        states = advance(states, np.full((2, 1, 1), rudder))
    gain, lag, time = *parameters.T, 10.0
    np.testing.assert_allclose(states[:, 0, 1], gain * rudder * (1 - np.exp(-time / lag)), rtol=1e-3)
    heading = gain * rudder * (time - lag * (1 - np.exp(-time / lag)))
    np.testing.assert_allclose(states[:, 0, 0], heading, rtol=2e-3)
    hard = ship.dynamics(parameters, 1.0)(np.zeros((2, 1, 2)), np.full((2, 1, 1), 50.0))
    np.testing.assert_allclose(hard[:, 0, 1], gain * 0.6 / lag)  # the rudder has a stop
    assert np.isfinite(draw_tasks(ship, 5, np.random.default_rng(0)).descriptors).all()


def dynamics(step):
    """Dynamics whose step(mass (T, 1), states, actions) is given."""
    return lambda parameters, seconds: lambda x, u: step(parameters.T[:, :, None][0], x, u)


def in_place(mass, x, u):
    x += u / mass[..., None]
    return x


def drifting(states):
    states += 1.0


@pytest.mark.parametrize(("changes", "said"), [
    ({"parameters": (Quantity("mass", "kg", 2, 1),)}, r"mass \[kg\] needs a range 0 < low < high, not 2 to 1"),
    ({"parameters": (Quantity("mass", "kg"),)}, r"mass \[kg\] needs a range 0 < low < high, not -inf to inf"),
    ({"draw_start": lambda rng, size: rng.random((size, 3))}, r"draw_start gives \(3, 3\), not .* = \(3, 2\)"),
    ({"dynamics": lambda parameters, seconds: lambda x, u: x[..., 0] * parameters[:, 0]},
     r"dynamics fails \(operands .*\): states are .* so write parameters.T\[:, :, None\]"),
    ({"dynamics": dynamics(lambda mass, x, u: x[..., :1])}, r"dynamics gives \(3, 2, 1\) for states \(3, 2, 2\)"),
    ({"dynamics": dynamics(lambda mass, x, u: x[..., [0, 0, 0]][..., 7])}, r"dynamics fails \(index 7 is out"),
    ({"dynamics": dynamics(lambda mass, x, u: x * np.nan)}, "dynamics gives numbers that are not finite"),
    ({"dynamics": dynamics(in_place)}, "dynamics writes into the states or actions that it is given"),
    ({"dynamics": dynamics(lambda mass, x, u: x + mass.mean())}, "a task moves otherwise when others share its batch"),
    ({"constrain": drifting}, "constrain changes states that it has constrained"),
])  # fmt: skip
def test_what_does_not_fit_is_one_line_that_names_the_system(changes, said):
    with pytest.raises(ValueError, match=f"^spring-mass-damper: {said}") as caught:
        check_system(replace(SPRING, **changes))
    assert "\n" not in str(caught.value)
