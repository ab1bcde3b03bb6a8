"""The digits are the published ones, and their tasks show them as they should."""

import hashlib
import runpy

import numpy as np
import pytest
from conftest import REPOSITORY

from lifelong_lib.environments.digits import FILE, PAIRS, DigitTask, pairs, permutations, read_digits


@pytest.fixture(scope="module")
def digits():
    return read_digits()


def test_the_digits_are_those_that_were_published(digits):
    made = runpy.run_path(str(REPOSITORY / "data" / "mnist" / "make.py"))
    for name, published in made["PUBLISHED"].items():
        array = getattr(digits, name)
        assert array.dtype == np.uint8
        assert hashlib.md5(made["published_form"](array)).hexdigest() == published
    assert made["PUBLISHED"]["train_images"] == "6bbc9ace898e44ae57da46a324031adb"
    assert made["TARGET"] == FILE
    assert np.bincount(digits.test_labels).tolist() == [980, 1135, 1032, 1010, 982, 892, 958, 1028, 974, 1009]


def test_another_file_and_none_are_refused(tmp_path):
    (tmp_path / "mnist.npz").write_bytes(FILE.read_bytes()[:-1] + b"x")
    with pytest.raises(ValueError, match=r"^.*mnist\.npz is not the file of this version: restore it, or make it with"):
        read_digits(tmp_path / "mnist.npz")
    with pytest.raises(ValueError, match=r"^.*none\.npz is missing: restore it, or make it with data/mnist/make\.py$"):
        read_digits(tmp_path / "none.npz")


def test_permuted_tasks_show_all_digits_with_the_same_pixels_elsewhere(digits):
    tasks = permutations(digits, 3, np.random.default_rng(0))
    plain, labels = tasks[0].test()
    assert plain.dtype == np.float32 and plain.shape == (10_000, 784) and plain.min() == 0 and plain.max() == 1
    assert (np.rint(255 * plain) == digits.test_images).all() and (labels == digits.test_labels).all()
    for task in tasks[1:]:
        shown, same = task.test()
        assert (same == labels).all() and sorted(task.pixels) == list(range(784)) and (shown != plain).any()
        assert (shown[:, np.argsort(task.pixels)] == plain).all()
    assert (tasks[1].pixels != tasks[2].pixels).any()


def test_pairs_show_their_two_digits_under_their_own_labels(digits):
    tasks = pairs(digits)
    assert PAIRS == ((0, 5), (1, 6), (2, 7), (3, 8), (4, 9))
    for pair, task in zip(PAIRS, tasks, strict=True):
        images, labels = task.test()
        assert sorted(set(labels)) == list(pair)
        assert (np.rint(255 * images) == digits.test_images[np.isin(digits.test_labels, pair)]).all()
    assert sum(len(task.digits.train_labels) for task in tasks) == 60_000


def test_draws_are_of_the_training_digits_and_follow_the_generator(digits):
    task = DigitTask(digits, np.arange(784)[::-1])
    images, labels = task.draw(50, np.random.default_rng(3))
    chosen = np.random.default_rng(3).integers(60_000, size=50)
    assert (np.rint(255 * images[:, ::-1]) == digits.train_images[chosen]).all()
    assert (labels == digits.train_labels[chosen]).all() and labels.dtype == np.int64 and images.dtype == np.float32
