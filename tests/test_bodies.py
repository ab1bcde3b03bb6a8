"""Bodies keep their sizes while they move, and stand where the state says."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lifelong_lib.environments.bodies import body
from lifelong_lib.environments.dynamical_systems import SYSTEMS, Tasks

PARAMETERS = {  # of two tasks each, so that the index matters
    "spring-mass-damper": [[1, 0.1, 3], [2, 0.2, 4]],
    "cart-pole": [[1, 0.1, 0.3, 0.1], [1, 0.1, 0.7, 0.1]],
    "bicycle": [[12, 0.3, 0.5, 1, 0.1, 1.2], [12, 0.4, 0.6, 2, 0.1, np.pi / 4]],
    "quadrotor": [[0.01, 0.02, 0.03, 0.2], [0.01, 0.02, 0.03, 0.5]],
}
every_system = pytest.mark.parametrize("name", list(SYSTEMS))


def tasks_of(name):
    parameters = np.array(PARAMETERS[name], float)
    return Tasks(SYSTEMS[name], parameters, np.zeros((2, len(SYSTEMS[name].state))))


def states_of(name, seed=0, moments=7):
    return np.random.default_rng(seed).uniform(-3, 3, (moments, len(SYSTEMS[name].state)))


def lengths(points):
    """Length of each piece of the polylines (H + 1, m, 3)."""
    return np.linalg.norm(np.diff(points, axis=1), axis=2)


@every_system
def test_every_part_is_a_finite_polyline_that_moves_with_the_state(name):
    parts, fixed = body(tasks_of(name), 1, states_of(name))
    for points in parts.values():
        assert points.shape[0] == 7 and points.shape[1] >= 2 and points.shape[2] == 3 and np.isfinite(points).all()
        assert not np.array_equal(points[0], points[1])
    for line in fixed.values():
        assert line.ndim == 2 and len(line) >= 2 and line.shape[1] == 3 and np.isfinite(line).all()


@every_system
def test_nothing_but_the_spring_is_stretched(name):
    parts, _ = body(tasks_of(name), 1, states_of(name))
    for part, points in parts.items():
        stretched = np.ptp(lengths(points), axis=0).max()
        assert (stretched > 0.01) == (part == "spring"), part


@every_system
def test_the_index_chooses_the_task(name):
    tasks, states = tasks_of(name), states_of(name)
    for index in (0, 1):
        expected = body(tasks[index], 0, states)[0]
        assert all(np.array_equal(points, expected[part]) for part, points in body(tasks, index, states)[0].items())


def test_the_spring_reaches_from_a_fixed_wall_to_the_mass():
    states = np.array([[0.0, 0], [1.5, 0], [-1, 9]])
    parts, _ = body(tasks_of("spring-mass-damper"), 0, states)
    assert np.ptp(parts["spring"][:, 0], axis=0).max() == 0
    assert np.allclose(parts["mass"][:, :4].mean(axis=1), [[0, 0, 0], [1.5, 0, 0], [-1, 0, 0]])
    assert np.allclose(parts["spring"][:, -1, 0], parts["mass"][..., 0].min(axis=1))


def test_the_pole_is_a_rod_of_twice_the_half_length_and_leans_against_positive_angles():
    states = np.array([[0.0, 0, 0, 0], [2, 0, np.pi / 2, 0], [-1, 0, -np.pi / 6, 0]])
    pole = body(tasks_of("cart-pole"), 1, states)[0]["pole"]
    assert np.allclose(pole[:, 0], [[0, 0, 0], [2, 0, 0], [-1, 0, 0]])
    assert np.allclose(lengths(pole), 2 * 0.7)
    assert np.allclose(pole[:, 1], [[0, 0, 1.4], [2 - 1.4, 0, 0], [-1 + 0.7, 0, 1.4 * np.cos(np.pi / 6)]])


def test_the_pole_leans_as_its_equations_say():
    """Pushed to the right with no friction, the common centre of mass takes F / (both masses), wherever it leans."""
    tasks = tasks_of("cart-pole")
    cart, pole = tasks.parameters[0, :2]
    tiny = 1e-6
    frictionless = SYSTEMS["cart-pole"].dynamics(tasks.parameters * [1, 1, 1, 0], seconds=tiny)
    acceleration = frictionless(np.zeros((2, 1, 4)), np.ones((2, 1, 1))) / tiny
    moved = body(tasks, 0, np.array([[0, 0, 0, 0], tiny * acceleration[0, 0, [1, 1, 3, 3]]]))[0]["pole"]
    cart_change, middle_change = moved[1, 0, 0], moved[1].mean(axis=0)[0]
    assert (cart * cart_change + pole * middle_change) / tiny == pytest.approx(1, rel=1e-4)


def test_the_bicycle_tilts_about_the_line_of_its_wheels():
    parts, _ = body(tasks_of("bicycle"), 1, np.array([[0.0, 0], [np.pi / 6, 0]]))
    mass = parts["frame"][:, 1]
    assert np.allclose(mass, [[0, 0.4, 0.6], [0.6 * 0.5, 0.4, 0.6 * np.cos(np.pi / 6)]])
    assert np.allclose(parts["rear wheel"][..., 2].min(axis=1), 0, atol=1e-12)
    hubs = [parts[f"{place} wheel"][:, :-1].mean(axis=1) for place in ("rear", "front")]
    assert np.allclose(hubs[1] - hubs[0], [0, 2, 0])
    _, _, head, front = parts["frame"][0]
    assert np.allclose(head[1] - front[1], -(head[2] - front[2])), "a head angle of 45 degrees"


def test_the_quadrotor_turns_by_yaw_then_pitch_then_roll():
    states = np.zeros((4, 6))
    states[1, 0], states[2, 1], states[3, 2] = 0.3, 0.3, 0.3
    parts, _ = body(tasks_of("quadrotor"), 1, states)
    cos, sin = np.cos(0.3), np.sin(0.3)
    assert np.allclose(parts["roll axis"][:, 0], 0.5 * np.array([[1, 0, 0], [1, 0, 0], [cos, 0, -sin], [cos, sin, 0]]))
    assert np.allclose(parts["pitch axis"][:, 0], 0.5 * np.array([[0, 1, 0], [0, cos, sin], [0, 1, 0], [-sin, cos, 0]]))
    states = states_of("quadrotor")
    turned = body(tasks_of("quadrotor"), 0, states)[0]
    about = Rotation.from_rotvec
    by_hand = [about([0, 0, yaw]) * about([0, pitch, 0]) * about([roll, 0, 0]) for roll, pitch, yaw in states[:, :3]]
    assert np.allclose(turned["mast"][:, 1], [turn.apply([0, 0, 0.1]) for turn in by_hand])
    assert np.allclose(lengths(turned["roll axis"]), 0.4) and np.allclose(lengths(turned["pitch axis"]), 0.4)
    assert np.allclose((np.diff(turned["roll axis"], axis=1) * np.diff(turned["pitch axis"], axis=1)).sum(axis=2), 0)


@pytest.mark.parametrize("states", [np.zeros((5, 3)), np.zeros(4), np.full((5, 4), np.nan)])
def test_states_that_do_not_fit_are_refused(states):
    with pytest.raises(ValueError, match=r"cart-pole: states must be finite and \(H \+ 1, 4\)"):
        body(tasks_of("cart-pole"), 0, states)
