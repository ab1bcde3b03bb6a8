"""HORDE: many demons that learn value functions off-policy from one stream of behaviour (thesis section 2.2.1).

A demon's *question* is a policy, a continuation (1 - the termination Upsilon), a reward and a terminal reward; its
*answer* is linear in features of a state, or of a state and an action. All demons see the same experiences, and none
sees what another has learned.
"""

import numpy as np


class Horde:
    """``demons`` demons with ``features`` features each, which learn by gradient-corrected temporal differences.

    GTD(lambda) with importance ratios, as Sutton et al. (2011) use it: one step of `learn` costs each demon a few
    products of its features, and keeps TD from diverging off-policy. With ``trace`` 0, ratios of 1 and for
    ``next_features`` those of the action that each demon's own answer prefers, it is Greedy-GQ, which learns to act.
    ``step``: of the answers; ``correction``: of the second weights, which estimate the gradient's correction;
    ``trace``: lambda. Learned: ``weights`` (demons, features). Raises ValueError for steps and traces out of range.
    """

    def __init__(self, demons: int, features: int, step: float, correction: float, trace: float = 0.0):
        if not (step > 0 and correction >= 0 and 0 <= trace <= 1):
            raise ValueError(f"a horde needs step > 0, correction >= 0 and a trace in [0, 1], got "
                             f"{step}, {correction} and {trace}")  # fmt: skip
        self.step, self.correction, self.trace = step, correction, trace
        self.weights, self.second, self.traces = np.zeros((3, demons, features))
        self.continued = np.zeros((demons, 1))  # nothing came before the first step

    def answers(self, features: np.ndarray) -> np.ndarray:
        """Return every demon's answer for features (n, features): (demons, n)."""
        return self.weights @ features.T

    def learn(self, features, next_features, ratios, rewards, continuations, terminals) -> None:
        """One step of the stream, from ``features`` (features,) to ``next_features`` (features,) or (demons, features).

        Of each demon, all (demons,): the probability of what was done next under its policy over that under the
        behaviour, its reward, how likely it goes on from the next state, and what it gets there if it ends.
        """
        ratios, rewards, on, terminals = (np.reshape(part, (-1, 1)) for part in
                                          (ratios, rewards, continuations, terminals))  # fmt: skip
        self.traces = ratios * (self.continued * self.trace * self.traces + features)
        ahead = rewards + (1 - on) * terminals + on * _products(self.weights, next_features)
        surprise = (ahead - _products(self.weights, features)) * self.traces
        lost = on * (1 - self.trace) * _products(self.second, self.traces) * next_features
        self.weights += self.step * (surprise - lost)
        self.second += self.correction * (surprise - _products(self.second, features) * features)
        self.continued = on


def _products(weights, features):
    """One number a demon, added up in an order that does not depend on how many demons there are: (demons, 1)."""
    return (weights * features).sum(axis=1, keepdims=True)
