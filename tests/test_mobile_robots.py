"""Physics that must be true of the robots in PyBullet, and what their roll-outs promise."""

import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lifelong_lib.environments import mobile_robots
from lifelong_lib.environments.mobile_robots import (
    ARDrone,
    Turtlebot,
    drone_view,
    features,
    heading,
    portrait,
    pybullet,
    world,
    wrap,
)

STILL = Turtlebot((2.0, 0.0), (0.0, 0.0))
TO_GOAL = np.array([0.5, 0, 0, 0, 0, 0.5, 0.5, 0])  # a controller by hand: forwards by distance, turn by bearing
LAND = np.diag([-1.0, -1.0, -3.0]).ravel()  # the same for the drone
SEED = 5


def always(forward, turning):
    return np.array([[0, 0, 0, forward, 0, 0, 0, turning]], float)


def poses(robot, policies, seed=SEED):
    return robot.roll_out(policies, np.random.default_rng(seed)).poses


def test_straight_command_covers_speed_times_time():
    path = poses(STILL, always(0.3, 0))[0]
    lost = 0.3**2 / (2 * STILL.ACCELERATION)  # [m] while it gathers speed
    assert path[-1, 0] == pytest.approx(0.3 * STILL.HORIZON * STILL.STEP - lost, rel=0.01)
    assert abs(path[:, 1]).max() < 0.02 and abs(heading(path)).max() < 0.02


def test_turn_in_place_stays_in_place():
    path = poses(STILL, always(0, 1.0))[0]
    assert np.linalg.norm(path[:, :2], axis=1).max() < 0.02
    turned = np.unwrap(heading(path))[-1]
    assert turned == pytest.approx(STILL.HORIZON * STILL.STEP, rel=0.02)


def test_a_robot_that_wants_nothing_drifts_by_its_disturbance():
    """To 0.0015 m/s or rad/s, little beside faults of up to 0.1: in the 14 s of a roll-out that is 0.02."""
    for drift in (0.1, -0.03, 0.01):
        path = poses(Turtlebot((2.0, 0.0), (drift, 0.0)), always(0, 0))[0]
        assert path[-1, 0] == pytest.approx(drift * 14, abs=0.02) and abs(path[-1, 1]) < 0.01
        path = poses(Turtlebot((2.0, 0.0), (0.0, drift)), always(0, 0))[0]
        assert heading(path)[-1] == pytest.approx(drift * 14, abs=0.02) and np.linalg.norm(path[-1, :2]) < 0.02


def test_commands_are_limited():
    path = poses(STILL, always(50.0, 0))[0]
    speeds = np.diff(path[:, 0]) / STILL.STEP
    assert speeds.max() < 0.7 * 1.01 and speeds[-1] > 0.7 * 0.99


def test_energy_does_not_grow():
    """A robot that is pushed and whose motors are off, and one that falls, only lose energy."""
    with world("turtlebot.urdf", 1, STILL.WHEEL_RADIUS) as place:
        robot, client = place.robots[0], place.client
        pybullet.setJointMotorControlArray(robot, (0, 1), pybullet.VELOCITY_CONTROL, forces=(0, 0),
                                           physicsClientId=client)
        pybullet.resetBaseVelocity(robot, (0.5, 0, 0), (0, 0, 0), physicsClientId=client)
        speeds = []
        for _ in range(100):
            place.step()
            speeds.append(np.linalg.norm(place.motion([0])[1][0]))
        assert max(speeds) <= 0.5 and speeds[-1] > 0.3  # the first step spins the wheels up, then it rolls on
    with world("ardrone.urdf", 1, 5.0) as place:
        energy = []
        for _ in range(200):
            place.step()
            energy.append(mobile_robots.GRAVITY * place.poses()[0, 2] + (place.motion([0])[1] ** 2).sum() / 2)
        free = np.diff(energy)[:15]  # what one time step is off, (g dt)^2 / 2, is lost and not won
        assert free == pytest.approx(np.full(15, -((mobile_robots.GRAVITY * mobile_robots.PHYSICS_STEP) ** 2) / 2))
        assert max(energy) == energy[0] and place.poses()[0, 2] == pytest.approx(0.04, abs=0.005)


def test_state_variables():
    robot = Turtlebot((1.0, 1.0), (0, 0))
    quarter = [0, 0, np.sqrt(0.5), np.sqrt(0.5)]  # nose along y
    rho, xi, psi = robot.states(np.array([1.0, 0.0, 0.0, *quarter]))
    assert (rho, xi, psi) == pytest.approx((1, 0, np.pi / 2))
    assert robot.states(np.array([1.0, 3.0, 0, *quarter])) == pytest.approx([2, -np.pi, -np.pi / 2])


