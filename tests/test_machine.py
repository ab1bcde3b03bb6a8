"""The commit of the code: results and figures may differ from it, code may not."""

import subprocess

import pytest

from lifelong_lib.reproduction import machine


@pytest.fixture
def repository(tmp_path, monkeypatch):
    monkeypatch.setattr(machine, "ROOT", tmp_path)
    return tmp_path


def git(folder, *words):
    who = ("-c", "user.name=x", "-c", "user.email=x@x")
    done = subprocess.run(["git", "-C", str(folder), *who, *words], env=machine.surroundings(), check=True,
                          capture_output=True, text=True)  # fmt: skip
    return done.stdout.strip()


def test_code_that_differs_from_its_commit_is_named_and_results_do_not_count(repository):
    assert machine.commit() == "unknown (no git history here)"
    for file in ("code.py", "data/results/runs.csv", "figures/F1.png"):
        (repository / file).parent.mkdir(parents=True, exist_ok=True)
        (repository / file).write_text("1")
    git(repository, "init", "-q")
    git(repository, "add", ".")
    git(repository, "commit", "-qm", "first")
    head = git(repository, "rev-parse", "HEAD")
    assert machine.commit() == head and len(head) == 40
    for file in ("data/results/runs.csv", "figures/F1.png"):
        (repository / file).write_text("2")
    assert machine.commit() == head
    (repository / "code.py").write_text("2")
    assert machine.commit() == head + " with changes"


def test_versions_name_the_processor_and_what_computes():
    found = machine.versions("pytest")
    assert {"python", "processor", "numpy", "torch", "pytest"} <= found.keys() and found["processor"].strip()
