"""The Turtlebot with a camera: what it sees, believes, and does when it has lost its goal."""

import numpy as np
import pytest

from lifelong_lib.environments import camera_robots
from lifelong_lib.environments.camera_robots import CameraTurtlebot, camera, locate
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


def test_a_robot_that_loses_its_goal_turns_to_it_and_pays():
    """It is made to turn away; recovery turns it back, and each of its steps costs more."""
    spin = np.array([0, 0, 0, 0, 0, 0, 0, 1.5])
    out = ROBOT.roll_out(spin[None], np.random.default_rng(0))
    lost = out.recovering[0]
    assert 0.1 < lost.mean() < 0.9
    assert (np.abs(out.actions[0, :, 1][lost[:-1]]) == camera_robots.RECOVERY_TURN).all()
    assert (out.actions[0, :, 1][~lost[:-1]] == 1.5).all()
    cost = np.linalg.norm(out.actions[0], axis=1) + camera_robots.RECOVERY_COST * lost[1:]
    assert out.rewards[0] == pytest.approx(-10 * out.states[0, 1:, 0] - cost)


def test_beliefs_stay_near_the_truth():
    out = ROBOT.roll_out(np.tile(TO_GOAL, (4, 1)), np.random.default_rng(1))
    truth = ROBOT.robot.states(out.poses)
    assert np.abs(out.states[..., 0] - truth[..., 0]).mean() < 0.1
    assert truth[:, -1, 0].max() < 0.5 and not out.recovering[:, -20:].mean() > 0.2


def test_it_is_harder_than_the_simulation(monkeypatch):
    easy = ROBOT.robot.roll_out(TO_GOAL[None], np.random.default_rng(0)).rewards.sum()
    hard = ROBOT.roll_out(np.tile(TO_GOAL, (4, 1)), np.random.default_rng(0)).rewards.sum(axis=1)
    assert hard.max() < easy


def test_the_same_seed_gives_the_same_roll_out():
    runs = [ROBOT.roll_out(TO_GOAL[None], np.random.default_rng(3)) for _ in range(2)]
    assert all((a == b).all() for a, b in zip(*runs, strict=True))


def test_a_goal_out_of_view_is_refused():
    with pytest.raises(ValueError, match="not in the camera's view"):
        CameraTurtlebot(Turtlebot((1.0, 1.0), (0.0, 0.0)))
