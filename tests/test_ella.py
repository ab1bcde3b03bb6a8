"""ELLA and TaDeLL against their algorithms written out, in worlds with known answers, and through save and load."""

import zipfile
from copy import deepcopy

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sklearn.base import clone

from lifelong_lib.transfer.dictionary import sparse_code
from lifelong_lib.transfer.ella import ELLA, TaDeLL, joint_code

d, k, d_m = 4, 3, 5


def single_task(rng):
    """Parameters alpha (d,), Hessian (d, d) and descriptor (d_m,) as a single-task learner might hand them over."""
    root = rng.standard_normal((d, d + 2))
    return rng.standard_normal(d), root @ root.T / d, rng.standard_normal(d_m)


def learner(kind, **more):
    settings = {"n_components": k, "sparsity": 0.05, "ridge": 0.01, "start": "random", "random_state": 3} | more
    return TaDeLL(descriptor_weight=0.7, **settings) if kind == "TaDeLL" else ELLA(**settings)


def meet(one, task, rng):
    alpha, hessian, descriptor = single_task(rng)
    one.partial_fit(task, alpha, hessian, *([descriptor] if isinstance(one, TaDeLL) else []))
    return alpha, hessian, descriptor


def meet_all(one, order, seed=0):
    rng = np.random.default_rng(seed)
    return [(task, *meet(one, task, rng)) for task in order]


def state(one):
    """Everything a learner carries on from, as bytes."""
    parts = [part for dictionary in one.dictionaries_ for part in (dictionary.basis, dictionary.A, dictionary.b)]
    return [part.tobytes() for part in parts], {task: code.tobytes() for task, code in one.codes_.items()}


kinds = pytest.mark.parametrize("kind", ["ELLA", "TaDeLL"])
# While tasks are fewer than columns, the columns are dependent, and the lasso may stop before it has converged.
pytestmark = pytest.mark.filterwarnings("ignore:Objective did not converge")
visits = st.lists(st.integers(0, 3), min_size=1, max_size=10)


# ---------------------------------------------------------------------------------------------------- the algorithms

def written_out(last, ridge):
    """Equations 2.13-2.15 word by word, from the code, target and weight (a matrix) of every task's last meeting."""
    A = sum(np.kron(np.outer(s, s), weight) for s, _, weight in last.values()) / len(last)
    b = sum(np.kron(s, weight @ target) for s, target, weight in last.values()) / len(last)
    code, target, _ = next(iter(last.values()))
    return (np.linalg.inv(A + ridge * np.eye(len(A))) @ b).reshape(len(code), len(target)).T


def duality_gap(code, target, basis, weight, sparsity):
    """An upper bound, in parts of the target's own size, on how far the code is from the best one (0: it is)."""
    root = np.linalg.cholesky(weight).T
    y, X = root @ target, root @ basis
    rest = y - X @ code
    dual = rest * min(1, sparsity / 2 / np.abs(X.T @ rest).max())
    return (rest @ rest + sparsity * np.abs(code).sum() - y @ y + (y - dual) @ (y - dual)) / (y @ y)


def follow(one, order, seed, stack):
    """Let the learner meet tasks and check each step: its code in the old dictionary, then the new dictionary."""
    rng, last, first = np.random.default_rng(seed), {}, np.random.default_rng(3)
    old = [first.standard_normal((size, k)) for size in ((d, d_m) if isinstance(one, TaDeLL) else (d,))]
    for task in order:
        before, known = deepcopy(one), len(last)
        alpha, hessian, descriptor = meet(one, task, rng)
        target, weight = stack(alpha, hessian, descriptor)
        if last:
            for dictionary in before.dictionaries_:
                dictionary.revive()
            old = [dictionary.basis for dictionary in before.dictionaries_]
        if one.start == "tasks" and known < k:  # each of the first k tasks is a column
            assert (one.codes_[task] == (last[task][0] if task in last else np.eye(k)[known])).all()
        else:
            assert duality_gap(one.codes_[task], target, np.concatenate(old), weight, 0.05) < 1e-3
        last[task] = one.codes_[task], target, weight
        expected = written_out(last, 0.01)
        found = np.concatenate([dictionary.basis for dictionary in one.dictionaries_])
        assert np.allclose(found, expected, atol=1e-8 * max(1, np.abs(expected).max()))
        assert set(one.codes_) == set(last) and one.n_tasks_ == len(last)
        assert np.allclose(one.policy(task), found[:d] @ last[task][0])


