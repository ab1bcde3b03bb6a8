"""Pictures of worlds as arrays: strokes and boxes on a plane, smooth at their edges. No world is known here."""

from itertools import pairwise

import numpy as np

RENDER_MODES = ["rgb_array"]  # a list, as Gymnasium wants it
OWN, OTHER, ROAD, PALE = (213, 94, 0), (0, 114, 178), (228, 228, 228), (200, 200, 200)


def known_mode(mode: str | None) -> str | None:
    """Return a mode of drawing that there is, or None for none; ValueError for any other."""
    if mode not in (None, *RENDER_MODES):
        raise ValueError(f"no render mode {mode!r}; there are None and {', '.join(map(repr, RENDER_MODES))}")
    return mode


def projected(points: np.ndarray, seen_from: tuple) -> np.ndarray:
    """Return points (..., 3) [m], z upwards, on the plane (..., 2) of a viewer far off in direction ``seen_from`` (3,).

    The direction must not be vertical; (0, -1, 0) gives x to the right and z upwards.
    """
    backwards = np.array(seen_from) / np.linalg.norm(seen_from)
    right = np.cross([0, 0, 1], backwards) / np.hypot(*backwards[:2])
    return points @ np.column_stack([right, np.cross(backwards, right)])


class Picture:
    """A window of the plane between two corners ``low`` and ``high`` (2,) [m], with ``scale`` pixels a metre.

    White at first; what is drawn later covers what was there. Colours are (red, green, blue) from 0 to 255.
    """

    def __init__(self, low: np.ndarray, high: np.ndarray, scale: float):
        self.low, self.scale = np.array(low, float), scale
        columns, rows = np.rint(scale * np.subtract(high, low)).astype(int)
        self.colours = np.full((rows, columns, 3), 255.0)  # row 0 is the lowest

    def stroke(self, line: np.ndarray, width: float, colour: tuple) -> None:
        """Draw a polyline (n, 2) [m] of a ``width`` [m], with round ends."""
        for start, end in pairwise(np.asarray(line, float)):
            along = end - start
            window, offset = self._near([start, end], width / 2, start)
            share = np.clip(offset @ along / max(along @ along, 1e-12), 0, 1)
            distance = np.linalg.norm(offset - share[..., None] * along, axis=-1)
            self._paint(window, width / 2 - distance, colour)

    def box(self, pose: np.ndarray, size: tuple, colour: tuple) -> None:
        """Draw a rectangle: x, y [m] of its middle and heading [rad]; length along the heading and width [m]."""
        x, y, heading = pose
        window, offset = self._near([(x, y)], np.hypot(*size) / 2, (x, y))
        ahead = offset @ [np.cos(heading), np.sin(heading)]
        aside = offset @ [-np.sin(heading), np.cos(heading)]
        self._paint(window, np.minimum(size[0] / 2 - np.abs(ahead), size[1] / 2 - np.abs(aside)), colour)

    def rgb(self) -> np.ndarray:
        """Pixels (rows, columns, 3) uint8, the highest row first."""
        return np.rint(self.colours[::-1]).astype(np.uint8)

    def _near(self, points, margin, origin):
        """The part of the picture around points [m], and where its pixels' middles lie from ``origin`` [m]."""
        size = self.colours.shape[1::-1]
        first = np.clip(self.scale * (np.min(points, axis=0) - margin - self.low) - 1, 0, size).astype(int)
        last = np.clip(self.scale * (np.max(points, axis=0) + margin - self.low) + 2, 0, size).astype(int)
        x, y = ((np.arange(*ends) + 0.5) / self.scale for ends in zip(first, last, strict=True))
        places = np.stack(np.meshgrid(x, y), axis=-1) + self.low
        return (slice(first[1], last[1]), slice(first[0], last[0])), places - origin

    def _paint(self, window, depth, colour):
        """Mix the colour in where the depth [m] below the edge of a shape is above 0; half of it at the edge."""
        share = np.clip(0.5 + self.scale * depth, 0, 1)[..., None]
        self.colours[window] += share * (np.array(colour) - self.colours[window])
