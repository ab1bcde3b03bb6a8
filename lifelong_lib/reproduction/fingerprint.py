"""What a result depends on: the experiment, the notebook functions and values it reads, the library modules it reaches.

Every part has its own digest, so that a stale result can name its cause. Sources are compared without comments,
docstrings and layout: a better sentence must not make hours of results stale.
"""

import ast
import dataclasses
import dis
import functools
import hashlib
import inspect
import textwrap
import types
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import numpy as np

LIBRARY = "lifelong_lib"
SOURCES = Path(__file__).resolve().parents[2]  # the folder that holds the library
_PLAIN = (type(None), bool, int, float, complex, str, bytes, range)


class ReproductionError(ValueError):
    """A foreseeable mistake or obstacle; its message is one line that names the thing and the mend."""


def require(condition, message: str) -> None:
    """Raise ReproductionError with the message unless the condition is true."""
    if not condition:
        raise ReproductionError(message)


def fingerprint(experiment: Callable) -> dict[str, str]:
    """Digest of every part of the code and of the values that an experiment's results depend on.

    experiment: a function made with def. Returns {part: sha256}, parts being "function f", "global x" and "module
    lifelong_lib.y". Raises ReproductionError for something whose source or value cannot be compared between two runs.
    """
    plain = inspect.isfunction(experiment) and experiment.__name__ != "<lambda>"
    require(plain, f"an experiment must be a function made with def, this is {experiment!r}")
    walk = _Walk(experiment)
    walk.text_of(experiment, experiment.__name__)
    return dict(sorted(walk.parts.items()))


def changes(stored: Mapping[str, str], now: Mapping[str, str]) -> list[str]:
    """What differs between two fingerprints, e.g. ["module lifelong_lib.transfer.ella changed"]; empty when equal."""
    differ = [part for part in sorted(stored.keys() | now.keys()) if stored.get(part) != now.get(part)]
    return [f"{part} {'changed' if part in stored and part in now else 'is new' if part in now else 'is gone'}"
            for part in differ]  # fmt: skip


def sha256(data: bytes | str) -> str:
    """Hexadecimal sha256 of bytes, or of a text in UTF-8."""
    return hashlib.sha256(data.encode() if isinstance(data, str) else data).hexdigest()


