"""Single-task classification and regression: what ELLA and TaDeLL start from outside reinforcement learning.

Both return the parameters alpha (d,) and the Hessian Gamma (d, d) of the mean loss there, penalty included
(thesis section 2.2.4; models without an intercept, as the tasks of section 4.5.7 have none).
"""

import numpy as np
from sklearn.linear_model import LogisticRegression, Ridge


def fit_classifier(X: np.ndarray, y: np.ndarray, C: float = 0.1) -> tuple[np.ndarray, np.ndarray]:
    """Logistic regression on X (n, d) and labels y (n,) in {0, 1}; ``C`` is scikit-learn's inverse penalty.

    A task whose samples all carry one label has no boundary; its parameters are then zero.
    """
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
