"""Pictures that are no charts: flows, networks, images, junctions. As in figures.py, each returns what it drew."""

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.collections import PolyCollection
from matplotlib.patches import FancyBboxPatch, Rectangle

from lifelong_lib.reproduction.figures import STYLE

OWN, OTHER, ROAD = "#D55E00", "#0072B2", "#E4E4E4"


def draw_flow(ax, flows):
    """Draw chains of boxes with arrows, one under the other.

    `flows`: {name of the chain: list of (text of the box, colour)}; the name stands to the left of its chain.
    """
    rows = []
    with plt.rc_context(STYLE):
        for line, (name, boxes) in enumerate(flows.items()):
            ax.text(-0.12, -line, name, ha="right", va="center", weight="bold")
            for place, (text, colour) in enumerate(boxes):
                frame = FancyBboxPatch((place + 0.04, -line - 0.3), 0.72, 0.6, boxstyle="round,pad=0.02",
                                       facecolor="white", edgecolor=colour, linewidth=1.6)  # fmt: skip
                ax.add_patch(frame)
                ax.text(place + 0.4, -line, text, ha="center", va="center", fontsize=7)
                if place:
                    ax.annotate("", (place + 0.01, -line), (place - 0.21, -line), arrowprops={"arrowstyle": "-|>"})
                rows.append({"panel": name, "step": place + 1, "text": " ".join(text.split())})
        ax.set(xlim=(-0.9, max(map(len, flows.values()))), ylim=(0.5 - len(flows), 0.5))
        ax.axis("off")
    return rows


def draw_layers(ax, layers):
    """Draw a network as a row of blocks, from input to output; a layer of vectors is a thin column.

    `layers`: list of (text, shape of the output); images have the shape (channels, rows, columns), vectors (n,).
    """
    rows, left = [], 0.0
    with plt.rc_context(STYLE):
        for text, shape in layers:
            height, width = (shape[1], shape[2]) if len(shape) == 3 else (4 + 4 * np.log10(shape[0]), 1.6)
            depth = 0.9 * np.log2(1 + shape[0]) if len(shape) == 3 else 0.0
            slot = max(width + depth, 17)  # room for the text
            start = left + (slot - width - depth) / 2
            for back in np.linspace(depth, 0, 5 if depth else 1):
                ax.add_patch(Rectangle((start + back, -height / 2 + back), width, height, facecolor="#CFE3F3",
                                       edgecolor=OTHER, linewidth=0.7))  # fmt: skip
            middle = left + slot / 2
            ax.text(middle, -12, " x ".join(map(str, shape)), ha="center", va="top", weight="bold")
            ax.text(middle, -15.5, text, ha="center", va="top", fontsize=7)
            left += slot + 2
            rows.append({"panel": text.partition("\n")[0], "layer": len(rows), "outputs": int(np.prod(shape)),
                         "shape": " x ".join(map(str, shape))})  # fmt: skip
        ax.set(xlim=(-1, left), ylim=(-23, 14), aspect="equal")
        ax.axis("off")
    return rows


def draw_image(ax, image, x, y):
    """Draw an image (rows, columns[, 3]) of values from 0 to 1, row 0 below; return the cells that are not empty.

    `x`, `y`: (first, last) edges of the columns and rows in the axes' units.
    """
    kept = image.reshape(*image.shape[:2], -1)
    with plt.rc_context(STYLE):
        ax.imshow(np.clip(image, 0, 1), origin="lower", extent=(*x, *y), cmap="gray", vmin=0, vmax=1, aspect="auto",
                  interpolation="nearest")  # fmt: skip
        ax.grid(visible=False)
    return [{"panel": ax.get_title(), "row": int(row), "column": int(column)}
            | {f"channel {c}": float(value) for c, value in enumerate(kept[row, column])}
            for row, column in np.argwhere(kept.any(axis=-1))]  # fmt: skip


def draw_junction(ax, lanes, cars, size, lane_width=3.2, path=()):
    """Draw lanes (or tracks) in grey and cars on them from above, the first one as the own car.

    `lanes`: list of polylines (n, 2) [m]; `cars`: (n, 4) x, y, heading [rad], speed [m/s]; `size`: (length, width) [m];
    `path`: (n, 2) [m] where the own car will go.
    """
    rows = [{"panel": ax.get_title(), "car": "own" if i == 0 else "other", "x": float(x), "y": float(y),
             "heading": float(heading), "speed": float(speed)} for i, (x, y, heading, speed) in enumerate(cars)]
    drawn = {f"line {i}": line for i, line in enumerate(lanes)} | {"path": path}
    rows += [{"panel": ax.get_title(), "car": of, "x": float(x), "y": float(y)} for of in drawn for x, y in drawn[of]]
    corners = np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]]) * np.array(size) / 2
    turns = np.array([[[np.cos(a), np.sin(a)], [-np.sin(a), np.cos(a)]] for a in cars[:, 2]])
    with plt.rc_context(STYLE):
        edge = 0.5 if lane_width > 1 else 0  # between lanes; it would hide thin tracks
        ax.add_collection(PolyCollection(_quads(lanes, lane_width), facecolor=ROAD, edgecolor="white", linewidth=edge))
        boxes, colours = corners @ turns + cars[:, None, :2], [OWN] + [OTHER] * (len(cars) - 1)
        ax.add_collection(PolyCollection(boxes, facecolor=colours, zorder=3))
        if len(path):
            ax.plot(*np.transpose(path), color=OWN, linestyle=":", zorder=2)
            ax.annotate("", path[-1], path[-2], arrowprops={"arrowstyle": "-|>", "color": OWN}, zorder=2)
        ax.set_aspect("equal")
        ax.grid(visible=False)
    return rows


def _quads(lines, width):
    """Rectangles (n, 4, 2) of a width around every segment of polylines."""
    starts, ends = (np.concatenate([line[part] for line in lines]) for part in (slice(None, -1), slice(1, None)))
    along = (ends - starts) / np.linalg.norm(ends - starts, axis=1, keepdims=True)
    side = width / 2 * np.column_stack([-along[:, 1], along[:, 0]])
    return np.stack([starts + side, ends + side, ends - side, starts - side], axis=1)
