"""The chapter notebooks as data: their parameters, the ids they make, and their execution.

papermill guesses types from text and only warns about a name it does not know. Here a value is checked against the
notebook's own parameters cell before anything runs, and is handed over as a Python value.
"""

import ast
import difflib
import json
import os
import re
from pathlib import Path
from unittest.mock import patch

import nbformat
import papermill
from jupyter_client.kernelspec import NoSuchKernel
from papermill.exceptions import PapermillExecutionError

from lifelong_lib.reproduction.children import surroundings, warn
from lifelong_lib.reproduction.configurations import flat, nested
from lifelong_lib.reproduction.files import ROOT, ReproductionError, read_json, require
from lifelong_lib.reproduction.fingerprint import SOURCES

COMMON = ("profile", "seeds", "workers", "output_dir")
ENDINGS = {"F": ("csv", "png", "svg"), "T": ("csv", "md")}
KINDS = {bool: "true or false", int: "a whole number", float: "a number", str: "a text", list: "a list with entries"}


def find_notebooks(folder: Path | None = None) -> dict[int, Path]:
    """The chapter notebooks by chapter number: `notebooks/ch04_predicting_policies.ipynb` is number 4.

    JupyterLab's copies are named and left out; two notebooks of one chapter raise ReproductionError.
    """
    found: dict[int, Path] = {}
    for path in sorted((folder or ROOT / "notebooks").glob("ch[0-9][0-9]_*.ipynb")):
        number = int(path.name[2:4])
        if "-Copy" in path.stem:
            warn(f"{path.name} is a copy and is not run; rename it, in place of the other, to use it")
            continue
        first = found.setdefault(number, path)
        require(first is path, f"{first.name} and {path.name} are both chapter {number}: move one of them away")
    return found


def read_notebook(path: Path) -> nbformat.NotebookNode:
    """The notebook at `path`; a file that is no notebook raises ReproductionError."""
    try:
        notebook = nbformat.read(path, as_version=4)
        nbformat.validate(notebook)  # reading one only logs what is wrong
        return notebook
    except (ValueError, nbformat.ValidationError, AttributeError, TypeError) as error:
        raise ReproductionError(f"{path.name} is not a readable notebook: {str(error).splitlines()[0]}") from error


def read_parameters(path: Path) -> dict[str, object]:
    """{name: default} of the one cell tagged `parameters`, in the cell's order.

    Raises ReproductionError when there is no such cell, more than one, or anything in it but `name = literal`:
    papermill sets new values *after* the cell, so whatever it computed from a default would keep the default.
    """
    parameters, text = {}, ""
    try:
        for statement in ast.parse(_parameters_cell(path), "its text").body:
            text = f"`{ast.unparse(statement)}`"
            (target,) = statement.targets
            parameters[target.id] = ast.literal_eval(statement.value)
    except (SyntaxError, AttributeError, ValueError, TypeError) as error:
        message = f"the parameters cell of {path.name} may hold only `name = literal`, not {text or error}"
        raise ReproductionError(message) from error
    return parameters


def _parameters_cell(path: Path) -> str:
    cells = [cell for cell in read_notebook(path).cells if "parameters" in cell.metadata.get("tags", [])]
    require(len(cells) == 1, f"{path.name} has {len(cells)} cells tagged 'parameters'; it needs exactly one")
    return cells[0].source


def typed_parameters(path: Path, given: dict[str, object]) -> dict[str, object]:
    """All parameters of the notebook: its defaults, and `given` (values, or texts from a command line) converted.

    An entry of a dictionary is named with a dot, as in `knobs.bicycle.step`. Unknown names (with the nearest known one)
    and values of another type than the default raise ReproductionError, and so do lists of another length, unless their
    comment says "any number".
    """
    defaults = read_parameters(path)
    typed = flat(defaults)
    message = f"dictionaries in the parameters cell of {path.name} need texts without dots as keys"
    require(nested(typed) == defaults, message)
    free = re.findall(r"(?m)^(\w+) = \[.*\]  # .*\bany number\b", _parameters_cell(path))
    for name, value in flat(given).items():
        near = difflib.get_close_matches(name, typed, n=1)
        hint = f"did you mean '{near[0]}'?" if near else f"it has {', '.join(typed)}"
        require(name in typed, f"{path.name} has no parameter '{name}'; {hint}")
        default = typed[name]
        try:
            typed[name] = _convert(value, default)
        except (ValueError, SyntaxError, TypeError) as error:
            wanted = KINDS.get(type(typed[name]), "a literal")
            raise ReproductionError(f"parameter '{name}' of {path.name} wants {wanted}, not '{value}'") from error
        if isinstance(default, list) and name not in free:
            due, found = len(default), len(typed[name])
            message = f"parameter '{name}' of {path.name} wants {due} entries, as in {default}, not {found}"
            require(found == due, message)
    return nested(typed)


