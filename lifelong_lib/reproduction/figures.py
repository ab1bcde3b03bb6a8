"""One style for every figure: a method looks the same everywhere, and a figure is saved with the data it shows.

Every draw function returns the rows that it drew; a notebook gathers them and `save_figure` stores exactly what the
reader sees. The rows carry the panel's title, so set title and scale first. No global setting of matplotlib is touched.
"""

import io
from typing import NamedTuple

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.ticker import SymmetricalLogLocator

from lifelong_lib.reproduction.files import require, write_atomically
from lifelong_lib.reproduction.labels import check_identity
from lifelong_lib.reproduction.statistics import standard_error
from lifelong_lib.reproduction.tables import csv_text

plt.switch_backend(plt.get_backend())  # loaded now: loaded inside rc_context, a notebook shows one figure only


class Look(NamedTuple):
    """How a method is drawn; marker, dashes and hatch keep methods apart in grey print."""

    colour: str
    marker: str
    line: object
    hatch: str = ""


# Colours of Okabe and Ito. As in the thesis: batch methods solid, lifelong methods dashed, single-task ones dotted.
LOOKS = {
    "TaDeMTL": Look("#56B4E9", "s", "-", ""),
    "GO-MTL": Look("#009E73", "^", "-", "\\\\\\"),
    "TaDeLL": Look("#0072B2", "o", (0, (5, 1.5)), "///"),
    "PG-ELLA": Look("#E69F00", "D", (0, (5, 1.5)), "xxx"),
    "ELLA": Look("#E69F00", "d", (0, (5, 1.5)), "xxx"),
    "PG": Look("#000000", "x", (0, (1, 1.5)), ""),
    "STL": Look("#000000", "+", (0, (1, 1.5)), ""),
    "Sinapov et al.": Look("#CC79A7", "v", (0, (5, 1.5, 1, 1.5)), "..."),
    "warm start": Look("#D55E00", "P", "-", "++"),
    "random": Look("#666666", "1", (0, (1, 3)), "ooo"),
    "random start": Look("#882255", "<", (0, (3, 1, 1, 1)), "..."),
    # chapter 5: where a network was trained first, and what became of it
    "right": Look("#0072B2", "o", "-", ""),
    "left": Look("#E69F00", "D", (0, (5, 1.5)), "xxx"),
    "left2": Look("#009E73", "^", (0, (5, 1.5, 1, 1.5)), "///"),
    "forward": Look("#56B4E9", "s", (0, (1, 1)), "..."),
    "challenge": Look("#D55E00", "v", (0, (3, 1, 1, 1)), "++"),
    "single task": Look("#000000", "x", "-", ""),
    "direct copy": Look("#BBBBBB", "o", (0, (1, 1.5)), ""),
    "reverse transfer": Look("#666666", "s", (0, (5, 1.5)), "///"),
    "pre-trained": Look("#0072B2", "o", "-", ""),
    "from scratch": Look("#E69F00", "D", (0, (5, 1.5)), "xxx"),
    # chapter 3: what stands beside PG-ELLA (new looks come last: the place decides where markers stand)
    "mean start": Look("#009E73", "^", (0, (5, 1.5, 1, 1.5)), ""),
    "random basis": Look("#882255", "<", (0, (3, 1, 1, 1)), ""),
    "other task": Look("#999999", "s", (0, (1, 1)), ""),
    "by hand": Look("#0072B2", "P", (0, (3, 1, 1, 1)), ""),
    "without faults": Look("#CC79A7", "v", (0, (5, 1.5)), ""),
    "other sources": Look("#56B4E9", "o", (0, (1, 1.5)), ""),
    # chapter 6: memories
    "unlimited": Look("#666666", "s", "-", "///"),
    "FIFO": Look("#000000", "x", (0, (1, 1.5)), ""),
    "surprise": Look("#D55E00", "v", (0, (3, 1, 1, 1)), "++"),
    "reward": Look("#E69F00", "D", (0, (5, 1.5)), "xxx"),
    "coverage": Look("#009E73", "^", (0, (5, 1.5, 1, 1.5)), "\\\\\\"),
    "matching": Look("#0072B2", "o", "-", "///"),
    "latest": Look("#CC79A7", "P", (0, (1, 1)), "..."),
}
# Chapter 6: rooms of the grid world, and what is done against forgetting, which never stand beside what they look like.
LOOKS |= {"top right": LOOKS["right"], "bottom left": LOOKS["left"], "bottom right": LOOKS["left2"],
          "none": LOOKS["FIFO"], "EWC": LOOKS["left"], "selective": LOOKS["right"], "both": LOOKS["left2"]}  # fmt: skip
