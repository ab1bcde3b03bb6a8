"""Pictures cover the areas that geometry says, in the right place and the right way up."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lifelong_lib.environments.pictures import Picture, projected

BLACK, RED = (0, 0, 0), (255, 0, 0)


def picture(scale=10):
    return Picture((-5, -3), (5, 3), scale)


def area(drawn):
    """Square metres that a black shape covers."""
    return (1 - drawn.colours[..., 0] / 255).sum() / drawn.scale**2


def middle(drawn):
    """Centre of mass [m] of a black shape."""
    weight = 1 - drawn.colours[..., 0] / 255
    rows, columns = np.indices(weight.shape)
    mean = [np.average(axis + 0.5, weights=weight) for axis in (columns, rows)]
    return drawn.low + np.array(mean) / drawn.scale


def test_an_empty_picture_is_white_and_has_its_size():
    assert picture().rgb().shape == (60, 100, 3) and picture().rgb().dtype == np.uint8
    assert (picture().rgb() == 255).all()


@given(x=st.floats(-2, 2), y=st.floats(-1, 1), heading=st.floats(-4, 4), length=st.floats(1, 2.5),
       width=st.floats(0.5, 1.5))  # fmt: skip
@settings(max_examples=50, deadline=None)
def test_a_box_covers_its_area_about_its_middle(x, y, heading, length, width):
    drawn = picture(scale=20)
    drawn.box((x, y, heading), (length, width), BLACK)
    assert area(drawn) == pytest.approx(length * width, rel=0.02)
    assert middle(drawn) == pytest.approx([x, y], abs=0.01)


@given(angle=st.floats(-4, 4), length=st.floats(0, 3), width=st.floats(0.3, 1))
@settings(max_examples=50, deadline=None)
def test_a_stroke_covers_a_rectangle_and_two_half_discs(angle, length, width):
    drawn = picture(scale=20)
    drawn.stroke(np.outer([-0.5, 0.5], [np.cos(angle), np.sin(angle)]) * length, width, BLACK)
    assert area(drawn) == pytest.approx(length * width + np.pi * width**2 / 4, rel=0.02)


def test_length_lies_along_the_heading_up_is_up_and_the_last_drawn_is_on_top():
    drawn = picture()
    drawn.box((1, 2, np.pi / 2), (1.6, 0.4), BLACK)
    drawn.stroke([(1, 2), (1, 2)], 0.4, RED)
    pixels = drawn.rgb()

    def seen(x, y):
        return tuple(pixels[59 - int((y + 3) * 10), int((x + 5) * 10)])

    assert seen(1, 2.7) == seen(1, 1.3) == BLACK and seen(1.7, 2) == seen(1, -2) == (255, 255, 255)
    assert seen(1, 2) == RED


def test_a_polyline_turns_without_a_gap():
    drawn = picture()
    drawn.stroke([(-2, -2), (0, -2), (0, 2)], 0.5, BLACK)
    assert drawn.colours[10, 50, 0] == 0  # the corner


@pytest.mark.parametrize("far", [20.0, 1e3, 1e9])
def test_what_lies_outside_changes_nothing_and_what_comes_in_is_drawn(far):
    drawn = picture()
    for place in np.array([[1, 0], [-1, 0], [0, 1], [0, -1], [1, -1]]) * far:
        drawn.box((*place, 1.0), (5, 2), BLACK)
        drawn.stroke([place, place + [0.1, 0.1]], 1.0, BLACK)
    assert (drawn.rgb() == 255).all()
    drawn.stroke([(-far, 0), (far, 0)], 1.0, BLACK)
    assert area(drawn) == pytest.approx(10, rel=0.01)


def test_a_viewer_sees_x_to_the_right_and_z_upwards_and_nothing_of_what_lies_along_his_view():
    points = np.array([[1.0, 2, 3], [0, 5, 0]])
    np.testing.assert_allclose(projected(points, (0, -2, 0)), [[1, 3], [0, 0]], atol=1e-12)
    np.testing.assert_allclose(projected(points, (1, 0, 0)), [[2, 3], [5, 0]], atol=1e-12)
    slanted = np.array([0.4, -1, 0.35])
    np.testing.assert_allclose(projected(slanted * 3, slanted), [0, 0], atol=1e-12)
    rng = np.random.default_rng(0)
    axes = projected(np.eye(3), rng.normal(size=3))
    np.testing.assert_allclose(axes.T @ axes, np.eye(2), atol=1e-12)  # lengths across the view are kept
