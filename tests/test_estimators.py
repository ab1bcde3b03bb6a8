"""ELLA as a scikit-learn estimator: its own checks, single tasks by hand, shared columns, and what is refused."""

import numpy as np
import pytest
from sklearn.base import clone
from sklearn.linear_model import LogisticRegression, Ridge
from sklearn.utils.estimator_checks import parametrize_with_checks

from lifelong_lib.transfer.estimators import LifelongClassifier, LifelongRegressor


@parametrize_with_checks([LifelongClassifier(), LifelongRegressor()])
def test_scikit_learn_finds_nothing_to_complain_of(estimator, check):
    check(estimator)


def tasks(count=30, n=25, d=6, k=2, noise=0.3, seed=0):
    """Samples (count * n, d), targets and task names of regressions that mix two models."""
    rng = np.random.default_rng(seed)
    models = rng.standard_normal((count, k)) @ rng.standard_normal((k, d + 1))
    models[:, -1] *= 0.1  # so that every task has both classes
    X, names = rng.standard_normal((count * n, d)), np.repeat(np.arange(count), n)
    y = (X * models[names, :-1]).sum(axis=1) + models[names, -1]
    return X, y + noise * rng.standard_normal(len(y)), names


def test_one_task_is_the_single_task_learner():
    """A first task becomes a column and its code is 1; only the weight of the dictionary's size pulls at it."""
    X, y, names = tasks(count=1, n=60)
    labels = np.where(y > 0, "up", "down")
    own = LifelongClassifier(ridge=1e-12).fit(X, labels)
    alone = LogisticRegression(C=1 / (60 * 0.1), fit_intercept=False).fit(np.column_stack([X, np.ones(60)]), labels)
    assert own.predict_proba(X) == pytest.approx(alone.predict_proba(np.column_stack([X, np.ones(60)])), abs=1e-6)
    assert (own.predict(X) == alone.predict(np.column_stack([X, np.ones(60)]))).all()
    assert own.classes_.tolist() == ["down", "up"]
    regression = LifelongRegressor(ridge=1e-12).fit(X, y)
    ridge = Ridge(60 * 0.1, fit_intercept=False).fit(np.column_stack([X, np.ones(60)]), y)
    assert regression.predict(X) == pytest.approx(ridge.predict(np.column_stack([X, np.ones(60)])), abs=1e-6)


@pytest.mark.parametrize("kind", [LifelongClassifier, LifelongRegressor])
def test_tasks_that_share_two_columns_teach_each_other(kind):
    X, y, names = tasks(count=60, n=12, noise=1.0)
    newer, truth, newer_names = tasks(count=60, n=200, noise=0.0)
    if kind is LifelongClassifier:
        y, truth = y > 0, truth > 0
    model = kind(n_components=2, penalty=0.1).fit(X, y, names)
    for t in range(60):  # a second visit
        model.fit_task(X[names == t], y[names == t], t)
    together = model.predict(newer, newer_names)
    alone = [kind(n_components=1, penalty=0.1).fit(X[names == t], y[names == t]) for t in range(60)]
    alone = np.concatenate([one.predict(newer[newer_names == t]) for t, one in enumerate(alone)])
    wrong, wrong_alone = (((1.0 * found - truth) ** 2).mean() for found in (together, alone))
    assert wrong < 0.6 * wrong_alone


def test_samples_of_many_tasks_and_of_one_are_answered_alike():
    X, y, names = tasks(count=4)
    model = LifelongClassifier().fit(X, y > 0, names)
    together = model.predict_proba(X, names)
    for t in range(4):
        assert (model.predict_proba(X[names == t], t) == together[names == t]).all()
    assert model.score(X[names == 0], y[names == 0] > 0) == np.mean(model.predict(X[names == 0]) == (y[names == 0] > 0))


def test_fit_forgets_and_fit_task_goes_on_in_the_order_of_the_samples():
    X, y, names = tasks(count=3)
    words = np.array(["a", "b", "c"])[names]
    at_once, one_by_one = LifelongRegressor().fit(X, y, words), LifelongRegressor()
    for word in ("a", "b", "c"):
        one_by_one.fit_task(X[words == word], y[words == word], word)
    assert (at_once.ella_.basis_ == one_by_one.ella_.basis_).all()
    again = clone(at_once).fit(X[::-1], y[::-1], words[::-1])
    assert list(again.ella_.codes_) == ["c", "b", "a"] and repr(again) == "LifelongRegressor()"
    again.fit(X, y, words)
    assert (again.ella_.basis_ == at_once.ella_.basis_).all()


@pytest.mark.parametrize(("change", "said"), [
    (lambda X, y: (X, np.where(y > 0, 1.0, np.nan)), "NaN"),
    (lambda X, y: (np.where(X > 2, np.inf, X), y > 0), "infinity"),
    (lambda X, y: (X, np.digitize(y, [-1, 1])), "task 'c' has 3 classes"),
    (lambda X, y: (X, y > -99), "task 'c' has 1 class, "),
    (lambda X, y: (X, np.where(y > 0, 5, 7)), r"task 'c' has the classes \[5 7\], earlier ones had \[False  True\]"),
    (lambda X, y: (X, y), "Unknown label type: continuous"),
    (lambda X, y: (X[:, 1:], y > 0), "X has 5 features"),
    (lambda X, y: (X, y[:9] > 0), "inconsistent numbers of samples"),
])  # fmt: skip
def test_what_is_refused_changes_nothing(change, said):
    X, y, names = tasks(count=3)
    model = LifelongClassifier().fit_task(X[names == 0], y[names == 0] > 0, "a")
    model.fit_task(X[names == 1], y[names == 1] > 0, "b")
    before = model.predict_proba(X, "a").tobytes(), model.ella_.basis_.tobytes(), model.classes_.tolist()
    with pytest.raises(ValueError, match=said):
        model.fit_task(*change(X[names == 2], y[names == 2]), "c")
    assert (model.predict_proba(X, "a").tobytes(), model.ella_.basis_.tobytes(), model.classes_.tolist()) == before
    model.fit_task(X[names == 2], y[names == 2] > 0, "c")


def test_tasks_that_nobody_knows_and_names_that_are_too_few_are_refused():
    X, y, names = tasks(count=2)
    model = LifelongRegressor().fit(X, y, names)
    with pytest.raises(ValueError, match="task 9 has not been learned yet"):
        model.predict(X, 9)
    with pytest.raises(ValueError, match="50 samples need as many names of tasks, or one, got 7"):
        model.predict(X, names[:7])
    with pytest.raises(ValueError, match="50 samples need as many names"):
        LifelongRegressor().fit(X, y, names[:7])
