"""What a result depends on: the experiment, the notebook functions and values it reads, the library modules it reaches,
the arrays it is handed and the files it reads.

Every part has its own digest, so that a stale result can name its cause. Sources are compared without comments,
docstrings and layout: a better sentence must not make hours of results stale. What cannot be compared is refused.
"""

import ast
import dataclasses
import dis
import inspect
import textwrap
import types
from collections.abc import Callable, Iterable, Iterator, Mapping
from importlib.util import resolve_name
from pathlib import Path

import numpy as np

from lifelong_lib.reproduction.files import ReproductionError, require, sha256

LIBRARY = "lifelong_lib"
SOURCES = Path(__file__).resolve().parents[2]  # the folder that holds the library


def fingerprint(experiment: Callable) -> dict[str, str]:
    """Digest of every part of the code and of the values that an experiment's results depend on.

    experiment: a function made with def. Returns {part: sha256}, parts being "function f", "global x" and "module
    lifelong_lib.y". Raises ReproductionError for something whose source or value cannot be compared between two runs.
    """
    require(inspect.isfunction(experiment), f"an experiment must be a function made with def, this is {experiment!r}")
    walk = _Walk(experiment)
    walk.text_of(experiment, experiment.__name__)
    return dict(sorted(walk.parts.items()))


def changes(stored: Mapping[str, str], now: Mapping[str, str]) -> list[str]:
    """What differs between two fingerprints, e.g. ["module lifelong_lib.transfer.ella changed"]; empty when equal."""
    differ = [part for part in sorted(stored.keys() | now.keys()) if stored.get(part) != now.get(part)]
    return [f"{part} {'changed' if part in stored and part in now else 'is new' if part in now else 'is gone'}"
            for part in differ]  # fmt: skip


def digests(inputs: Mapping[str, np.ndarray]) -> dict[str, str]:
    """{"input <name>": sha256} of arrays: of their type, shape and numbers."""
    return {f"input {name}": sha256(f"{array.dtype.str} {array.shape} ".encode() + array.tobytes())
            for name, array in inputs.items()}  # fmt: skip


def checksums(files: Iterable[Path | str], root: Path) -> dict[str, str]:
    """{"file <name>": sha256} of files; inside `root` the name is the path from there, elsewhere the bare file name."""
    require(not isinstance(files, (str, Path)), f"files must be a list of paths, not {str(files)!r}")
    parts = {}
    for path in (root / file for file in files):
        require(path.is_file(), f"{path}, which runs depend on, is missing: restore it")
        part = f"file {path.relative_to(root).as_posix() if path.is_relative_to(root) else path.name}"
        require(part not in parts, f"two files that runs depend on have one name: {part}")
        parts[part] = sha256(path.read_bytes())
    return parts


class _Walk:
    """Follows an experiment through the functions, values and modules it uses, and notes a digest of each."""

    def __init__(self, experiment):
        self.experiment, self.parts, self.functions = experiment, {}, {}

    def text_of(self, value, name: str) -> str:
        """A text that is equal for equal values in every process; functions and modules met on the way become parts."""
        kind = type(value)
        if value is None or isinstance(value, (bool, int, float, str)):
            return f"{kind.__name__} {value!r}"
        if isinstance(value, (list, tuple)):
            return f"{kind.__name__} {[self.text_of(item, name) for item in value]}"
        if isinstance(value, dict):
            return f"dict {[(self.text_of(key, name), self.text_of(item, name)) for key, item in value.items()]}"
        if inspect.ismodule(value):
            self._module(value.__name__)
            return f"module {value.__name__}"
        of_no_object = isinstance(getattr(value, "__self__", None), (types.NoneType, types.ModuleType))
        if callable(value) and hasattr(value, "__qualname__") and of_no_object:
            return self._callable_text(value, name)
        if dataclasses.is_dataclass(value) and not kind.__module__.startswith(f"{LIBRARY}.reproduction"):
            fields = {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
            return self.text_of((kind, fields), name)
        self._refuse(name, f"a {kind.__name__}", "put what it needs into the configs, or make it inside")

    def _refuse(self, name, what, mend):
        reads = f"experiment '{self.experiment.__name__}' reads '{name}', {what}"
        raise ReproductionError(f"{reads}, whose changes cannot be followed: {mend}")

    def _callable_text(self, value, name):
        module = getattr(value, "__module__", None) or "builtins"
        if _source_of(module):
            self._module(module)
        elif module == self.experiment.__module__:
            return self._function(value, name)
        return f"{module}.{value.__qualname__}"

    def _function(self, function, name) -> str:
        """Note a notebook function's source, and everything that it reads when it runs."""
        if not inspect.isfunction(function):
            self._refuse(name, "a wrapped function or class of the notebook", "move it into the library")
        if "<" in function.__code__.co_qualname:  # a lambda, or made inside another function (also by a decorator)
            self._refuse(name, "a function not made with def at the top of a cell", "define it there")
        label = f"function {function.__qualname__}"
        if self.functions.setdefault(label, function) is not function:
            self._refuse(name, f"a second {label}", "give it another name")
        if label not in self.parts:
            text, tree = _normalised(textwrap.dedent(inspect.getsource(function)))
            hidden = self.text_of((function.__defaults__, function.__kwdefaults__), function.__qualname__)
            self.parts[label] = sha256(text + hidden)
            for module in _imported(tree, ""):
                self._module(module)
            for read in sorted(_globals_read(function.__code__) & function.__globals__.keys()):
                self._global(read, function.__globals__[read])
        return label

    def _global(self, name, value):
        """Note the value behind a global name. A function or module under its own name is a part already."""
        text = self.text_of(value, name)
        if text not in (f"function {name}", f"module {name}"):
            self.parts[f"global {name}"] = sha256(text)

    def _module(self, name: str):
        """Note a library module and, through its import statements, all library modules that it reaches."""
        path = _source_of(name)
        if path is None or f"module {name}" in self.parts:
            return
        if path.is_dir():
            self._refuse(name, "a whole package", f"import a module: from {name} import ...")
        text, tree = _normalised(path.read_text(encoding="utf-8"))
        self.parts[f"module {name}"] = sha256(text)
        for module in _imported(tree, name.rpartition(".")[0]):
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
            base = resolve_name("." * node.level + (node.module or ""), package)
            inner = [f"{base}.{alias.name}" for alias in node.names]
            yield from (name if _source_of(name) else base for name in inner)


def _source_of(module: str) -> Path | None:
    """Source file of a library module, folder of a library package, None for everything else."""
    path = SOURCES.joinpath(*module.split("."))
    found = [file for file in (path.with_suffix(".py"), path) if file.exists()]
    return found[0] if found and module.partition(".")[0] == LIBRARY else None


def _globals_read(code: types.CodeType) -> set[str]:
    """Names that a function, or a function defined inside it, looks up in its module."""
    names = {step.argval for step in dis.get_instructions(code) if step.opname in ("LOAD_GLOBAL", "LOAD_NAME")}
    return names.union(*(_globals_read(inner) for inner in code.co_consts if isinstance(inner, types.CodeType)))
