"""Speed as ratios measured in one run: medians over repetitions that alternate between the two sides.

`./reproduce.sh bench` runs it; exit code 1 if a promise is missed.
"""

import os
import shutil
import sys
from functools import partial
from itertools import chain, product
from time import perf_counter
from typing import NamedTuple

import gymnasium as gym
import numpy as np
import torch
from torch import nn

from lifelong_lib.environments.crossing import COLUMNS, GO, LENGTH, MAX_STEPS, ROWS, WIDTH, grid
from lifelong_lib.environments.dynamical_systems import SYSTEMS, draw_tasks
from lifelong_lib.environments.gymnasium_envs import IDS, STEPS
from lifelong_lib.environments.intersections import Intersection
from lifelong_lib.environments.prediction import PROFILES, corners, covered
from lifelong_lib.environments.safe_junction import SafeJunction
from lifelong_lib.environments.sumo import OPTIONS, WARM_UP, poses
from lifelong_lib.learners.classifier import Classifier, digit_network
from lifelong_lib.learners.networks import Convolution, Dense, Network
from lifelong_lib.learners.q_learning import DQN, ReplayBuffer, Settings, Trial, q_network
from lifelong_lib.transfer.dictionary import Dictionary
from lifelong_lib.transfer.distances import extended_jaccard, whole_experience
from lifelong_lib.transfer.ella import ELLA
from lifelong_lib.transfer.replay import CoverageMemory, EpisodicMemory, distribution_matching, noisy_reward, surprise

D, SPARSITY, RIDGE = 40, 0.1, 1e-3  # of ELLA: size of a policy and the two penalties


class Row(NamedTuple):
    """One promise: ``measured`` is to be "at least" or "at most" (``bound``) the ``limit``."""
    what: str
    measured: float
    bound: str
    limit: float

    @property
    def ok(self) -> bool:
        return self.measured >= self.limit if self.bound == "at least" else self.measured <= self.limit


def main() -> list[Row]:
    """Measure, print a line a promise, and return the rows."""
    torch.set_num_threads(1)
    load, rows = os.getloadavg()[0], []
    ella = many_tasks(), dense_inverse("full", 3), dense_inverse("identity", 10)
    replay = inserts(), digit_update()
    for row in chain(batched_roll_outs(), *ella, junction(), traci_loop(), q_update(), q_learning(), *replay, mask()):
        rows.append(row)
        print(f"{'ok' if row.ok else 'MISSED':7}{row.measured:<9.3g}{row.bound} {row.limit:<6g} {row.what}", flush=True)
    advice = "; the machine was loaded: measure again when nothing else runs" * (load > 0.5)
    print(f"load before: {load:.1f} on {os.cpu_count()} cores{advice}")
    return rows


def medians(repetitions: int, *sides) -> np.ndarray:
    """Median seconds of each side; they are called in turn, after one call of each to warm up."""
    seconds = np.empty((repetitions + 1, len(sides)))
    for turn, side in np.ndindex(*seconds.shape):
        start = perf_counter()
        sides[side]()
        seconds[turn, side] = perf_counter() - start
    return np.median(seconds[1:], axis=0)


def batched_roll_outs(count: int = 40, n: int = 100, repetitions: int = 5):
    """Every system: seconds a step of a Gymnasium environment in a loop, over those of a batch of tasks."""
    for name, system in SYSTEMS.items():
        tasks, policy = draw_tasks(system, count, np.random.default_rng(0)), np.full(system.policy_size, -0.1)
        env, gains = gym.make(IDS[name], parameters=tasks.parameters[0]), policy.reshape(len(system.actions), -1)

        def batch(tasks=tasks, policy=policy):
            tasks.roll_out(np.tile(policy, (count, 1)), n, [*map(np.random.default_rng, range(count))], 0.1, STEPS)

        def loop(env=env, gains=gains):
            state, _ = env.reset(seed=0)
            for noise in 0.1 * np.random.default_rng(0).standard_normal((STEPS, len(gains))):
                state = env.step(gains @ state + noise)[0]
        together, alone = medians(repetitions, batch, loop)
        yield Row(f"{name}: a step of a batch against a Gymnasium loop", alone * count * n / together, "at least", 30)


