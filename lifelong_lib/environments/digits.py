"""Handwritten digits, MNIST, as two lives of five tasks: permuted pixels, and pairs of digits (thesis section 6.4.7).

data/mnist.npz has the digits; data/mnist tells where they come from.
"""

import hashlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np

FILE = Path(__file__).resolve().parents[2] / "data" / "mnist.npz"
CHECKSUM = "e183595579f3fdb5af0a6aa55938e81620b1f28a8118b2eda52dce03bbf6087b"  # sha256
PAIRS = ((0, 5), (1, 6), (2, 7), (3, 8), (4, 9))


@dataclass(frozen=True)
class Digits:
    """Images (n, 784) from 0 to 255 and labels (n,), to learn from and to test on, uint8 as published."""

    train_images: np.ndarray
    train_labels: np.ndarray
    test_images: np.ndarray
    test_labels: np.ndarray


def read_digits(path: Path = FILE) -> Digits:
    """The 60,000 + 10,000 digits. Raises ValueError for a file that is missing or not the one of this version."""
    if not path.exists():
        raise ValueError(f"{path} is missing: restore it, or make it with data/mnist/make.py")
    if hashlib.sha256(path.read_bytes()).hexdigest() != CHECKSUM:
        raise ValueError(f"{path} is not the file of this version: restore it, or make it with data/mnist/make.py")
    with np.load(path, allow_pickle=False) as arrays:
        return Digits(**arrays)


@dataclass(frozen=True)
class DigitTask:
    """One task of a life: digits, and the pixels (784,) of them in the order in which the task shows them."""

    digits: Digits
    pixels: np.ndarray

    def draw(self, n: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """``n`` training digits drawn with repetition: images (n, 784) float32 from 0 to 1 and labels (n,)."""
        chosen = rng.integers(len(self.digits.train_labels), size=n)
        return self._seen(self.digits.train_images[chosen]), self.digits.train_labels[chosen].astype(np.int64)

    def test(self) -> tuple[np.ndarray, np.ndarray]:
        """All test digits, in the same form."""
        return self._seen(self.digits.test_images), self.digits.test_labels.astype(np.int64)

    def _seen(self, images):
        return (images[:, self.pixels] / np.float32(255)).astype(np.float32)


def permutations(digits: Digits, count: int, rng: np.random.Generator) -> list[DigitTask]:
    """Return tasks with all ten classes, the first with the pixels in place, each other with them in random order."""
    orders = [np.arange(784), *(rng.permutation(784) for _ in range(count - 1))]
    return [DigitTask(digits, order) for order in orders]


def pairs(digits: Digits) -> list[DigitTask]:
    """Return five tasks with two classes each, those of PAIRS, which keep their own labels."""
    tasks = []
    for pair in PAIRS:
        train, test = np.isin(digits.train_labels, pair), np.isin(digits.test_labels, pair)
        part = Digits(digits.train_images[train], digits.train_labels[train],
                      digits.test_images[test], digits.test_labels[test])  # fmt: skip
        tasks.append(DigitTask(part, np.arange(784)))
    return tasks
