"""The dynamical systems as Gymnasium environments: lifelong_lib/SpringMassDamper-v0, -/CartPole-v0, -/Bicycle-v0 and
-/Quadrotor-v0, registered when this module is imported. Each takes the very step that `Tasks.roll_out` takes.
"""

from typing import ClassVar

import gymnasium as gym
import numpy as np

from lifelong_lib.environments.bodies import body
from lifelong_lib.environments.dynamical_systems import START_SPREAD, SYSTEMS, Tasks, draw_tasks, reward
from lifelong_lib.environments.pictures import OTHER, PALE, RENDER_MODES, Picture, known_mode, projected

IDS = {name: f"lifelong_lib/{name.title().replace('-', '')}-v0" for name in SYSTEMS}
STEPS = 100  # an episode is truncated after so many
VIEWS = {  # of pictures: direction towards the viewer, two corners of the window [m], pixels a metre
    "spring-mass-damper": ((0, -1, 0), (-2.4, -0.5), (2.4, 0.5), 200),
    "cart-pole": ((0, -1, 0), (-5.3, -1.3), (5.3, 1.3), 90),
    "bicycle": ((-1, -0.5, 0.3), (-2.3, -1.1), (1.1, 1.4), 200),
    "quadrotor": ((0.4, -1, 0.35), (-0.45, -0.45), (0.45, 0.45), 600),
}


class DynamicalSystem(gym.Env):
    """One task of a system at a time. Observation: the state (d_x,); action (d_a,); both in the units of the system and
    without limits, as the tasks have none.

    ``parameters``: the physical parameters (p,) of the task in the units of the system, or None to draw a task from the
    system's ranges at every reset. Raises ValueError if they are not p positive numbers. Every ``info`` holds the
    task's parameters as {"parameters": {"cart mass [kg]": 0.5, ...}}. ``render_mode``: None or "rgb_array".
    """

    metadata: ClassVar = {"render_modes": RENDER_MODES}

    def __init__(self, system: str, parameters=None, render_mode: str | None = None):
        self.system, self.render_mode = SYSTEMS[system], known_mode(render_mode)
        self.metadata = self.metadata | {"render_fps": round(1 / self.system.step_seconds)}
        self.parameters = None if parameters is None else np.array(parameters, float)
        if self.parameters is not None:
            if self.parameters.shape != (len(self.system.parameters),):
                wanted = ", ".join(f"{name} [{unit}]" for name, unit, *_ in self.system.parameters)
                raise ValueError(f"{system}: parameters must be {wanted}, got {parameters}")
            Tasks(self.system, self.parameters[None], np.zeros((1, len(self.system.state))))  # refuses what is not > 0
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (len(self.system.state),), np.float64)
        self.action_space = gym.spaces.Box(-np.inf, np.inf, (len(self.system.actions),), np.float64)

    def reset(self, *, seed: int | None = None, options: dict | None = None):
        """Return (state, info) at a start of the task's own; the same seed gives the same task and start."""
        super().reset(seed=seed)
        task = draw_tasks(self.system, 1, self.np_random)
        if self.parameters is not None:
            task = Tasks(self.system, self.parameters[None], task.starts)
        self.task = task
        self.advance = self.system.dynamics(task.parameters, self.system.step_seconds)
        self.state = task.starts[0] + START_SPREAD * self.np_random.standard_normal(len(self.system.state))
        pairs = zip(self.system.parameters, task.parameters[0].tolist(), strict=True)
        self.named = {f"{name} [{unit}]": value for (name, unit, *_), value in pairs}
        return self.state.copy(), {"parameters": dict(self.named)}

    def step(self, action):
        """Return (state, reward, False, False, info): tasks have no end of their own; a wrapper truncates episodes."""
        action = np.asarray(action, float)
        if action.shape != self.action_space.shape or not np.isfinite(action).all():
            raise ValueError(f"{self.system.name}: actions must be finite and {self.action_space.shape}, got {action}")
        self.state = self.advance(self.state[None, None], action[None, None])[0, 0].copy()
        self.system.constrain(self.state)
        gained = float(reward(self.system, self.state, action))
        return self.state.copy(), gained, False, False, {"parameters": dict(self.named)}

    def render(self) -> np.ndarray | None:
        """Return a picture (rows, columns, 3) uint8 of the body, in grey where it should be; None without a mode."""
        if self.render_mode is None:
            return None
        seen_from, low, high, pixels = VIEWS[self.system.name]
        parts, fixed = body(self.task, 0, np.stack([np.zeros_like(self.state), self.state]))
        picture, width = Picture(low, high, pixels), 5 / pixels
        for line in fixed.values():
            picture.stroke(projected(line, seen_from), width / 2, PALE)
        for moment, colour in enumerate((PALE, OTHER)):
            for points in parts.values():
                picture.stroke(projected(points[moment], seen_from), width, colour)
        return picture.rgb()


for _system, _id in IDS.items():
    gym.register(_id, f"{__name__}:DynamicalSystem", kwargs={"system": _system}, max_episode_steps=STEPS)
