"""Batch multi-task learning: GO-MTL and, with task descriptors, TaDeMTL (thesis section 4.5.5)."""

import numpy as np

from lifelong_lib.transfer.dictionary import Dictionary, objective
from lifelong_lib.transfer.ella import TaDeLL, joint_code


class MultiTask(TaDeLL):
    """All tasks at once, by turns: every code with the dictionaries fixed, then the dictionaries with the codes fixed.

    With descriptors this is TaDeMTL (equation 4.3), without it is GO-MTL (equation 2.11); zero-shot prediction is that
    of TaDeLL. ``max_rounds`` and ``tolerance`` (relative change of the objective) end the alternation. Learned:
    ``basis_``, ``descriptor_basis_``, ``codes_`` by position, ``objectives_`` after each round.
    """

    def __init__(
        self, n_components=4, sparsity=1e-3, ridge=1e-5, descriptor_weight=1.0, max_rounds=100, tolerance=1e-4,
        random_state=0,
    ):  # fmt: skip
        super().__init__(n_components, sparsity, ridge, descriptor_weight, random_state=random_state)
        self.max_rounds = max_rounds
        self.tolerance = tolerance

    def fit(self, parameters: np.ndarray, hessians: np.ndarray, descriptors: np.ndarray | None = None) -> "MultiTask":
        """Learn T tasks from alpha (T, d), Gamma (T, d, d) and, for TaDeMTL, phi(m) (T, d_m); return self.

        Dictionaries start from the leading left singular vectors of the stacked targets.
        """
        weights = [self._weight(alpha, hessian) for alpha, hessian in zip(parameters, hessians, strict=True)]
        views = [(np.asarray(parameters, float), weights)]
        if descriptors is not None:
            views.append((np.asarray(descriptors, float), [self._zeta(hessian) for hessian in hessians]))
        rng = np.random.default_rng(self.random_state)
        stacked = np.concatenate([targets for targets, _ in views], axis=1)
        left, values, _ = np.linalg.svd(stacked.T, full_matrices=False)
        start = rng.standard_normal((stacked.shape[1], self.n_components)) * values[-1]
        used = min(self.n_components, len(values))
        start[:, :used] = left[:, :used] * values[:used] / np.sqrt(len(stacked))
        bases = np.split(start, np.cumsum([targets.shape[1] for targets, _ in views])[:-1])
        self.objectives_ = []
        for _ in range(self.max_rounds):
            bases = self._alternate(views, bases, rng)
            change = np.diff(self.objectives_[-2:])
            if change.size and abs(change[0]) <= self.tolerance * self.objectives_[-1]:
                break
        return self

    def _alternate(self, views: list, bases: list, rng) -> list:
        """One round; return the new bases and append the objective."""
        T = len(views[0][0])
        codes = [
            joint_code([targets[t] for targets, _ in views], bases, [weights[t] for _, weights in views], self.sparsity)
            for t in range(T)
        ]
        self.dictionaries_ = []
        for targets, weights in views:
            dictionary = Dictionary(
                targets.shape[1], self.n_components, self.ridge, "full" if np.ndim(weights[0]) else "scalar", rng
            )
            for code, target, weight in zip(codes, targets, weights, strict=True):
                dictionary.add(code, target, weight)
            dictionary.solve(T)
            self.dictionaries_.append(dictionary)
        self.codes_ = dict(enumerate(codes))
        self._parts = {t: [(targets[t], weights[t]) for targets, weights in views] for t in range(T)}
        total = sum(
            objective(targets, codes, weights, dictionary.basis, 0.0, self.ridge)
            for (targets, weights), dictionary in zip(views, self.dictionaries_, strict=True)
        )
        self.objectives_.append(total + self.sparsity * float(np.mean([np.abs(code).sum() for code in codes])))
        return [dictionary.basis for dictionary in self.dictionaries_]
