"""The chapter notebooks as data: their parameters, the ids they make, and their execution.

papermill guesses types from text and only warns about a name it does not know. Here a value is checked against the
notebook's own parameters cell before anything runs, and is handed over as a Python value.
"""

from __future__ import annotations

import ast
import contextlib
import difflib
import io
import json
import os
import re
import tokenize
from collections.abc import Iterator
from pathlib import Path

import nbformat
import papermill
from nbclient.exceptions import CellTimeoutError, DeadKernelError
from papermill.exceptions import PapermillExecutionError

from .fingerprint import SOURCES
from .runs import ROOT, ReproductionError

COMMON = ("profile", "seeds", "workers", "output_dir")
MAKERS = ("save_figure", "save_table", "check_claim")
KINDS = {bool: "true or false", int: "a whole number", float: "a number", str: "a text", list: "a list"}


def find_notebooks(folder: Path | None = None) -> dict[int, Path]:
    """The chapter notebooks by chapter number: `notebooks/ch04_predicting_policies.ipynb` is number 4."""
    paths = sorted((folder or ROOT / "notebooks").glob("ch[0-9][0-9]_*.ipynb"))
    return {int(path.name[2:4]): path for path in paths}


def read_notebook(path: Path) -> nbformat.NotebookNode:
    """The notebook at `path`; a file that is no notebook raises ReproductionError."""
    try:
        return nbformat.read(path, as_version=4)
    except (ValueError, nbformat.ValidationError, AttributeError) as error:
        raise ReproductionError(f"{path.name} is not a readable notebook: {str(error).splitlines()[0]}") from error


def read_parameters(path: Path) -> dict[str, tuple[object, str]]:
    """{name: (default, comment)} of the one cell tagged `parameters`, in the cell's order.

    Raises ReproductionError when there is no such cell, more than one, or anything in it but `name = literal`:
    papermill sets new values *after* the cell, so whatever it computed from a default would keep the default.
    """
    cells = [cell for cell in read_notebook(path).cells if "parameters" in cell.metadata.get("tags", [])]
    if len(cells) != 1:
        raise ReproductionError(f"{path.name} has {len(cells)} cells tagged 'parameters'; it needs exactly one")
    source = cells[0].source
    tokens = tokenize.generate_tokens(io.StringIO(source).readline)
    comments = {token.start[0]: token.string.lstrip("# ") for token in tokens if token.type == tokenize.COMMENT}
    parameters = {}
    for statement in ast.parse(source).body:
        text = ast.get_source_segment(source, statement)
        try:
            (target,) = statement.targets
            parameters[target.id] = (ast.literal_eval(statement.value), comments.get(statement.end_lineno, ""))
        except (AttributeError, ValueError) as error:
            message = f"the parameters cell of {path.name} may hold only `name = literal`, not `{text}`"
            raise ReproductionError(message) from error
    return parameters


def typed_parameters(path: Path, given: dict[str, object]) -> dict[str, object]:
    """All parameters of the notebook: its defaults, and `given` (values, or texts from a command line) converted.

    Unknown names (with the nearest known one) and values of another type than the default raise ReproductionError.
    """
    known = read_parameters(path)
    typed = {name: default for name, (default, _) in known.items()}
    for name, value in given.items():
        if name not in known:
            near = difflib.get_close_matches(name, known, n=1)
            hint = f"did you mean '{near[0]}'?" if near else f"it has {', '.join(known)}"
            raise ReproductionError(f"{path.name} has no parameter '{name}'; {hint}")
        try:
            typed[name] = _convert(value, known[name][0])
        except (ValueError, SyntaxError, TypeError) as error:
            wanted = KINDS.get(type(known[name][0]), "a literal")
            raise ReproductionError(f"parameter '{name}' of {path.name} wants {wanted}, not '{value}'") from error
    return typed


def _convert(value: object, default: object) -> object:
    kind = type(default)
    if isinstance(default, str):
        return _of_type(value, str)
    if not isinstance(value, str):
        literal = value
    elif isinstance(default, bool):
        literal = {"true": True, "false": False}.get(value.strip().lower())
    elif isinstance(default, list) and not value.lstrip().startswith("["):
        literal = [part.strip() for part in value.split(",")]
    else:
        literal = ast.literal_eval(value.strip())
    if isinstance(default, float) and type(literal) is int:
        return float(literal)
    if isinstance(default, list) and default:
        return [_convert(item, default[0]) for item in _of_type(literal, list)]
    return literal if default is None else _of_type(literal, kind)


