"""A Turtlebot that finds its goal by camera: a harder simulator, the stand-in for the thesis's real robots.

What is harder than in mobile_robots.py: the goal is a beacon in rendered colour and depth images with a Kinect's field
of view, range and noise; frames are lost; commands come one step late; wheels slip; a robot measures its own motion
with errors that add up; and one that has lost the beacon turns to where it believes it (thesis section 3.3.1,
Application to Physical Robots). Within NEAREST of the beacon, which may then stand beside it, it goes on without.
"""

from contextlib import contextmanager
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import numpy as np

from lifelong_lib.environments.mobile_robots import (
    RollOuts,
    Turtlebot,
    checked,
    features,
    heading,
    pybullet,
    render,
    world,
    wrap,
)

ROWS, COLUMNS = 48, 64  # of colour and depth images
VIEW = np.radians(57)  # their width; they are 4:3
NEAREST, FARTHEST = 0.5, 4.5  # [m] of the depth image
CAMERA = 0.3  # [m] above the ground, over the robot's middle
BEACON = (0.08, 0.6)  # [m] radius and height; a light tube, which stops no robot
GUESS = (2.0, 0.0)  # [m] ahead, where the beacon is believed before it was seen
LOST_FRAMES = 0.02  # share
SLIP = 0.15  # a wheel loses between nothing and so much of its speed, anew in each step
ODOMETRY = 0.05  # standard deviation of the measured share of a move or turn
RECOVERY_TURN, RECOVERY_COST = 0.8, 10.0  # [rad/s]; reward lost in each step of recovery


class CameraRollOuts(NamedTuple):
    """Roll-outs of n policies over H steps; states and rewards are what the robots believe."""

    states: np.ndarray  # (n, H + 1, 3)
    actions: np.ndarray  # (n, H, 2)
    rewards: np.ndarray  # (n, H)
    poses: np.ndarray  # (n, H + 1, 7), the truth
    recovering: np.ndarray  # (n, H + 1)


@dataclass(frozen=True)
class CameraTurtlebot:
    """A `Turtlebot` that knows its goal from its camera only. ValueError for a goal that it could not see at first."""

    robot: Turtlebot

    POLICY_SIZE: ClassVar = Turtlebot.POLICY_SIZE

    def __post_init__(self):
        x, y = self.robot.goal
        if not (NEAREST < x < FARTHEST and abs(y) < 0.9 * x * np.tan(VIEW / 2)):
            raise ValueError(f"goal {self.robot.goal} [m] is not in the camera's view at the start")

    def roll_out(self, policies: np.ndarray, rng: np.random.Generator, noise: float = 0.0) -> CameraRollOuts:
        """Return one roll-out of each policy (n, 8), as `Turtlebot.roll_out`; a step in recovery costs more."""
        robot, gains = self.robot, checked(policies, self.POLICY_SIZE).reshape(-1, 2, 4)
        n, H = len(gains), robot.HORIZON
        actions, poses = noise * rng.standard_normal((n, H, 2)), np.empty((n, H + 1, 7))
        states, recovering, commands = np.empty((n, H + 1, 3)), np.empty((n, H + 1), bool), np.zeros((n, H + 1, 2))
        wheels, goals, noses = np.zeros((n, 2)), np.tile(GUESS, (n, 1)), np.zeros(n)  # goals and noses as believed
        with world("turtlebot.urdf", n, robot.WHEEL_RADIUS) as place, camera(robot.goal) as see:
            for h in range(H + 1):
                poses[:, h] = place.poses()
                if h:
                    goals, turns = reckon(goals, poses[:, h - 1], poses[:, h], rng)
                    noses += turns
                goals, recovering[:, h] = look(see, poses[:, h], goals, rng)
                xi = np.arctan2(goals[:, 1], goals[:, 0])
                states[:, h] = np.column_stack([np.linalg.norm(goals, axis=1), xi, wrap(xi + noses)])
                if h == H:
                    break
                wanted = (gains @ features(states[:, h])[:, :, None])[:, :, 0]
                turning = np.column_stack([np.zeros(n), RECOVERY_TURN * np.sign(xi)])
                actions[:, h] += np.where(recovering[:, h, None], turning, wanted)
                commands[:, h + 1] = robot.limited(actions[:, h])  # carried out one step late
                robot.drive(place, commands[:, h], wheels, rng.uniform(1 - SLIP, 1, (n, 2)))
        cost = np.linalg.norm(commands[:, :-1], axis=-1) + RECOVERY_COST * recovering[:, :-1]
        return CameraRollOuts(states, actions, -10 * states[:, 1:, 0] - cost, poses, recovering)

    def succeeded(self, out: RollOuts | CameraRollOuts) -> np.ndarray:
        """Return which roll-outs really end near the goal, as `Turtlebot.succeeded`: (n,)."""
        return self.robot.succeeded(out)