@settings(max_examples=50, deadline=None)
@given(st.floats(0, 10), st.floats(-3.14, 3.14), st.floats(-3.14, 3.14))
def test_features_are_those_of_the_thesis_and_finite(rho, xi, psi):
    found = features(np.array([rho, xi, psi]))
    third = np.cos(xi) * np.sin(xi) / xi * (xi + psi) if abs(xi) > 1e-9 else psi
    assert found == pytest.approx([rho * np.cos(xi), xi, third, 1], abs=1e-7)


def test_features_straight_ahead():
    assert features(np.array([2.0, 0.0, 0.7])) == pytest.approx([2, 0, 0.7, 1])


def test_reward_is_what_the_docstring_says():
    robot = Turtlebot((1.0, -1.0), (0.05, 0.1))
    out = robot.roll_out(always(0.2, 0.9), np.random.default_rng(0), noise=0.01)
    commands = out.actions + robot.disturbance
    rewards = -10 * out.states[:, 1:, 0] - np.linalg.norm(commands, axis=-1)
    assert out.rewards == pytest.approx(rewards)
    assert out.actions[0, :, 0].std() == pytest.approx(0.01, rel=0.3)


def test_the_controller_by_hand_gets_there_and_stops_and_a_turned_round_one_does_not():
    for goal in ((2.0, 0.5), (-1.0, 1.0), (0.5, -1.5)):
        robot = Turtlebot(goal, (0.0, 0.0))
        out = robot.roll_out(np.stack([TO_GOAL, -TO_GOAL]), np.random.default_rng(0))
        assert out.states[0, -10:, 0].max() < 0.1 and out.states[1, -1, 0] > 2
        assert robot.succeeded(out).tolist() == [True, False]


def test_robots_of_a_world_never_meet():
    """The farthest that two neighbours can come towards each other, Turtlebots and drones."""
    reach = max(STILL.LIMITS[0] * STILL.HORIZON * STILL.STEP, (1 + 0.08) * ARDrone.HORIZON * ARDrone.STEP)
    assert 2 * reach < mobile_robots.SPACING
    far = ARDrone((0.15, 0.15)).roll_out(np.zeros((2, 9)), np.random.default_rng(0)).poses[:, :, :2]
    assert np.abs(far).max() < reach


BOTH = pytest.mark.parametrize("robot, policy", [(Turtlebot((1.5, -1.0), (0.1, -0.1)), TO_GOAL),
                                                 (ARDrone((0.1, -0.15)), LAND)])  # fmt: skip


@BOTH
def test_the_same_seed_gives_the_same_roll_out_in_another_process_too(robot, policy):
    first, again = (poses(robot, policy[None]) for _ in range(2))
    assert (first == again).all()
    code = (f"import numpy as np; from lifelong_lib.environments.mobile_robots import ARDrone, Turtlebot\n"
            f"poses = {robot!r}.roll_out(np.array({policy.tolist()})[None], np.random.default_rng({SEED})).poses\n"
            f"print(poses.sum().hex())")
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == first.sum().hex() and done.stderr == ""


def test_a_roll_out_does_not_depend_on_its_neighbours():
    """But for rounding, as robots stand at different places of one world."""
    robot = Turtlebot((1.5, -1.0), (0.1, -0.1))
    crowd = poses(robot, np.stack([-TO_GOAL, TO_GOAL, 2 * TO_GOAL, TO_GOAL]))
    assert np.abs(crowd[[1, 3]] - poses(robot, TO_GOAL[None])).max() < 1e-6


@pytest.mark.parametrize("robot, policy, bound", [
    (Turtlebot((1.5, -1.0), (0.05, -0.05)), TO_GOAL, 0.01),
    (Turtlebot((-1.5, 1.0), (-0.1, 0.1)), TO_GOAL, 0.02),
    (ARDrone((0.15, -0.1)), LAND, 0.04),
    (ARDrone((0.15, -0.1)), 0 * LAND, 0.01),
])  # fmt: skip
def test_half_the_time_step_changes_little(monkeypatch, robot, policy, bound):
    coarse = robot.roll_out(policy[None], np.random.default_rng(0))
    monkeypatch.setattr(mobile_robots, "PHYSICS_STEP", mobile_robots.PHYSICS_STEP / 2)
    fine = robot.roll_out(policy[None], np.random.default_rng(0))
    assert fine.rewards.sum() == pytest.approx(coarse.rewards.sum(), rel=bound)