def _of_type(value: object, kind: type) -> object:
    if type(value) is not kind:   # not isinstance: True is no whole number here
        raise TypeError(f"{value!r} is not {kind.__name__}")
    return value


def made_ids(path: Path) -> dict[str, list[str]]:
    """{"F4.2": [heading above the cell, ...]}: the ids which the notebook's code makes, once for every call.

    Read from the literal second argument of save_figure, save_table and check_claim, without running anything.
    """
    made: dict[str, list[str]] = {}
    heading = ""
    for cell in read_notebook(path).cells:
        if cell.cell_type == "markdown":
            heading = (re.findall(r"^#+ +(.+)$", cell.source, re.MULTILINE) or [heading])[-1]
        elif cell.cell_type == "code":
            for identifier in cell_ids(cell.source):
                made.setdefault(identifier, []).append(heading)
    return made


def cell_ids(source: str) -> list[str]:
    """The ids that one cell's source makes."""
    try:
        tree = ast.parse(source)
    except SyntaxError:   # a line magic: such a cell makes no result
        return []
    calls = [node for node in ast.walk(tree) if isinstance(node, ast.Call) and len(node.args) > 1]
    calls.sort(key=lambda call: (call.lineno, call.col_offset))
    named = [(getattr(call.func, "id", getattr(call.func, "attr", "")), call.args[1]) for call in calls]
    return [second.value for name, second in named if name in MAKERS and isinstance(second, ast.Constant)]


def grid_names(path: Path) -> list[str]:
    """The names that the notebook's code gives to its grids, as in `run_grid(chapter, "slopes", ...)`."""
    cells = read_notebook(path).cells
    return [name for cell in cells for name in re.findall(r'run_grid\(\s*chapter,\s*"([^"]+)"', cell.source)]


def missing_results(path: Path, folder: Path, since: float = 0.0) -> list[str]:
    """The ids which the notebook makes but whose files (or row in claims.json) are not in `folder`, or older."""
    def fresh(name: str) -> bool:   # a second's grace: a file system's clock may lag behind ours
        return (folder / name).exists() and (folder / name).stat().st_mtime > since - 1

    claims = {row["id"] for row in json.loads((folder / "claims.json").read_text())} if fresh("claims.json") else set()
    ending = {"F": ("csv", "png", "svg"), "T": ("csv", "md")}
    return [name for name in made_ids(path) if not (
        name in claims if name[0] == "C" else all(fresh(f"{name}.{end}") for end in ending.get(name[0], ())))]


def execute(path: Path, parameters: dict[str, object], folder: Path, options: dict | None = None) -> Path:
    """Runs the notebook with checked `parameters`; returns the executed copy in `folder`/notebooks.

    `options` reach run_grid through the environment variable LIFELONG_OPTIONS. With options["plan"], nothing is
    computed and cells may fail. Otherwise a failing cell raises ReproductionError with notebook, cell, error and copy.
    """
    options = options or {}
    defaults = typed_parameters(path, {})
    changed = {name: value for name, value in typed_parameters(path, parameters).items() if value != defaults[name]}
    copy = folder / "notebooks" / path.name
    copy.parent.mkdir(parents=True, exist_ok=True)
    with _environment(LIFELONG_OPTIONS=json.dumps(options)):
        try:
            papermill.execute_notebook(
                str(path), str(copy), changed, kernel_name="python3", language="python", cwd=str(ROOT),
                progress_bar=False, allow_errors="plan" in options, extra_arguments=["--log-level=CRITICAL"],
            )
        except PapermillExecutionError as error:
            if "plan" not in options:
                cause = (error.evalue.strip().splitlines() or ["no message"])[0]
                place = f"{path.name}, cell [{error.exec_count}]"
                raise ReproductionError(f"{place}: {error.ename}: {cause} (the run so far: {copy})") from error
        except (DeadKernelError, CellTimeoutError) as error:
            message = f"{path.name}: the kernel died, perhaps for want of memory (the run so far: {copy}); run again"
            raise ReproductionError(message) from error
    return copy


@contextlib.contextmanager
def _environment(**variables: str) -> Iterator[None]:
    """Environment variables for the kernel, which starts with a copy of ours."""
    before = dict(os.environ)
    os.environ.update(variables, PYTHONPATH=str(SOURCES), PYTHONHASHSEED="0", PYDEVD_DISABLE_FILE_VALIDATION="1")
    try:
        yield
    finally:
        os.environ.clear()
        os.environ.update(before)
