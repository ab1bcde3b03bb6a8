"""Figures and tables: the saved data are the drawn data, the bytes repeat, methods can be told apart."""

import csv
import os
import subprocess
import sys
from types import SimpleNamespace

import matplotlib
import matplotlib.pyplot as plt
import numpy as np
import pytest

from lifelong_lib.reproduction import figures, tables
from lifelong_lib.reproduction.files import ReproductionError

matplotlib.use("Agg")

DRAW = """
import sys
from pathlib import Path
from types import SimpleNamespace
import numpy as np
from lifelong_lib.reproduction import figures as f

chapter = SimpleNamespace(number=4, folder=Path(sys.argv[1]))
values = np.random.default_rng(0).normal(size=(6, 30))
fig, axes = f.panels(2)
axes[0].set(title="Spring-mass-damper", xlabel="iteration", ylabel="reward per step")
rows = f.draw_curves(axes[0], range(1, 31), values, "TaDeLL")
rows += f.draw_bars(axes[1], ["SM", "CP"], {"PG": values[:, :2], "TaDeLL": values[:, 2:4]})
f.shade_sides(axes[0], 8, "few", "many")
f.legend(fig)
f.save_figure(chapter, "F4.2", fig, rows)
"""


@pytest.fixture
def chapter(tmp_path):
    yield SimpleNamespace(number=4, profile="quick", seeds=6, folder=tmp_path / "latest")
    plt.close("all")


def read(path):
    with path.open() as file:
        return list(csv.DictReader(file))


def test_two_processes_write_the_same_bytes(tmp_path):
    for name, hash_seed in (("one", "1"), ("two", "2")):
        environment = os.environ | {"PYTHONHASHSEED": hash_seed, "MPLBACKEND": "Agg"}
        subprocess.run([sys.executable, "-c", DRAW, tmp_path / name], check=True, env=environment)
    names = sorted(path.name for path in (tmp_path / "one").iterdir())
    assert names == ["F4.2.csv", "F4.2.png", "F4.2.svg"]
    for name in names:
        assert (tmp_path / "one" / name).read_bytes() == (tmp_path / "two" / name).read_bytes(), name
    assert b"matplotlib.org" not in b"".join(path.read_bytes() for path in (tmp_path / "one").iterdir())


def test_curve_shows_and_returns_mean_and_standard_error(chapter):
    fig, (ax,) = figures.panels()
    values = np.array([[1.0, 2.0], [3.0, 6.0]])
    rows = figures.draw_curves(ax, [0, 1], values, "TaDeLL", label="ours")
    assert [row["mean"] for row in rows] == [2.0, 4.0] == list(ax.lines[0].get_ydata())
    assert [row["standard error"] for row in rows] == pytest.approx([1.0, 2.0])
    band = ax.collections[0].get_paths()[0].vertices
    assert band[:, 1].min() == pytest.approx(1.0) and band[:, 1].max() == pytest.approx(6.0)
    assert {(row["series"], row["n"]) for row in rows} == {("ours", 2)}


def test_rewards_have_plain_numbers_on_their_axis():
    fig, (ax, *_) = figures.panels(1)
    ax.plot([-6.0, -0.2])
    figures.reward_scale(ax)
    fig.canvas.draw()
    shown = [text.get_text().replace("\N{MINUS SIGN}", "-") for text in ax.get_yticklabels()]
    low, high = ax.get_ylim()
    assert {"-5", "-2", "-1", "-0.5", "-0.2"} <= {text for text, place in zip(shown, ax.get_yticks(), strict=True)
                                                 if low <= place <= high}


def test_bars_stand_side_by_side(chapter):
    fig, (ax,) = figures.panels()
    rows = figures.draw_bars(ax, ["SM", "CP"], {"TaDeLL": np.ones((3, 2)), "PG": np.full((1, 2), 2.0)})
    assert [bar.get_height() for bar in ax.patches] == [1.0, 1.0, 2.0, 2.0]
    edges = sorted((bar.get_x(), bar.get_x() + bar.get_width()) for bar in ax.patches)
    assert all(left[1] < right[0] for left, right in zip(edges, edges[1:], strict=False))
    assert {row["series"] for row in rows} == {"TaDeLL", "PG"}
    assert [row["mean"] for row in rows if row["x"] == "SM"] == [1.0, 2.0]
    assert [row["standard error"] for row in rows if row["n"] == 1] == [None, None]


def test_legend_names_each_series_once(chapter):
    fig, axes = figures.panels(2)
    for ax in axes:
        figures.draw_curves(ax, [1], [[1.0]], "TaDeLL")
        figures.draw_curves(ax, [1], [[1.0]], "PG", label="alone")
    figures.legend(fig)
    assert [text.get_text() for text in fig.legends[0].get_texts()] == ["TaDeLL", "alone"]


def test_factors_show_every_cell_and_keep_exact_zeros(chapter):
    fig, (ax,) = figures.panels()
    left, code = np.array([[1.0, 2.0], [3.0, 4.0]]), np.array([[0.5], [0.0]])
    rows = figures.draw_factors(ax, [[("θ", left @ code), ("L", left), ("s", code)]])
    assert [row["value"] for row in rows if row["panel"] == "L"] == [1.0, 2.0, 3.0, 4.0]
    assert {"0", "0.5", "=", "×"} <= {text.get_text() for text in ax.texts}


