"""Configurations as text: one canonical text each, a readable name for files, cells of a table, dotted names."""

import json
import math
import re

from lifelong_lib.reproduction.files import require, sha256

PLAIN = r"(?!(true|false|null)$)[A-Za-z][A-Za-z0-9_.+-]*"  # texts that can be taken for nothing else


def canonical(config: dict) -> str:
    """One text per configuration, whatever the order of its entries; it must be flat and plain."""
    require(isinstance(config, dict), f"a configuration must be a dict, not {config!r}")
    for key, value in config.items():
        require(isinstance(key, str) and key.isascii() and key.isidentifier(), f"configuration entry {key!r}: no name")
        plain = math.isfinite(value) if isinstance(value, float) else value is None or isinstance(value, (int, str))
        require(plain, f"configuration entry {key}={value!r} must be a number, a text, True, False or None")
    return json.dumps(config, sort_keys=True)


def file_name(config: dict) -> str:
    """Readable name, e.g. domain=cart-pole,tasks=40, with a digest where that could mean another configuration too."""
    text = canonical(config)
    words = {key: value if isinstance(value, str) else json.dumps(value) for key, value in sorted(config.items())}
    name = ",".join(f"{key}={re.sub('[^A-Za-z0-9_.+-]', '_', word)}" for key, word in words.items()) or "run"
    exact = all(re.fullmatch(PLAIN, value) for value in config.values() if isinstance(value, str))
    return name if exact and len(name) <= 120 else f"{name[:100]}~{sha256(text)[:16]}"


def run_key(config: dict, seed: int) -> str:
    """The name of one run within its grid, e.g. domain=cart-pole,tasks=40-s3."""
    return f"{file_name(config)}-s{seed}"


def to_cell(value: object) -> str:
    """A configuration's value as a cell of a table: a plain text as it is, everything else as JSON."""
    return value if isinstance(value, str) and re.fullmatch(PLAIN, value) else json.dumps(value)


def from_cell(cell: str) -> object:
    """The value that `to_cell` wrote."""
    return cell if re.fullmatch(PLAIN, cell) else json.loads(cell)


def flat(parameters: dict) -> dict[str, object]:
    """{"knobs.bicycle.step": 0.1} for {"knobs": {"bicycle": {"step": 0.1}}}."""
    found = {}
    for name, value in parameters.items():
        inner = flat(value) if isinstance(value, dict) else {}
        found |= {f"{name}.{key}": entry for key, entry in inner.items()} or {name: value}
    return found


def nested(dotted: dict[str, object]) -> dict:
    """What `flat` was given."""
    whole: dict = {}
    for name, value in dotted.items():
        *outer, last = name.split(".")
        place = whole
        for key in outer:
            place = place.setdefault(key, {})
        place[last] = value
    return whole
