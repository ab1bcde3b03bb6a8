"""Single-task classifiers and regressions: at the minimum of their loss, with the Hessian that the loss has there."""

import numpy as np
import pytest

from lifelong_lib.learners.supervised import fit_classifier, fit_regression


def samples(n=40, d=4, seed=0):
    rng = np.random.default_rng(seed)
    X = rng.standard_normal((n, d))
    return X, X @ rng.standard_normal(d) + rng.standard_normal(n)


def logistic_loss(X, labels, C):
    """The mean of -log p(label), with scikit-learn's penalty on the same scale."""
    signs = 2 * labels - 1
    return lambda w: np.log1p(np.exp(-signs * (X @ w))).mean() + w @ w / (2 * len(X) * C)


def square_loss(X, y, penalty):
    return lambda w: ((y - X @ w) ** 2).mean() / 2 + penalty * (w @ w) / 2


def numerical(loss, w, size=1e-3):
    """Gradient (d,) and Hessian (d, d) by central differences."""
    steps = size * np.eye(len(w))
    gradient = [(loss(w + a) - loss(w - a)) / (2 * size) for a in steps]
    hessian = [[(loss(w + a + b) - loss(w + a - b) - loss(w - a + b) + loss(w - a - b)) / (4 * size**2) for b in steps]
               for a in steps]
    return np.array(gradient), np.array(hessian)


@pytest.mark.parametrize("C", [0.1, 5.0])
def test_the_classifier_is_at_the_minimum_with_the_hessian_of_its_loss(C):
    X, y = samples()
    labels = (y > 0).astype(int)
    alpha, gamma = fit_classifier(X, labels, C)
    gradient, hessian = numerical(logistic_loss(X, labels, C), alpha)
    assert np.abs(gradient).max() < 2e-4, "scikit-learn's own tolerance is 1e-4"
    assert np.allclose(gamma, hessian, atol=1e-5)
    assert np.abs(alpha).max() > 0.05


@pytest.mark.parametrize("penalty", [0.01, 1.0])
def test_the_regression_is_at_the_minimum_with_the_hessian_of_its_loss(penalty):
    X, y = samples()
    alpha, gamma = fit_regression(X, y, penalty)
    gradient, hessian = numerical(square_loss(X, y, penalty), alpha)
    assert np.abs(gradient).max() < 1e-9
    assert np.allclose(gamma, hessian, atol=1e-6)
    assert np.allclose(alpha, np.linalg.solve(X.T @ X / 40 + penalty * np.eye(4), X.T @ y / 40))


@pytest.mark.parametrize("label", [0, 1])
def test_one_label_alone_gives_no_boundary(label):
    X, _ = samples(n=10)
    alpha, gamma = fit_classifier(X, np.full(10, label), C=0.5)
    assert not alpha.any()
    assert np.allclose(gamma, X.T @ X / 40 + np.eye(4) / 5), "p (1 - p) is 1/4 everywhere"


def test_opposite_labels_give_the_opposite_boundary():
    X, y = samples()
    labels = (y > 0).astype(int)
    assert np.allclose(fit_classifier(X, labels)[0], -fit_classifier(X, 1 - labels)[0], atol=1e-3)