@pytest.mark.parametrize("start", ["tasks", "random"])
@given(order=visits, seed=st.integers(0, 1000))
@settings(max_examples=25, deadline=None)
def test_ella_is_algorithm_1_with_revisits(start, order, seed):
    follow(learner("ELLA", start=start), order, seed, lambda alpha, hessian, _: (alpha, hessian))


@pytest.mark.parametrize("start", ["tasks", "random"])
@given(order=visits, seed=st.integers(0, 1000))
@settings(max_examples=25, deadline=None)
def test_tadell_is_algorithm_1_on_stacked_policies_and_descriptors(start, order, seed):
    """Both dictionaries under one another, with the weight blockdiag(Gamma, zeta I): equation 4.4."""
    def stack(alpha, hessian, descriptor):
        weight = np.zeros((d + d_m, d + d_m))
        weight[:d, :d], weight[d:, d:] = hessian, 0.7 * np.trace(hessian) / d * np.eye(d_m)
        return np.concatenate([alpha, descriptor]), weight

    follow(learner("TaDeLL", start=start), order, seed, stack)


@kinds
@given(order=visits)
@settings(max_examples=25, deadline=None)
def test_after_any_visits_A_and_b_are_the_sums_over_each_tasks_last_meeting(kind, order):
    one = learner(kind)
    last = {task: (alpha, hessian) for task, alpha, hessian, _ in meet_all(one, order)}
    A = sum(np.kron(np.outer(one.codes_[task], one.codes_[task]), hessian) for task, (_, hessian) in last.items())
    b = sum(np.outer(one.codes_[task], hessian @ alpha) for task, (alpha, hessian) in last.items())
    assert np.allclose(one.dictionaries_[0].A, A, atol=1e-9) and np.allclose(one.dictionaries_[0].b, b, atol=1e-9)


def test_a_revisit_equals_having_learned_the_second_version_only_when_codes_are_equal():
    rng = np.random.default_rng(0)
    old, new, other = (single_task(rng)[:2] for _ in range(3))
    for learn_dictionary in (False, True):
        twice, once = (learner("ELLA", learn_dictionary=learn_dictionary) for _ in range(2))
        twice.partial_fit("b", *other).partial_fit("a", *old).partial_fit("a", *new)
        once.partial_fit("b", *other).partial_fit("a", *new)
        equal = np.allclose(twice.codes_["a"], once.codes_["a"])
        assert equal != learn_dictionary, "with a fixed dictionary the code depends on the second version alone"
        for part in ("A", "b"):
            sums = [getattr(one.dictionaries_[0], part) for one in (twice, once)]
            assert np.allclose(*sums, atol=1e-12) == equal
        assert twice.n_tasks_ == 2


def test_the_same_task_over_and_over_does_not_pile_up():
    one = learner("ELLA")
    alpha, hessian, _ = single_task(np.random.default_rng(0))
    for _ in range(50):
        one.partial_fit("a", alpha, hessian)
    code = one.codes_["a"]
    assert np.allclose(one.dictionaries_[0].A, np.kron(np.outer(code, code), hessian), atol=1e-9)
    assert one.n_tasks_ == 1


def test_without_hessians_only_their_mean_diagonal_counts_and_the_system_is_small():
    one, same = learner("ELLA", hessian=False), learner("ELLA")
    for task, alpha, hessian, _ in meet_all(one, [0, 1, 0, 2]):
        same.partial_fit(task, alpha, np.trace(hessian) / d * np.eye(d))
    assert one.dictionaries_[0].A.shape == (k, k)
    assert np.allclose(one.basis_, same.basis_, atol=1e-6)


@kinds
def test_a_dictionary_that_does_not_learn_stays_random(kind):
    one = learner(kind, learn_dictionary=False)
    meet_all(one, [0, 1, 2])
    assert np.array_equal(one.basis_, np.random.default_rng(3).standard_normal((d, k))) and one.n_tasks_ == 3


def test_joint_code_minimises_the_sum_of_both_views():
    rng = np.random.default_rng(0)
    alpha, hessian, descriptor = single_task(rng)
    bases = [rng.standard_normal((d, k)), rng.standard_normal((d_m, k))]
    code = joint_code([alpha, descriptor], bases, [hessian, 0.8], 0.2)

    def value(s):
        errors = alpha - bases[0] @ s, descriptor - bases[1] @ s
        return errors[0] @ hessian @ errors[0] + 0.8 * errors[1] @ errors[1] + 0.2 * np.abs(s).sum()

    assert min(value(code + 1e-2 * rng.standard_normal(k)) for _ in range(200)) > value(code)
    assert np.array_equal(joint_code([alpha], bases[:1], [hessian], 0.2), sparse_code(alpha, bases[0], hessian, 0.2))


