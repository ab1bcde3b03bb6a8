"""Sparse coding in a shared dictionary: the one place for ELLA's mathematics (thesis equations 2.11-2.15, 4.2-4.5).

A task's vector a (its policy, or its descriptor) is coded as a = L s with few non-zero entries in s. The weight W of a
task says how much each direction of a - L s matters: a matrix (d, d), or a number w that stands for w I.
"""

import numpy as np
from scipy.linalg.lapack import dposv

DEAD_NORM = 1e-8  # a column shorter than this carries no knowledge and is drawn anew
CODING_ROUNDS = 300  # a few suffice; only columns that are parallel up to rounding would need more


def sparse_code(target: np.ndarray, basis: np.ndarray, weight, sparsity: float) -> np.ndarray:
    """Return s (k,) = argmin ||target - basis s||^2_weight + sparsity ||s||_1 (equation 2.12).

    ``target`` (d,), ``basis`` (d, k), ``weight`` (d, d) or a number. An exact active set: from the least-squares code,
    Newton steps with the present signs. An entry that reaches zero stays there until its slope asks for it; when none
    does, s is optimal. What is added to the Gram matrix, about its rounding error, shapes the steps, not their end.
    """
    weighed, half = (weight @ basis if np.ndim(weight) else weight * basis), sparsity / 2
    moments = target @ weighed
    largest = np.abs(moments).max()
    if largest <= half:
        return np.zeros(len(moments))
    gram = basis.T @ weighed
    ridge, tolerance = np.abs(weight).max() * np.vdot(basis, basis) * np.eye(len(gram)), 1e-9 * (half + largest)
    code = np.linalg.solve(gram + 1e-8 * ridge, moments)
    gram, signs = gram + 1e-15 * ridge, np.sign(code)
    for _ in range(CODING_ROUNDS):
        slope = (target - basis @ code) @ weighed
        missing = np.where(signs, slope - half * signs, 0)
        if np.abs(missing).max() <= tolerance:  # optimal among the codes with these signs
            outside = np.where(signs, 0, np.abs(slope))
            entry = outside.argmax()
            if outside[entry] <= half + tolerance:
                break
            signs[entry] = np.sign(slope[entry])
            missing[entry] = slope[entry] - half * signs[entry]
        used = np.flatnonzero(signs)
        old, step = code[used], np.linalg.solve(gram[used[:, None], used], missing[used])
        parts = np.where((old + step) * signs[used] < 0, -old / np.where(step, step, 1), 1)  # of the step, up to zero
        code[used] += parts.min() * step
        gone = used[parts == parts.min()] if parts.min() < 1 else []
        code[gone] = signs[gone] = 0
    return code


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
        # The transpose of a symmetric matrix is that matrix in the order of memory that LAPACK wants: no copies.
        _, solution, failed = dposv(system.T, self.b.reshape(len(system), -1), lower=True, overwrite_a=True)
        if failed:
            raise ValueError(f"the dictionary's equations lost their precision; raise ridge (now {self.ridge:g})")
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