@contextmanager
def camera(goal):
    """Yield a function of a robot's pose (7,): colours (ROWS, COLUMNS, 3) from 0 to 1 and depth [m], row 0 above."""
    client = pybullet.connect(pybullet.DIRECT)
    try:
        ground = pybullet.createVisualShape(pybullet.GEOM_BOX, halfExtents=[30, 30, 0.01],
                                            rgbaColor=[0.75, 0.75, 0.7, 1], physicsClientId=client)  # fmt: skip
        beacon = pybullet.createVisualShape(pybullet.GEOM_CYLINDER, radius=BEACON[0], length=BEACON[1],
                                            rgbaColor=[0.9, 0, 0.9, 1], physicsClientId=client)  # fmt: skip
        for shape, place in ((ground, (0, 0, -0.01)), (beacon, (*goal, BEACON[1] / 2))):
            pybullet.createMultiBody(0, -1, shape, place, physicsClientId=client)

        def see(pose):
            angle, eye = heading(pose), np.array([pose[0], pose[1], CAMERA])
            return render(client, eye, eye + [np.cos(angle), np.sin(angle), 0], (0, 0, 1), VIEW, ROWS, COLUMNS)

        yield see
    finally:
        pybullet.disconnect(client)


def locate(colours: np.ndarray, depth: np.ndarray) -> tuple[float, float]:
    """Return distance [m] to the beacon's middle and bearing [rad], to the left; nan where they cannot be told."""
    red, green, blue = np.moveaxis(colours, -1, 0)
    found = (red > 2 * green + 0.15) & (blue > 2 * green + 0.15)
    if found.sum() < 3:
        return np.nan, np.nan
    column = np.nonzero(found)[1].mean()
    bearing = np.arctan((COLUMNS / 2 - 0.5 - column) / (COLUMNS / 2) * np.tan(VIEW / 2))
    distance = np.median(depth[found]) / np.cos(bearing) + BEACON[0]
    return distance if NEAREST <= distance <= FARTHEST else np.nan, bearing


def look(see, poses: np.ndarray, goals: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return where robots believe their goals (n, 2), in their own axes, after an image each; and if they are lost."""
    goals, lost = goals.copy(), rng.random(len(poses)) < LOST_FRAMES
    noise = 0.01 * rng.standard_normal(len(poses))  # [1/m] of a distance, as it grows with the square
    for i, pose in enumerate(poses):
        distance, bearing = locate(*see(pose))
        believed = np.linalg.norm(goals[i])
        if np.isnan(bearing) or lost[i]:
            lost[i] = believed > NEAREST
        else:
            reach = believed if np.isnan(distance) else distance + noise[i] * distance**2
            goals[i] = reach * np.cos(bearing), reach * np.sin(bearing)
    return goals, lost


def reckon(goals: np.ndarray, before: np.ndarray, now: np.ndarray, rng: np.random.Generator):
    """Return goals (n, 2) in the robots' own axes after a move between poses (n, 7), and turns (n,), as measured."""
    turns = wrap(heading(now) - heading(before)) * rng.normal(1, ODOMETRY, len(now))
    moves = rotated((now - before)[:, :2], -heading(before)) * rng.normal(1, ODOMETRY, (len(now), 1))
    return rotated(goals - moves, -turns), turns


def rotated(vectors: np.ndarray, angles: np.ndarray) -> np.ndarray:
    """Return vectors (n, 2) turned to the left by angles (n,) [rad]."""
    x, y, cos, sin = *vectors.T, np.cos(angles), np.sin(angles)
    return np.column_stack([cos * x - sin * y, sin * x + cos * y])
