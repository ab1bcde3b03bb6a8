"""GO-MTL and TaDeMTL: the objective falls, shared structure is found, and descriptors predict what was not seen."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lifelong_lib.transfer.dictionary import objective
from lifelong_lib.transfer.multitask import MultiTask

SIZE, COLUMNS, FEATURES = 8, 3, 6


def factored_world(count, seed=0, active=2):
    """Parameters theta = L s, descriptors m = D s with ``active`` of the codes not zero, and Hessians."""
    rng = np.random.default_rng(seed)
    L, D = rng.standard_normal((SIZE, COLUMNS)), rng.standard_normal((FEATURES, COLUMNS))
    codes = rng.standard_normal((count, COLUMNS))
    codes[rng.random(codes.shape).argsort(axis=1) >= active] = 0
    roots = rng.standard_normal((count, SIZE, SIZE))
    return codes @ L.T, codes @ D.T, np.eye(SIZE) + roots @ roots.swapaxes(1, 2) / SIZE


def policies(one):
    return np.stack([one.policy(t) for t in range(one.n_tasks_)])


def explained(predicted, truth):
    return 1 - ((predicted - truth) ** 2).sum() / ((truth - truth.mean(axis=0)) ** 2).sum()


@given(seed=st.integers(0, 1000), k=st.integers(1, 5), sparsity=st.sampled_from([1e-3, 0.05, 1.0]), both=st.booleans())
@settings(max_examples=8, deadline=None)
def test_the_objective_falls_in_every_round(seed, k, sparsity, both):
    theta, descriptors, hessians = factored_world(12, seed)
    noise = np.random.default_rng(seed + 1).standard_normal(theta.shape)
    one = MultiTask(k, sparsity, ridge=1e-3, max_rounds=15, tolerance=0.0, random_state=0)
    one.fit(theta + 0.3 * noise, hessians, descriptors if both else None)
    values = np.array(one.objectives_)
    assert len(values) == 15
    assert (np.diff(values) <= 1e-6 * values[:-1]).all(), np.diff(values)
    assert values[-1] < values[0]


@pytest.mark.parametrize("both", [False, True], ids=["GO-MTL", "TaDeMTL"])
def test_the_objective_is_that_of_the_thesis(both):
    """Equation 2.11, and 4.3 with the descriptors as a second sum of squares weighted by zeta; |s|_1 counts once."""
    theta, descriptors, hessians = factored_world(10)
    one = MultiTask(2, 0.05, ridge=1e-2, descriptor_weight=0.6, max_rounds=4, tolerance=0.0)
    one.fit(theta, hessians, descriptors if both else None)
    codes = [one.codes_[t] for t in range(10)]
    expected = objective(theta, codes, hessians, one.basis_, 0.05, 1e-2)
    if both:
        zeta = 0.6 * np.trace(hessians, axis1=1, axis2=2) / SIZE
        expected += objective(descriptors, codes, zeta, one.descriptor_basis_, 0.0, 1e-2)
    assert one.objectives_[-1] == pytest.approx(expected)


@pytest.mark.parametrize("both", [False, True], ids=["GO-MTL", "TaDeMTL"])
def test_neither_codes_nor_dictionaries_alone_can_improve_the_end(both):
    theta, descriptors, hessians = factored_world(6)
    one = MultiTask(2, 0.05, ridge=1e-2, max_rounds=100, tolerance=1e-8)
    one.fit(theta, hessians, descriptors if both else None)
    codes, rng = np.stack([one.codes_[t] for t in range(6)]), np.random.default_rng(0)
    zeta = np.trace(hessians, axis1=1, axis2=2) / SIZE

    def value(change_codes=0.0, change_basis=0.0):
        total = objective(theta, codes + change_codes, hessians, one.basis_ + change_basis, 0.05, 1e-2)
        if both:
            total += objective(descriptors, codes + change_codes, zeta, one.descriptor_basis_, 0.0, 1e-2)
        return total

    for _ in range(30):
        assert value(change_codes=3e-2 * rng.standard_normal(codes.shape)) > value()
        assert value(change_basis=3e-2 * rng.standard_normal(one.basis_.shape)) > value()


def test_go_mtl_recovers_parameters_that_factorise():
    theta, _, hessians = factored_world(60)
    one = MultiTask(COLUMNS, sparsity=1e-5, ridge=1e-8).fit(theta, hessians)
    assert explained(policies(one), theta) > 0.9999
    too_few = MultiTask(COLUMNS - 2, sparsity=1e-5, ridge=1e-8).fit(theta, hessians)
    assert explained(policies(too_few), theta) < 0.9


def test_go_mtl_brings_noisy_parameters_closer_to_the_truth():
    theta, _, hessians = factored_world(80)
    noisy = theta + 0.3 * np.random.default_rng(9).standard_normal(theta.shape)
    one = MultiTask(COLUMNS, sparsity=1e-2, ridge=1e-6).fit(noisy, hessians)
    assert np.mean((policies(one) - theta) ** 2) < 0.6 * np.mean((noisy - theta) ** 2)


@pytest.mark.parametrize("shuffled", [False, True])
def test_tademtl_predicts_unseen_tasks_from_their_own_descriptors_only(shuffled):
    theta, descriptors, hessians = factored_world(90, active=COLUMNS)
    known = np.random.default_rng(1).permutation(60) if shuffled else np.arange(60)
    one = MultiTask(COLUMNS, sparsity=1e-4, ridge=1e-6).fit(theta[:60], hessians[:60], descriptors[known])
    quality = explained(np.stack([one.predict(m) for m in descriptors[60:]]), theta[60:])
    assert quality < 0.3 if shuffled else quality > 0.99


def test_it_stops_when_the_objective_hardly_changes():
    theta, _, hessians = factored_world(12)
    one = MultiTask(2, 0.05, ridge=1e-3, max_rounds=200, tolerance=1e-3).fit(30 * theta, hessians)
    assert one.objectives_[-1] > 10, "so that relative and absolute changes differ"
    changes = np.abs(np.diff(one.objectives_)) / one.objectives_[1:]
    assert 2 <= len(one.objectives_) < 200 and changes[-1] <= 1e-3 and (changes[:-1] > 1e-3).all()


@pytest.mark.parametrize("both", [False, True], ids=["GO-MTL", "TaDeMTL"])
def test_the_same_data_give_the_same_dictionaries(both):
    theta, descriptors, hessians = factored_world(10)
    given_descriptors = descriptors if both else None
    first, again = (MultiTask(3, max_rounds=5).fit(theta, hessians, given_descriptors) for _ in range(2))
    assert np.array_equal(first.basis_, again.basis_) and first.objectives_ == again.objectives_


def test_more_columns_than_tasks_and_numbers_can_be_fitted():
    theta, _, hessians = factored_world(3)
    one = MultiTask(10, sparsity=1e-4, ridge=1e-6, max_rounds=5).fit(theta, hessians)
    assert one.basis_.shape == (SIZE, 10) and explained(policies(one), theta) > 0.99


@pytest.mark.parametrize("both", [False, True], ids=["GO-MTL", "TaDeMTL"])
def test_it_can_be_saved_and_go_on_one_task_at_a_time(both, tmp_path):
    theta, descriptors, hessians = factored_world(11)
    views = (theta, hessians, descriptors) if both else (theta, hessians)
    one = MultiTask(3, max_rounds=5).fit(*(view[:10] for view in views))
    one.save(tmp_path / "learner.npz")
    loaded = MultiTask.load(tmp_path / "learner.npz")
    if both:
        for each in (one, loaded):
            each.partial_fit(10, *(view[10] for view in views)).partial_fit(2, *(view[3] for view in views))
        assert one.n_tasks_ == 11
    assert np.array_equal(one.basis_, loaded.basis_) and np.array_equal(policies(one), policies(loaded))


def test_go_mtl_has_nothing_to_predict_from():
    theta, descriptors, hessians = factored_world(4)
    with pytest.raises(ValueError, match="no task with a descriptor has been learned yet"):
        MultiTask(2).fit(theta, hessians).predict(descriptors[0])


def test_parameters_without_a_hessian_each_are_refused():
    theta, _, hessians = factored_world(4)
    with pytest.raises(ValueError):
        MultiTask(2).fit(theta, hessians[:3])
    with pytest.raises(ValueError, match="must be finite; did the single-task learner diverge"):
        MultiTask(2).fit(theta * np.nan, hessians)