def _convert(value: object, default: object) -> object:
    """The value, or what its text means, if it has the type of the default (or of its items); else ValueError."""
    kind = type(default)
    if kind is list and isinstance(value, str) and not value.startswith("["):
        value = [part.strip() for part in value.split(",")]
    if kind is not str and isinstance(value, str):
        value = ast.literal_eval(value.title() if kind is bool else value)
    if kind is float and type(value) is int:
        value = float(value)
    require(type(value) is kind, "another type")  # not isinstance: True is no whole number here
    require(value or kind is not list or not default, "a list without entries")
    return [_convert(item, default[0]) for item in value] if kind is list and default else value


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
            for identifier in named_in_calls(cell.source):
                made.setdefault(identifier, []).append(heading)
    return made


def named_in_calls(source: str, functions: str = "save_figure|save_table|check_claim") -> list[str]:
    """The literal second arguments of calls, outside comments; the source need not be Python (a line magic)."""
    return re.findall(rf"""^[^#\n]*\b(?:{functions})\(\s*\w+,\s*["']([^"']+)["']""", source, re.MULTILINE)


def grid_names(path: Path) -> list[str]:
    """The names that the notebook's code gives to its grids, as in `run_grid(chapter, "slopes", ...)`."""
    code = (cell.source for cell in read_notebook(path).cells if cell.cell_type == "code")
    return named_in_calls("\n".join(code), "run_grid")


def missing_results(path: Path, folder: Path, since: float = 0.0) -> list[str]:
    """The ids which the notebook makes but whose files (or row in claims.json) are not in `folder`, or older."""
    def fresh(name: str) -> bool:   # a second's grace: a file system's clock may lag behind ours
        return (folder / name).exists() and (folder / name).stat().st_mtime > since - 1

    found = {row["id"] for row in read_json(folder / "claims.json", [])} if fresh("claims.json") else set()
    made = made_ids(path)
    found |= {name for name in made if name[0] in ENDINGS and all(fresh(f"{name}.{end}") for end in ENDINGS[name[0]])}
    return [name for name in made if name not in found]


def execute(path: Path, parameters: dict[str, object], folder: Path, options: dict | None = None) -> None:
    """Runs the notebook with checked `parameters`; the executed copy goes to `folder`/notebooks.

    `options` reach run_grid through the environment variable LIFELONG_OPTIONS. With options["plan"], nothing is
    computed, and cells may fail from the first missing run on. Otherwise a failing cell raises ReproductionError with
    notebook, cell, error and copy.
    """
    options = options or {}
    defaults = read_parameters(path)
    changed = {name: value for name, value in typed_parameters(path, parameters).items() if value != defaults[name]}
    copy = folder / "notebooks" / path.name
    copy.parent.mkdir(parents=True, exist_ok=True)
    kernel = surroundings(LIFELONG_OPTIONS=json.dumps(options), PYTHONPATH=str(SOURCES), PYTHONHASHSEED="0",
                          PYDEVD_DISABLE_FILE_VALIDATION="1")  # fmt: skip
    try:
        with patch.dict(os.environ, kernel, clear=True):  # the kernel starts with a copy
            papermill.execute_notebook(
                str(path), str(copy), changed, kernel_name="python3", language="python", cwd=str(ROOT),
                progress_bar=False, allow_errors="plan" in options, extra_arguments=["--log-level=CRITICAL"],
            )
    except PapermillExecutionError as error:
        errors = [(cell.execution_count, output) for cell in read_notebook(copy).cells
                  for output in cell.get("outputs", []) if output.output_type == "error"]  # fmt: skip
        count, first = errors[0]  # papermill names the last
        if "plan" not in options or first.ename != "NotStored":
            cause = (first.evalue.strip().splitlines() or ["no message"])[0]
            place = f"{path.name}, cell [{count}]"
            raise ReproductionError(f"{place}: {first.ename}: {cause} (the run so far: {copy})") from error
    except (RuntimeError, NoSuchKernel) as error:  # at its start or later
        mend = "give it more memory, or install ipykernel, and run again"
        raise ReproductionError(f"{path.name}: the kernel died ({error}; the run so far: {copy}): {mend}") from error
