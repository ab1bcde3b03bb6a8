"""ELLA, PG-ELLA and TaDeLL: lifelong learners that meet one task at a time (thesis sections 2.2.4, 2.2.5, 4.2, 4.3).

Both follow scikit-learn's conventions. They take what a single-task learner found: its parameters alpha (d,) and the
Hessian Gamma of its loss there. With classifiers or regressions that is ELLA; with policies found by policy gradient it
is PG-ELLA (algorithm 1); with task descriptors added it is TaDeLL (algorithm 2) in either case.
"""

import json

import numpy as np
from scipy.linalg.lapack import dpotrf
from sklearn.base import BaseEstimator

from lifelong_lib.transfer.dictionary import Dictionary, sparse_code


class ELLA(BaseEstimator):
    """Efficient lifelong learning: policies theta = L s in a dictionary L that grows wiser with each task.

    ``n_components``: columns k of L; ``sparsity``: weight mu of ||s||_1 (the authors' released ELLA multiplies its own
    by d / n, n samples in the task, and halves its Hessians); ``ridge``: weight lambda of ||L||_F^2;
    ``start``: "tasks" makes the first k tasks the first columns, as the authors' released ELLA can, "random" draws them
    (algorithms 1, 2), which may take many visits to be forgotten; ``learn_dictionary`` False keeps a random basis (a
    negative control); ``hessian`` False replaces every Gamma by its mean diagonal times I; ``random_state``: seed or
    generator of the first basis.
    Learned: ``basis_`` (d, k), ``codes_`` {task: (k,)}, ``n_tasks_``. A task that is refused changes nothing.
    """

    def __init__(
        self, n_components=4, sparsity=1e-3, ridge=1e-5, start="tasks", learn_dictionary=True, hessian=True,
        random_state=0,
    ):  # fmt: skip
        self.n_components = n_components
        self.sparsity = sparsity
        self.ridge = ridge
        self.start = start
        self.learn_dictionary = learn_dictionary
        self.hessian = hessian
        self.random_state = random_state

    def partial_fit(self, task, parameters: np.ndarray, hessian: np.ndarray) -> "ELLA":
        """Learn ``task`` (any hashable name), new or met before, from its single-task solution; return self.

        ``parameters``: alpha (d,); ``hessian``: Gamma (d, d), positive semi-definite. Raises ValueError if they are
        something else, do not fit together or are not finite, and for impossible settings.
        """
        return self._learn(task, [np.asarray(parameters, float)], [self._weight(parameters, hessian)])

    def policy(self, task) -> np.ndarray:
        """Return theta = L s (d,) of a task met before, with today's dictionary."""
        if task not in getattr(self, "codes_", {}):
            raise ValueError(f"task {task!r} has not been learned yet; call partial_fit for it first")
        return self.basis_ @ self.codes_[task]

    def save(self, path) -> None:
        """Write settings and all that was learned to ``path`` (.npz, no pickle); `load` goes on where it stopped.

        Raises ValueError before a first task, and unless tasks are named by integers or strings.
        """
        names = list(getattr(self, "codes_", ()))
        if not names or not all(isinstance(name, int | str) for name in names):
            raise ValueError("only a learner that met tasks, named by integers or strings, can be saved")
        generator = self.dictionaries_[0].rng.bit_generator.state
        arrays = {
            # A generator given as random_state has done its part and is stored as null; its state is kept beside it.
            "about": json.dumps(
                [type(self).__name__, self.get_params(deep=False), names, generator],
                default=lambda value: value.item() if isinstance(value, np.generic) else None,
            ),
            "codes": [*self.codes_.values()],
        }
        for view, dictionary in enumerate(self.dictionaries_):
            arrays |= {f"{part}{view}": getattr(dictionary, part) for part in ("basis", "A", "b")}
            for place, part in enumerate(("target", "weight")):
                arrays[f"{part}{view}"] = np.array([self._parts[name][view][place] for name in names])
        with open(path, "wb") as file:  # given only a name, numpy would add an ending to it
            np.savez(file, **arrays)

    @classmethod
    def load(cls, path) -> "ELLA":
        """Return the learner that `save` wrote to ``path``. Raises ValueError if it is of another class."""
        with np.load(path, allow_pickle=False) as stored:
            kind, settings, names, generator = json.loads(str(stored["about"]))
            if kind != cls.__name__:
                raise ValueError(f"{path} holds a {kind}, not a {cls.__name__}; call {kind}.load")
            learner = cls(**settings)
            learner.codes_ = dict(zip(names, stored["codes"], strict=True))
            views = range(sum(name.startswith("basis") for name in stored.files))
            parts = [list(zip(stored[f"target{view}"], stored[f"weight{view}"], strict=True)) for view in views]
            learner._parts = {name: [part[i] for part in parts] for i, name in enumerate(names)}
            rng = np.random.default_rng()
            rng.bit_generator.state = generator
            learner.dictionaries_ = []
            for view in views:
                d, k = stored[f"basis{view}"].shape
                weights = "full" if stored[f"weight{view}"].ndim == 3 else "scalar"
                dictionary = Dictionary(d, k, learner.ridge, weights, rng)
                for part in ("basis", "A", "b"):
                    setattr(dictionary, part, stored[f"{part}{view}"])
                learner.dictionaries_.append(dictionary)
            rng.bit_generator.state = generator
        return learner

    @property
    def basis_(self) -> np.ndarray:
        return self.dictionaries_[0].basis

    @property
    def n_tasks_(self) -> int:
        return len(self.codes_)

    def _weight(self, parameters, hessian):
        parameters, hessian = np.asarray(parameters, float), np.asarray(hessian, float)
        if parameters.ndim != 1:
            raise ValueError(f"parameters are a vector (d,), got {parameters.shape}; of a linear model: coef_.ravel()")
        if hessian.shape != (parameters.size, parameters.size):
            raise ValueError(f"{parameters.size} parameters need a square Hessian of that size, got {hessian.shape}")
        if not (np.isfinite(parameters).all() and np.isfinite(hessian).all()):
            raise ValueError("parameters and Hessian must be finite; did the single-task learner diverge?")
        slack = 1e-8 * np.abs(hessian).max() + np.finfo(float).tiny  # for rounding
        lopsided = np.abs(hessian - hessian.T).max() > slack
        _, indefinite = dpotrf(hessian + slack * np.eye(len(hessian)))
        if lopsided or indefinite:
            raise ValueError("a Hessian is symmetric and positive semi-definite; is this one taken at a minimum?")
        return hessian if self.hessian else float(np.diag(hessian).mean())

    def _first(self, targets: list, weights: list) -> list:
        """The dictionaries before a first task."""
        if self.start not in ("tasks", "random"):
            raise ValueError(f"start must be 'tasks' or 'random', got {self.start!r}")
        rng = np.random.default_rng(self.random_state)
        return [Dictionary(len(a), self.n_components, self.ridge, "full" if np.ndim(W) else "scalar", rng)
                for a, W in zip(targets, weights, strict=True)]  # fmt: skip

    def _learn(self, task, targets: list, weights: list) -> "ELLA":
        """Code the task in the old dictionaries, exchange its part of A and b, solve them anew (algorithms 1, 2)."""
        if not (self.sparsity >= 0 and self.n_components >= 1):
            raise ValueError(f"sparsity is 0 or more, n_components 1 or more; got {self.sparsity}, {self.n_components}")
        task = task.item() if isinstance(task, np.generic) else task
        codes, parts = getattr(self, "codes_", {}), getattr(self, "_parts", {})
        dictionaries = [old.copy() for old in self.dictionaries_] if codes else self._first(targets, weights)
        for dictionary, target in zip(dictionaries, targets, strict=True):
            if len(target) != len(dictionary.basis):
                raise ValueError(f"task {task!r} has {len(target)} numbers, earlier ones had {len(dictionary.basis)}")
        for view, dictionary in enumerate(dictionaries):
            dictionary.revive()
            if task in codes:
                dictionary.add(codes[task], *parts[task][view], sign=-1)
        if self.start == "tasks" and self.learn_dictionary and len(codes) < self.n_components:
            code = codes.get(task, np.eye(self.n_components)[len(codes)])
        else:
            code = joint_code(targets, [dictionary.basis for dictionary in dictionaries], weights, self.sparsity)
        for dictionary, target, weight in zip(dictionaries, targets, weights, strict=True):
            dictionary.add(code, target, weight)
            if self.learn_dictionary:
                dictionary.solve(len(codes) + (task not in codes))
        codes[task], parts[task] = code, list(zip(targets, weights, strict=True))
        self.dictionaries_, self.codes_, self._parts = dictionaries, codes, parts
        return self


