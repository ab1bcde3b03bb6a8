"""What stands beside the code: the container, the citation, and what the README tells to type."""

import re
import subprocess
import sys
import tomllib
import types

import yaml
from conftest import REPOSITORY

PROJECT = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"]
README = (REPOSITORY / "README.md").read_text()


def instructions():
    """(word, arguments) of each line of the Dockerfile, continued ones joined."""
    text = (REPOSITORY / "Dockerfile").read_text().replace("\\\n", " ")
    return [line.split(maxsplit=1) for line in text.splitlines() if line.strip() and not line.startswith("#")]


def test_the_container_has_everything_that_is_tracked_and_nothing_else():
    copied = [words.split()[:-1] for word, words in instructions() if word == "COPY" and "--from" not in words]
    copied = sorted({source for sources in copied for source in sources})
    tracked = subprocess.run(["git", "ls-files"], cwd=REPOSITORY, capture_output=True, text=True).stdout.split()
    top = {path if path.startswith("figures/") else path.split("/")[0] for path in tracked}
    top = {"figures/reference" if path.startswith("figures/reference/") else path for path in top}
    assert set(copied) == (top or set(copied)) and all((REPOSITORY / source).exists() for source in copied)


def test_the_container_has_two_stages_of_the_oldest_python_and_ends_in_the_two_commands():
    words = instructions()
    assert [text.split()[0] for word, text in words if word == "FROM"] == ["python:3.11-slim"] * 2
    assert words[-2:] == [["ENTRYPOINT", '["./reproduce.sh"]'], ["CMD", '["run"]']]
    assert PROJECT["requires-python"] == ">=3.11" and "./reproduce.sh test" in README


def test_the_container_names_no_registry():
    assert not re.search(r"https?://|/root|/home|/work", (REPOSITORY / "Dockerfile").read_text() + README)


def test_the_citation_is_that_of_this_version():
    citation = yaml.safe_load((REPOSITORY / "CITATION.cff").read_text())
    assert {"cff-version", "message", "title", "authors"} <= citation.keys() and citation["cff-version"] == "1.2.0"
    assert citation["version"] == PROJECT["version"]
    assert (REPOSITORY / "LICENSE").read_text().startswith(f"{citation['license']} License")
    (thesis,) = citation["references"]
    assert thesis["type"] == "thesis" and thesis["year"] == 2018


def test_the_example_for_slurm_asks_for_workers_of_one_thread_that_find_the_library(monkeypatch):
    """dask-jobqueue is not pinned: a stand-in notes what it is asked for."""
    (code,) = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    asked, done = {}, []

    class SLURMCluster:
        scheduler_address = "tcp://login:8786"

        def __init__(self, **settings):
            asked.update(settings)

        def job_script(self):
            return ""

        def scale(self, jobs):
            done.append(jobs)

    client = types.SimpleNamespace(wait_for_workers=done.append)
    monkeypatch.setitem(sys.modules, "dask_jobqueue", types.SimpleNamespace(SLURMCluster=SLURMCluster))
    monkeypatch.setattr("distributed.Client", lambda cluster: client)
    said = []
    exec(compile(code, "README", "exec"), {"input": said.append})
    assert asked["cores"] == asked["processes"] == 1 and done == [100, 1]
    assert "--backend dask --address tcp://login:8786" in said[0]
    (prologue,) = (line for line in asked["job_script_prologue"] if "PYTHONPATH=." in line)
    for line in [*asked["job_script_prologue"], prologue]:
        assert line in README.split("The job script it prints:")[1]
