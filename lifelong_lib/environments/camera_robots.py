"""A Turtlebot that finds its goal by camera: a harder simulator, the stand-in for the thesis's real robots.

What is harder than in mobile_robots.py: the goal is a beacon in rendered colour and depth images with a Kinect's field
of view, range and noise; frames are lost; commands come one step late; wheels slip; and a robot that has lost the
beacon turns to where it was (thesis section 3.3.1, Application to Physical Robots). Within NEAREST of the beacon, which
then fills the image or stands beside it, a robot goes on without.
"""

from contextlib import contextmanager
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import numpy as np

from lifelong_lib.environments.mobile_robots import (
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
BEACON = (0.08, 0.6)  # [m] radius and height
LOST_FRAMES = 0.02  # share
SLIP = 0.15  # a wheel loses between nothing and so much of its speed, anew in each step
RECOVERY_TURN, RECOVERY_COST = 0.8, 10.0  # [rad/s]; reward lost in each step of recovery


class CameraRollOuts(NamedTuple):
    """Roll-outs of n policies over H steps; states and rewards are what the robots believe."""

    states: np.ndarray  # (n, H + 1, 3)
    actions: np.ndarray  # (n, H, 2)
    rewards: np.ndarray  # (n, H)
    poses: np.ndarray  # (n, H + 1, 7)
    recovering: np.ndarray  # (n, H + 1)


@dataclass(frozen=True)
class CameraTurtlebot:
    """A `Turtlebot` that knows its goal from its camera only. ValueError for a goal that it does not see at first."""

    robot: Turtlebot

    POLICY_SIZE: ClassVar = Turtlebot.POLICY_SIZE

    def __post_init__(self):
        x, y = self.robot.goal
        if not (NEAREST < x < FARTHEST and abs(y) < 0.9 * x * np.tan(VIEW / 2)):
            raise ValueError(f"goal {self.robot.goal} [m] is not in the camera's view at the start")

    def roll_out(self, policies: np.ndarray, rng: np.random.Generator, noise: float = 0.0) -> CameraRollOuts:
        """Return one roll-out of each policy (n, 8), as `Turtlebot.roll_out`; a step of recovery costs more."""
        robot, gains = self.robot, checked(policies, self.POLICY_SIZE).reshape(-1, 2, 4)
        n, H = len(gains), robot.HORIZON
        actions, poses = noise * rng.standard_normal((n, H, 2)), np.empty((n, H + 1, 7))
        states, recovering, commands = np.empty((n, H + 1, 3)), np.empty((n, H + 1), bool), np.zeros((n, H + 1, 2))
        wheels, believed = np.zeros((n, 2)), np.tile(robot.goal, (n, 1))  # of the robots; in their own axes
        with world("turtlebot.urdf", n, robot.WHEEL_RADIUS) as place, camera(robot.goal) as see:
            for h in range(H + 1):
                poses[:, h] = place.poses()
                believed = _reckon(believed, poses[:, max(h - 1, 0)], poses[:, h], rng)
                believed, recovering[:, h] = self._look(see, poses[:, h], believed, rng)
                xi = np.arctan2(believed[:, 1], believed[:, 0])
                psi = wrap(xi + heading(poses[:, h]))
                states[:, h] = np.column_stack([np.linalg.norm(believed, axis=1), xi, psi])
                if h == H:
                    break
                wanted = (gains @ features(states[:, h])[:, :, None])[:, :, 0]
                turn = np.column_stack([np.zeros(n), RECOVERY_TURN * np.sign(xi)])
                actions[:, h] += np.where(recovering[:, h, None], turn, wanted)
                commands[:, h + 1] = robot.limited(actions[:, h])
                slipping = rng.uniform(1 - SLIP, 1, (n, 2))
                robot.drive(place, commands[:, h], wheels, slipping)  # one step late
        cost = np.linalg.norm(commands[:, 1:], axis=-1) + RECOVERY_COST * recovering[:, 1:]
        return CameraRollOuts(states, actions, -10 * states[:, 1:, 0] - cost, poses, recovering)

    def succeeded(self, out: CameraRollOuts) -> np.ndarray:
        """Return which roll-outs really end near the goal, as `Turtlebot.succeeded`: (n,)."""
        return self.robot.succeeded(out)

    def _look(self, see, poses, believed, rng):
        """What the robots believe of their goals (n, 2) after a look, and which of them have lost it (n,)."""
        believed, lost = believed.copy(), rng.random(len(poses)) < LOST_FRAMES
        noise = 0.01 * rng.standard_normal(len(poses))
        for i, pose in enumerate(poses):
            distance, bearing = locate(*see(pose))
            if np.isnan(bearing) or lost[i]:
                lost[i] = np.linalg.norm(believed[i]) > NEAREST
            else:
                distance += noise[i] * distance**2
                known = np.linalg.norm(believed[i]) if np.isnan(distance) else distance
                believed[i] = known * np.cos(bearing), known * np.sin(bearing)
        return believed, lost


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
        yield lambda pose: _picture(client, pose)
    finally:
        pybullet.disconnect(client)


def _picture(client, pose):
    angle, eye = heading(pose), np.array([pose[0], pose[1], CAMERA])
    return render(client, eye, eye + [np.cos(angle), np.sin(angle), 0], (0, 0, 1), VIEW, ROWS, COLUMNS)


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


def _reckon(believed, before, now, rng):
    """Goals in the robots' own axes after a move that they measure with an error of a twentieth."""
    turn, moved = heading(now) - heading(before), (now - before)[:, :2] * rng.normal(1, 0.05, (len(now), 1))
    cos, sin = np.cos(heading(before)), np.sin(heading(before))
    ahead = believed - np.column_stack([cos * moved[:, 0] + sin * moved[:, 1], cos * moved[:, 1] - sin * moved[:, 0]])
    cos, sin = np.cos(turn), np.sin(turn)
    return np.column_stack([cos * ahead[:, 0] + sin * ahead[:, 1], cos * ahead[:, 1] - sin * ahead[:, 0]])