STYLE = {
    "font.family": "DejaVu Sans", "font.size": 8, "axes.titlesize": 9, "axes.titleweight": "bold",
    "axes.linewidth": 0.6, "axes.spines.top": False, "axes.spines.right": False, "axes.axisbelow": True,
    "axes.grid": True, "grid.color": "#DDDDDD", "grid.linewidth": 0.5, "lines.linewidth": 1.4, "lines.markersize": 4.5,
    "legend.frameon": False, "hatch.linewidth": 0.6, "figure.dpi": 110, "savefig.dpi": 150, "svg.fonttype": "path",
    "axes.formatter.min_exponent": 3,  # 4, not 4 x 10^0
}


def panels(n=1, columns=None, height=2.3):
    """Return (figure, axes (n,)): `n` panels in rows of `columns` (default 3 at most), each `height` [inch] high."""
    columns = columns or min(n, 3)
    rows = -(-n // columns)
    size = (6.8 if columns > 1 else 4.4, rows * height + 0.4)  # [inch] a printed line is 6.8 wide
    with plt.rc_context(STYLE):
        fig, axes = plt.subplots(rows, columns, figsize=size, layout="constrained", squeeze=False)
    for unused in axes.flat[n:]:
        unused.remove()
    return fig, axes.flat[:n]


def legend(fig):
    """Put one legend for all panels above them, where it hides no data; call it when everything is drawn."""
    entries = {text: mark for ax in fig.axes for mark, text in zip(*ax.get_legend_handles_labels(), strict=True)}
    length = sum(11 + len(text) for text in entries)  # [letters of 4.4 points] texts and the samples before them
    rows = np.ceil(4.4 * length / (72 * fig.get_figwidth()))
    with plt.rc_context(STYLE):
        fig.legend(entries.values(), entries.keys(), loc="outside upper center", handlelength=3.2, columnspacing=1.4,
                   ncols=int(np.ceil(len(entries) / rows)))


def reward_scale(ax):
    """Draw rewards, which are below zero, by their order of magnitude, or failures would dwarf all that is good."""
    ax.set_yscale("symlog", linthresh=0.05)
    ax.yaxis.set_major_locator(SymmetricalLogLocator(base=10, linthresh=0.05, subs=(1, 2, 5)))
    ax.yaxis.set_major_formatter("{x:g}")


def draw_curves(ax, x, values, method, label=None):
    """Draw the mean of `values` (n_seeds, n_x) over `x` (n_x,) with a band of one standard error; return the rows.

    `method`: a name of LOOKS; `label`: what the legend says (default: the method).
    """
    values = np.asarray(values, dtype=float)
    mean, error, look = values.mean(axis=0), standard_error(values), look_of(method)
    step = max(1, len(mean) // 7)  # markers of different methods stand at different places, so that none hides another
    with plt.rc_context(STYLE):
        ax.plot(x, mean, color=look.colour, linestyle=look.line, marker=look.marker, markerfacecolor="white",
                markevery=(list(LOOKS).index(method) % step, step), label=label or method)
        ax.fill_between(x, mean - error, mean + error, color=look.colour, alpha=0.18, linewidth=0)
    if ax.get_xscale() == "log" and len(mean) <= 12:
        ax.set_xticks(x, [f"{place:g}" for place in x])
        ax.minorticks_off()
    return _rows(ax, label or method, x, mean, error, len(values))


def draw_bars(ax, labels, values):
    """Draw the mean of each method's values as bars with one standard error; return the rows.

    `labels`: (n_labels,) groups on the axis; `values`: {method: (n_seeds, n_labels)}.
    """
    width, rows, places = 0.8 / len(values), [], np.arange(len(labels))
    for i, (method, samples) in enumerate(values.items()):
        samples, look = np.asarray(samples, dtype=float), look_of(method)
        mean, error, x = samples.mean(axis=0), standard_error(samples), places + (i - (len(values) - 1) / 2) * width
        with plt.rc_context(STYLE):
            ax.bar(x, mean, 0.92 * width, color=look.colour, hatch=look.hatch, hatchcolor="white", label=method)
            for colour, size in (("white", 2.4), ("#444444", 1)):  # the white edge shows the mark on a dark bar
                ax.errorbar(x, mean, error, fmt="none", ecolor=colour, elinewidth=size, capsize=2, capthick=size)
        rows += _rows(ax, method, labels, mean, error, len(samples))
    ax.set_xticks(places, labels)
    ax.tick_params(axis="x", length=0)
    ax.grid(visible=False, axis="x")
    return rows


def shade_sides(ax, boundary, below, above):
    """Tint the panel left and right of `boundary` (data units); `below` and `above` name the sides in the legend."""
    left, right = ax.get_xlim()
    ax.axvspan(left, boundary, color="#FFF3B8", zorder=-2, linewidth=0, label=below)
    ax.axvspan(boundary, right, color="#E3F0FA", zorder=-2, linewidth=0, label=above)
    ax.axvline(boundary, color="#777777", linewidth=0.7, zorder=-1)
    ax.set_xlim(left, right)


def draw_factors(ax, equations):
    """Draw matrix equations such as theta = L s, all cells of one size; return the rows.

    `equations`: list of lists of (name, matrix), the first matrix being the product of the others. Each matrix has its
    own colours, from blue (negative) to red (positive), and small ones have numbers in their cells.
    """
    rows, top, right = [], 0.0, 0.0
    with plt.rc_context(STYLE):
        for equation in equations:
            left, tallest = 0.0, max(len(matrix) for _, matrix in equation)
            for i, (name, matrix) in enumerate(equation):
                height, width = matrix.shape
                start = top + (tallest - height) / 2
                if i:
                    ax.text(left - 0.5, top + tallest / 2, "×" if i > 1 else "=", ha="center", va="center", fontsize=12)
                _draw_cells(ax, matrix, left, start)
                ax.text(left + width / 2, start - 0.15, name, ha="center", va="bottom", weight="bold")
                left += width + 1
                rows += [{"panel": name, "row": row, "column": column, "value": float(value)}
                         for (row, column), value in np.ndenumerate(matrix)]
            top, right = top + tallest + 1, max(right, left - 1)
        ax.set(xlim=(0, right), ylim=(top - 1, -0.7), aspect="equal")
        ax.axis("off")
    return rows


def save_figure(chapter, identity, fig, rows):
    """Write `<identity>.svg`, `.png` and `.csv` (the drawn data) to the chapter's folder; the figure stays open.

    `identity`: such as "F4.2"; `rows`: list of flat dicts, as the draw functions return them. The same figure gives the
    same bytes: no date, no random id and no version is written.
    """
    check_identity(chapter, identity, "F")
    for ax in fig.axes:  # a title set by ax.set() outside the style would keep matplotlib's own size
        ax.title.set(fontsize=STYLE["axes.titlesize"], fontweight=STYLE["axes.titleweight"])
    pictures = {".csv": csv_text(identity, rows)}
    for ending, metadata in ((".svg", {"Creator": None, "Date": None}), (".png", {"Software": None})):
        content = io.BytesIO()
        with plt.rc_context(STYLE | {"svg.hashsalt": identity}):
            fig.savefig(content, format=ending[1:], metadata=metadata)
        pictures[ending] = content.getvalue()
    for ending, content in pictures.items():  # only now, when nothing can fail half way
        write_atomically(chapter.folder / f"{identity}{ending}", content)


def look_of(method):
    """Return the Look of `method`; raises ReproductionError with the known names for a method that has none."""
    require(method in LOOKS, f"method '{method}' has no look: add it to LOOKS in figures.py or use {', '.join(LOOKS)}")
    return LOOKS[method]


def _rows(ax, series, x, mean, error, n):
    return [{"panel": ax.get_title(), "series": series, "x": place if isinstance(place, str) else float(place),
             "mean": float(m), "standard error": None if np.isnan(e) else float(e), "n": n}
            for place, m, e in zip(x, mean, error, strict=True)]


def _draw_cells(ax, matrix, x, y):
    (height, width), limit = matrix.shape, np.abs(matrix).max() or 1.0
    ax.imshow(matrix, cmap="RdBu_r", vmin=-limit, vmax=limit, interpolation="nearest",
              extent=(x, x + width, y + height, y))
    for (i, j), value in np.ndenumerate(matrix) if matrix.size <= 100 else ():
        text = f"{value:.{1 if abs(value) < 10 else 0}f}".replace("-", "−") if value else "0"
        ax.text(x + j + 0.5, y + i + 0.5, text, color="white" if abs(value) > 0.6 * limit else "black",
                ha="center", va="center", fontsize=6)
