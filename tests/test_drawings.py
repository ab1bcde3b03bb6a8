"""Drawings: what is returned is what is drawn, at the places where it should be."""

import matplotlib
import numpy as np
import pytest
from matplotlib.collections import PolyCollection

from lifelong_lib.reproduction import drawings
from lifelong_lib.reproduction.figures import panels

matplotlib.use("Agg")


@pytest.fixture
def ax():
    return panels(1)[1][0]


def test_a_flow_has_a_box_a_step_and_an_arrow_between_two(ax):
    rows = drawings.draw_flow(ax, {"copy": [("learn A", "blue"), ("try B:\n50%", "grey")], "none": [("wait", "grey")]})
    assert rows == [{"panel": "copy", "step": 1, "text": "learn A"}, {"panel": "copy", "step": 2, "text": "try B: 50%"},
                    {"panel": "none", "step": 1, "text": "wait"}]  # fmt: skip
    assert len(ax.patches) == 3
    assert sum(text.arrow_patch is not None for text in ax.texts if hasattr(text, "arrow_patch")) == 1


def test_layers_are_drawn_in_their_order_without_touching(ax):
    rows = drawings.draw_layers(ax, [("input", (3, 18, 26)), ("convolution\n6 x 6", (32, 7, 11)), ("values", (5,))])
    assert [(row["panel"], row["shape"], row["outputs"]) for row in rows] == [
        ("input", "3 x 18 x 26", 1404), ("convolution", "32 x 7 x 11", 2464), ("values", "5", 5)]
    fronts = [patch for patch in ax.patches if patch.get_y() == -patch.get_height() / 2]
    assert [(patch.get_width(), patch.get_height()) for patch in fronts[:2]] == [(26, 18), (11, 7)]
    edges = [(patch.get_x(), patch.get_x() + patch.get_width()) for patch in ax.patches]
    assert all(left[1] < right[0] for left, right in zip(edges[:5], edges[5:10], strict=True))


def test_an_image_gives_its_cells_that_are_not_empty(ax):
    image = np.zeros((3, 4, 2))
    image[2, 1] = 0.25, 1.0
    ax.set_title("seen")
    assert drawings.draw_image(ax, image[..., 0], (-2, 2), (0, 3)) == [
        {"panel": "seen", "row": 2, "column": 1, "channel 0": 0.25}]
    (row,) = drawings.draw_image(ax, np.concatenate([image, image[..., :1]], axis=2), (-2, 2), (0, 3))
    assert (row["channel 0"], row["channel 1"], row["channel 2"]) == (0.25, 1.0, 0.25)
    assert ax.images[0].origin == "lower" and ax.images[0].get_extent() == [-2, 2, 0, 3]


def test_a_junction_has_its_lanes_and_each_car_where_it_is(ax):
    lane, cars = np.array([[0.0, 0], [10, 0], [10, 5]]), np.array([[2.0, 1, 0, 0], [5, 5, np.pi / 2, 9]])
    rows = drawings.draw_junction(ax, [lane], cars, (4, 2), lane_width=3, path=np.array([[4.0, 1], [9, 1]]))
    assert [row["car"] for row in rows] == ["own", "other", *["line 0"] * 3, "path", "path"]
    assert ax.lines[0].get_xydata().tolist() == [[4, 1], [9, 1]]
    assert rows[1] == {"panel": "", "car": "other", "x": 5.0, "y": 5.0, "heading": np.pi / 2, "speed": 9.0}
    lanes, boxes = (found for found in ax.collections if isinstance(found, PolyCollection))
    corners = [path.vertices for path in boxes.get_paths()]
    assert np.allclose([corners[0].min(axis=0), corners[0].max(axis=0)], [[0, 0], [4, 2]])
    assert np.allclose([corners[1].min(axis=0), corners[1].max(axis=0)], [[4, 3], [6, 7]])
    first, second = (path.vertices for path in lanes.get_paths())
    assert np.allclose([first.min(axis=0), first.max(axis=0)], [[0, -1.5], [10, 1.5]])
    assert np.allclose([second.min(axis=0), second.max(axis=0)], [[8.5, 0], [11.5, 5]])
