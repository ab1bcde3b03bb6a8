"""Sparse coding in a shared dictionary: the one place for ELLA's mathematics (thesis equations 2.11-2.15, 4.2-4.5).

A task's vector a (its policy, or its descriptor) is coded as a = L s with few non-zero entries in s. The weight W of a
task says how much each direction of a - L s matters: a matrix (d, d), or a number w that stands for w I.
"""

from copy import copy

import numpy as np
from scipy.linalg.lapack import dposv

DEAD_NORM = 1e-8  # a column shorter than this carries no knowledge and is drawn anew
CODING_ROUNDS = 300  # a few suffice; only columns that are parallel up to rounding would need more


def sparse_code(target: np.ndarray, basis: np.ndarray, weight, sparsity: float) -> np.ndarray:
    """Return s (k,) = argmin ||target - basis s||^2_weight + sparsity ||s||_1 (equation 2.12).

    ``target`` (d,), ``basis`` (d, k), ``weight`` (d, d) or a number. An exact active set: ``signs`` says which entries
    of s are used and on which side of zero each is. While they stay, the objective is a parabola, and a Newton step
    leads to its lowest point. There an unused entry whose slope outweighs its penalty is let in; when there is none, s
    is optimal. Raises RuntimeError if that is not reached, as with numbers that are not finite.
    """
    weighed = weight @ basis if np.ndim(weight) else weight * basis
    half = sparsity / 2  # the objective's slopes are halved throughout, and so is the penalty's
    moments = target @ weighed
    largest = np.abs(moments).max()
    if largest <= half:
        return np.zeros(len(moments))

    gram = basis.T @ weighed
    # Added to the Gram matrix, about its rounding error, it shapes the steps, not their end.
    ridge = np.abs(weight).max() * np.vdot(basis, basis) * np.eye(len(gram))
    code = np.linalg.solve(gram + 1e-8 * ridge, moments)  # least squares, a start near the end
    gram = gram + 1e-15 * ridge
    signs = np.sign(code)
    tolerance = 1e-9 * (half + largest)
    for _ in range(CODING_ROUNDS):
        slope = (target - basis @ code) @ weighed
        missing = np.where(signs, slope - half * signs, 0)
        if np.abs(missing).max() <= tolerance:  # optimal among the codes with these signs
            outside = np.where(signs, 0, np.abs(slope))
            entry = outside.argmax()
            if outside[entry] <= half + tolerance:
                return code
            signs[entry] = np.sign(slope[entry])
            missing[entry] = slope[entry] - half * signs[entry]
        _newton_step(code, signs, gram, missing)
    d, k = basis.shape
    raise RuntimeError(f"no sparse code found in {CODING_ROUNDS} rounds (d = {d}, k = {k}, sparsity = {sparsity:g}): "
                       "are target, basis and weight finite, and is the weight positive semi-definite?")  # fmt: skip


def _newton_step(code: np.ndarray, signs: np.ndarray, gram: np.ndarray, missing: np.ndarray) -> None:
    """Move the used entries of ``code`` to where nothing is ``missing``, or until one reaches zero: that one leaves.

    All are (k,) but ``gram`` (k, k); ``code`` and ``signs`` are changed in place.
    """
    used = np.flatnonzero(signs)
    old, step = code[used], np.linalg.solve(gram[np.ix_(used, used)], missing[used])
    crosses = (old + step) * signs[used] < 0
    to_zero = -old / np.where(step == 0, 1, step)  # in steps; a step of zero crosses nothing, and must not divide
    reach = np.where(crosses, to_zero, 1)
    shortest = reach.min()
    code[used] += shortest * step
    if shortest < 1:
        gone = used[reach == shortest]
        code[gone] = 0
        signs[gone] = 0


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

    def copy(self) -> "Dictionary":
        """Return one with arrays of its own, and the same generator."""
        other = copy(self)
        other.basis, other.A, other.b = self.basis.copy(), self.A.copy(), self.b.copy()
        return other

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
