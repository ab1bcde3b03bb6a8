"""Parameters are checked before anything runs; every chapter notebook runs at smoke and makes what it announces."""

import json
import re

import pytest
from conftest import BROKEN, REPOSITORY, SET_UP, TITLE, write_notebook
from jupyter_client.kernelspec import NoSuchKernel

from lifelong_lib.reproduction.files import ReproductionError
from lifelong_lib.reproduction.notebooks import (
    execute,
    find_notebooks,
    made_ids,
    missing_results,
    read_notebook,
    read_parameters,
    typed_parameters,
)


@pytest.fixture
def notebook(tmp_path):
    return write_notebook(tmp_path / "ch04_small.ipynb", [TITLE, "print(scale, tasks)", BROKEN])


def test_parameters_have_their_values_in_order(notebook):
    found = read_parameters(notebook)
    assert list(found) == ["profile", "seeds", "workers", "output_dir", "scale", "tasks", "limits", "broken"]
    assert found["scale"] == 1.0 and found["tasks"] == [1, 2]


@pytest.mark.parametrize("source, complaint", [
    ("a = 1\nb = a * 2", "not `b = a * 2`"),
    ("import os", "not `import os`"),
    ("a = b = 1", "not `a = b = 1`"),
    ("a = 1\nscale = \nb = 2", "not invalid syntax (its text, line 2)"),
    ("a = [1,", "never closed (its text, line 1)"),
    ("a = {[1]: 2}", "not `a = {[1]: 2}`"),
    (None, "0 cells tagged 'parameters'"),
])
def test_a_parameters_cell_holds_literals_only(tmp_path, source, complaint):
    path = write_notebook(tmp_path / "ch04_bad.ipynb", [TITLE, SET_UP], parameters=source)
    with pytest.raises(ReproductionError, match="ch04_bad.ipynb") as caught:
        read_parameters(path)
    assert complaint in str(caught.value)


def test_two_parameters_cells_are_refused(tmp_path):
    path = write_notebook(tmp_path / "ch04_twice.ipynb", [TITLE, SET_UP])
    content = json.loads(path.read_text())
    content["cells"][2]["metadata"]["tags"] = ["parameters"]
    path.write_text(json.dumps(content))
    with pytest.raises(ReproductionError, match="2 cells"):
        read_parameters(path)


@pytest.mark.parametrize("text", [
    '{"cells": [', "", "[]", '{"cells": 3}', '{"nbformat": 4, "nbformat_minor": 5, "metadata": {}, "cells": ['
    '{"cell_type": "raw", "metadata": {}, "source": 3, "id": "a"}]}',
])
def test_a_file_that_is_no_notebook_is_named(tmp_path, text):
    (tmp_path / "ch04_torn.ipynb").write_text(text)
    with pytest.raises(ReproductionError, match="ch04_torn.ipynb is not a readable notebook"):
        read_parameters(tmp_path / "ch04_torn.ipynb")


@pytest.mark.parametrize("name, text, value", [
    ("scale", "2", 2.0), ("scale", "1e-3", 0.001), ("scale", 2, 2.0), ("seeds", "7", 7), ("profile", "007", "007"),
    ("broken", "true", True), ("broken", "False", False),
    ("tasks", "[3, 4]", [3, 4]), ("tasks", "3,4", [3, 4]), ("tasks", [5], [5]),
])
def test_values_take_the_type_of_the_default(notebook, name, text, value):
    typed = typed_parameters(notebook, {name: text})
    assert typed[name] == value and type(typed[name]) is type(value)
    assert typed["output_dir"] == ""


@pytest.mark.parametrize("name, text, complaint", [
    ("seeds", "1.5", "wants a whole number, not '1.5'"), ("seeds", "many", "wants a whole number"),
    ("seeds", True, "wants a whole number"), ("scale", "fast", "wants a number"),
    ("broken", "1", "wants true or false"), ("tasks", "3,x", "wants a list"), ("tasks", "[1.5]", "wants a list"),
    ("limits", "[3.0]", "wants 2 entries, as in [0.0, 1.0], not 1"),
    ("tasks", "[]", "wants a list with entries, not '[]'"), ("tasks", "", "wants a list with entries"),
    ("profile", 3, "wants a text"), ("sclae", "1", "did you mean 'scale'?"),
    ("zzz", "1", "it has profile, seeds"), ("scale", "{[1]: 2}", "wants a number"),
])
def test_wrong_names_and_types_are_refused(notebook, name, text, complaint):
    with pytest.raises(ReproductionError) as caught:
        typed_parameters(notebook, {name: text})
    assert complaint in str(caught.value) and "\n" not in str(caught.value)


def test_entries_of_a_dictionary_are_parameters_too(tmp_path):
    knobs = 'knobs = {"cart-pole": {"step": 0.3, "k": 5}, "bicycle": {"step": 0.1, "k": 7}}'
    path = write_notebook(tmp_path / "ch04_knobs.ipynb", [TITLE], parameters=knobs)
    typed = typed_parameters(path, {"knobs.cart-pole.step": "1"})
    assert typed == {"knobs": {"cart-pole": {"step": 1.0, "k": 5}, "bicycle": {"step": 0.1, "k": 7}}}
    assert typed_parameters(path, typed) == typed
    refused = [("knobs.bicycle.k", "7.5", "'knobs.bicycle.k' of ch04_knobs.ipynb wants a whole number"),
               ("knobs.bicycel.k", "7", "did you mean 'knobs.bicycle.k'?"), ("knobs", "{}", "no parameter 'knobs'; ")]
    for name, text, complaint in refused:
        with pytest.raises(ReproductionError, match=re.escape(complaint)):
            typed_parameters(path, {name: text})


