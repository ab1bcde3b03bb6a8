"""Synthetic classification tasks whose descriptors are tied to the true model (thesis section 4.5.7)."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class ClassificationTasks:
    """T linear tasks: true models ``theta`` (T, d), descriptors ``descriptors`` (T, d_m)."""

    theta: np.ndarray
    descriptors: np.ndarray

    def __len__(self):
        return len(self.theta)

    def draw_samples(self, task: int, n: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Return X (n, d), uniform in [-0.5, 0.5], and labels (n,): 1 where x . theta is positive, else 0."""
        X = rng.uniform(-0.5, 0.5, (n, self.theta.shape[1]))
        return X, (X @ self.theta[task] > 0).astype(int)


def domain_one(count: int, rng: np.random.Generator, d: int = 8) -> ClassificationTasks:
    """Synthetic domain 1: the descriptor is the model itself, uniform in [-0.5, 0.5]; tasks share no basis."""
    theta = rng.uniform(-0.5, 0.5, (count, d))
    return ClassificationTasks(theta, theta)


def shared_subspace(count: int, rng: np.random.Generator, d: int = 8, k: int = 4) -> ClassificationTasks:
    """Synthetic domain 1 in another reading: the descriptor is the model, but all models lie in one k-dim. subspace."""
    basis = np.linalg.qr(rng.standard_normal((d, k)))[0]
    theta = rng.uniform(-0.5, 0.5, (count, k)) @ basis.T
    return ClassificationTasks(theta, theta)


def domain_two(count: int, rng: np.random.Generator, d: int = 8, d_m: int = 8, k: int = 6, active: int = 2):
    """Synthetic domain 2: models L s and descriptors D s with ``active`` of k codes not zero; all normal draws."""
    L, D = rng.standard_normal((d, k)), rng.standard_normal((d_m, k))
    codes = rng.standard_normal((count, k))
    codes[rng.random((count, k)).argsort(axis=1) >= active] = 0.0
    return ClassificationTasks(codes @ L.T, codes @ D.T)
