"""Sparse codes and dictionaries against enumeration, optimality conditions and dense algebra."""

from itertools import product

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from lifelong_lib.transfer.dictionary import (
    DEAD_NORM,
    Dictionary,
    mutual_coherence,
    objective,
    reconstruction_loss,
    sparse_code,
)

seeds = st.integers(0, 10**6)


def positive(d, rng, extra=0.0):
    """A random positive semi-definite matrix (d, d)."""
    root = rng.standard_normal((d, d + 1))
    return root @ root.T / d + extra * np.eye(d)


def problem(seed, d=5, k=3):
    rng = np.random.default_rng(seed)
    return rng.standard_normal(d), rng.standard_normal((d, k)), positive(d, rng)


def as_matrix(weight, d):
    return weight if np.ndim(weight) else weight * np.eye(d)


def weighed_objective(target, basis, code, weight, sparsity):
    return reconstruction_loss(target, basis, code, weight) + sparsity * np.abs(code).sum()


def by_enumeration(target, basis, weight, sparsity):
    """The exact lasso solution: for every pattern of signs the linear equations that hold there; the best one wins."""
    Q, c = basis.T @ weight @ basis, basis.T @ weight @ target
    best = np.zeros(len(c))
    for signs in product((-1, 0, 1), repeat=len(c)):
        used = np.flatnonzero(signs)
        code = np.zeros(len(c))
        code[used] = np.linalg.solve(Q[np.ix_(used, used)], c[used] - sparsity / 2 * np.array(signs)[used])
        if weighed_objective(target, basis, code, weight, sparsity) < weighed_objective(
            target, basis, best, weight, sparsity
        ):
            best = code
    return best


# ----------------------------------------------------------------------------------------------------- sparse coding

@pytest.mark.parametrize("sparsity", [0.01, 0.5, 2.0])
@pytest.mark.parametrize("seed", range(5))
def test_sparse_code_is_the_minimum_found_by_enumeration(seed, sparsity):
    target, basis, weight = problem(seed)
    code, exact = sparse_code(target, basis, weight, sparsity), by_enumeration(target, basis, weight, sparsity)
    assert np.allclose(code, exact, atol=1e-4)
    assert np.array_equal(code == 0, exact == 0)


def violation(target, basis, weight, sparsity, code):
    """How far the optimality conditions are missed, relative to the largest of their terms.

    The gradient of the squared error is -sparsity * sign where the code is not zero, and no larger where it is.
    """
    weight = as_matrix(weight, len(target))
    slope, used = 2 * basis.T @ weight @ (target - basis @ code), code != 0
    missed = np.where(used, np.abs(slope - sparsity * np.sign(code)), np.abs(slope) - sparsity)
    return missed.max() / (sparsity + 2 * np.abs(basis.T @ weight @ target).max())