# ------------------------------------------------------------------------------------------------- the drone

def test_the_drone_weighs_what_it_says():
    with world("ardrone.urdf", 1, 2.0) as place:
        for _ in range(200):
            place.push([0], np.array([[0, 0, ARDrone.MASS * mobile_robots.GRAVITY]]), np.zeros((1, 3)))
            place.step()
        assert place.poses()[0, :3] == pytest.approx([0, 0, 2], abs=1e-9)


def test_the_drone_hovers_and_rights_itself():
    drone = ARDrone((0.0, 0.0))
    with world("ardrone.urdf", 1, 2.0) as place:
        tilted = pybullet.getQuaternionFromEuler((0.3, -0.2, 0.0))
        pybullet.resetBasePositionAndOrientation(place.robots[0], (0, 0, 2), tilted, place.client)
        for _ in range(25):  # 10 s
            drone.fly(place, np.zeros((1, 3)), np.ones(1, bool))
        turn, speed, spin = place.motion([0])
        assert np.abs(speed).max() < 1e-3 and np.abs(spin).max() < 1e-3
        assert turn[0, 2, 2] == pytest.approx(1, abs=1e-4)


def test_the_drone_flies_as_commanded():
    drone, commands = ARDrone((0.0, 0.0)), np.array([[0.5, 0, 0], [0, -0.5, 0], [0, 0, 0.3], [0, 0, 2]], float)
    with world("ardrone.urdf", 4, 2.0) as place:
        for _ in range(25):
            before = place.poses()
            drone.fly(place, commands, np.ones(4, bool))
        speeds, moved = place.motion(range(4))[1], (place.poses() - before)[:, :3]
    wanted = np.clip(commands, -drone.LIMITS, drone.LIMITS)
    assert np.abs(speeds - wanted).max() < 0.03 and np.abs(moved - wanted * drone.STEP).max() < 0.01


def test_the_marker_in_the_image():
    drone, level = ARDrone((0.0, 0.0)), [0, 0, 0, 1]
    edge = np.tan(drone.VIEW / 2)
    positions = np.array([[0, 0, 2], [0.4, 0, 1], [-0.99 * edge, 0, 1], [-1.01 * edge, 0, 1], [0, 0.76 * edge, 1]])
    found, visible = drone.look(np.column_stack([positions, np.tile(level, (5, 1))]), np.array([[1.0, -1.0]] * 5))
    assert visible.tolist() == [True, True, True, False, False]
    assert found[:3] == pytest.approx(np.array([[0, 0], [-0.8 / edge, 0], [1.98, 0]]), abs=1e-9)
    assert found[3:].tolist() == [[4, -3], [4, -3]]


@pytest.mark.parametrize("marker, altitude, visible, lands", [
    ((0.69, 0.59), 0.4, True, True), ((-0.69, -0.79), 0.4, True, True), ((0.71, 0), 0.4, True, False),
    ((-0.71, 0), 0.4, True, False), ((0, 0.61), 0.4, True, False), ((0, -0.81), 0.4, True, False),
    ((0, 0), 0.41, True, False), ((0, 0), 0.4, False, False),
])  # fmt: skip
def test_the_landing_window(marker, altitude, visible, lands):
    found = ARDrone((0.0, 0.0)).lands(np.array([marker]), np.array([visible]), np.array([altitude]))
    assert found.tolist() == [lands]


def test_the_ceiling_and_a_lost_marker():
    up = np.diag([0.0, 0.0, 3.0]).ravel()
    out = ARDrone((0.15, 0.0)).roll_out(up[None], np.random.default_rng(0))
    assert 2.7 < out.poses[0, :, 2].max() < 3.0
    above = out.poses[0, :-1, 2] >= ARDrone.CEILING
    assert above.any() and (out.actions[0, above, 2] == -0.1).all()
    lost = np.abs(out.states[0, :-1, 0]) == 1
    assert lost.any() and not out.actions[0, lost & ~above].any()


