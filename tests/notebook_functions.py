"""Functions and claim cells of the notebooks, taken out of their cells, to be tried on hand-made numbers."""

import ast
from functools import cache
from types import SimpleNamespace

from conftest import REPOSITORY

from lifelong_lib.reproduction.claims import check_claim
from lifelong_lib.reproduction.notebooks import find_notebooks, named_in_calls, read_notebook
from lifelong_lib.reproduction.runs import Chapter, Results, Run

NOTEBOOKS = REPOSITORY / "notebooks"


@cache
def code_cells(chapter: int) -> list[str]:
    """Sources of the chapter's code cells, in order."""
    path = find_notebooks(NOTEBOOKS)[chapter]
    return [cell.source for cell in read_notebook(path).cells if cell.cell_type == "code"]


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


def load(chapter: int, *names: str, **given) -> SimpleNamespace:
    """The functions and constants `names` of a notebook, with its imports that they use.

    Whatever else they read is `given` by hand. All of it are attributes of what is returned; one that is set later is
    seen by the functions too.
    """
    statements = [statement for source in code_cells(chapter) for statement in ast.parse(source).body]
    chosen = [statement for statement in statements if set(names) & set(bound_by(statement))]
    found = [name for statement in chosen for name in bound_by(statement)]
    for name in names:
        assert found.count(name) == 1, f"chapter {chapter} defines {name} {found.count(name)} times, not once"
    space = SimpleNamespace(**given)
    run(imports_of(statements, names_in(chosen) - given.keys()), space)
    run(chosen, space)
    return space


def judge(chapter: int, identity: str, space: SimpleNamespace, folder) -> SimpleNamespace:
    """What the notebook's own cell makes of a claim, run among the names of `space`, at the profile paper.

    `verdict` and `control_verdict` as in the book; `measured` and `control`: {label: mean over seeds}.
    """
    (source,) = [source for source in code_cells(chapter) if identity in named_in_calls(source, "check_claim")]
    statements = ast.parse(source).body
    space.chapter = Chapter(chapter, "paper", seeds=1, output_dir=str(folder))
    space.check_claim = lambda *claim, **more: vars(space).update(claim=check_claim(*claim, **more))
    every = [statement for cell in code_cells(chapter) for statement in ast.parse(cell).body]
    run(imports_of(every, names_in(statements) - vars(space).keys()), space)
    run([statement for statement in statements if not isinstance(statement, ast.Import | ast.ImportFrom)], space)
    measured, control = ({part["label"]: part["measured"] for part in parts}
                         for parts in (space.claim.parts, space.claim.control_parts))  # fmt: skip
    return SimpleNamespace(verdict=space.claim.verdict, control_verdict=space.claim.control_verdict,
                           measured=measured, control=control)  # fmt: skip


def runs(*entries: tuple[dict, dict]) -> Results:
    """Results as run_grid returns them: of each (configuration, {name: one value a seed}) all seeds."""
    made = []
    for config, values in entries:
        for seed in range(len(next(iter(values.values())))):
            chosen = {name: value[seed] for name, value in values.items()}
            made.append(Run(config, seed, chosen, seconds=0.0, made_by={}, versions={}))
    return Results(made)
