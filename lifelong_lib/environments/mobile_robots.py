"""A Turtlebot 2 and an AR.Drone in PyBullet, each with an unknown constant disturbance (thesis section 3.3).

PyBullet stands in for Gazebo. Every call of ``roll_out`` loads a world of its own, in which one robot stands several
times, too far apart to meet, once for each policy: so the physics of a roll-out depends, but for rounding, neither on
its neighbours nor on what ran before. What the thesis leaves open stands in DEVIATIONS.md.
"""

import hashlib
import os
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import ClassVar, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation


def _load_pybullet():
    """PyBullet says hello on standard error as it is loaded, which would stand in every notebook and log."""
    kept, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 2)
    try:
        import pybullet
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)
    return pybullet


pybullet = _load_pybullet()
FOLDER = Path(__file__).resolve().parents[2] / "data" / "robots"
CHECKSUMS = {"turtlebot.urdf": "1d60d88a15f8", "ardrone.urdf": "422ed34c5073", "marker.urdf": "4688f8a2e9fe"}
GRAVITY = 9.81  # [m/s^2]
SPACING = 200.0  # [m] between the robots of a world, more than any of them can drive or fly
PHYSICS_STEP = 0.05  # [s]; the tests show what half of it would change


class RollOuts(NamedTuple):
    """Roll-outs of n policies over H steps."""

    states: np.ndarray  # (n, H + 1, 3)
    actions: np.ndarray  # (n, H, d_a)
    rewards: np.ndarray  # (n, H)
    poses: np.ndarray  # (n, H + 1, 7): position [m] and orientation as a quaternion xyzw


@dataclass(frozen=True)
class Turtlebot:
    """A Turtlebot that is to drive from the origin to ``goal`` (x, y) [m] and to stop there.

    It starts with its nose along x. ``disturbance`` is added to its commands, forward [m/s] and turning [rad/s]. Raises
    ValueError for a goal beyond REACH and a disturbance beyond DRIFT.
    """

    goal: tuple[float, float]
    disturbance: tuple[float, float]

    STEP: ClassVar = 0.2  # [s] between commands
    HORIZON: ClassVar = 70  # commands a roll-out
    REACH: ClassVar = 5.0  # [m] the world ends so far from the start, in x and y
    CLOSE: ClassVar = 0.3  # [m] from the goal
    DRIFT: ClassVar = 0.1
    POLICY_SIZE: ClassVar = 8
    WHEEL_RADIUS: ClassVar = 0.035  # [m]
    TRACK: ClassVar = 0.23  # [m] between the wheels
    LIMITS: ClassVar = (0.7, np.pi)  # [m/s], [rad/s]
    ACCELERATION: ClassVar = 1.0  # [m/s^2] of a wheel's rim
    TORQUE: ClassVar = 1.0  # [N m] of a wheel's motor at most

    def __post_init__(self):
        _require_within(self.goal, self.REACH, "goal [m]")
        _require_within(self.disturbance, self.DRIFT, "disturbance [m/s, rad/s]")

    def states(self, poses: np.ndarray) -> np.ndarray:
        """Return distance rho [m] to the goal, its bearing xi from the nose and psi in the world [rad]: (..., 3)."""
        away = np.array(self.goal) - poses[..., :2]
        psi = np.arctan2(away[..., 1], away[..., 0])
        return np.stack([np.linalg.norm(away, axis=-1), wrap(psi - heading(poses)), psi], axis=-1)

    def roll_out(self, policies: np.ndarray, rng: np.random.Generator, noise: float = 0.0) -> RollOuts:
        """Return one roll-out of each policy (n, 8): theta (4 x 2) of equation 3.5, a block of 4 for each command.

        ``noise``: standard deviation of both commands. The reward of a step is -10 rho where it leads, less the norm of
        the command that was carried out. Raises ValueError for policies of another shape or that are not finite.
        """
        gains = checked(policies, self.POLICY_SIZE).reshape(-1, 2, 4)
        n, wheels = len(gains), np.zeros((len(gains), 2))
        actions, poses = noise * rng.standard_normal((n, self.HORIZON, 2)), np.empty((n, self.HORIZON + 1, 7))
        commands = np.empty_like(actions)
        with world("turtlebot.urdf", n, self.WHEEL_RADIUS) as place:
            poses[:, 0] = place.poses()
            for h in range(self.HORIZON):
                actions[:, h] += (gains @ features(self.states(poses[:, h]))[:, :, None])[:, :, 0]
                commands[:, h] = self.limited(actions[:, h])
                self.drive(place, commands[:, h], wheels)
                poses[:, h + 1] = place.poses()
        states = self.states(poses)
        rewards = -10 * states[:, 1:, 0] - np.linalg.norm(commands, axis=-1)
        return RollOuts(states, actions, rewards, poses)

    def succeeded(self, out: RollOuts) -> np.ndarray:
        """Return which roll-outs spend their last two seconds within CLOSE of the goal: (n,)."""
        return (np.linalg.norm(out.poses[:, -11:, :2] - self.goal, axis=2) < self.CLOSE).all(axis=1)

    def limited(self, actions: np.ndarray) -> np.ndarray:
        """Return the commands that are carried out: actions (n, 2) and the disturbance, within the base's limits."""
        return np.clip(actions + self.disturbance, np.negative(self.LIMITS), self.LIMITS)

    def drive(self, world, commands: np.ndarray, wheels: np.ndarray, grip: float | np.ndarray = 1.0) -> None:
        """Carry out commands (n, 2) for one step; ``wheels`` (n, 2) are the rims' speeds [m/s], changed in place.

        ``grip``: share of its speed that a wheel brings to the ground.
        """
        forward, turning = commands.T
        wanted = grip * np.column_stack([forward - turning * self.TRACK / 2, forward + turning * self.TRACK / 2])
        for _ in range(round(self.STEP / PHYSICS_STEP)):
            moving = np.flatnonzero((wheels != wanted).any(axis=1))
            wheels += np.clip(wanted - wheels, *np.array([-1, 1]) * self.ACCELERATION * PHYSICS_STEP)
            world.turn(moving, wheels / self.WHEEL_RADIUS, self.TORQUE)
            world.step()


