"""The synthetic classification tasks: labels by hand, ranges, and how models and descriptors hang together."""

import numpy as np
import pytest

from lifelong_lib.environments.classification import ClassificationTasks, domain_one, domain_two, shared_subspace


def rng(seed=0):
    return np.random.default_rng(seed)


class FixedDraws:
    """A stand-in generator that hands out these samples."""

    def __init__(self, X):
        self.X = np.array(X)

    def uniform(self, low, high, shape):
        assert (low, high, shape) == (-0.5, 0.5, self.X.shape)
        return self.X


def test_labels_by_hand():
    theta = np.array([[1.0, -1.0], [0.0, 2.0]])
    tasks = ClassificationTasks(theta, theta)
    X = [[0.2, 0.1], [0.1, 0.2], [-0.1, -0.3], [0.0, 0.0]]  # x . theta of task 0: 0.1, -0.1, 0.2, 0
    for task, labels in ((0, [1, 0, 1, 0]), (1, [1, 1, 0, 0])):
        drawn, found = tasks.draw_samples(task, 4, FixedDraws(X))
        assert drawn.tolist() == X and found.tolist() == labels


def test_samples_fill_the_cube_and_repeat_with_their_seed():
    tasks = domain_one(2, rng())
    X, labels = tasks.draw_samples(1, 3000, rng(1))
    again, _ = tasks.draw_samples(1, 3000, rng(1))
    assert X.shape == (3000, 8) and labels.shape == (3000,) and np.array_equal(X, again)
    assert X.min() >= -0.5 and X.max() <= 0.5 and np.allclose(X.std(axis=0), 1 / np.sqrt(12), rtol=0.05)
    assert labels.mean() == pytest.approx(0.5, abs=0.05), "a boundary through the middle halves the cube"


def test_domain_one_describes_a_task_by_its_own_model():
    tasks = domain_one(500, rng(), d=6)
    assert len(tasks) == 500 and tasks.theta.shape == (500, 6)
    assert np.array_equal(tasks.theta, tasks.descriptors)
    assert np.abs(tasks.theta).max() <= 0.5 and np.ptp(tasks.theta) > 0.98
    assert np.linalg.matrix_rank(tasks.theta) == 6


@pytest.mark.parametrize(("k", "active"), [(4, 2), (5, 1), (3, 3)])
def test_domain_two_codes_have_exactly_so_many_entries(k, active):
    """The codes are recovered from models and descriptors, with L and D drawn as the first two of the generator."""
    tasks = domain_two(200, rng(3), d=8, d_m=7, k=k, active=active)
    same = rng(3)
    L, D = same.standard_normal((8, k)), same.standard_normal((7, k))
    codes = tasks.theta @ np.linalg.pinv(L).T
    assert np.allclose(codes, tasks.descriptors @ np.linalg.pinv(D).T), "models and descriptors share their codes"
    assert ((np.abs(codes) > 1e-10).sum(axis=1) == active).all()
    assert ((np.abs(codes) > 1e-10).mean(axis=0) > 0.7 * active / k).all(), "no column is preferred"
    assert np.allclose(codes @ L.T, tasks.theta) and np.linalg.matrix_rank(tasks.theta) == k
    assert codes[np.abs(codes) > 1e-10].std() == pytest.approx(1, rel=0.15)


def test_domain_two_repeats_with_its_seed():
    assert np.array_equal(domain_two(5, rng(1)).theta, domain_two(5, rng(1)).theta)
    assert not np.array_equal(domain_two(5, rng(1)).theta, domain_two(5, rng(2)).theta)


def test_models_in_a_shared_subspace_span_just_that():
    tasks = shared_subspace(50, rng(), d=8, k=3)
    assert tasks.theta.shape == (50, 8) and tasks.descriptors is tasks.theta
    assert np.linalg.matrix_rank(tasks.theta) == 3
    assert np.linalg.norm(tasks.theta, axis=1).max() <= 0.5 * np.sqrt(3) + 1e-12, "a rotated cube of side 1"
