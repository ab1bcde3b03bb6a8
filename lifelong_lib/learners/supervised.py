"""Single-task classification and regression: what ELLA and TaDeLL start from outside reinforcement learning.

Both fits return the parameters alpha (d,) and the Hessian Gamma (d, d) of the mean loss there, penalty included
(thesis section 2.2.4; models without an intercept, as the tasks of section 4.5.7 have none).
"""

import numpy as np
from scipy.optimize import linprog
from sklearn.linear_model import LogisticRegression, Ridge


def fit_classifier(X: np.ndarray, y: np.ndarray, C: float = 0.1) -> tuple[np.ndarray, np.ndarray]:
    """Logistic regression on X (n, d) and labels y (n,) in {0, 1}; ``C`` is scikit-learn's inverse penalty.

    A task whose samples all carry one label has no boundary; its parameters are then zero. Raises ValueError for other
    labels.
    """
    if not np.isin(y, (0, 1)).all():
        raise ValueError(f"labels are 0 or 1, got {np.unique(y)[:5]}")
    n, d = X.shape
    alpha = np.zeros(d)
    if len(np.unique(y)) == 2:
        alpha = LogisticRegression(C=C, fit_intercept=False).fit(X, y).coef_[0]
    p = 1 / (1 + np.exp(-X @ alpha))
    return alpha, (X * (p * (1 - p))[:, None]).T @ X / n + np.eye(d) / (n * C)


def fit_regression(X: np.ndarray, y: np.ndarray, penalty: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Ridge regression on X (n, d) and y (n,): minimises the mean of ((y - X alpha)^2 + penalty ||alpha||^2) / 2."""
    n, d = X.shape
    alpha = Ridge(alpha=n * penalty, fit_intercept=False).fit(X, y).coef_
    return alpha, X.T @ X / n + penalty * np.eye(d)


def consistent_models(X: np.ndarray, y: np.ndarray, sweeps: int, rng: np.random.Generator, half: float = 0.5):
    """Draw models m uniform in [-half, half]^d given that x . m > 0 exactly where y = 1: (``sweeps``, T, d).

    For T tasks with samples X (T, n, d) and labels y (T, n). Gibbs sampling from a wide margin: one entry after another
    is uniform in what the labels leave of its interval; a quarter more sweeps come first and are dropped. If the true
    models were drawn from the cube, the vote of these is Bayes' classifier: on average no learner that sees nothing
    else of a task beats it.
    """
    rows = np.where(y, 1, -1)[..., None] * X
    bounds, target = [(-half, half)] * X.shape[2] + [(None, 1)], np.append(np.zeros(X.shape[2]), -1)
    best = [linprog(target, np.c_[-own, np.ones(len(own))], np.zeros(len(own)), bounds=bounds).x for own in rows]
    models = np.array(best)[:, :-1]
    if not np.all(rows @ models[..., None] > 0):
        raise ValueError("no linear model in the cube labels every sample of its task as asked")
    draws = []
    for _ in range(sweeps + sweeps // 4):
        for j, column in enumerate(np.moveaxis(rows, 2, 0)):
            edges = models[:, j, None] - (rows @ models[..., None])[..., 0] / np.where(column, column, 1)
            low = np.where(column > 0, edges, -half).max(axis=1, initial=-half)
            high = np.where(column < 0, edges, half).min(axis=1, initial=half)
            models[:, j] = low + (high - low) * rng.random(len(models))
        draws.append(models.copy())
    return np.array(draws[-sweeps:])
