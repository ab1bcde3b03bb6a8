"""Functions and claim cells of the notebooks, taken out of their cells, to be tried on hand-made numbers."""

import ast
import itertools
from functools import cache
from types import SimpleNamespace

import numpy as np
from conftest import REPOSITORY

from lifelong_lib.reproduction.claims import check_claim
from lifelong_lib.reproduction.notebooks import find_notebooks, read_notebook
from lifelong_lib.reproduction.runs import Chapter, Results, Run

NOTEBOOKS = REPOSITORY / "notebooks"


@cache
def code_cells(chapter: int) -> dict[str, list[ast.stmt]]:
    """The chapter's code cells in order: {source: its statements}."""
    path = find_notebooks(NOTEBOOKS)[chapter]
    sources = [cell.source for cell in read_notebook(path).cells if cell.cell_type == "code"]
    return {source: ast.parse(source).body for source in sources}


def all_statements(chapter: int) -> list[ast.stmt]:
    return list(itertools.chain(*code_cells(chapter).values()))


def bound_by(statement: ast.stmt) -> list[str]:
    """Names that a statement at the top of a cell defines: of a function, of a class, or of plain assignments."""
    if isinstance(statement, ast.FunctionDef | ast.ClassDef):
        return [statement.name]
    if isinstance(statement, ast.Assign):
        return [target.id for target in statement.targets if isinstance(target, ast.Name)]
    return []


def imports_of(statements: list[ast.stmt], wanted: set[str]) -> list[ast.stmt]:
    """The parts of import statements that bind wanted names, as statements of their own."""
    found = []
    for statement in statements:
        if isinstance(statement, ast.Import | ast.ImportFrom):
            for alias in statement.names:
                if (alias.asname or alias.name.partition(".")[0]) in wanted:
                    one = {**vars(statement), "names": [alias]}
                    found.append(type(statement)(**one))
    return found


def names_in(statements: list[ast.stmt]) -> set[str]:
    return {node.id for statement in statements for node in ast.walk(statement) if isinstance(node, ast.Name)}


def run(statements: list[ast.stmt], space: SimpleNamespace) -> None:
    exec(compile(ast.Module(statements, []), "notebook", "exec"), vars(space))


def load(chapter: int, /, *names: str, **given) -> SimpleNamespace:
    """The functions and constants `names` of a notebook, with its imports that they use.

    Whatever else they read is `given` by hand. All of it are attributes of what is returned; one that is set later is
    seen by the functions too.
    """
    chosen = [statement for statement in all_statements(chapter) if set(names) & set(bound_by(statement))]
    found = [name for statement in chosen for name in bound_by(statement)]
    for name in names:
        assert found.count(name) == 1, f"chapter {chapter} defines {name} {found.count(name)} times, not once"
    space = SimpleNamespace(**given)
    run(imports_of(all_statements(chapter), names_in(chosen) - given.keys()), space)
    run(chosen, space)
    return space


def run_cell(chapter: int, words: str, space: SimpleNamespace) -> None:
    """Run the one cell with these words among the names of `space`; names that are given already are not imported."""
    cells = [cell for source, cell in code_cells(chapter).items() if words in source]
    assert len(cells) == 1, f"chapter {chapter} has {len(cells)} cells with {words!r}, not one"
    (statements,) = cells
    run(imports_of(all_statements(chapter), names_in(statements) - vars(space).keys()), space)
    run([statement for statement in statements if not isinstance(statement, ast.Import | ast.ImportFrom)], space)


def judge(chapter: int, identity: str, space: SimpleNamespace, folder) -> SimpleNamespace:
    """What the notebook's own cell makes of a claim, run among the names of `space`, at the profile paper.

    `verdict` and `control_verdict` as in the book; `measured` and `control`: {label: mean over seeds}.
    """
    space.chapter = Chapter(chapter, "paper", seeds=1, output_dir=str(folder))
    space.check_claim = lambda *claim, **more: vars(space).update(claim=check_claim(*claim, **more))
    run_cell(chapter, f'check_claim(chapter, "{identity}"', space)
    measured, control = ({part["label"]: part["measured"] for part in parts}
                         for parts in (space.claim.parts, space.claim.control_parts))  # fmt: skip
    return SimpleNamespace(verdict=space.claim.verdict, control_verdict=space.claim.control_verdict,
                           measured=measured, control=control)  # fmt: skip


class Recorder:
    """Stands for a method that learns from tasks: it notes what it is told and asked, and predicts zero."""

    def __init__(self, *args, **settings):
        self.told, self.settings, self.asked = [], settings, []

    def partial_fit(self, task, *what):
        self.told.append((task, *(np.asarray(part).tolist() for part in what)))

    def fit(self, *what):
        self.told = [np.asarray(part).tolist() for part in what]
        return self

    def predict(self, description):
        self.asked.append(description.tolist())
        return np.zeros(1)


def same(*values: float, trials: int = 3) -> list:
    """The same numbers (or number) in every trial, a value for `runs`."""
    return [np.array(values, float) if len(values) > 1 else float(values[0])] * trials


def runs(*entries: tuple[dict, dict]) -> Results:
    """Results as run_grid returns them: of each (configuration, {name: one value a seed}) all seeds."""
    made = []
    for config, values in entries:
        for seed in range(len(next(iter(values.values())))):
            chosen = {name: value[seed] for name, value in values.items()}
            made.append(Run(config, seed, chosen, seconds=0.0, made_by={}, versions={}))
    return Results(made)
