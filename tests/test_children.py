"""Every child process runs under a locale that is there, and one that fails says why."""

import ast

import pytest
from conftest import REPOSITORY, SET_UP, TITLE, command, make_project, write_notebook

from lifelong_lib.reproduction import book
from lifelong_lib.reproduction.children import LOCALE, last_words, surroundings
from lifelong_lib.reproduction.runs import ReproductionError

ABSENT = "xx_XX.UTF-8"  # no machine has it; de_DE.UTF-8, brought along by ssh, is absent from most


@pytest.mark.parametrize("variable", ["LC_ALL", "LANG"])
def test_a_locale_that_is_not_installed_spoils_neither_chapter_nor_book(tmp_path, variable):
    root = make_project(tmp_path)
    needy = 'import locale\nlocale.setlocale(locale.LC_ALL, "")'  # what Sphinx does first; fails under an absent one
    write_notebook(root / "notebooks" / "ch04_demonstration.ipynb", [TITLE, SET_UP, needy])
    clean = {"LC_ALL": "", "LC_CTYPE": "", "LANG": ""}
    done = command(root, "run", **clean | {variable: ABSENT})
    assert done.returncode == 0, done.stderr
    assert (root / "figures" / "latest" / "quick" / "book" / "index.html").exists()


def test_a_users_settings_of_drawing_do_not_reach_a_chapter(project, tmp_path):
    (tmp_path / "matplotlibrc").write_text("lines.linewidth: 9\nbackend: TkAgg\n")
    root = make_project(tmp_path / "project")
    done = command(root, "run", MPLBACKEND="TkAgg", MATPLOTLIBRC=str(tmp_path / "matplotlibrc"))
    assert done.returncode == 0, done.stderr
    ours, plain = (place / "figures" / "latest" / "quick" for place in (root, project))
    assert (ours / "F4.1.png").read_bytes() == (plain / "F4.1.png").read_bytes()
    assert "image/png" in (ours / "notebooks" / "ch04_demonstration.ipynb").read_text()


def test_a_book_that_cannot_be_built_says_why(tmp_path, monkeypatch):
    monkeypatch.setattr(book, "CONFIGURATION", book.CONFIGURATION + "\nraise KeyError('the very cause')\n")
    with pytest.raises(ReproductionError, match="could not be built: .*KeyError: 'the very cause'") as caught:
        book.build_book(tmp_path / "quick", tmp_path)
    assert "\n" not in str(caught.value)


def test_surroundings_are_ours_and_what_is_added(monkeypatch):
    monkeypatch.setenv("LC_ALL", ABSENT)
    monkeypatch.setenv("OURS", "kept")
    monkeypatch.setenv("MPLBACKEND", "TkAgg")
    found = surroundings(CI="1")
    assert (found["LC_ALL"], found["OURS"], found["CI"]) == (LOCALE, "kept", "1")
    assert "MPLBACKEND" not in found


def test_last_words_are_the_end_on_one_line():
    assert last_words("first\n\n  second   word \nthird\n", lines=2) == "second word / third"
    assert last_words("0123456789", letters=4) == "...6789"
    assert last_words(" \n") == "it said nothing"


def test_no_child_is_started_without_its_surroundings():
    bare = []
    for path in sorted((REPOSITORY / "lifelong_lib").rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and ast.unparse(node.func) in ("subprocess.run", "subprocess.Popen"):
                bare += [f"{path.name}, line {node.lineno}"] * ("env" not in [word.arg for word in node.keywords])
    assert bare == []
