"""Single-task classifiers and regressions at the minimum of their loss; Gibbs sampling against rejection."""

import numpy as np
import pytest

from lifelong_lib.learners.supervised import consistent_models, fit_classifier, fit_regression


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


# --------------------------------------------------------------------------------- models that agree with the labels

def labelled(T, n, d, seed=0):
    """Tasks with models uniform in the cube: models (T, d), samples (T, n, d) and labels (T, n)."""
    rng = np.random.default_rng(seed)
    theta, X = rng.uniform(-0.5, 0.5, (T, d)), rng.standard_normal((T, n, d))
    return theta, X, (np.einsum("tnd,td->tn", X, theta) > 0).astype(int)


def test_every_drawn_model_is_in_the_cube_and_labels_every_sample_rightly():
    _, X, y = labelled(T=6, n=10, d=8)
    X[0, :, 2] = 0  # a feature that never varies
    y[0] = X[0] @ np.ones(8) > 0
    models = consistent_models(X, y, 50, np.random.default_rng(1))
    assert models.shape == (50, 6, 8) and np.abs(models).max() <= 0.5
    assert np.array_equal(np.einsum("tnd,std->stn", X, models) > 0, np.broadcast_to(y == 1, (50, 6, 10)))
    assert np.array_equal(models, consistent_models(X, y, 50, np.random.default_rng(1)))
    assert (models[-1] != models[-2]).all(), "every entry moves"


@pytest.mark.parametrize("seed", range(3))
def test_models_are_drawn_as_by_throwing_away_those_that_disagree(seed):
    _, X, y = labelled(T=1, n=3, d=4, seed=seed)
    rng = np.random.default_rng(1)
    cube = rng.uniform(-0.5, 0.5, (100_000, 4))
    kept = cube[((cube @ X[0].T > 0) == y[0]).all(axis=1)]
    drawn = consistent_models(X, y, 8000, rng)[:, 0]
    assert len(kept) > 1000
    features = [np.hstack([models, models**2, np.sort(models, axis=1), models @ X[0].T]) for models in (drawn, kept)]
    batches = features[0].reshape(20, 400, -1).mean(axis=1)  # of neighbours, which resemble each other
    errors = np.hypot(batches.std(axis=0, ddof=1) / np.sqrt(20), features[1].std(axis=0) / np.sqrt(len(kept)))
    assert np.abs((features[0].mean(axis=0) - features[1].mean(axis=0)) / errors).max() < 4.5


def test_without_samples_models_are_uniform_in_the_cube():
    models = consistent_models(np.empty((2, 0, 3)), np.empty((2, 0)), 4000, np.random.default_rng(0), half=2.0)
    assert np.allclose(models.mean(axis=0), 0, atol=0.1) and np.allclose(models.var(axis=0), 16 / 12, rtol=0.08)


def test_the_majority_of_models_is_as_often_right_as_it_believes_and_beats_the_classifier():
    theta, X, y = labelled(T=150, n=10, d=8)
    models = consistent_models(X, y, 400, np.random.default_rng(1))
    new = np.random.default_rng(2).standard_normal((150, 200, 8))
    truth = np.einsum("tnd,td->tn", new, theta) > 0
    votes = np.mean([np.einsum("tnd,td->tn", new, draw) > 0 for draw in models], axis=0)
    right = ((votes > 0.5) == truth).mean(axis=1)
    surplus = right - np.maximum(votes, 1 - votes).mean(axis=1)
    assert abs(surplus.mean()) < 4 * surplus.std() / np.sqrt(150)
    alone = np.mean([((x @ fit_classifier(*known)[0] > 0) == labels).mean()
                     for x, labels, *known in zip(new, truth, X, y, strict=True)])
    assert right.mean() > alone + 0.015


def test_labels_that_no_model_gives_are_refused():
    x = np.ones((1, 2, 3))  # the same sample twice, with both labels
    with pytest.raises(ValueError, match="no linear model in the cube labels every sample"):
        consistent_models(x, np.array([[0, 1]]), 1, np.random.default_rng(0))


@pytest.mark.parametrize("labels", [[0, 1, 2], [0, 1, np.nan], [-1, 1, 1]])
def test_labels_that_are_neither_0_nor_1_are_refused(labels):
    with pytest.raises(ValueError, match="labels are 0 or 1, got"):
        fit_classifier(np.eye(3), np.array(labels))
