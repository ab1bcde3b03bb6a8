"""Trials at a SUMO junction, step by step, as arrays that a recording can show."""

import numpy as np

from lifelong_lib.environments.crossing import LENGTH, WIDTH, grid

OUTSIDE = (0.0, -500.0, 0.0, 0.0)  # where those stand that are not there: in no picture
HEIGHT = 1.5  # [m] of every car


def film(frames: list[tuple], origin: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A trial of H steps as arrays, from the cars (own, others) that a simulation ``noted`` at every step.

    Returns poses of the own car (H + 1, 4), the last one held once it has left; of the others (H + 1, n, 4), which
    change places, with OUTSIDE where there are fewer than n; and what would be seen (H + 1, rows, columns, 3) if a
    decision were due, with the grid at ``origin`` (2,).
    """
    own, most = [], max(len(others) for _, others in frames)
    crowd = np.tile(OUTSIDE, (len(frames), most, 1))
    for place, (mine, others) in enumerate(frames):
        own.append(mine[0] if len(mine) else own[-1])
        crowd[place, : len(others)] = others
    return np.array(own), crowd, np.stack([grid(others, origin) for _, others in frames])


def trial_shown(env) -> dict[str, dict]:
    """What a recording shows of the trial that a junction has just driven while its simulation ``noted`` all cars:
    the own car's boxes, the crowd of the others, images of what would be seen, and the lanes as fixed lines.
    """
    own, others, images = film(env.sumo.noted, env.origin)
    return {"boxes": {"own car": car_boxes(own)}, "crowds": {"traffic": car_boxes(others)}, "images": {"input": images},
            "fixed": on_the_ground(env.roads.lanes)}  # fmt: skip


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
