"""Networks of chapters 5 to 7, and how they learn: forwards, backwards, and a step of RMSProp.

All layers do the same: they gather inputs into rows, multiply them by a matrix and add a bias. A dense layer gathers a
whole input into one row, a convolution every window of an image. So the gradient is the same three lines for both.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch


@dataclass(frozen=True)
class Dense:
    """A layer of `nodes`, each of which sees the whole input."""

    nodes: int

    def shape(self, shape: tuple) -> tuple:
        """Shape of the output for one input of `shape`."""
        return (self.nodes,)

    def fan_in(self, shape: tuple) -> int:
        """Inputs that a node sees."""
        return math.prod(shape)

    def gather(self, inputs: torch.Tensor) -> torch.Tensor:
        """Inputs (n, ...) as rows (n, inputs of a node)."""
        return inputs.reshape(len(inputs), -1)

    def scatter(self, rows: torch.Tensor, shape: tuple) -> torch.Tensor:
        """The transpose of `gather`: rows back at their places in an input of `shape`, (n, *shape)."""
        return rows.view(-1, *shape)


@dataclass(frozen=True)
class Convolution:
    """A layer of `nodes` filters of `size` x `size` cells, moved by `stride`, without padding.

    Images are (n, rows, columns, channels), so that the channels of a cell lie side by side.
    """

    nodes: int
    size: int
    stride: int

    def shape(self, shape: tuple) -> tuple:
        """Shape of the output for one image of `shape`."""
        rows, columns = ((cells - self.size) // self.stride + 1 for cells in shape[:2])
        return rows, columns, self.nodes

    def fan_in(self, shape: tuple) -> int:
        """Inputs that a filter sees."""
        return self.size * self.size * shape[2]

    def gather(self, images: torch.Tensor) -> torch.Tensor:
        """Every window of the images as a row, (n * windows of an image, size * size * channels)."""
        channels = images.shape[3]
        high, wide, _ = self.shape(images.shape[1:])
        image, row, column, channel = images.stride()
        windows = images.as_strided(
            (len(images), high, wide, self.size, self.size * channels),  # a row of a window is one piece of memory
            (image, self.stride * row, self.stride * column, row, channel),
        )
        return windows.reshape(-1, self.size * self.size * channels)

    def scatter(self, rows: torch.Tensor, shape: tuple) -> torch.Tensor:
        """The transpose of `gather`: every cell of an image of `shape` gets the sum over the windows it lies in."""
        high, wide, _ = self.shape(shape)
        windows = rows.view(-1, high, wide, self.size, self.size, shape[2])
        images = torch.zeros(len(windows), *shape)
        below, beyond = self.stride * (high - 1) + 1, self.stride * (wide - 1) + 1
        for i in range(self.size):
            for j in range(self.size):
                images[:, i : i + below : self.stride, j : j + beyond : self.stride] += windows[:, :, :, i, j]
        return images


class Network:
    """Layers with leaky ReLUs between them; all weights are parts of one vector.

    shape: of one input, (features,) or (rows, columns, channels). layers: Dense and Convolution, the last one gives the
    outputs. seed: of the first weights, uniform within 1 / sqrt(inputs of a node). slope: of the leaky ReLU below zero.
    dropout: share of the nodes before the outputs that is left out at random in training, the others being scaled up.

    `weights` and `gradient` are vectors (weights,); `parts` are a layer's matrix (inputs of a node, nodes) and bias
    (1, nodes) within the weights; `shapes` holds the shape of the input and of every layer's output.
    Raises ValueError for an input that is too small for the layers.
    """

    def __init__(self, shape: tuple, layers: list, seed: int, slope: float = 0.01, dropout: float = 0.0):
        self.layers, self.slope, self.dropout, self.shapes = layers, slope, dropout, [tuple(shape)]
        limits, sizes = [], []
        for layer in layers:
            before, fan_in = self.shapes[-1], layer.fan_in(self.shapes[-1])
            self.shapes.append(layer.shape(before))
            if min(self.shapes[-1]) < 1:
                raise ValueError(f"an input of {before} is too small for {layer}")
            sizes += [(fan_in, layer.nodes), (1, layer.nodes)]  # matrix and bias
            limits += [fan_in**-0.5] * 2
        rng = np.random.default_rng(seed)
        first = [rng.uniform(-limit, limit, math.prod(size)) for limit, size in zip(limits, sizes, strict=True)]
        self.weights = torch.from_numpy(np.concatenate(first).astype(np.float32))
        self.gradient = torch.zeros_like(self.weights)
        self.parts, self._gradients = (_parts(vector, sizes) for vector in (self.weights, self.gradient))

    @torch.inference_mode()
    def forward(self, inputs: torch.Tensor, rng: np.random.Generator | None = None) -> list:
        """Pass inputs (n, *shape) through; what each layer gathered, put out, and kept of it by dropout.

        The last layer's output are the values (n, outputs). rng: draws the nodes that are left out; None: all stay.
        """
        passed, outputs = [], inputs
        for number, (layer, (matrix, bias)) in enumerate(zip(self.layers, self.parts, strict=True), 1):
            rows, kept = layer.gather(outputs), None
            outputs = torch.addmm(bias, rows, matrix).view(-1, *self.shapes[number])
            if number < len(self.layers):
                torch.nn.functional.leaky_relu_(outputs, self.slope)
            if number == len(self.layers) - 1 and self.dropout and rng is not None:
                kept = torch.from_numpy(rng.random(outputs.shape, np.float32) >= self.dropout) / (1 - self.dropout)
                outputs *= kept
            passed.append((rows, outputs, kept))
        return passed

    @torch.inference_mode()
    def backward(self, passed: list, errors: torch.Tensor) -> None:
        """Set `gradient`, given what `forward` passed and the derivatives of a loss by the values, (n, outputs)."""
        for number in reversed(range(len(self.layers))):
            rows, _, _ = passed[number]
            errors = errors.reshape(len(rows), -1)
            matrix_gradient, bias_gradient = self._gradients[number]
            torch.mm(rows.t(), errors, out=matrix_gradient)
            torch.sum(errors, 0, keepdim=True, out=bias_gradient)
            if number > 0:
                _, outputs, kept = passed[number - 1]
                errors = self.layers[number].scatter(errors @ self.parts[number][0].t(), self.shapes[number])
                if kept is not None:
                    errors *= kept
                errors = torch.ops.aten.leaky_relu_backward(errors, outputs, self.slope, True)

    def values(self, inputs: np.ndarray) -> np.ndarray:
        """Outputs (n, outputs) for inputs (n, *shape), with all nodes in place."""
        return self.forward(torch.from_numpy(np.asarray(inputs, np.float32)))[-1][1].numpy()

    def best(self, observation: np.ndarray, allowed: np.ndarray | None = None) -> int:
        """The action of largest value for one input, among those that the mask `allowed` (outputs,) has as true."""
        values = self.values(observation[None])[0]
        if allowed is not None:
            values = np.where(allowed, values, -np.inf)
        return int(values.argmax())

    def get_weights(self) -> np.ndarray:
        """A copy of all weights, layer after layer (weights,)."""
        return self.weights.numpy().copy()

    def set_weights(self, weights: np.ndarray) -> None:
        """Take over what `get_weights` gave; raises ValueError for those of a network of another shape."""
        if np.shape(weights) != self.weights.shape:
            count, given = len(self.weights), np.shape(weights)
            raise ValueError(f"this network has {count} weights; those given have shape {given}")
        self.weights.copy_(torch.from_numpy(np.asarray(weights, np.float32)))


def _parts(vector: torch.Tensor, sizes: list) -> list:
    """(matrix, bias) of every layer, views of one vector."""
    pieces = vector.split([math.prod(size) for size in sizes])
    parts = [piece.view(size) for piece, size in zip(pieces, sizes, strict=True)]
    return list(zip(parts[::2], parts[1::2], strict=True))


class RMSProp:
    """Steps along the gradient, each weight's divided by the root mean square of its latest gradients.

    rate: step size; damping: what is added to root mean squares; decay: share of the mean of squares that stays.
    """

    def __init__(self, network: Network, rate: float, damping: float, decay: float):
        self.network, self.rate, self.damping, self.decay = network, rate, damping, decay
        self.squares = torch.zeros_like(network.weights)

    @torch.inference_mode()
    def step(self) -> None:
        """Change the network's weights by one step."""
        gradient = self.network.gradient
        self.squares.mul_(self.decay).addcmul_(gradient, gradient, value=1 - self.decay)
        self.network.weights.addcdiv_(gradient, self.squares.sqrt().add_(self.damping), value=-self.rate)