def test_the_drone_pays_for_distance_and_for_the_command_that_is_carried_out():
    drone, push = ARDrone((0.1, -0.1)), np.array([0.1, -0.1, 0])
    out = drone.roll_out(0.3 * LAND[None], np.random.default_rng(0))
    flying = out.states[0, 1:].any(axis=1)
    away = np.linalg.norm(out.states[0, 1:] * [1, 1, 3], axis=1)  # altitude counts in metres
    cost = 10 * away + np.linalg.norm(np.clip(out.actions[0] + push, -1, 1), axis=1)
    assert flying.sum() > 5 and out.rewards[0, flying] == pytest.approx(-cost[flying])


def test_a_good_policy_lands_and_earns_nothing_afterwards():
    out = ARDrone((0.05, -0.05)).roll_out(LAND[None], np.random.default_rng(0))
    landed = np.flatnonzero(out.states[0].any(axis=1))[-1] + 1
    assert landed < 100 and not out.rewards[0, landed:].any() and not out.actions[0, landed:].any()
    assert out.poses[0, -1, 2] < 0.1 and np.linalg.norm(out.poses[0, -1, :2]) < 0.3


def test_a_drone_that_wants_nothing_loses_the_marker_by_its_disturbance():
    out = ARDrone((0.15, 0.0)).roll_out(np.zeros((1, 9)), np.random.default_rng(1))
    assert out.poses[0, 75, 0] == pytest.approx(0.15 * 30, abs=0.8)
    assert out.states[0, -1, :1].tolist() == [1.0]


# ------------------------------------------------------------------------------------------------- pictures, bad input

def test_the_drone_sees_the_marker_where_look_says():
    """The rendered image of a tilted drone against `look`, by the middle of what is dark and bright in it."""
    turn = pybullet.getQuaternionFromEuler((0.1, -0.15, 0.3))
    pose = np.array([0.3, -0.2, 1.8, *turn])
    picture = drone_view(pose, 240, 320)
    assert picture.shape == (240, 320, 3)
    marker = np.ptp(picture, axis=2) < 0.04  # the floor is blue or light
    dark = marker & (picture.max(axis=2) < 0.3)
    rows, columns = np.nonzero(dark)
    found = (columns.mean() - 159.5) / 80, -(rows.mean() - 119.5) / 80
    assert found == pytest.approx(tuple(ARDrone((0.0, 0.0)).look(pose[None], np.ones((1, 2)))[0][0]), abs=0.04)


def test_a_missing_renderer(monkeypatch):
    class WithoutNumpy:
        def __getattr__(self, name):
            return (lambda: False) if name == "isNumpyEnabled" else getattr(pybullet, name)

    monkeypatch.setattr(mobile_robots, "pybullet", WithoutNumpy())
    with pytest.raises(RuntimeError, match="no renderer"):
        portrait({"marker.urdf": [0, 0, 0, 0, 0, 0, 1]}, (0, -1, 1), (0, 0, 0))


def test_robots_of_other_files_are_refused(monkeypatch, tmp_path):
    (tmp_path / "turtlebot.urdf").write_text((mobile_robots.FOLDER / "turtlebot.urdf").read_text() + " ")
    monkeypatch.setattr(mobile_robots, "FOLDER", tmp_path)
    with pytest.raises(ValueError, match="turtlebot.urdf is not the one"):
        poses(STILL, always(0, 0))
    with pytest.raises(ValueError, match="ardrone.urdf is missing"):
        poses(ARDrone((0.0, 0.0)), np.zeros((1, 9)))


@pytest.mark.parametrize("make, message", [
    (lambda: Turtlebot((6.0, 0.0), (0, 0)), "goal"),
    (lambda: Turtlebot((1.0, np.nan), (0, 0)), "goal"),
    (lambda: Turtlebot((1.0, 0.0), (0.2, 0)), "disturbance .* from -0.1 to 0.1"),
    (lambda: ARDrone((0.2, 0.0)), "disturbance .* from -0.15 to 0.15"),
    (lambda: STILL.roll_out(np.full((1, 8), np.nan), np.random.default_rng(0)), "not finite"),
    (lambda: STILL.roll_out(np.zeros((1, 9)), np.random.default_rng(0)), r"\(n, 8\)"),
    (lambda: ARDrone((0.0, 0.0)).roll_out(np.zeros(9), np.random.default_rng(0)), r"\(n, 9\)"),
])  # fmt: skip
def test_bad_input_has_one_clear_line(make, message):
    with pytest.raises(ValueError, match=message) as caught:
        make()
    assert "\n" not in str(caught.value)


def test_wrap():
    assert wrap(np.array([0, np.pi, -np.pi, 4.0])) == pytest.approx([0, -np.pi, -np.pi, 4 - 2 * np.pi])
