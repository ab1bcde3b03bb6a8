"""Trials at a SUMO junction, step by step, as arrays that a recording can show."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from lifelong_lib.environments.crossing import LENGTH, WIDTH, Crossing, grid

OUTSIDE = (0.0, -500.0, 0.0, 0.0)  # where those stand that are not there: in no picture
HEIGHT = 1.5  # [m] of every car


class Trial(NamedTuple):
    """All of a trial of H steps."""

    own: np.ndarray  # (H + 1, 4) poses of the own car, the last one held once it has left
    others: np.ndarray  # (H + 1, n, 4) poses of n cars or fewer, which change places; the rest is OUTSIDE
    images: np.ndarray  # (H + 1, rows, columns, 3) what is seen at every step, whether or not a decision is due
    decisions: list[tuple[int, int]]  # step of each and the action chosen
    outcome: str


def watch(env: Crossing, policy: Callable, seed: int) -> Trial:
    """Run ``policy(image) -> action`` for one trial at a junction in SUMO and note all cars after every step."""
    image, info = env.reset(seed=seed)
    env.sumo.noted, decisions, ended = [env.cars()], [], False
    while not ended:
        action = policy(image)
        decisions.append((len(env.sumo.noted) - 1, action))
        image, _, terminated, truncated, info = env.step(action)
        ended = terminated or truncated
    frames, env.sumo.noted = env.sumo.noted, None
    own, most = [], max(len(others) for _, others in frames)
    others = np.tile(OUTSIDE, (len(frames), most, 1))
    for place, (mine, theirs) in enumerate(frames):
        own.append(mine[0] if len(mine) else own[-1])
        others[place, : len(theirs)] = theirs
    images = np.stack([grid(theirs, env.origin) for _, theirs in frames])
    return Trial(np.array(own), others, images, decisions, info["outcome"])


def car_boxes(cars: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Boxes of poses (..., 4): centres (..., 3), half sizes (3,) and quaternions (..., 4) as xyzw."""
    x, y, heading, _ = np.moveaxis(cars, -1, 0)
    zero = np.zeros_like(x)
    centres = np.stack([x, y, zero + HEIGHT / 2], axis=-1)
    turns = np.stack([zero, zero, np.sin(heading / 2), np.cos(heading / 2)], axis=-1)
    return centres, np.array([LENGTH, WIDTH, HEIGHT]) / 2, turns


def on_the_ground(lines: list[np.ndarray]) -> dict[str, np.ndarray]:
    """Polylines (n, 2) as {"line 0": (n, 3), ...} at height 0."""
    return {f"line {i}": np.column_stack([line, np.zeros(len(line))]) for i, line in enumerate(lines)}