def test_the_number_of_a_cell_stands_in_the_cell(chapter):
    fig, (ax,) = figures.panels()
    figures.draw_factors(ax, [[("map", np.array([[1.0, -2.0]]))]])
    places = {text.get_text(): text.get_position() for text in ax.texts}
    assert places["1.0"] == (0.5, 0.5) and places["−2.0"] == (1.5, 0.5)


TOGETHER = [  # names that may stand in one figure
    ["TaDeMTL", "GO-MTL", "TaDeLL", "PG-ELLA", "ELLA", "PG", "STL", "Sinapov et al.", "warm start", "random",
     "random start"],
    ["PG", "PG-ELLA", "mean start", "random basis", "other task", "other sources", "by hand", "without faults",
     "random"],
    ["right", "left", "left2", "forward", "challenge", "random start"],
    ["single task", "direct copy", "reverse transfer"],
    ["pre-trained", "from scratch", "random"],
    ["unlimited", "FIFO", "surprise", "reward", "coverage", "matching", "latest"],
    ["top right", "bottom left", "bottom right"],
    ["none", "EWC", "selective", "both"],
]  # fmt: skip


@pytest.mark.parametrize("names", TOGETHER, ids=lambda names: names[0])
def test_methods_differ_by_more_than_colour(names):
    looks = [figures.LOOKS[name] for name in names]
    assert len({look.marker for look in looks}) == len(looks)


def test_every_look_stands_somewhere_and_others_are_refused():
    assert {name for names in TOGETHER for name in names} == figures.LOOKS.keys()
    with pytest.raises(ValueError, match="no look"):
        figures.look_of("TaDELL")


def test_global_style_is_left_alone(chapter):
    before = dict(matplotlib.rcParams)
    fig, (ax,) = figures.panels()
    rows = figures.draw_curves(ax, [1, 2], np.ones((2, 2)), "PG")
    figures.save_figure(chapter, "F4.2", fig, rows)
    assert dict(matplotlib.rcParams) == before


def test_files_of_a_figure_hold_every_digit_of_what_was_drawn(chapter):
    fig, (ax,) = figures.panels()
    ax.set(title="SM")
    rows = figures.draw_curves(ax, [1], [[0.1], [0.2], [np.float32(0.3)]], "PG")
    figures.save_figure(chapter, "F4.9", fig, rows)
    (row,) = read(chapter.folder / "F4.9.csv")
    assert row["panel"] == "SM" and float(row["mean"]) == rows[0]["mean"] == ax.lines[0].get_ydata()[0]
    assert (chapter.folder / "F4.9.png").stat().st_size > 1000


@pytest.mark.parametrize("identity", ["4.2", "F5.2", "T4.2", "F4.2/../x", "f4.2"])
def test_ids_of_other_chapters_and_other_things_are_refused(chapter, identity):
    fig, _ = figures.panels()
    with pytest.raises(ReproductionError, match=r"use F4\.1"):
        figures.save_figure(chapter, identity, fig, [{"x": 1}])


@pytest.mark.parametrize("rows, message", [([], "no rows"), ([{"x": [1, 2]}], "column 'x'")])
def test_rows_that_are_no_table_are_refused_before_anything_is_written(chapter, rows, message):
    with pytest.raises(ReproductionError, match=message):
        tables.save_table(chapter, "T4.1", rows)
    assert not chapter.folder.exists()


def test_table_is_saved_exactly_and_shown_readably(chapter):
    rows = [{"system": "SM|x", "reward": -2.3671234, "n": np.int64(10)},
            {"system": "<b>", "reward": np.nan, "note": None}]
    table = tables.save_table(chapter, "T4.1", rows)
    assert read(chapter.folder / "T4.1.csv")[0] == {"system": "SM|x", "reward": "-2.3671234", "n": "10", "note": ""}
    text = (chapter.folder / "T4.1.md").read_text()
    assert text.splitlines() == ["| system | reward | n | note |", "| --- | --- | --- | --- |",
                                 "| SM\\|x | -2.367 | 10 |  |", "| <b> | – |  |  |"]
    assert "<td>&lt;b&gt;</td>" in table._repr_html_() and table._repr_html_().count("<tr>") == 3


def test_the_backend_of_a_notebook_is_loaded_before_the_style_is_set():
    # Loaded by the first figure, inside rc_context, it was switched off again: a notebook showed one figure only.
    code = "import sys, lifelong_lib.reproduction.figures; print('matplotlib_inline.backend_inline' in sys.modules)"
    environment = os.environ | {"MPLBACKEND": "module://matplotlib_inline.backend_inline"}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "True"


def test_mean_and_standard_error_as_text_by_hand():
    samples = np.array([1.0, 2, 3, 6])  # mean 3, variance 14 / 3, standard error 1.0801
    assert tables.with_error(samples) == "3.000 ± 1.080" and tables.with_error(samples, "+.1f", ".1g") == "+3.0 ± 1"