def solutions(count: int, columns: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """Parameters (D,) of tasks that share ``columns``, and Hessians (D, D)."""
    rng = np.random.default_rng(1)
    shared, roots = rng.standard_normal((D, columns)), rng.standard_normal((count, D, D))
    parameters = rng.standard_normal((count, columns)) @ shared.T + 0.1 * rng.standard_normal((count, D))
    return list(zip(parameters, np.eye(D) + roots @ roots.swapaxes(1, 2) / D, strict=True))


def many_tasks(few: int = 10, many: int = 1000, columns: int = 4, repetitions: int = 200):
    """Seconds of an update at T = ``many`` over those at T = ``few``; known tasks are met again, so that T stays."""
    known, learners = solutions(many, columns), [ELLA(columns, SPARSITY, RIDGE) for _ in range(2)]
    for learner, count in zip(learners, (few, many), strict=True):
        for task, solution in enumerate(known[:count]):
            learner.partial_fit(task, *solution)
    turns = iter(np.repeat(np.arange(repetitions + 1), 2))
    sides = [lambda one=one: one.partial_fit((turn := next(turns)) % few, *known[turn]) for one in learners]
    small, large = medians(repetitions, *sides)
    yield Row(f"ELLA: time of an update at T = {many} against T = {few}", large / small, "at most", 1.1)


class DenseDictionary(Dictionary):
    """Equations 2.13-2.15 word by word: Kronecker products and the inverse of the (kd, kd) matrix."""

    def add(self, code, target, weight, sign=1):
        self.A += sign * np.kron(np.outer(code, code), weight)
        self.b += sign * np.outer(code, weight @ target)

    def solve(self, n_tasks):
        inverse = np.linalg.inv(self.A / n_tasks + self.ridge * np.eye(len(self.A)))
        self.basis = (inverse @ self.b.ravel() / n_tasks).reshape(self.b.shape).T


class DenseELLA(ELLA):
    """ELLA with a dictionary of the dense kind."""

    def _first(self, targets, weights):
        return [DenseDictionary(D, self.n_components, self.ridge, "full", np.random.default_rng(0))]


def dense_inverse(hessians: str, limit: float, tasks: int = 40, columns: int = 10, repetitions: int = 30):
    """Whole updates of a task met again (code it, exchange its part of A and b, solve), with either dictionary."""
    known, full = solutions(tasks, columns), hessians == "full"
    if not full:
        known = [(alpha, np.diag(gamma).mean() * np.eye(D)) for alpha, gamma in known]
    fast, dense = ELLA(columns, SPARSITY, RIDGE, hessian=full), DenseELLA(columns, SPARSITY, RIDGE)
    for task, solution in enumerate(known):
        fast.partial_fit(task, *solution)
        dense.partial_fit(task, *solution)
    difference = np.abs(dense.basis_ - fast.basis_).max() / np.abs(fast.basis_).max()
    ours, theirs = medians(repetitions, *(partial(learner.partial_fit, 0, *known[0]) for learner in (fast, dense)))
    yield Row(f"ELLA, {hessians} Hessians: an update against the dense inverse", theirs / ours, "at least", limit)
    yield Row(f"ELLA, {hessians} Hessians: difference from the dense inverse", difference, "at most", 1e-8)


def junction(repetitions: int = 20):
    """A trial in SUMO of 100 waits of one step, each observed, against a simulation of as many steps left unread."""
    env = Intersection("challenge")

    def trial():
        env.reset(seed=1)
        while not env.step(0)[3]:
            pass

    def simulation():
        env.sumo.load(1)
        env.sumo.drive_on(WARM_UP + 2 + MAX_STEPS)
    bare, ours = medians(repetitions, simulation, trial)
    env.close()
    yield Row("SUMO: steps a second, observed, against the bare simulation", bare / ours, "at least", 0.8)


def traci_loop(repetitions: int = 5):
    """The same trial through TraCI, the socket to a SUMO of its own, reading the same of every car near the junction.

    Needs the program `sumo` of the pinned release, which nothing else here does; without it there is no such row.
    """
    if not shutil.which("sumo"):
        print("no program `sumo` here (pip install eclipse-sumo==1.28.0): the row about TraCI is left out")
        return
    import traci

    env = Intersection("challenge")
    env.reset(seed=1)
    options = {"net-file": env.sumo.network, "route-files": env.sumo.routes, "seed": 1} | OPTIONS
    traci.start(["sumo", *(str(word) for key, value in options.items() for word in (f"--{key}", value))])
    for _ in range(WARM_UP):
        traci.simulationStep()

    def theirs():
        for _ in range(MAX_STEPS - 1):
            traci.simulationStep()
            cars = [[traci.vehicle.getPosition(car), traci.vehicle.getAngle(car), traci.vehicle.getSpeed(car)]
                    for car in traci.vehicle.getIDList()]  # fmt: skip
            grid(poses([(*place, angle, speed) for place, angle, speed in cars]), np.zeros(2))

    def ours():
        for _ in range(MAX_STEPS - 1):
            env.steps = 0  # one trial without an end
            env.step(0)

    ours, theirs = medians(repetitions, ours, theirs)
    traci.close()
    env.close()
    yield Row("SUMO: observed steps a second against the same loop through TraCI", theirs / ours, "at least", 5)


def torch_twin(network):
    """The same network of torch's own layers, which differentiate by themselves; images have their channels last."""
    class Axes(nn.Module):
        """Images with their axes in another order."""

        def __init__(self, *order):
            super().__init__()
            self.order = order

        def forward(self, images):
            return images.permute(self.order)

    layers = [Axes(0, 3, 1, 2)] if len(network.shapes[0]) == 3 else []
    for number, (layer, (matrix, bias)) in enumerate(zip(network.layers, network.parts, strict=True)):
        shape = network.shapes[number]
        if isinstance(layer, Convolution):
            twin = nn.Conv2d(shape[2], layer.nodes, layer.size, layer.stride)
            weights = matrix.view(layer.size, layer.size, shape[2], layer.nodes).permute(3, 2, 0, 1)
        else:
            layers += [Axes(0, 2, 3, 1), nn.Flatten()] if len(shape) == 3 else []
            twin, weights = nn.Linear(len(matrix), layer.nodes), matrix.t()
        twin.weight.data, twin.bias.data = weights.clone(), bias[0].clone()
        layers += [twin, nn.LeakyReLU(network.slope)]
    return nn.Sequential(*layers[:-1])


def learner(**more):
    """A learner of the junctions with the settings of chapter 5's first search."""
    knobs = {"rate": 1e-4, "damping": 1e-6, "decay": 0.95, "discount": 0.99, "epsilon": 0.05, "batch": 60, "warm_up": 1}
    shape = (ROWS, COLUMNS, 3)
    memory = ReplayBuffer(20_000, shape)
    return DQN(q_network(GO + 1, shape, seed=0), memory, Settings(**knobs | more), np.random.SeedSequence(0))


def random_trial(shape: tuple, count: int) -> Trial:
    """A trial of so many decisions that shows random images of the shape."""
    rng, nothing, masks = np.random.default_rng(0), np.zeros(count), np.ones((count + 1, GO + 1), bool)
    images = rng.random((count + 1, *shape), np.float32)
    return Trial(images, masks, np.arange(count) % (GO + 1), nothing, nothing, rng.random(count), {})


def filled_memory(memory, count: int = 2000):
    """The memory, with experiences of random images."""
    memory.add(random_trial(memory.images.shape[1:], count))
    return memory


def q_update(repetitions: int = 200):
    """An update of 60 experiences and a decision, against bare matrix products and against torch's own layers."""
    ours = learner()
    memory, twin, batch = filled_memory(ours.memory), torch_twin(ours.network), ours.settings.batch
    optimiser = torch.optim.RMSprop(twin.parameters(), lr=1e-4, alpha=0.95, eps=1e-6)
    rng, image = np.random.default_rng(0), memory.images[0]
    sizes = [(batch * 7 * 11, 6 * 6 * 3, 32), (batch * 3 * 5, 3 * 3 * 32, 64), (batch, 960, 100), (batch, 100, 5)]
    layers = [(torch.rand(n, i), torch.rand(i, o), torch.rand(n, o)) for n, i, o in sizes]

    def products():
        for place, (inputs, weights, errors) in enumerate(layers):
            inputs @ weights, inputs.T @ errors
            if place:  # nothing is passed back to the image
                errors @ weights.T

    def theirs():
        images, actions, returns = map(torch.from_numpy, memory.sample(batch, rng))
        loss = ((twin(images).gather(1, actions[:, None])[:, 0] - returns) ** 2).mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()

    def their_decision():
        with torch.inference_mode():
            return int(twin(torch.from_numpy(image)[None])[0].argmax())

    bare, update, other = medians(repetitions, products, ours.update, theirs)
    yield Row("DQN: an update against the matrix products that it needs", update / bare, "at most", 1.8)
    yield Row("DQN: an update against the same one of torch's layers", update / other, "at most", 0.85)
    decision, other = medians(repetitions, lambda: ours.network.best(image), their_decision)
    yield Row("DQN: a decision against the same one of torch's layers", decision / other, "at most", 0.6)


def q_learning(iterations: int = 1000, repetitions: int = 3):
    """Decision, environment and update against Stable-Baselines3's DQN: same network, batch, buffer and junction."""
    from stable_baselines3 import DQN as Theirs  # slow to import
    from stable_baselines3.common.torch_layers import BaseFeaturesExtractor

    env, ours = Intersection("left"), learner(rate=0.0)  # what is learned would make trials longer or shorter
    twin, settings = torch_twin(ours.network), ours.settings

    class Features(BaseFeaturesExtractor):
        def __init__(self, space):
            super().__init__(space, 100)
            self.layers = twin[:-1]

        def forward(self, images):
            return self.layers(images)

    policy = {"features_extractor_class": Features, "net_arch": [],
              "optimizer_class": torch.optim.RMSprop, "optimizer_kwargs": {"alpha": 0.95, "eps": 1e-6}}  # fmt: skip
    theirs = Theirs("MlpPolicy", env, settings.rate, 20_000, learning_starts=1, batch_size=settings.batch,
                    train_freq=1, gradient_steps=1, policy_kwargs=policy, exploration_initial_eps=settings.epsilon,
                    exploration_final_eps=settings.epsilon, device="cpu", seed=0)  # fmt: skip
    theirs.q_net.q_net[0].load_state_dict(twin[-1].state_dict())
    ours.train(env, 1)  # fills the memory
    alone, other = medians(repetitions, lambda: ours.train(env, iterations), lambda: theirs.learn(iterations))
    env.close()
    yield Row("DQN: decision, environment and update against Stable-Baselines3", other / alone, "at least", 1.6)


def full_memory(name: str, size: int):
    """A memory of chapter 6 that is full, and whose experiences all rank below those that come.

    It is given its scores, as adding 100,000 experiences takes a minute with coverage. Coverage has images of 3 x 4
    cells, since 100,000 whole ones do not fit into memory: an experience then has 75 entries that are not zero, as
    many as one at Challenge (the median; fewer elsewhere), and these are what a distance costs.
    """
    rng, shape = np.random.default_rng(0), (ROWS, COLUMNS, 3)
    if name == "coverage":
        memory = filled_memory(CoverageMemory(size, (3, 4, 3), whole_experience, extended_jaccard, 0.3, rng), 1)
        memory.described[:size] = whole_experience(random_trial((3, 4, 3), size))
        memory.neighbours[:size], memory.keys[:size] = rng.integers(size, 2 * size, size), rng.random(size)
    else:
        rankings = {"surprise": surprise, "reward": noisy_reward(1e-3), "matching": distribution_matching}
        memory = EpisodicMemory(size, shape, rankings[name], rng)
        memory.scores[:] = -10 - rng.random(size)
    memory.images[:] = 0  # the system hands memory out when it is written to first, which no insert is to pay for
    memory.added = size
    return memory


def inserts(sizes: tuple = (900, 100_000), decisions: int = 10, repetitions: int = 50):
    """One insert into a full memory by each ranking of chapter 6, against an update of the network that learns."""
    ours = learner()
    filled_memory(ours.memory)
    limits = {"surprise": (0.05, 0.1), "reward": (0.02, 0.05), "matching": (0.02, 0.05), "coverage": (0.1, 5)}
    for (name, of_sizes), place in product(limits.items(), range(len(sizes))):
        memory = full_memory(name, sizes[place])
        trial = random_trial(memory.images.shape[1:], decisions)
        update, add = medians(repetitions, ours.update, partial(memory.add, trial, ours.network))
        what = f"memory: an insert by {name} into {sizes[place]:,} against an update of the network"
        yield Row(what, add / decisions / update, "at most", of_sizes[place])


def digit_update(repetitions: int = 300):
    """An update of the classifier of digits, against the same network in a plain torch loop."""
    network = digit_network(seed=0)
    ours, twin = Classifier(network, 0.1, 100, np.random.SeedSequence(0)), torch_twin(network)
    optimiser, rng = torch.optim.SGD(twin.parameters(), lr=ours.rate), np.random.default_rng(0)
    images, labels = rng.random((ours.batch, 784), np.float32), rng.integers(10, size=ours.batch)
    pair = torch.from_numpy(images), torch.from_numpy(labels)

    def theirs():
        optimiser.zero_grad()
        nn.functional.cross_entropy(twin(pair[0]), pair[1]).backward()
        optimiser.step()

    update, other = medians(repetitions, lambda: ours.update(images, labels), theirs)
    yield Row("digits: an update against the same one of torch's layers", update / other, "at most", 1)


def mask(repetitions: int = 20):
    """The mask of chapter 7 for 30 cars, against a forward simulation of all boxes, and against a step of learning."""
    predict, rng = SafeJunction().prediction, np.random.default_rng(0)
    places = predict.middle[0] + rng.uniform(-100, 100, 30), rng.choice(predict.lanes(), 30)
    cars = np.column_stack([*places, np.zeros(30), np.full(30, 12.0)])
    size = LENGTH + 2 * predict.margins.own, WIDTH + 2 * predict.margins.aside

    def simulated():
        safe = np.ones(len(PROFILES), bool)
        for number, way in enumerate(predict.poses):
            for step, box in enumerate(corners(way, size)):
                for x, y, length, width in predict.regions(cars, step):
                    low, high = covered(box[None], y - width / 2, y + width / 2)[0]
                    safe[number] &= x + length / 2 < low or x - length / 2 > high
        return safe

    network = Network((2, 26, 3), [Dense(100), Dense(100), Dense(1 + len(PROFILES))], seed=0)
    memory = filled_memory(ReplayBuffer(20_000, network.shapes[0]))
    memory.actions %= 1 + len(PROFILES)
    ours = DQN(network, memory, learner().settings, np.random.SeedSequence(0))

    def learning():
        ours.network.best(memory.images[0])
        ours.update()

    alone, other = medians(max(1, repetitions // 10), lambda: predict.safe(cars), simulated)
    yield Row("mask of chapter 7: a simulation of all boxes against it", other / alone, "at least", 100)
    alone, step = medians(10 * repetitions, lambda: predict.safe(cars), learning)
    yield Row("mask of chapter 7: its share of a step of learning", alone / step, "at most", 0.1)


def exit_code() -> int:
    """1 if a promise is missed."""
    return int(not all(row.ok for row in main()))


if __name__ == "__main__":
    sys.exit(exit_code())