@kinds
def test_the_same_seed_gives_the_same_learner_and_another_one_does_not(kind):
    first, again, other = learner(kind), learner(kind), learner(kind, random_state=4)
    for one in (first, again, other):
        meet_all(one, [0, 1, 0])
    assert state(first) == state(again) != state(other)


def test_a_dead_dictionary_recovers_when_there_is_something_to_learn():
    """Sparsity so high that no code is used leaves L = 0; columns drawn anew let the next task in."""
    one = learner("ELLA", sparsity=1e6)
    meet_all(one, [0, 1])
    assert not one.codes_[1].any() and not one.basis_.any()
    one.sparsity = 1e-3
    meet(one, 2, np.random.default_rng(5))
    assert one.codes_[2].any() and one.basis_.any()


# ---------------------------------------------------------------------------------------------- worlds with an answer

def coupled_world(count, rng, size=8, columns=2, features=6):
    """Noiseless tasks theta = L s with descriptors m = D s, s dense in few columns."""
    L, D = rng.standard_normal((size, columns)), rng.standard_normal((features, columns))
    codes = rng.standard_normal((count, columns))
    return codes @ L.T, codes @ D.T


def explained(predicted, truth):
    """Share of the variance of ``truth`` (T, d) that ``predicted`` explains."""
    return 1 - ((predicted - truth) ** 2).sum() / ((truth - truth.mean(axis=0)) ** 2).sum()


def zero_shot(shuffle):
    rng = np.random.default_rng(0)
    theta, descriptors = coupled_world(80, rng)
    known = rng.permutation(60) if shuffle else np.arange(60)
    one = TaDeLL(n_components=2, sparsity=1e-4, ridge=1e-6, random_state=0)
    for _ in range(2):
        for t in range(60):
            one.partial_fit(t, theta[t], np.eye(8), descriptors[known[t]])
    return explained(np.stack([one.predict(m) for m in descriptors[60:]]), theta[60:])


def test_zero_shot_finds_policies_from_descriptors_alone():
    assert zero_shot(shuffle=False) > 0.99


def noisy_world(seed, start):
    """How much less of new tasks a learner that met 40 noisy ones once explains than least squares would."""
    rng = np.random.default_rng(seed)
    descriptors = np.column_stack([rng.uniform(-1.7, 1.7, (80, 3)), np.ones(80)])
    theta = descriptors @ rng.standard_normal((4, 2))
    noisy, one = theta + 0.3 * rng.standard_normal(theta.shape), TaDeLL(4, 0.01, 1e-3, 100.0, start)
    for t in range(40):
        one.partial_fit(t, noisy[t], np.eye(2), descriptors[t])
    best = descriptors[40:] @ np.linalg.lstsq(descriptors[:40], noisy[:40], rcond=None)[0]
    return explained(best, theta[40:]) - explained(np.stack([one.predict(m) for m in descriptors[40:]]), theta[40:])


def test_columns_that_start_as_tasks_do_as_well_as_least_squares_where_a_random_start_may_not():
    """With more columns than policies have entries, a random start can take many visits to be forgotten."""
    assert max(noisy_world(seed, "tasks") for seed in range(8)) < 0.01
    assert max(noisy_world(seed, "random") for seed in range(8)) > 0.1


def test_an_unknown_start_is_refused():
    with pytest.raises(ValueError, match="start must be 'tasks' or 'random', got 'zeros'"):
        meet_all(learner("ELLA", start="zeros"), [0])


def test_zero_shot_fails_when_descriptors_belong_to_other_tasks():
    assert zero_shot(shuffle=True) < 0.3


def test_ella_recovers_noisy_tasks_that_share_a_basis():
    """What the dictionary gives back is closer to the true parameters than the noisy ones it was given."""
    rng = np.random.default_rng(1)
    theta, _ = coupled_world(100, rng, size=10)
    noisy = theta + 0.3 * rng.standard_normal(theta.shape)
    one = ELLA(n_components=2, sparsity=1e-3, ridge=1e-6, random_state=0)
    for _ in range(2):
        for t in range(100):
            one.partial_fit(t, noisy[t], np.eye(10))
    error = np.mean([np.sum((one.policy(t) - theta[t]) ** 2) for t in range(100)])
    assert error < 0.5 * np.mean(np.sum((noisy - theta) ** 2, axis=1))