BASES = {
    "independent": lambda basis, rng: basis,
    "a zero column": lambda basis, rng: basis * (np.arange(basis.shape[1]) > 0),
    "the same column twice": lambda basis, rng: basis[:, np.arange(basis.shape[1]) // 2],
    "opposite and nearly parallel": lambda basis, rng: np.hstack([basis, -2 * basis + 1e-5 * rng.random(basis.shape)]),
    "all parallel, as after one task": lambda basis, rng: np.outer(basis[:, 0], rng.standard_normal(basis.shape[1])),
    "all nearly parallel": lambda basis, rng: basis[:, :1] + 1e-4 * basis,
    "lengths that differ": lambda basis, rng: basis * 10 ** rng.uniform(-3, 1, basis.shape[1]),
    "whole numbers, with ties": lambda basis, rng: np.round(basis),
}  # fmt: skip


@pytest.mark.parametrize("kind", BASES)
@given(seed=seeds, d=st.integers(1, 9), k=st.integers(1, 12), scale=st.floats(-8, 0.1), rank=st.sampled_from([0, 1, 4]))
@example(seed=2, d=8, k=8, scale=-1.0, rank=1)  # long columns with little weight: the Gram matrix is mostly rounding
@settings(max_examples=60, deadline=None)
def test_sparse_code_fulfils_the_optimality_conditions(kind, seed, d, k, scale, rank):
    """From penalties so small that they hardly count to those that leave nothing; weights of any rank, or a number."""
    rng = np.random.default_rng(seed)
    target, basis, root = rng.standard_normal(d), BASES[kind](rng.standard_normal((d, k)), rng), positive(d, rng)
    # A square of what has a smaller rank is singular but for rounding; rank 0 stands for a number.
    weight = root[:, :rank] @ root[:, :rank].T if rank else 3.0
    largest = 2 * np.abs(basis.T @ as_matrix(weight, d) @ target).max()
    sparsity = 10**scale * largest or 1.0
    code = sparse_code(target, basis, weight, sparsity)
    assert violation(target, basis, weight, sparsity, code) <= 1e-8
    assert abs(scale) < 1e-8 or code.any() == (sparsity < largest)


@pytest.mark.parametrize("place", ["target", "basis", "weight"])
def test_numbers_that_are_not_finite_are_complained_about(place):
    arrays = dict(zip(("target", "basis", "weight"), problem(0), strict=True))
    arrays[place].flat[0] = np.nan
    with pytest.raises(RuntimeError, match=r"no sparse code found in 300 rounds \(d = 5, k = 3, .* finite") as caught:
        sparse_code(**arrays, sparsity=0.1)
    assert "\n" not in str(caught.value)


def test_a_code_that_is_not_optimal_is_not_returned(monkeypatch):
    target, basis, weight = problem(0)
    assert np.count_nonzero(sparse_code(target, basis, weight, 0.5)) == 1  # of three: the others have to leave
    monkeypatch.setattr("lifelong_lib.transfer.dictionary.CODING_ROUNDS", 1)
    with pytest.raises(RuntimeError, match="no sparse code found in 1 rounds"):
        sparse_code(target, basis, weight, 0.5)


@given(seed=seeds, weight=st.floats(0.01, 100))
@settings(max_examples=30, deadline=None)
def test_a_number_stands_for_that_many_times_the_identity(seed, weight):
    target, basis, _ = problem(seed)
    expected = sparse_code(target, basis, weight * np.eye(5), 0.1)
    assert np.allclose(sparse_code(target, basis, weight, 0.1), expected, atol=1e-6)
    loss = reconstruction_loss(target, basis, expected, weight)
    assert loss == pytest.approx(reconstruction_loss(target, basis, expected, weight * np.eye(5)))


def test_only_the_ratio_of_weight_and_sparsity_matters():
    target, basis, weight = problem(1)
    assert np.allclose(sparse_code(target, basis, weight, 0.1), sparse_code(target, basis, 1000 * weight, 100.0))


def test_more_sparsity_never_gives_a_larger_code_and_in_the_end_none():
    target, basis, weight = problem(2)
    largest = 2 * np.abs(basis.T @ weight @ target).max()
    sizes = [np.abs(sparse_code(target, basis, weight, s)).sum() for s in largest * np.linspace(0.01, 1.01, 20)]
    assert (np.diff(sizes) <= 1e-6).all() and sizes[0] > 0 and sizes[-1] == 0
    assert sparse_code(target, basis, weight, 0.98 * largest).any(), "the bound of the lasso path is tight"


def test_without_knowledge_the_code_is_zero():
    target, basis, weight = problem(3)
    assert not sparse_code(target, np.zeros_like(basis), weight, 0.1).any()
    assert not sparse_code(target, basis, np.zeros_like(weight), 0.1).any()
    assert not sparse_code(target, basis, 0.0, 0.1).any()


def test_reconstruction_loss_by_hand():
    target, basis, code = np.array([3.0, 1.0]), np.array([[1.0], [2.0]]), np.array([2.0])  # error (1, -3)
    assert reconstruction_loss(target, basis, code, np.array([[2.0, 1.0], [1.0, 1.0]])) == 2 - 6 + 9
    assert reconstruction_loss(target, basis, code, 0.5) == 5


def test_eigenvalues_below_zero_that_only_rounding_makes_do_no_harm():
    flat = np.outer([1.0, 2.0], [1.0, 2.0]) - 1e-16 * np.eye(2)
    basis = np.array([[1.0, 2.0], [3.0, -1.0]])  # the second column lies in the direction that has no weight
    assert sparse_code(np.array([1.0, 1.0]), basis, flat, 0.7) == pytest.approx([(3 * 7 - 0.35) / 49, 0])


# -------------------------------------------------------------------------------------------------------- dictionary

def filled(weights, seed=0, d=4, k=3, T=6, ridge=0.01):
    """A dictionary that met T tasks, and the tasks as (code, target, weight)."""
    rng = np.random.default_rng(seed)
    codes = rng.standard_normal((T, k)) * (rng.random((T, k)) < 0.7)
    draw = {"full": lambda: positive(d, rng), "scalar": lambda: float(rng.uniform(0.5, 2))}[weights]
    tasks = [(code, rng.standard_normal(d), draw()) for code in codes]
    dictionary = Dictionary(d, k, ridge, weights, rng)
    for task in tasks:
        dictionary.add(*task)
    return dictionary, tasks


def dense_solution(tasks, d, k, ridge):
    """Equations 2.13-2.15 word by word: Kronecker products, one inverse, columns stacked."""
    T = len(tasks)
    A = sum(np.kron(np.outer(code, code), as_matrix(weight, d)) for code, _, weight in tasks) / T
    b = sum(np.kron(code, as_matrix(weight, d) @ target) for code, target, weight in tasks) / T
    return (np.linalg.inv(A + ridge * np.eye(k * d)) @ b).reshape(k, d).T


@pytest.mark.parametrize("weights", ["full", "scalar"])
@given(seed=seeds, d=st.integers(1, 6), k=st.integers(1, 5), T=st.integers(1, 8), ridge=st.sampled_from([1e-4, 0.1]))
@settings(max_examples=30, deadline=None)
def test_the_solution_equals_the_dense_inverse(weights, seed, d, k, T, ridge):
    dictionary, tasks = filled(weights, seed, d, k, T, ridge)
    expected = dense_solution(tasks, d, k, ridge)
    assert np.allclose(dictionary.solve(T), expected, rtol=1e-8, atol=1e-8 * np.abs(expected).max())
    assert dictionary.basis.shape == (d, k)


@pytest.mark.parametrize("weights", ["full", "scalar"])
def test_the_solution_minimises_the_objective(weights):
    dictionary, tasks = filled(weights)
    codes, targets, matrices = zip(*tasks, strict=True)

    def value(basis):
        return objective(targets, codes, matrices, basis, 0.3, 0.01)

    basis, rng = dictionary.solve(len(tasks)).copy(), np.random.default_rng(1)
    for _ in range(20):
        direction = 1e-3 * rng.standard_normal(basis.shape)
        up, down = value(basis + direction), value(basis - direction)
        assert min(up, down) > value(basis)
        assert abs(up - down) < 1e-6 * (up + down - 2 * value(basis)) + 1e-14, "the slope is zero"


def test_objective_by_hand():
    basis = np.array([[1.0, 0.0], [0.0, 2.0]])
    targets, codes = [np.array([1.0, 1.0]), np.array([0.0, 4.0])], [np.array([1.0, 0.0]), np.array([0.0, -1.0])]
    # errors (0, 1) and (0, 6); squared and weighted 3 * 1 and 1 * 36; codes of size 1 each; |L|^2 = 5
    assert objective(targets, codes, [3 * np.eye(2), np.eye(2)], basis, 0.5, 0.1) == pytest.approx((39 + 1) / 2 + 0.5)


@pytest.mark.parametrize("weights", ["full", "scalar"])
@given(seed=seeds)
@settings(max_examples=30, deadline=None)
def test_adding_and_taking_out_returns_to_the_start(weights, seed):
    dictionary, tasks = filled(weights, seed)
    before = dictionary.A.copy(), dictionary.b.copy(), dictionary.solve(6).copy()
    rng = np.random.default_rng(seed + 1)
    extra = rng.standard_normal(3), rng.standard_normal(4), tasks[0][2]
    dictionary.add(*extra)
    assert not np.allclose(dictionary.solve(7), before[2], rtol=1e-3)
    dictionary.add(*extra, sign=-1)
    assert np.allclose(dictionary.A, before[0], atol=1e-12) and np.allclose(dictionary.b, before[1], atol=1e-12)
    assert np.allclose(dictionary.solve(6), before[2], rtol=1e-6, atol=1e-9)


@given(seed=seeds)
@settings(max_examples=20, deadline=None)
def test_the_order_of_tasks_does_not_matter_once_codes_are_given(seed):
    dictionary, tasks = filled("full", seed)
    backwards = Dictionary(4, 3, 0.01, "full", np.random.default_rng(0))
    for task in reversed(tasks):
        backwards.add(*task)
    assert np.allclose(backwards.solve(6), dictionary.solve(6), rtol=1e-7, atol=1e-9)


def test_scalar_weights_are_full_ones_in_a_small_system():
    scalar, tasks = filled("scalar")
    full = Dictionary(4, 3, 0.01, "full", np.random.default_rng(0))
    for code, target, weight in tasks:
        full.add(code, target, weight * np.eye(4))
    assert scalar.A.shape == (3, 3) and full.A.shape == (12, 12)
    assert np.allclose(scalar.solve(6), full.solve(6), rtol=1e-10)


def test_only_dead_columns_are_drawn_anew_and_from_the_own_generator():
    dictionaries = [Dictionary(4, 3, 0.1, "full", np.random.default_rng(9)) for _ in range(2)]
    for dictionary in dictionaries:
        dictionary.basis[:, 1] = DEAD_NORM / 10
        kept = dictionary.basis[:, [0, 2]].copy()
        dictionary.revive()
        assert np.array_equal(dictionary.basis[:, [0, 2]], kept)
        assert np.linalg.norm(dictionary.basis[:, 1]) > 0.1
    assert np.array_equal(dictionaries[0].basis, dictionaries[1].basis)
    alive = dictionaries[0].basis.copy()
    dictionaries[0].revive()
    assert np.array_equal(dictionaries[0].basis, alive)


def test_a_column_whose_entries_sum_to_zero_is_not_dead():
    dictionary = Dictionary(2, 1, 0.1, "full", np.random.default_rng(0))
    dictionary.basis[:, 0] = [1.0, -1.0]
    dictionary.revive()
    assert dictionary.basis[:, 0].tolist() == [1.0, -1.0]


# -------------------------------------------------------------------------------------------------------- coherence

@pytest.mark.parametrize(("basis", "coherence"), [
    (np.eye(3), 0),
    ([[2.0, 0.0, -3.0], [0.0, 1.0, 3.0]], np.sqrt(0.5)),
    ([[1.0, -2.0], [3.0, -6.0]], 1),
    ([[5.0], [1.0]], 0),  # one column resembles none
    ([[1.0, 0.0], [1.0, 0.0]], 0),  # nor does a dead one
])
def test_mutual_coherence_by_hand(basis, coherence):
    assert mutual_coherence(np.array(basis)) == pytest.approx(coherence, abs=1e-12)


@given(seed=seeds, d=st.integers(1, 6), k=st.integers(2, 6))
@settings(max_examples=30, deadline=None)
def test_mutual_coherence_lies_between_the_welch_bound_and_one(seed, d, k):
    basis = np.random.default_rng(seed).standard_normal((d, k))
    coherence = mutual_coherence(basis)
    welch = np.sqrt(max(k - d, 0) / (d * (k - 1)))
    assert welch - 1e-9 <= coherence <= 1 + 1e-9
    assert coherence == pytest.approx(mutual_coherence(basis * (-1.5) ** np.arange(k))), "lengths do not matter"


# -------------------------------------------------------------------------------------------------------- bad input

def test_bad_settings_are_refused():
    with pytest.raises(ValueError, match="weights must be 'full' or 'scalar', got 'diagonal'"):
        Dictionary(2, 2, 0.1, "diagonal", np.random.default_rng(0))
    for ridge in (0.0, -1.0):
        with pytest.raises(ValueError, match="ridge must be positive"):
            Dictionary(2, 2, ridge, "full", np.random.default_rng(0))


def test_lost_precision_is_said_and_how_to_mend_it():
    dictionary, _ = filled("full", ridge=1e-9)
    dictionary.add(np.ones(3), np.ones(4), 1e3 * np.eye(4), sign=-1)
    with pytest.raises(ValueError, match=r"lost their precision; raise ridge \(now 1e-09\)"):
        dictionary.solve(6)