class TaDeLL(ELLA):
    """Task descriptors for lifelong learning: a second dictionary D codes descriptors with the same s (equation 4.1).

    Learned besides ELLA's: ``descriptor_basis_`` (d_m, k). The descriptor's fit has the weight zeta, the mean diagonal
    of the task's Hessian, times ``descriptor_weight``: the unit of descriptors is free, and with it their weight.
    """

    def __init__(
        self, n_components=4, sparsity=1e-3, ridge=1e-5, descriptor_weight=1.0, start="tasks", learn_dictionary=True,
        random_state=0,
    ):  # fmt: skip
        super().__init__(n_components, sparsity, ridge, start, learn_dictionary, random_state=random_state)
        self.descriptor_weight = descriptor_weight

    def partial_fit(self, task, parameters: np.ndarray, hessian: np.ndarray, descriptor: np.ndarray) -> "TaDeLL":
        """Learn ``task`` from its single-task solution and its descriptor features phi(m) (d_m,); return self."""
        descriptor = np.asarray(descriptor, float)
        if descriptor.ndim != 1 or not np.isfinite(descriptor).all():
            raise ValueError(f"the descriptor of task {task!r} must be a vector of finite numbers")
        weights = [self._weight(parameters, hessian), self._zeta(hessian)]
        return self._learn(task, [np.asarray(parameters, float), descriptor], weights)

    def _zeta(self, hessian: np.ndarray) -> float:
        return self.descriptor_weight * float(np.diag(hessian).mean())

    @property
    def descriptor_basis_(self) -> np.ndarray:
        return self.dictionaries_[1].basis

    def predict(self, descriptor: np.ndarray) -> np.ndarray:
        """Return the zero-shot policy L s (d,) for a new task's descriptor (algorithm 3, equation 4.5)."""
        descriptor = np.asarray(descriptor, float)
        if len(getattr(self, "dictionaries_", ())) < 2:
            raise ValueError("no task with a descriptor has been learned yet; partial_fit one first")
        if descriptor.shape != self.descriptor_basis_.shape[:1] or not np.isfinite(descriptor).all():
            raise ValueError(f"a descriptor here is {len(self.descriptor_basis_)} finite numbers, got {descriptor}")
        return self.basis_ @ sparse_code(descriptor, self.descriptor_basis_, 1.0, self.sparsity)


def joint_code(targets: list, bases: list, weights: list, sparsity: float) -> np.ndarray:
    """Return the one code s (k,) that fits all targets in their bases, each with its weight (equations 2.12, 4.4)."""
    if len(targets) == 1:
        return sparse_code(targets[0], bases[0], weights[0], sparsity)
    sizes = [len(target) for target in targets]
    joint = np.zeros((sum(sizes), sum(sizes)))
    for end, size, weight in zip(np.cumsum(sizes), sizes, weights, strict=True):
        joint[end - size : end, end - size : end] = weight if np.ndim(weight) else weight * np.eye(size)
    return sparse_code(np.concatenate(targets), np.concatenate(bases), joint, sparsity)