# ---------------------------------------------------------------------------------------------------- save and load

@kinds
@pytest.mark.parametrize("sparsity", [0.05, 1e6], ids=["alive", "dead columns"])
def test_a_loaded_learner_goes_on_bit_for_bit(kind, sparsity, tmp_path):
    """Dead columns make the next step draw from the generator, whose state must have been kept."""
    one, first, rest = learner(kind, sparsity=sparsity), [0, "one", 0, 2], [2, "one", 5, 6, 0]
    meet_all(one, first)
    one.save(tmp_path / "learner.npz")
    loaded = type(one).load(tmp_path / "learner.npz")
    assert state(loaded) == state(one) and loaded.n_tasks_ == one.n_tasks_
    for both in (one, loaded):
        both.sparsity = 0.05
        meet_all(both, rest, seed=1)
    assert state(loaded) == state(one)
    assert vars(loaded).keys() == vars(one).keys()
    assert [getattr(loaded, name) for name in ("n_components", "ridge", "random_state")] == [k, 0.01, 3]


def test_a_learner_with_numbers_for_weights_is_kept_too(tmp_path):
    one = learner("ELLA", hessian=False)
    meet_all(one, [0, 1])
    one.save(tmp_path / "learner.npz")
    loaded = ELLA.load(tmp_path / "learner.npz")
    for both in (one, loaded):
        meet_all(both, [1, 2], seed=1)
    assert state(loaded) == state(one) and loaded.dictionaries_[0].weights == "scalar"


@kinds
def test_the_file_holds_plain_arrays_and_no_pickle(kind, tmp_path):
    one = learner(kind)
    meet_all(one, [0, "b"])
    one.save(tmp_path / "learner.npz")
    with np.load(tmp_path / "learner.npz", allow_pickle=False) as stored:
        assert all(stored[name].dtype.kind in "fU" for name in stored.files)
    with zipfile.ZipFile(tmp_path / "learner.npz") as archive:
        assert all(name.endswith(".npy") for name in archive.namelist())


def test_generators_and_numpys_integers_as_settings_are_kept(tmp_path):
    one = learner("ELLA", n_components=np.int64(k), random_state=np.random.default_rng(3))
    meet_all(one, [0])
    one.save(tmp_path / "learner.npz")
    loaded = ELLA.load(tmp_path / "learner.npz")
    for both in (one, loaded):
        meet_all(both, [1, 0], seed=1)
    assert state(loaded) == state(one) and loaded.n_components == k


def test_a_file_of_another_class_is_refused(tmp_path):
    one = learner("TaDeLL")
    meet_all(one, [0])
    one.save(tmp_path / "learner.npz")
    with pytest.raises(ValueError, match="holds a TaDeLL, not a ELLA; call TaDeLL.load"):
        ELLA.load(tmp_path / "learner.npz")


def test_what_is_loaded_is_the_file_that_was_named_and_numpys_integers_are_names(tmp_path):
    one = learner("ELLA")
    meet_all(one, [np.int64(3), 3, np.str_("b")])
    assert list(one.codes_) == [3, "b"]
    one.save(tmp_path / "learner.of.today")
    assert [path.name for path in tmp_path.iterdir()] == ["learner.of.today"]
    assert state(ELLA.load(tmp_path / "learner.of.today")) == state(one)


@pytest.mark.parametrize("met", [[], [(1, 2)]])
def test_learners_that_met_nothing_or_tasks_with_other_names_cannot_be_saved(met, tmp_path):
    one = learner("ELLA")
    meet_all(one, met)
    with pytest.raises(ValueError, match="named by integers or strings"):
        one.save(tmp_path / "learner.npz")
    assert not list(tmp_path.iterdir())


# -------------------------------------------------------------------------------------------------------- bad input