class _Walk:
    """Follows an experiment through the functions, values and modules it uses, and notes a digest of each."""

    def __init__(self, experiment):
        self.experiment, self.parts, self.seen = experiment, {}, {}

    def text_of(self, value, name: str) -> str:
        """A text that is equal for equal values in every process; functions and modules met on the way become parts."""
        if isinstance(value, (np.ndarray, np.generic)) and not value.dtype.hasobject:
            return f"array {value.dtype.str} {value.shape} {sha256(value.tobytes())}"
        if isinstance(value, _PLAIN):
            return f"{type(value).__name__} {value!r}"
        if isinstance(value, (list, tuple)):
            return f"{type(value).__name__} {[self.text_of(item, name) for item in value]}"
        if isinstance(value, (set, frozenset)):
            return f"set {sorted(self.text_of(item, name) for item in value)}"
        if isinstance(value, Mapping):
            return f"dict {[(self.text_of(key, name), self.text_of(item, name)) for key, item in value.items()]}"
        if isinstance(value, functools.partial):
            return self.text_of((value.func, value.args, value.keywords), name)
        if isinstance(value, types.ModuleType):
            if hasattr(value, "__path__") and _file_of(value.__name__):
                raise self._refusal(name, "a whole package", f"import a module: from {value.__name__} import ...")
            self._module(value.__name__)
            return f"module {value.__name__}"
        if hasattr(value, "__wrapped__") and not inspect.isfunction(value):  # functools.cache
            return self.text_of(value.__wrapped__, name)
        if callable(value) and hasattr(value, "__qualname__"):
            return self._callable_text(value, name)
        if dataclasses.is_dataclass(value) and not type(value).__module__.startswith(f"{LIBRARY}.reproduction"):
            fields = {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
            return self.text_of((type(value), fields), name)
        raise self._refusal(name, f"a {type(value).__name__}", "put what it needs into the configs, or make it inside")

    def _refusal(self, name, what, mend):
        return ReproductionError(
            f"experiment '{self.experiment.__name__}' reads '{name}', {what}, whose changes cannot be followed: {mend}"
        )

    def _callable_text(self, value, name):
        module = getattr(value, "__module__", None) or ""
        if _file_of(module):
            self._module(module)
        elif module == self.experiment.__module__ and inspect.isfunction(value):
            return self._function(value)
        elif module == self.experiment.__module__ and inspect.isclass(value):
            raise self._refusal(name, "a class of the notebook", "move it into the library")
        return f"{module}.{value.__qualname__}"

    def _function(self, function) -> str:
        """Note a notebook function's source, and everything that it reads when it runs."""
        if id(function) in self.seen:
            return self.seen[id(function)]
        label = f"function {function.__qualname__}"
        while label in self.parts:  # another function of the same name
            label += "'"
        self.seen[id(function)] = label
        try:
            text, tree = _normalised(textwrap.dedent(inspect.getsource(function.__code__)))
        except (OSError, SyntaxError):
            mend = "define it with def in a cell of its own"
            raise self._refusal(function.__qualname__, "a function without readable source", mend) from None
        self.parts[label] = ""  # its place, so that the names below cannot take it
        for module in _imported(tree, ""):
            self._module(module)
        hidden = (function.__defaults__, function.__kwdefaults__, _closure(function))
        self.parts[label] = sha256(text + self.text_of(hidden, function.__qualname__))
        for name in sorted(_globals_read(function.__code__)):
            if name in function.__globals__:
                self._global(name, function.__globals__[name])
        return label

    def _global(self, name, value):
        """Note the value behind a global name. A function or module under its own name is a part already."""
        text = self.text_of(value, name)
        if text not in (f"function {name}", f"module {name}"):
            self.parts[f"global {name}"] = sha256(text)

    def _module(self, name: str):
        """Note a library module and, through its import statements, all library modules that it reaches."""
        path = _file_of(name)
        if path is None or f"module {name}" in self.parts:
            return
        text, tree = _normalised(path.read_text(encoding="utf-8"))
        self.parts[f"module {name}"] = sha256(text)
        for module in _imported(tree, name if path.name == "__init__.py" else name.rpartition(".")[0]):
            self._module(module)


def _normalised(source: str) -> tuple[str, ast.Module]:
    """Source without comments, docstrings and layout, and its tree."""
    tree = ast.parse(source)
    for node in ast.walk(tree):
        if isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)):
            if ast.get_docstring(node, clean=False) is not None:
                node.body = node.body[1:] or [ast.Pass()]
    return ast.unparse(tree), tree


def _imported(tree: ast.AST, package: str) -> Iterator[str]:
    """Names of the modules that the import statements in a tree load, relative imports resolved against the package."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            above = package.split(".")[: len(package.split(".")) + 1 - node.level] if node.level else []
            base = ".".join([*above, *([node.module] if node.module else [])])
            for alias in node.names:
                inner = f"{base}.{alias.name}"
                yield inner if _file_of(inner) else base


def _file_of(module: str) -> Path | None:
    """Source file of a library module; None for a module that is not the library's."""
    if module.partition(".")[0] != LIBRARY:
        return None
    path = SOURCES.joinpath(*module.split("."))
    return next((file for file in (path.with_suffix(".py"), path / "__init__.py") if file.is_file()), None)


def _globals_read(code: types.CodeType) -> set[str]:
    """Names that a function, or a function defined inside it, looks up in its module."""
    names = {step.argval for step in dis.get_instructions(code) if step.opname in ("LOAD_GLOBAL", "LOAD_NAME")}
    return names.union(*(_globals_read(inner) for inner in code.co_consts if isinstance(inner, types.CodeType)))


def _closure(function) -> dict:
    """Values of the variables that a function defined inside another one took along; unset ones are left out."""
    cells = zip(function.__code__.co_freevars, function.__closure__ or (), strict=True)
    return {name: cell.cell_contents for name, cell in cells if cell != types.CellType()}