def features(states: np.ndarray) -> np.ndarray:
    """Return phi(x) (..., 4) of states (rho, xi, psi), equation 3.5; at xi = 0 its limit."""
    rho, xi, psi = np.moveaxis(states, -1, 0)
    return np.stack([rho * np.cos(xi), xi, np.cos(xi) * np.sinc(xi / np.pi) * (xi + psi), np.ones_like(xi)], axis=-1)


@dataclass(frozen=True)
class ARDrone:
    """An AR.Drone that hovers above a marker, the origin, and is to land on it by what its downward camera sees.

    ``disturbance`` is added to its commands along x and y [m/s], also while it waits; ValueError for one beyond DRIFT.
    """

    disturbance: tuple[float, float]

    STEP: ClassVar = 0.4  # [s] between commands
    HORIZON: ClassVar = 150  # commands a roll-out
    DRIFT: ClassVar = 0.15
    POLICY_SIZE: ClassVar = 9
    START, SONAR, CEILING = 2.0, 0.4, 2.8  # [m] altitude at the start, the lowest one that is measured, the highest one
    VIEW: ClassVar = np.radians(53)  # [rad] width of the camera's view, which is 4:3
    WINDOW: ClassVar = np.array([[-0.7, 0.7], [-0.8, 0.6]])  # of the marker in the image when the drone may land
    MASS, INERTIA = 1.477, np.array([0.01152, 0.01152, 0.0218])  # [kg], [kg m^2], of the URDF
    DRAG: ClassVar = 0.1  # [N s/m]
    LIMITS: ClassVar = np.array([2.0, 2.0, 0.5])  # [m/s] of the controller

    def __post_init__(self):
        _require_within(self.disturbance, self.DRIFT, "disturbance [m/s]")

    def roll_out(self, policies: np.ndarray, rng: np.random.Generator, noise: float = 0.0) -> RollOuts:
        """Return one roll-out of each policy (n, 9), K (3 x 3) in rows: commands K x along x, y and z [m/s].

        A state x is (-x/4, -y/3, z/3): the marker's place in the image, whose edges are at 2 and 1.5, and the altitude
        above SONAR [m]. Out of view the marker counts as at 4 and 3, where it was last seen, and the drone waits. The
        reward of a step is -10 |(x/4, y/3, z)| where it leads, less the norm of the command that was carried out;
        nothing after landing.
        Raises ValueError for policies of another shape or that are not finite.
        """
        gains, n = checked(policies, self.POLICY_SIZE).reshape(-1, 3, 3), len(policies)
        actions = noise * rng.standard_normal((n, self.HORIZON, 3))
        gusts = rng.uniform(-0.05, 0.05, actions.shape)  # [m/s] as in the TUM simulator; and a drift, for 5 s each
        gusts += np.repeat(rng.uniform(-0.03, 0.03, (n, -(-self.HORIZON // 12), 3)), 12, axis=1)[:, : self.HORIZON]
        commands, rewards = np.zeros_like(actions), np.zeros((n, self.HORIZON))
        states, poses = np.zeros((n, self.HORIZON + 1, 3)), np.empty((n, self.HORIZON + 1, 7))
        flying, marker = np.ones(n, bool), np.zeros((n, 2))
        with world("ardrone.urdf", n, self.START) as place:
            for h in range(self.HORIZON + 1):
                poses[:, h] = place.poses()
                marker, visible = self.look(poses[:, h], marker)
                altitude = np.maximum(poses[:, h, 2], self.SONAR)
                state = np.column_stack([-marker / [4, 3], (altitude - self.SONAR) / 3])
                if h:
                    cost = 10 * np.linalg.norm(state * [1, 1, 3], axis=1) + np.linalg.norm(commands[:, h - 1], axis=1)
                    rewards[:, h - 1] = np.where(flying, -cost, 0)
                flying &= ~self.lands(marker, visible, altitude)
                place.rest(np.flatnonzero(~flying))
                states[flying, h] = state[flying]
                if h == self.HORIZON:
                    break
                actions[:, h] += visible[:, None] * (gains @ states[:, h, :, None])[:, :, 0]
                actions[altitude >= self.CEILING, h, 2] = -0.1
                actions[:, h] *= flying[:, None]
                commands[:, h] = flying[:, None] * np.clip(actions[:, h] + [*self.disturbance, 0], -1, 1)
                self.fly(place, commands[:, h] + gusts[:, h], flying)
        return RollOuts(states, actions, rewards, poses)

    def lands(self, marker: np.ndarray, visible: np.ndarray, altitude: np.ndarray) -> np.ndarray:
        """Return which drones land now (n,): as low as can be measured, with the marker (n, 2) within the window."""
        low, high = self.WINDOW.T
        return visible & (altitude <= self.SONAR) & ((low <= marker) & (marker <= high)).all(axis=1)

    def succeeded(self, out: RollOuts) -> np.ndarray:
        """Return which roll-outs end landed on the marker: (n,)."""
        return ~out.states[:, -1].any(axis=1)

    def look(self, poses: np.ndarray, last: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the marker's places in the images (n, 2), and where it is in view (n,).

        Out of view it counts as at 4 and 3, twice the edges, on the side where it was ``last``.
        """
        marker = -Rotation.from_quat(poses[:, 3:]).apply(poses[:, :3], inverse=True)  # as seen from the drone
        with np.errstate(divide="ignore", invalid="ignore"):
            place = 2 / np.tan(self.VIEW / 2) * marker[:, :2] / -marker[:, 2:]
        visible = (marker[:, 2] < 0) & (np.abs(place) <= [2, 1.5]).all(axis=1)
        return np.where(visible[:, None], place, np.where(last < 0, -1, 1) * [4, 3]), visible

    def fly(self, world, commands: np.ndarray, flying: np.ndarray) -> None:
        """Track velocities (n, 3) [m/s] for one step, with the controllers of the TUM simulator."""
        wanted = np.clip(commands, -self.LIMITS, self.LIMITS)
        which = np.flatnonzero(flying)
        for _ in range(round(self.STEP / PHYSICS_STEP) if len(which) else 0):
            turns, speeds, spins = world.motion(which)
            along, up = _level(turns[:, :, 0]), turns[:, :, 2]  # the nose's heading, and the rotors' axis
            heading = np.stack([along, along @ [[0, 1], [-1, 0]]], axis=1)  # (n, 2, 2), rows x and y of the commands
            tilt = (heading @ up[:, :2, None])[:, :, 0]
            error = wanted[which] - np.column_stack([(heading @ speeds[:, :2, None])[:, :, 0], speeds[:, 2]])
            lean = np.clip(5 / GRAVITY * error[:, :2] - tilt, -0.5, 0.5) - tilt  # still to be turned, along x and y
            spin = (spins[:, None] @ turns)[:, 0]  # about the drone's own axes
            turning = np.column_stack([-10 * lean[:, 1], 10 * lean[:, 0], -2 * spin[:, 2]]) - spin * [5, 5, 0]
            thrust = np.clip(self.MASS * (2.5 * error[:, 2] + GRAVITY) / np.maximum(up[:, 2], 0.3), 0, 30)
            torque = (turns @ (self.INERTIA * turning)[:, :, None])[:, :, 0]
            world.push(which, thrust[:, None] * up - self.DRAG * speeds, torque)
            world.step()


class World:
    """A physics server with a plane and ``count`` robots; positions are counted from each robot's start."""

    def __init__(self, client, urdf: str, count: int, height: float):
        self.client, self.resting, side = client, set(), int(np.ceil(np.sqrt(count)))
        self.places = SPACING * np.column_stack([*np.divmod(np.arange(count), side), np.zeros(count)])
        pybullet.setGravity(0, 0, -GRAVITY, client)
        pybullet.setPhysicsEngineParameter(
            PHYSICS_STEP, deterministicOverlappingPairs=1, physicsClientId=client, solverResidualThreshold=1e-3,
            contactBreakingThreshold=0.5,  # a wheel touches in one point: those it leaves behind would brake it by 5 %
        )  # fmt: skip
        plane = pybullet.createMultiBody(0, pybullet.createCollisionShape(pybullet.GEOM_PLANE, physicsClientId=client),
                                         physicsClientId=client)  # fmt: skip
        pybullet.changeDynamics(plane, -1, lateralFriction=1.0, physicsClientId=client)
        self.robots = [self.load(urdf, place + [0, 0, height]) for place in self.places]

    def load(self, urdf, position, look=pybullet.URDF_IGNORE_VISUAL_SHAPES):
        _check(urdf)
        robot = pybullet.loadURDF(str(FOLDER / urdf), position, flags=pybullet.URDF_USE_INERTIA_FROM_FILE | look,
                                  physicsClientId=self.client)  # fmt: skip
        pybullet.changeDynamics(robot, -1, linearDamping=0, angularDamping=0, physicsClientId=self.client)
        return robot

    def step(self):
        pybullet.stepSimulation(self.client)

    def poses(self) -> np.ndarray:
        """Position [m] and quaternion xyzw of every robot: (count, 7)."""
        found = [pybullet.getBasePositionAndOrientation(robot, self.client) for robot in self.robots]
        return np.array([place + turn for place, turn in found]) - np.pad(self.places, ((0, 0), (0, 4)))

    def motion(self, which):
        """Rotations (m, 3, 3), velocities [m/s] and angular velocities [rad/s] (m, 3) of some robots in the world."""
        turns = [pybullet.getBasePositionAndOrientation(self.robots[i], self.client)[1] for i in which]
        moves = np.array([pybullet.getBaseVelocity(self.robots[i], self.client) for i in which])
        return Rotation.from_quat(turns).as_matrix(), moves[:, 0], moves[:, 1]

    def turn(self, which, rates: np.ndarray, torque: float):
        """Let the wheels of some robots run at ``rates`` (count, 2) [rad/s] from now on."""
        for i in which:
            pybullet.setJointMotorControlArray(self.robots[i], (0, 1), pybullet.VELOCITY_CONTROL,
                                               targetVelocities=rates[i], forces=(torque, torque),
                                               physicsClientId=self.client)  # fmt: skip

    def push(self, which, forces: np.ndarray, torques: np.ndarray):
        """Apply forces [N] and torques [N m] (m, 3), in the world's axes, to some robots for one step."""
        for i, force, torque in zip(which, forces.tolist(), torques.tolist(), strict=True):
            place = pybullet.getBasePositionAndOrientation(self.robots[i], self.client)[0]
            pybullet.applyExternalForce(self.robots[i], -1, force, place, pybullet.WORLD_FRAME, self.client)
            pybullet.applyExternalTorque(self.robots[i], -1, torque, pybullet.WORLD_FRAME, self.client)

    def rest(self, which):
        """Put some robots on the ground for good."""
        for i in set(which) - self.resting:
            self.resting.add(i)
            place, turn = pybullet.getBasePositionAndOrientation(self.robots[i], self.client)
            pybullet.changeDynamics(self.robots[i], -1, mass=0, physicsClientId=self.client)
            pybullet.resetBasePositionAndOrientation(self.robots[i], [*place[:2], 0.05], turn, self.client)


def render(client: int, eye, target, up, view: float, rows: int, columns: int) -> tuple[np.ndarray, np.ndarray]:
    """Return colours (rows, columns, 3) from 0 to 1 and depth [m] (rows, columns), row 0 above, of a client's world.

    ``view``: width of the picture [rad]. Raises RuntimeError if this PyBullet cannot hand over pictures.
    """
    if not pybullet.isNumpyEnabled():
        raise RuntimeError("this PyBullet has no renderer for numpy: install the version in environment.txt")
    near, far = 0.05, 20.0  # [m]
    height = np.degrees(2 * np.arctan(np.tan(view / 2) * rows / columns))
    lens = pybullet.computeProjectionMatrixFOV(height, columns / rows, near, far)
    camera = pybullet.computeViewMatrix(eye, target, up)
    _, _, colours, depth, _ = pybullet.getCameraImage(
        columns, rows, camera, lens, renderer=pybullet.ER_TINY_RENDERER, physicsClientId=client
    )
    colours = np.reshape(colours, (rows, columns, 4))[..., :3] / 255
    return colours, far * near / (far - (far - near) * np.reshape(depth, (rows, columns)))


def portrait(bodies: dict, eye, target, up=(0, 0, 1), view: float = 0.8, rows: int = 360, columns: int = 480):
    """Return a picture (rows, columns, 3), row 0 above, of bodies {URDF: pose (7,)} on a chequered floor."""
    with world("", 0, 0.0) as place:  # no robots yet: each has a pose of its own
        for urdf, pose in bodies.items():
            body = place.load(urdf, [0, 0, 0], look=0)
            pybullet.resetBasePositionAndOrientation(body, pose[:3], pose[3:], place.client)
        return render(place.client, eye, target, up, view, rows, columns)[0]


def drone_view(pose: np.ndarray, rows: int, columns: int) -> np.ndarray:
    """Return what the downward camera of a drone at ``pose`` (7,) sees: (rows, columns, 3), row 0 above."""
    turn = Rotation.from_quat(pose[3:])
    return portrait({"marker.urdf": (0, 0, 0, 0, 0, 0, 1)}, pose[:3], pose[:3] - turn.apply([0, 0, 1]),
                    turn.apply([0, 1, 0]), ARDrone.VIEW, rows, columns)  # fmt: skip


@contextmanager
def world(urdf: str, count: int, height: float):
    client = pybullet.connect(pybullet.DIRECT)
    try:
        yield World(client, urdf, count, height)
    finally:
        pybullet.disconnect(client)


@cache
def _digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def _check(urdf: str) -> None:
    """Refuse a robot that is not the one that stored runs were made with."""
    path = FOLDER / urdf
    if not path.is_file():
        raise ValueError(f"{path} is missing: restore data/robots")
    if not _digest(path).startswith(CHECKSUMS[urdf]):
        raise ValueError(f"{path} is not the one of this version: restore it, or enter its sha256 in CHECKSUMS")


def _require_within(values, limit: float, what: str) -> None:
    if len(values) != 2 or not np.all(np.abs(values) <= limit):
        raise ValueError(f"{what} must be two numbers from {-limit:g} to {limit:g}, got {tuple(values)}")


def checked(policies: np.ndarray, size: int) -> np.ndarray:
    policies = np.asarray(policies, float)
    if policies.ndim != 2 or policies.shape[1] != size:
        raise ValueError(f"policies must be (n, {size}), got {policies.shape}")
    if not np.isfinite(policies).all():
        raise ValueError("a policy has parameters that are not finite; was the step too large?")
    return policies


def wrap(angles: np.ndarray) -> np.ndarray:
    """Return angles in [-pi, pi)."""
    return (angles + np.pi) % (2 * np.pi) - np.pi


def heading(poses: np.ndarray) -> np.ndarray:
    """Return the direction of the nose [rad] of poses (..., 7)."""
    x, y, z, w = np.moveaxis(poses[..., 3:], -1, 0)
    return np.arctan2(2 * (w * z + x * y), 1 - 2 * (y**2 + z**2))


def _level(directions: np.ndarray) -> np.ndarray:
    return directions[:, :2] / np.linalg.norm(directions[:, :2], axis=1, keepdims=True)
