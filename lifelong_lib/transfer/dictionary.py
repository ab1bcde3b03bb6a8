"""Sparse coding in a shared dictionary: the one place for ELLA's mathematics (thesis equations 2.11-2.15, 4.2-4.5).

A task's vector a (its policy, or its descriptor) is coded as a = L s with few non-zero entries in s. The weight W of a
task says how much each direction of a - L s matters: a matrix (d, d), or a number w that stands for w I.
"""

import warnings

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve
from sklearn.exceptions import ConvergenceWarning
from sklearn.linear_model import lars_path_gram, lasso_path

DEAD_NORM = 1e-8  # a column shorter than this carries no knowledge and is drawn anew


def symmetric_root(weight: np.ndarray) -> np.ndarray:
    """Return R with R^T R = weight (d, d); eigenvalues below zero, which only rounding makes, count as zero."""
    values, vectors = np.linalg.eigh(weight)
    return np.sqrt(np.clip(values, 0, None))[:, None] * vectors.T


def sparse_code(target: np.ndarray, basis: np.ndarray, weight, sparsity: float) -> np.ndarray:
    """Return s (k,) = argmin ||target - basis s||^2_weight + sparsity ||s||_1 (equation 2.12).

    ``target`` (d,), ``basis`` (d, k), ``weight`` (d, d) or a number. scikit-learn's lasso divides the squared error by
    twice the number of rows, hence the scaling of the penalty. Least angles, not coordinate descent: columns of a
    young dictionary are nearly parallel, where the latter needs more rounds than it gets.
    """
    root = symmetric_root(weight) if np.ndim(weight) else np.sqrt(weight)
    target, basis = (root @ target, root @ basis) if np.ndim(weight) else (root * target, root * basis)
    if not np.any(basis):
        return np.zeros(basis.shape[1])
    gram, moments, alpha = basis.T @ basis, basis.T @ target, sparsity / (2 * len(target))
    with warnings.catch_warnings():
        warnings.simplefilter("error", ConvergenceWarning)
        try:
            options = {"precompute": gram, "Xy": moments, "check_input": False, "tol": 1e-10, "max_iter": 1000}
            return lasso_path(np.asfortranarray(basis), target, alphas=[alpha], **options)[1][:, 0]
        except ConvergenceWarning:
            return lars_path_gram(moments, gram, n_samples=len(target), method="lasso", alpha_min=alpha)[2][:, -1]


def reconstruction_loss(target: np.ndarray, basis: np.ndarray, code: np.ndarray, weight) -> float:
    """Return ||target - basis code||^2_weight."""
    error = target - basis @ code
    return float(error @ weight @ error if np.ndim(weight) else weight * error @ error)


class Dictionary:
    """A basis L (d, k) with the running sums A and b from which it is solved.

    ``weights`` are "full" (every task brings a (d, d) matrix; A is kd x kd) or "scalar" (every task brings a number; A
    shrinks to k x k, as all rows of L then share one system). ``rng`` draws the first basis and dead columns.
    """

    def __init__(self, d: int, k: int, ridge: float, weights: str, rng: np.random.Generator):
        if weights not in ("full", "scalar"):
            raise ValueError(f"weights must be 'full' or 'scalar', got {weights!r}")
        if ridge <= 0:
            raise ValueError(f"ridge must be positive, or the dictionary has no unique solution; got {ridge}")
        self.ridge, self.weights, self.rng = ridge, weights, rng
        self.basis = rng.standard_normal((d, k))
        self.A = np.zeros((k * d, k * d) if weights == "full" else (k, k))
        self.b = np.zeros((k, d))

    def add(self, code: np.ndarray, target: np.ndarray, weight, sign: int = 1) -> None:
        """Add one task's part to A and b (equations 2.13, 2.14); ``sign`` = -1 takes it out again (algorithm 1)."""
        if self.weights == "scalar":
            self.A += sign * float(weight) * np.outer(code, code)
            self.b += sign * float(weight) * np.outer(code, target)
            return
        k, d = self.b.shape
        blocks, row = self.A.reshape(k, d, k, d), weight[:, None] * code[:, None]  # row (d, k, d): s^T times Gamma
        for i in np.flatnonzero(code):
            blocks[i] += sign * code[i] * row
        self.b += sign * np.outer(code, weight @ target)

    def solve(self, n_tasks: int) -> np.ndarray:
        """Set and return the basis L = mat((A / T + ridge I)^-1 b / T) (equation 2.15) for T = ``n_tasks``.

        One Cholesky solve; an explicit inverse, or its recursive eigenvalue form, gives the same L.
        """
        system = self.A.copy()
        system.flat[:: len(system) + 1] += n_tasks * self.ridge
        right = self.b if self.weights == "scalar" else self.b.ravel()
        try:
            # The transpose of a symmetric matrix is that matrix in the order of memory that LAPACK wants: no copies.
            factor = cho_factor(system.T, lower=True, overwrite_a=True, check_finite=False)
            solution = cho_solve(factor, right, check_finite=False)
        except LinAlgError:
            raise ValueError(
                f"the dictionary's equations lost their precision; raise ridge (now {self.ridge:g})"
            ) from None
        self.basis = np.ascontiguousarray(solution.reshape(self.b.shape).T)
        return self.basis

    def revive(self) -> None:
        """Draw columns anew that have died (norm zero), as otherwise no code would ever use them again."""
        dead = np.linalg.norm(self.basis, axis=0) < DEAD_NORM
        self.basis[:, dead] = self.rng.standard_normal((len(self.basis), int(dead.sum())))


def objective(targets, codes, weights, basis: np.ndarray, sparsity: float, ridge: float) -> float:
    """Return the multi-task objective (1/T) sum_t [||a - L s||^2_W + sparsity ||s||_1] + ridge ||L||_F^2 (eq. 2.11)."""
    terms = [
        reconstruction_loss(target, basis, code, weight) + sparsity * np.abs(code).sum()
        for target, code, weight in zip(targets, codes, weights, strict=True)
    ]
    return float(np.mean(terms) + ridge * (basis**2).sum())


def mutual_coherence(basis: np.ndarray) -> float:
    """Return the largest |cosine| between two different columns of ``basis`` (thesis section 4.4.1)."""
    unit = basis / np.maximum(np.linalg.norm(basis, axis=0), DEAD_NORM)
    return float(np.abs(unit.T @ unit - np.diag((unit**2).sum(axis=0))).max())
