"""The ground floor: where the repository is, foreseeable errors, checksums, and files that are whole or not there."""

import contextlib
import errno
import fcntl
import hashlib
import json
import os
import tomllib
from pathlib import Path

ROOT = Path(os.environ.get("LIFELONG_ROOT") or Path(__file__).resolve().parents[2])


class ReproductionError(ValueError):
    """A foreseeable mistake or obstacle; its message is one line that names the thing and the mend."""


def require(condition, message: str) -> None:
    """Raise ReproductionError with the message unless the condition is true."""
    if not condition:
        raise ReproductionError(message)


def sha256(data: bytes | str) -> str:
    """Hexadecimal sha256 of bytes, or of a text in UTF-8."""
    return hashlib.sha256(data.encode() if isinstance(data, str) else data).hexdigest()


def read_json(path: Path, default: object) -> object:
    """The content of a JSON file, or `default` when there is none; a damaged file raises ReproductionError."""
    if not path.exists():
        return default
    try:
        return json.loads(path.read_bytes())
    except ValueError as error:
        raise ReproductionError(f"{path} is damaged ({error}); delete it and run again") from error


def read_toml(path: Path) -> dict:
    """The content of a TOML file; ReproductionError for one that is missing or damaged."""
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ReproductionError(f"{path} is missing or no valid TOML ({error}); restore or mend it") from error


def write_json(path: Path, content: object) -> None:
    """Write `content` as readable JSON with sorted names, whole or not at all."""
    write_atomically(path, _as_text(content))


def seal(content: dict) -> str:
    """Readable JSON of `content` and its own checksum, from which `unseal` sees any damage."""
    return _as_text(content | {"checksum": sha256(_as_text(content))})


def unseal(data: bytes) -> dict:
    """The content that `seal` wrote. Raises ReproductionError, or another ValueError, if a byte is not as written."""
    content = json.loads(data)
    require(isinstance(content, dict) and content.pop("checksum", None), "it has no checksum of its own")
    require(seal(content).encode() == data, "its bytes are not those that were written")
    return content


def write_atomically(path: Path, data: bytes | str) -> None:
    """Write a file whole or not at all. Raises ReproductionError when the disk is full or refuses."""
    part = path.with_name(path.name + ".part")
    with explained(path):
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            part.write_bytes(data.encode() if isinstance(data, str) else data)
            os.replace(part, path)
        finally:
            with contextlib.suppress(OSError):
                part.unlink()


@contextlib.contextmanager
def explained(path: Path):
    """What a disk refuses inside becomes a ReproductionError that names the path and the mend."""
    try:
        yield
    except OSError as error:
        full = error.errno in (errno.ENOSPC, errno.EDQUOT)
        cause = "the disk is full, free some space" if full else f"{error.strerror}, check the folder"
        raise ReproductionError(f"cannot write {path}: {cause} and run again; what was stored is kept") from error


@contextlib.contextmanager
def alone(path: Path, doing: str):
    """Hold the lock of the file at `path` meanwhile; ReproductionError that says what another process does with it."""
    with explained(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        file = path.open("a+")
    with file:
        file.seek(0)
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise ReproductionError(f"another run is going on in this folder ({file.read()}): wait for it, or run in "
                                    "another copy of the project") from None  # fmt: skip
        file.truncate(0)
        file.write(f"process {os.getpid()}: {doing}")
        file.flush()
        yield


def _as_text(content) -> str:
    return json.dumps(content, indent=1, sort_keys=True, allow_nan=False) + "\n"