@pytest.mark.parametrize("keys", ['{10: 1}', '{"a.b": 1}', '{"a": {True: 1}}'])
def test_dictionaries_whose_entries_have_no_dotted_name_are_refused(tmp_path, keys):
    path = write_notebook(tmp_path / "ch04_keys.ipynb", [TITLE], parameters=f"sizes = {keys}")
    with pytest.raises(ReproductionError, match=r"parameters cell of ch04_keys.ipynb need texts without dots as keys"):
        typed_parameters(path, {})


def test_two_notebooks_of_one_chapter_are_refused_and_copies_are_named(tmp_path, capsys):
    first = write_notebook(tmp_path / "ch02_background.ipynb", [TITLE])
    write_notebook(tmp_path / "ch02_background-Copy1.ipynb", [TITLE])
    assert find_notebooks(tmp_path) == {2: first}
    assert capsys.readouterr().err.startswith("warning: ch02_background-Copy1.ipynb is a copy and is not run")
    write_notebook(tmp_path / "ch02_mine.ipynb", [TITLE])
    with pytest.raises(ReproductionError, match="ch02_background.ipynb and ch02_mine.ipynb are both chapter 2: move"):
        find_notebooks(tmp_path)


def test_ids_are_read_from_the_code_with_the_heading_above(tmp_path):
    cells = ["# Top", "## Curves", 'save_figure(chapter, "F4.2", fig, rows)', "## Words",
             'check_claim(chapter, "C4.2", {})\nsave_table(chapter, "T4.1", rows)',
             '%time save_figure(\n    chapter, "F4.2", fig, rows)\nx = 1  # save_figure(chapter, "F4.3", fig, rows)']
    path = write_notebook(tmp_path / "ch04_ids.ipynb", cells)
    assert made_ids(path) == {"F4.2": ["Curves", "Words"], "C4.2": ["Words"], "T4.1": ["Words"]}
    assert missing_results(path, tmp_path) == ["F4.2", "C4.2", "T4.1"]
    for name in ("F4.2.csv", "F4.2.png", "F4.2.svg", "T4.1.csv"):
        (tmp_path / name).touch()
    (tmp_path / "claims.json").write_text('[{"id": "C4.2"}]')
    assert missing_results(path, tmp_path) == ["T4.1"]
    (tmp_path / "T4.1.md").touch()
    assert missing_results(path, tmp_path) == []
    assert missing_results(path, tmp_path, since=4e9) == ["F4.2", "C4.2", "T4.1"]


def test_execution_hands_over_values_and_names_a_failing_cell(notebook, tmp_path):
    complaint = r"ch04_small.ipynb, cell \[\d\]: ValueError: broken on demand"
    with pytest.raises(ReproductionError, match=complaint) as caught:
        execute(notebook, {"scale": "0.5", "tasks": [7], "broken": True}, tmp_path / "out")
    copy = tmp_path / "out" / "notebooks" / "ch04_small.ipynb"
    assert str(copy) in str(caught.value)
    outputs = [output for cell in read_notebook(copy).cells for output in cell.get("outputs", [])]
    assert "0.5 [7]\n" in [output.get("text") for output in outputs]


def test_a_kernel_that_dies_is_named(tmp_path):
    path = write_notebook(tmp_path / "ch04_dies.ipynb", [TITLE, "import os\nos._exit(1)"])
    with pytest.raises(ReproductionError, match="ch04_dies.ipynb: the kernel died"):
        execute(path, {}, tmp_path / "out")


def test_a_kernel_that_does_not_start_is_named(notebook, tmp_path, monkeypatch):
    spec = tmp_path / "jupyter" / "kernels" / "python3" / "kernel.json"
    spec.parent.mkdir(parents=True)
    spec.write_text('{"argv": ["false"], "display_name": "dies at once", "language": "python"}')
    monkeypatch.setenv("JUPYTER_PATH", str(tmp_path / "jupyter"))
    with pytest.raises(ReproductionError, match="ch04_small.ipynb: the kernel died .*install ipykernel"):
        execute(notebook, {}, tmp_path / "out")

    def none(self, name):
        raise NoSuchKernel(name)

    monkeypatch.setattr("jupyter_client.kernelspec.KernelSpecManager.get_kernel_spec", none)
    with pytest.raises(ReproductionError, match="ch04_small.ipynb: the kernel died .No such kernel"):
        execute(notebook, {}, tmp_path / "out")


def test_nothing_runs_when_a_parameter_is_wrong(notebook, tmp_path):
    with pytest.raises(ReproductionError):
        execute(notebook, {"seeds": "many"}, tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("path", find_notebooks(REPOSITORY / "notebooks").values(), ids=lambda path: path.name[:4])
def test_chapter_at_smoke_makes_everything_it_announces(path, tmp_path):
    execute(path, {"profile": "smoke", "output_dir": str(tmp_path)}, tmp_path)
    made = made_ids(path)
    assert bool(made) == (path.name[:4] not in ("ch01", "ch08"))  # which have no figure, table or claim of the thesis
    assert all(len(places) == 1 for places in made.values())
    assert missing_results(path, tmp_path) == []
    shown = (tmp_path / "notebooks" / path.name).read_text()
    assert "<table>" in shown and "<tbody><tr></tr></tbody>" not in shown  # no table without rows
