"""ELLA for others' data: scikit-learn's fit and predict, over samples that say which task they belong to.

The single-task learners are those of thesis section 2.2.4: logistic or ridge regression, with the Hessian of its loss.
"""

import numpy as np
from sklearn.base import BaseEstimator, ClassifierMixin, RegressorMixin
from sklearn.utils.multiclass import check_classification_targets
from sklearn.utils.validation import check_is_fitted, column_or_1d, validate_data

from lifelong_lib.learners.supervised import fit_classifier, fit_regression
from lifelong_lib.transfer.ella import ELLA


class _Lifelong(BaseEstimator):
    """What the two have in common. A task is a name (a string or an integer); samples are told of it one by one."""

    def __init__(self, n_components=4, sparsity=1e-3, ridge=1e-5, penalty=0.1, random_state=0):
        self.n_components = n_components
        self.sparsity = sparsity
        self.ridge = ridge
        self.penalty = penalty
        self.random_state = random_state

    def fit(self, X, y, task=None):
        """Learn, from scratch, tasks in the order of their first samples: X (n, d), y (n,), task (n,) or, of one, None.

        Returns self. Raises ValueError for samples that are not finite numbers, or too few of a task.
        """
        fresh = type(self)(**self.get_params())
        X, y = validate_data(fresh, X, y)
        tasks = np.zeros(len(X), int) if task is None else _per_sample(task, X)
        for name in dict.fromkeys(tasks.tolist()):
            fresh.fit_task(X[tasks == name], y[tasks == name], name)
        vars(self).update(vars(fresh))
        return self

    def fit_task(self, X, y, task=0):
        """Learn one task, new or met before, from its samples X (n, d) and y (n,); return self.

        What is refused changes nothing. Raises ValueError as `fit`, and for samples unlike those of earlier tasks.
        """
        X, y = validate_data(self, X, y, reset=not hasattr(self, "ella_"))
        solution = self._solve(np.column_stack([X, np.ones(len(X))]), y, task)
        newborn = ELLA(self.n_components, self.sparsity, self.ridge, random_state=self.random_state)
        self.ella_ = getattr(self, "ella_", newborn).partial_fit(task, *solution)
        return self

    def _linear(self, X, task):
        """X theta of each sample's task (n,); without a task, of the first one learned."""
        check_is_fitted(self, "ella_")
        X = validate_data(self, X, reset=False)
        first = next(iter(self.ella_.codes_))
        tasks = np.full(len(X), first) if task is None else _per_sample(task, X)
        theta = {name: self.ella_.policy(name) for name in set(tasks.tolist())}
        weights = np.array([theta[name] for name in tasks.tolist()])
        return (X * weights[:, :-1]).sum(axis=1) + weights[:, -1]


class LifelongRegressor(RegressorMixin, _Lifelong):
    """Ridge regressions theta = L s, with an intercept each. ``penalty``: that of the single-task learner's ridge.

    The other settings are ELLA's. Learned: ``ella_``, with ``basis_`` and ``codes_``; the intercept is the last entry.
    """

    def _solve(self, X, y, task):
        return fit_regression(X, y.astype(float), self.penalty)

    def predict(self, X, task=None):
        """Return what is expected (n,) for X (n, d), samples of one ``task`` or of one each (n,)."""
        return self._linear(X, task)


class LifelongClassifier(ClassifierMixin, _Lifelong):
    """Logistic regressions of two classes, theta = L s, with an intercept each.

    ``penalty``: 1 / (n C), with the C of the single-task learner and the number n of a task's samples. The other
    settings are ELLA's. Learned: ``classes_`` (2,), and ``ella_``; the intercept is the last entry.
    """

    def __sklearn_tags__(self):
        tags = super().__sklearn_tags__()
        tags.classifier_tags.multi_class = False
        return tags

    def _solve(self, X, y, task):
        check_classification_targets(y)
        classes = np.unique(y)
        if len(classes) != 2:
            of = f"Only binary classification is supported, one class or more than two are not: task {task!r}"
            raise ValueError(f"{of} has {len(classes)} class{'es' * (len(classes) > 1)}, {classes[:5]}")
        if hasattr(self, "ella_") and (classes != self.classes_).any():
            raise ValueError(f"task {task!r} has the classes {classes}, earlier ones had {self.classes_}")
        self.classes_ = classes
        return fit_classifier(X, y == classes[1], 1 / (len(X) * self.penalty))

    def decision_function(self, X, task=None):
        """Return the log-odds (n,) of the second class."""
        return self._linear(X, task)

    def predict_proba(self, X, task=None):
        """Return the probability of each class (n, 2)."""
        second = 1 / (1 + np.exp(-self._linear(X, task)))
        return np.column_stack([1 - second, second])

    def predict(self, X, task=None):
        """Return the likelier class (n,) of X (n, d), samples of one ``task`` or of one each (n,)."""
        second = self.decision_function(X, task) > 0
        return self.classes_[second.astype(int)]


def _per_sample(task, X) -> np.ndarray:
    """The name of every sample's task (n,)."""
    if np.ndim(task) == 0:
        return np.full(len(X), task)
    tasks = column_or_1d(task)
    if len(tasks) != len(X):
        raise ValueError(f"{len(X)} samples need as many names of tasks, or one, got {len(tasks)}")
    return tasks
