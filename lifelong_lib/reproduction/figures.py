"""One style for every figure: a method looks the same everywhere, and a figure is saved with the data it shows.

Every draw function returns the rows that it drew; a notebook gathers them and `save_figure` stores exactly what the
reader sees. The rows carry the panel's title, so set title and scale first. No global setting of matplotlib is touched.
"""

import io
from typing import NamedTuple

import matplotlib.pyplot as plt
import numpy as np

from lifelong_lib.reproduction.runs import write_atomically
from lifelong_lib.reproduction.statistics import standard_error
from lifelong_lib.reproduction.tables import check_identity, csv_text

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
    "copied": Look("#999999", "X", (0, (3, 3)), "---"),
    "random": Look("#666666", "1", (0, (1, 3)), "ooo"),
    "published": Look("#000000", "*", ""),
}
STYLE = {
    "font.family": "DejaVu Sans", "font.size": 8, "axes.titlesize": 9, "axes.titleweight": "bold",
    "axes.linewidth": 0.6, "axes.spines.top": False, "axes.spines.right": False, "axes.axisbelow": True,
    "axes.grid": True, "grid.color": "#DDDDDD", "grid.linewidth": 0.5, "lines.linewidth": 1.4, "lines.markersize": 4.5,
    "legend.frameon": False, "hatch.linewidth": 0.6, "figure.dpi": 110, "savefig.dpi": 150, "svg.fonttype": "path",
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
    entries = dict(sorted(entries.items(), key=lambda entry: entry[0] == "published"))  # ours first, published last
    length = sum(11 + len(text) for text in entries)  # [letters of 4.4 points] texts and the samples before them
    rows = np.ceil(4.4 * length / (72 * fig.get_figwidth()))
    with plt.rc_context(STYLE):
        fig.legend(entries.values(), entries.keys(), loc="outside upper center", handlelength=3.2, columnspacing=1.4,
                   ncols=max(1, int(np.ceil(len(entries) / max(1, rows)))))


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


def draw_bars(ax, labels, values, published=None, label_of=None):
    """Draw the mean of each method's values as bars with one standard error; return the rows.

    `labels`: (n_labels,) groups on the axis; `values`: {method: (n_seeds, n_labels)}; `published`: numbers to mark on
    the bars, {method: (n_labels,)}, nan where there is none; `label_of`: {method: text for the legend}.
    """
    width, rows, places = 0.8 / len(values), [], np.arange(len(labels))
    for i, (method, samples) in enumerate(values.items()):
        samples, look, text = np.asarray(samples, dtype=float), look_of(method), (label_of or {}).get(method, method)
        mean, error, x = samples.mean(axis=0), standard_error(samples), places + (i - (len(values) - 1) / 2) * width
        with plt.rc_context(STYLE):
            ax.bar(x, mean, 0.92 * width, color=look.colour, hatch=look.hatch, hatchcolor="white", label=text)
            for colour, size in (("white", 2.4), ("#444444", 1)):  # the white edge shows the mark on a dark bar
                ax.errorbar(x, mean, error, fmt="none", ecolor=colour, elinewidth=size, capsize=2, capthick=size)
        rows += _rows(ax, text, labels, mean, error, len(samples))
        if published and method in published:
            rows += draw_published(ax, x + 0.3 * width, published[method], method, x_names=labels)
    ax.set_xticks(places, labels)
    ax.tick_params(axis="x", length=0)
    ax.grid(visible=False, axis="x")
    return rows


def draw_published(ax, x, y, method="published", x_names=None):
    """Mark published numbers `y` (n,) at `x` (n,) by stars in the colour of `method`; return the rows.

    `x_names`: what the rows call the places (default: `x`). One legend entry serves all stars of a panel.
    """
    stars = {"linestyle": "", "marker": "*", "markersize": 9, "markerfacecolor": "white", "markeredgewidth": 1.1}
    if "published" not in ax.get_legend_handles_labels()[1]:
        ax.plot([], [], **stars, markeredgecolor="black", label="published")
    ax.plot(x, y, **stars, markeredgecolor=look_of(method).colour, zorder=5, clip_on=False)
    series = "published" if method == "published" else f"published {method}"
    return _rows(ax, series, x if x_names is None else x_names, y, np.full(len(y), np.nan), None)


def shade_sides(ax, boundary, below, above):
    """Tint the panel left and right of `boundary` (data units); `below` and `above` name the sides in the legend."""
    left, right = ax.get_xlim()
    ax.axvspan(left, boundary, color="#FFF3B8", zorder=-2, linewidth=0, label=below)
    ax.axvspan(boundary, right, color="#E3F0FA", zorder=-2, linewidth=0, label=above)
    ax.axvline(boundary, color="#777777", linewidth=0.7, zorder=-1)
    ax.set_xlim(left, right)


def heat_map(ax, matrix, title="", row_labels=(), column_labels=()):
    """Draw `matrix` (rows, columns) from blue (negative) to red (positive), few cells with numbers; return the rows."""
    matrix = np.atleast_2d(np.asarray(matrix, dtype=float))
    with plt.rc_context(STYLE):
        image = _cells(ax, matrix, (0, 0))
        if matrix.size > 100:
            ax.figure.colorbar(image, ax=ax, shrink=0.8)
        ax.set(title=title, xlim=(0, matrix.shape[1]), ylim=(matrix.shape[0], 0), aspect="equal",
               xticks=np.arange(len(column_labels)) + 0.5, xticklabels=column_labels,
               yticks=np.arange(len(row_labels)) + 0.5, yticklabels=row_labels)
    ax.tick_params(length=0)
    ax.grid(visible=False)
    ax.spines[:].set_visible(False)
    return _cell_rows(title, matrix)


def draw_factors(ax, equations, row_labels=None):
    """Draw matrix equations such as theta = L s, all cells of one size; return the rows.

    `equations`: list of lists of (name, matrix), the first matrix being the product of the others; `row_labels`:
    {name of a first matrix: texts beside its rows}. Each matrix has its own colour scale; numbers stand in the cells.
    """
    rows, top, right, row_labels = [], 0.0, 0.0, row_labels or {}
    margin = 0.16 * max((len(text) for texts in row_labels.values() for text in texts), default=0)  # [cells]
    with plt.rc_context(STYLE):
        for equation in equations:
            left, tallest = margin, max(len(matrix) for _, matrix in equation)
            for i, (name, matrix) in enumerate(equation):
                start = top + (tallest - len(matrix)) / 2
                _cells(ax, np.asarray(matrix, dtype=float), (left, start))
                ax.text(left + matrix.shape[1] / 2, start - 0.15, name, ha="center", va="bottom", weight="bold")
                for j, text in enumerate(row_labels.get(name, ()) if i == 0 else ()):
                    ax.text(left - 0.1, start + j + 0.5, text, ha="right", va="center", fontsize=7)
                left += matrix.shape[1] + 1
                if i < len(equation) - 1:
                    ax.text(left - 0.5, top + tallest / 2, "×" if i else "=", ha="center", va="center", fontsize=12)
                rows += _cell_rows(name, matrix)
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
    """Return the Look of `method`; raises ValueError with the known names for a method that has none."""
    if method not in LOOKS:
        raise ValueError(f"method '{method}' has no look: add it to LOOKS in figures.py or use {', '.join(LOOKS)}")
    return LOOKS[method]


def _rows(ax, series, x, mean, error, n):
    return [{"panel": ax.get_title(), "series": series, "x": place if isinstance(place, str) else float(place),
             "mean": float(m), "standard error": None if np.isnan(e) else float(e), "n": n}
            for place, m, e in zip(x, mean, error, strict=True)]


def _cells(ax, matrix, corner):
    (x, y), (height, width), limit = corner, matrix.shape, np.abs(matrix).max() or 1.0
    image = ax.imshow(matrix, cmap="RdBu_r", vmin=-limit, vmax=limit, interpolation="nearest",
                      extent=(x, x + width, y + height, y))
    for (i, j), value in np.ndenumerate(matrix) if matrix.size <= 100 else ():
        text = f"{value:.{2 if abs(value) < 10 else 0}f}".replace("-", "−") if value else "0"
        ax.text(x + j + 0.5, y + i + 0.5, text, color="white" if abs(value) > 0.6 * limit else "black",
                ha="center", va="center", fontsize=6)
    return image


def _cell_rows(name, matrix):
    return [{"panel": name, "row": i, "column": j, "value": float(v)} for (i, j), v in np.ndenumerate(matrix)]
