"""What tells experiences apart where a memory is to cover them (thesis section 6.3.3)."""

import numpy as np

from lifelong_lib.learners.q_learning import Trial


def whole_experience(trial: Trial) -> np.ndarray:
    """State, action (a 1 in its own place), next state and reward, side by side, and their squared length (n, d)."""
    states, actions = trial.images.reshape(len(trial.images), -1), np.eye(trial.masks.shape[1])[trial.actions]
    whole = np.column_stack([states[:-1], actions, states[1:], trial.rewards])
    return np.column_stack([whole, (whole**2).sum(axis=1)])


def extended_jaccard(one: np.ndarray, others: np.ndarray) -> np.ndarray:
    """1 - x y / (|x|^2 + |y|^2 - x y) of ``one`` (d,) and ``others`` (m, d), whose last entries are |x|^2 and |y|^2."""
    used = np.flatnonzero(one[:-1])  # few, where images are nearly empty
    common = others[:, used] @ one[used]
    return 1 - common / (one[-1] + others[:, -1] - common)


def manhattan(one: np.ndarray, others: np.ndarray) -> np.ndarray:
    """The sum of absolute differences between ``one`` (d,) and each of ``others`` (m, d)."""
    return np.abs(others - one).sum(axis=1)
