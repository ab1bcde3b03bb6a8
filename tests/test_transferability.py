"""Transferability: benefits by hand with a stub, and the model on a world in which benefits are linear."""

import numpy as np
import pytest

from lifelong_lib.transfer.transferability import TransferabilityModel, transfer_benefits


def test_benefits_by_hand():
    """Three tasks with best policies 0, 1, 3; two steps of training from a start give minus its distance, then half."""
    goals, seen = np.array([0.0, 1.0, 3.0]), []

    def train(starts):
        seen.append(starts)
        distance = -np.abs(starts[:, 0] - goals)
        return np.stack([distance, distance / 2])

    baseline = np.array([[-2.0, -2.0, -2.0], [0.0, 0.0, -1.0]])  # means -1, -1, -1.5
    benefits = transfer_benefits(train, goals[:, None], baseline)
    # row i: minus 3/4 of the distances from policy i to each goal, less the baseline's mean
    expected = [[np.nan, -0.75 + 1, -2.25 + 1.5], [-0.75 + 1, np.nan, -1.5 + 1.5], [-2.25 + 1, -1.5 + 1, np.nan]]
    assert np.allclose(benefits, expected, equal_nan=True)
    assert [starts.tolist() for starts in seen] == [[[goal]] * 3 for goal in goals], "one policy for all targets"


def linear_world(slope, count=12, seed=0):
    """Descriptors, and benefits B(i, j) = 0.5 + slope . (m_j - m_i) with nothing on the diagonal."""
    descriptors = np.random.default_rng(seed).uniform(1, [2, 50, 3], (count, 3))
    benefits = 0.5 + (descriptors[None] - descriptors[:, None]) @ slope
    np.fill_diagonal(benefits, np.nan)
    return descriptors, benefits


def test_a_linear_world_is_found_exactly_and_its_best_source_chosen():
    slope = np.array([2.0, -0.1, 1.0])
    descriptors, benefits = linear_world(slope)
    model = TransferabilityModel().fit(descriptors, benefits)
    assert np.allclose(model.scale_, descriptors.std(axis=0))
    assert np.allclose(model.regression_.coef_ / model.scale_, slope)
    assert model.regression_.intercept_ == pytest.approx(0.5)
    for new in ([1.5, 20.0, 2.0], [1.0, 49.0, 1.0]):
        assert model.best_source(np.array(new)) == np.argmax((new - descriptors) @ slope)


def test_the_direction_of_a_transfer_counts():
    """With the benefits turned round (transposed) the best source becomes the worst one."""
    descriptors, benefits = linear_world(np.array([1.0, 0.0, 0.0]))
    best = TransferabilityModel().fit(descriptors, benefits).best_source(np.ones(3))
    worst = TransferabilityModel().fit(descriptors, benefits.T).best_source(np.ones(3))
    assert best == descriptors[:, 0].argmin() and worst == descriptors[:, 0].argmax()


def test_units_of_descriptors_do_not_matter_and_constant_ones_do_no_harm():
    descriptors, benefits = linear_world(np.array([2.0, -0.1, 1.0]))
    units = np.array([1e3, 1e-3, 7.0])
    with_constant = np.column_stack([descriptors * units, np.ones(len(descriptors))])
    model = TransferabilityModel().fit(with_constant, benefits)
    assert model.scale_[-1] == 1
    new = np.array([1.5, 20.0, 2.0])
    expected = TransferabilityModel().fit(descriptors, benefits).best_source(new)
    assert model.best_source(np.append(new * units, 1)) == expected


def test_benefits_that_are_missing_are_left_out():
    descriptors, benefits = linear_world(np.array([2.0, -0.1, 1.0]))
    benefits[0, 1:4] = np.nan
    model = TransferabilityModel().fit(descriptors, benefits)
    assert np.allclose(model.regression_.coef_ / model.scale_, [2.0, -0.1, 1.0])
