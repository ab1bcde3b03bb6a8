"""The loader of notebook functions itself."""

import numpy as np
import pytest
from notebook_functions import load, runs


def test_a_function_comes_with_its_imports_and_sees_names_that_are_given_later():
    space = load(3, "lead", "jump", early=1)
    curves = {"PG": np.array([[0, 1, 2]]), "PG-ELLA": np.array([[0, 5, 10]])}
    assert space.jump(curves, "PG-ELLA") == [2]
    space.early = 2
    assert space.jump(curves, "PG-ELLA") == [4]
    assert load(4, "exponents").growth_exponent([1, 2], [1, 4]) == pytest.approx(2)


def test_a_name_that_is_gone_is_named():
    with pytest.raises(AssertionError, match="chapter 3 defines jumpp 0 times, not once"):
        load(3, "jump", "jumpp")


def test_hand_made_runs_are_stacked_like_stored_ones():
    made = runs(({"task": "a"}, {"x": [1, 2]}), ({"task": "b"}, {"x": [3, 4]}))
    assert made.stack("x", task="b").tolist() == [3, 4]