@pytest.mark.parametrize(("alpha", "hessian", "said"), [
    (np.ones(3), np.eye(4), r"3 parameters need a square Hessian of that size, got \(4, 4\)"),
    (np.ones(4), np.ones(4), r"4 parameters need a square Hessian of that size, got \(4,\)"),
    (np.array([1, np.nan, 0, 0]), np.eye(4), "must be finite; did the single-task learner diverge"),
    (np.ones(4), np.full((4, 4), np.inf), "must be finite; did the single-task learner diverge"),
    (np.ones((1, 4)), np.eye(4), r"parameters are a vector \(d,\), got \(1, 4\); of a linear model: coef_.ravel"),
    (np.ones(4), np.diag([1.0, 1, 1, -0.1]), "a Hessian is symmetric and positive semi-definite"),
    (np.ones(4), np.eye(4) + np.eye(4, k=1), "a Hessian is symmetric and positive semi-definite"),
])
@kinds
def test_what_does_not_fit_is_refused_and_nothing_is_learned(kind, alpha, hessian, said):
    one = learner(kind)
    meet_all(one, [0, 1])
    before = state(one)
    with pytest.raises(ValueError, match=said):
        one.partial_fit(0, alpha, hessian, *([np.ones(d_m)] if kind == "TaDeLL" else []))
    assert state(one) == before


@kinds
def test_a_task_whose_numbers_are_too_large_to_solve_is_refused_and_the_learner_goes_on(kind):
    one, other = learner(kind), learner(kind)
    for both in (one, other):
        meet_all(both, [0, 1, 2])
    with pytest.raises((ValueError, RuntimeError), match="raise ridge|no sparse code"):
        one.partial_fit(1, np.ones(d), 1e200 * np.eye(d), *([np.ones(d_m)] if kind == "TaDeLL" else []))
    for both in (one, other):
        meet_all(both, [1, 3], seed=1)
    assert state(one) == state(other)


@pytest.mark.parametrize("impossible", [{"sparsity": -0.1}, {"n_components": 0}, {"sparsity": float("nan")}])
def test_impossible_settings_are_refused_before_a_first_task(impossible):
    one = learner("ELLA", **impossible)
    with pytest.raises(ValueError, match="sparsity is 0 or more, n_components 1 or more; got"):
        meet_all(one, [0])
    assert not hasattr(one, "codes_")


def test_a_learner_without_a_hessian_that_says_anything_still_learns():
    one = learner("ELLA")
    assert one.partial_fit(0, np.ones(d), np.zeros((d, d))).policy(0).shape == (d,)


def test_learners_are_cloned_and_shown_as_scikit_learn_does():
    one = learner("TaDeLL", sparsity=0.5)
    meet_all(one, [0])
    assert clone(one).get_params() == one.get_params() and not hasattr(clone(one), "codes_")
    assert "sparsity=0.5" in repr(one)


def test_a_task_of_another_size_is_refused():
    one = learner("ELLA")
    meet_all(one, [0])
    with pytest.raises(ValueError, match="task 'b' has 5 numbers, earlier ones had 4"):
        one.partial_fit("b", np.ones(5), np.eye(5))


def test_a_refused_descriptor_leaves_the_learner_as_it_was():
    one = learner("TaDeLL")
    meet_all(one, [0, 1])
    before = state(one)
    with pytest.raises(ValueError, match="task 0 has 6 numbers, earlier ones had 5"):
        one.partial_fit(0, np.ones(d), np.eye(d), np.ones(d_m + 1))
    assert state(one) == before


def test_prediction_wants_tasks_with_descriptors_and_a_descriptor_like_theirs():
    with pytest.raises(ValueError, match="no task with a descriptor has been learned yet"):
        learner("TaDeLL").predict(np.ones(d_m))
    one = learner("TaDeLL")
    meet_all(one, [0])
    for descriptor in (np.ones(d_m + 1), np.full(d_m, np.nan), 1.0):
        with pytest.raises(ValueError, match="a descriptor here is 5 finite numbers, got"):
            one.predict(descriptor)


@pytest.mark.parametrize("descriptor", [np.ones((2, 2)), np.array([1, np.nan, 1, 1, 1]), 3.0])
def test_descriptors_that_are_no_finite_vectors_are_refused(descriptor):
    with pytest.raises(ValueError, match="descriptor of task 'a' must be a vector of finite numbers"):
        learner("TaDeLL").partial_fit("a", np.ones(4), np.eye(4), descriptor)


@kinds
def test_policies_of_unknown_tasks_are_refused(kind):
    for met in ([], [0]):
        one = learner(kind)
        meet_all(one, met)
        with pytest.raises(ValueError, match="task 9 has not been learned yet; call partial_fit for it first"):
            one.policy(9)
