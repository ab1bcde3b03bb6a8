"""Transferability between tasks, learned from trying every pair (Sinapov et al. 2015; thesis section 4.5.4)."""

from collections.abc import Callable

import numpy as np
from sklearn.linear_model import LinearRegression


def transfer_benefits(train: Callable, policies: np.ndarray, baseline: np.ndarray) -> np.ndarray:
    """Return B_m(i, j), the mean gain over m training steps when task j starts from task i's policy: (T, T).

    ``train(starts (T, d)) -> rewards (m, T)`` trains every task j for m iterations from row j of ``starts``;
    ``policies`` (T, d) are the trained policies; ``baseline`` (m, T) the rewards of tasks trained from their own start.
    The diagonal, a task transferred to itself, is not a transfer and is NaN.
    """
    T = len(policies)
    benefits = np.stack([(train(np.repeat(policies[i : i + 1], T, axis=0)) - baseline).mean(axis=0) for i in range(T)])
    np.fill_diagonal(benefits, np.nan)
    return benefits


class TransferabilityModel:
    """Predict the benefit of a transfer from the change in descriptors, and choose the source for a new task.

    Learned: ``regression_`` from (m_j - m_i) / spread to B(i, j), ``scale_`` (p,).
    """

    def fit(self, descriptors: np.ndarray, benefits: np.ndarray) -> "TransferabilityModel":
        """Learn from descriptors (T, p) and benefits (T, T); return self."""
        self.descriptors_ = np.asarray(descriptors, float)
        spread = self.descriptors_.std(axis=0)
        self.scale_ = np.where(spread > 0, spread, 1.0)
        source, target = np.nonzero(np.isfinite(benefits))
        change = (self.descriptors_[target] - self.descriptors_[source]) / self.scale_
        self.regression_ = LinearRegression().fit(change, benefits[source, target])
        return self

    def best_source(self, descriptor: np.ndarray) -> int:
        """Return the index of the task whose policy is predicted to help the task with this descriptor (p,) most."""
        return int(self.regression_.predict((descriptor - self.descriptors_) / self.scale_).argmax())
