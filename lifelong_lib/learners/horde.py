"""HORDE: demons that learn value functions off-policy from one stream of behaviour (thesis section 2.2.1).

A demon's question is a policy, a continuation (1 minus the termination), a reward and a terminal reward. Its answer is
linear in features of a state, or of a state and an action. All demons see every experience, none another's answer.
"""

import numpy as np


class Horde:
    """``demons`` that learn by gradient-corrected temporal differences: GTD(lambda) of Maei, with importance ratios, as
    in Sutton et al. (2011), which off-policy does not diverge as TD may.

    ``step``: size of the answers' steps; ``correction``: of those of the second weights, from which the correction of
    the gradient is made; ``trace``: lambda. With trace 0, ratios of 1 and, as next features, those of the action that
    each answer prefers, it is Greedy-GQ, and demons learn to act. Learned: ``weights`` (demons, features). Raises
    ValueError for steps and traces out of range.
    """

    def __init__(self, demons: int, features: int, step: float, correction: float, trace: float = 0.0):
        if not (step > 0 and correction >= 0 and 0 <= trace <= 1):
            raise ValueError(f"a horde needs a step > 0, a correction >= 0 and a trace in [0, 1], not "
                             f"{step}, {correction} and {trace}")  # fmt: skip
        self.step, self.correction, self.trace = step, correction, trace
        self.weights, self.second, self.traces = np.zeros((3, demons, features))
        self.continued = np.zeros((demons, 1))  # from the step before

    def learn(self, features, next_features, ratios, rewards, continuations, terminals) -> None:
        """One step of the stream, from ``features`` (features,) to ``next_features`` (features,) or (demons, features).

        Of each demon (demons,): the probability of what the behaviour did under the demon's policy over that under its
        own (0: not heard), the reward, how likely it goes on from the next state, and what it gets there if it ends.
        """
        ratios, rewards, on, ends = (part[:, None] for part in (ratios, rewards, continuations, terminals))
        self.traces = ratios * (self.continued * self.trace * self.traces + features)
        ahead = rewards + (1 - on) * ends + on * _products(self.weights, next_features)
        surprise = (ahead - _products(self.weights, features)) * self.traces
        lost = on * (1 - self.trace) * _products(self.second, self.traces) * next_features
        self.weights += self.step * (surprise - lost)
        self.second += self.correction * (surprise - _products(self.second, features) * features)
        self.continued = on


def _products(weights, features):
    """One number a demon (demons, 1), added up in an order that does not depend on how many demons there are."""
    return (weights * features).sum(axis=1, keepdims=True)
