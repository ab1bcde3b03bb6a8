"""The Turtlebot with a camera: what it sees, believes, and does when it has lost its goal."""

import numpy as np
import pytest

from lifelong_lib.environments import camera_robots
from lifelong_lib.environments.camera_robots import CameraTurtlebot, camera, locate, reckon, rotated
from lifelong_lib.environments.mobile_robots import Turtlebot

ROBOT = CameraTurtlebot(Turtlebot((2.5, 0.4), (0.0, 0.0)))
TO_GOAL = np.array([0.5, 0, 0, 0, 0, 0.5, 0.3, 0])


def pose(x, y, heading):
    return np.array([x, y, 0.1, 0, 0, np.sin(heading / 2), np.cos(heading / 2)])


@pytest.mark.parametrize("distance", [0.7, 1.5, 3.0, 4.3])
@pytest.mark.parametrize("bearing", [-0.4, 0.0, 0.2])
def test_the_beacon_is_found_where_it_is(distance, bearing):
    heading = 0.7
    goal = 1 + distance * np.cos(heading + bearing), 2 + distance * np.sin(heading + bearing)
    with camera(goal) as see:
        found = locate(*see(pose(1, 2, heading)))
    pixel = 2 * np.tan(camera_robots.VIEW / 2) / camera_robots.COLUMNS
    assert found[0] == pytest.approx(distance, abs=0.05) and found[1] == pytest.approx(bearing, abs=pixel)


def test_the_depth_image_has_a_nearest_and_a_farthest_distance():
    for distance in (0.4, 4.8):
        with camera((distance, 0.0)) as see:
            found = locate(*see(pose(0, 0, 0)))
        assert np.isnan(found[0]) and found[1] == pytest.approx(0, abs=0.02)


def test_no_beacon_out_of_view():
    with camera((2.0, 0.0)) as see:
        assert np.isnan(locate(*see(pose(0, 0, 0.6)))).all()
        colours, depth = see(pose(0, 0, np.pi))
    assert np.isnan(locate(colours, depth)).all() and colours.max() <= 1 and depth.min() > 0


def carried_out(out):
    """The commands of a roll-out one step late: the first step is spent standing."""
    commands = ROBOT.robot.limited(out.actions)
    return np.concatenate([np.zeros_like(commands[:, :1]), commands[:, :-1]], axis=1)


def test_a_robot_that_loses_its_goal_turns_to_it_and_pays():
    """It is made to turn away; recovery turns it back, and each of its steps costs more."""
    spin = np.array([0, 0, 0, 0, 0, 0, 0, 1.5])
    out = ROBOT.roll_out(spin[None], np.random.default_rng(0))
    lost = out.recovering[0, :-1]
    assert 0.1 < lost.mean() < 0.9
    turns = out.actions[0, :, 1]
    assert (np.abs(turns[lost]) == camera_robots.RECOVERY_TURN).all() and (turns[~lost] == 1.5).all()
    missing = -10 * out.states[0, 1:, 0] - np.linalg.norm(carried_out(out)[0], axis=1) - out.rewards[0]
    assert missing == pytest.approx(10.0 * lost)


def test_commands_come_one_step_late():
    """A robot that wants to drive at once stands for the first step, and rolls on in the step after a stop."""
    out = ROBOT.roll_out(np.array([[0, 0, 0, 0.3, 0, 0, 0, 0]]), np.random.default_rng(0))
    moved = np.diff(out.poses[0, :, 0])
    assert abs(moved[0]) < 1e-3 and moved[1] > 0.01


def test_wheels_slip():
    path = {}
    for name, robot in (("slips", ROBOT), ("grips", ROBOT.robot)):
        path[name] = robot.roll_out(np.array([[0, 0, 0, 0.15, 0, 0, 0, 0]]), np.random.default_rng(0)).poses[0, -1, 0]
    mean = 1 - camera_robots.SLIP / 2
    assert path["slips"] == pytest.approx(mean * path["grips"], rel=0.05)


@pytest.mark.parametrize("share", [0.0, 0.3])
def test_lost_frames(monkeypatch, share):
    monkeypatch.setattr(camera_robots, "LOST_FRAMES", share)
    still = np.zeros((4, 8))
    lost = ROBOT.roll_out(still, np.random.default_rng(0)).recovering
    assert lost.mean() == pytest.approx(share, abs=0.1) and (share > 0 or not lost.any())


def test_a_measured_move_is_the_move_on_average():
    goals, before, now = np.tile([2.0, 0.5], (4000, 1)), pose(1, 1, 0.3), pose(1.1, 1.05, 0.5)
    found, turns = reckon(goals, np.tile(before, (4000, 1)), np.tile(now, (4000, 1)), np.random.default_rng(0))
    place = np.array([1, 1]) + rotated(goals[:1], np.array([0.3]))[0]  # of the goal in the world
    truth = rotated((place - [1.1, 1.05])[None], np.array([-0.5]))[0]
    assert found.mean(axis=0) == pytest.approx(truth, abs=0.002) and turns.mean() == pytest.approx(0.2, abs=0.001)
    assert turns.std() == pytest.approx(0.2 * camera_robots.ODOMETRY, rel=0.1)


def test_beliefs_stay_near_the_truth():
    out = ROBOT.roll_out(np.tile(TO_GOAL, (4, 1)), np.random.default_rng(1))
    truth = ROBOT.robot.states(out.poses)
    assert np.abs(out.states[..., 0] - truth[..., 0]).mean() < 0.1
    assert truth[:, -1, 0].max() < 0.5 and out.recovering[:, -20:].mean() < 0.2


def test_it_is_harder_than_the_simulation():
    policies = np.stack([TO_GOAL, 0.5 * TO_GOAL, np.array([0, 0, 0, 0.2, 0, 0, 0, 0.1])])
    easy, hard = (robot.roll_out(policies, np.random.default_rng(0)).rewards.sum(axis=1)
                  for robot in (ROBOT.robot, ROBOT))  # fmt: skip
    assert (hard < easy).all()


def test_the_same_seed_gives_the_same_roll_out():
    runs = [ROBOT.roll_out(TO_GOAL[None], np.random.default_rng(3)) for _ in range(2)]
    assert all((a == b).all() for a, b in zip(*runs, strict=True))


def test_a_goal_out_of_view_is_refused():
    with pytest.raises(ValueError, match="not in the camera's view"):
        CameraTurtlebot(Turtlebot((1.0, 1.0), (0.0, 0.0)))
