"""The commands as a person types them: exit codes, one-line complaints, plan, why, audit, and the set-up script."""

import os
import re
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace

import pytest
from conftest import REPOSITORY, command, make_project, write_notebook

from lifelong_lib.__main__ import main
from lifelong_lib.reproduction.files import alone
from lifelong_lib.reproduction.machine import processor
from lifelong_lib.reproduction.store import Store


@pytest.mark.parametrize("arguments, complaint", [
    ("", "COMMAND"),
    ("frobnicate", "invalid choice: 'frobnicate'"),
    ("run --profile tiny", "invalid choice: 'tiny'"),
    ("run --chapters 9", "chapter 9 has no notebook"),
    ("run --chapters four", "'four' is not a whole number above 0"),
    ("run --workers 0", "'0' is not a whole number above 0"),
    ("run --seeds -3", "'-3' is not a whole number above 0"),
    ("run --backend spark", "invalid choice: 'spark'"),
    ("run --address tcp://a:1", "--address needs --backend dask"),
    ("run --backend dask", "--backend dask needs --address"),
    ("run --wrong", "unrecognized arguments: --wrong"),
    ("run -p scale", "NAME=VALUE is wanted"),
    ("run -p profile=paper", "profile has its own option"),
    ("run -p sclae=1", "did you mean 'scale'?"),
    ("run -p scale=fast", "wants a number, not 'fast'"),
    ("run --plan --audit 3", "not allowed with"),
    ("run --why F4.7", "no notebook makes F4.7"),
    ("audit", "required: K"),
    ("audit 0", "'0' is not a whole number above 0"),
    ("compare --profile paper", "run --profile paper"),
    ("accept --profile paper", "nothing in"),
])
def test_bad_input_is_one_line_and_runs_nothing(tmp_path, monkeypatch, capsys, arguments, complaint):
    write_notebook(tmp_path / "notebooks" / "ch04_small.ipynb", ["# Text", "raise SystemExit"])
    monkeypatch.setattr("lifelong_lib.__main__.ROOT", tmp_path)
    monkeypatch.setattr("lifelong_lib.reproduction.notebooks.ROOT", tmp_path)
    try:
        code = main(arguments.split())
    except SystemExit as stopped:
        code = stopped.code
    said = capsys.readouterr().err
    assert code == 2 and said.startswith("error: ") and said.count("\n") == 1 and complaint in said
    assert not (tmp_path / "figures").exists()


@pytest.fixture
def inside(monkeypatch):
    """A command run in this process (which spares it the imports) with another folder as the repository."""
    def run(root, *arguments):
        for module in ("__main__", "reproduction.notebooks", "reproduction.report", "reproduction.book"):
            monkeypatch.setattr(f"lifelong_lib.{module}.ROOT", root)
        monkeypatch.setenv("LIFELONG_ROOT", str(root))   # for the kernel
        return main(list(arguments))
    return run


def test_pytest_gets_what_follows_test(monkeypatch):
    called = []

    def stand_in(words, cwd, env):
        called.append(words)
        return subprocess.CompletedProcess(words, 5)

    monkeypatch.setattr("lifelong_lib.__main__.subprocess.run", stand_in)
    assert main(["test", "-k", "layout", "--fresh"]) == 5
    two = ["-n", "2", "--dist", "loadfile"]
    assert called == [[sys.executable, "-m", "pytest", *two, "-k", "layout", "--fresh"]]


def test_a_second_run_in_one_folder_says_which_one_is_going_on(tmp_path):
    root = make_project(tmp_path)
    with alone(root / "figures" / "latest" / "lock", "run --chapters 4"):
        done = command(root, "run")
        assert done.returncode == 2 and done.stderr.count("\n") == 1
        assert f"another run is going on in this folder (process {os.getpid()}: run --chapters 4)" in done.stderr
        assert command(root, "run", "--plan").returncode == 0, "a plan disturbs nobody"


def test_who_reads_the_first_line_only_is_no_error(project):
    """As in `./reproduce.sh compare | head -1`."""
    environment = os.environ | {"LIFELONG_ROOT": str(project), "PYTHONPATH": str(REPOSITORY)}
    child = subprocess.Popen([sys.executable, "-m", "lifelong_lib", "compare"], env=environment, text=True,
                             stdout=subprocess.PIPE, stderr=subprocess.PIPE)  # fmt: skip
    child.stdout.close()
    assert child.stderr.read() == "" and child.wait() == 0


def test_a_run_tells_what_it_did(project):
    said = (project / "run.txt").read_text()
    assert "[1/1] chapter 4, quick: ch04_demonstration.ipynb" in said
    assert "no reference" in said and "claims: 1 holds" in said and "book/index.html" in said


def test_plan_and_why_compute_nothing(project, inside, capsys):
    before = sorted((path, path.stat().st_mtime_ns) for path in (project / "figures").rglob("*"))
    assert inside(project, "run", "--plan", "-p", "tasks=2,3") == 0
    planned = capsys.readouterr().out
    assert "8 runs: 4 stored, 0 stale, 4 missing" in planned and "min to compute" in planned
    assert re.search(r"chosen +depends on runs that are missing", planned)
    assert inside(project, "run", "--why", "T4.1", "-p", "tasks=2,3") == 0
    unknown = capsys.readouterr().out
    assert re.search(r"chosen +depends on runs that are missing", unknown) and "rests on no stored" not in unknown
    assert inside(project, "run", "--plan", "-p", "broken=true") == 2
    assert "ValueError: broken on demand" in capsys.readouterr().err
    assert inside(project, "run", "--why", "F4.1") == 0
    asked = capsys.readouterr().out
    assert "slopes" in asked and "8 stored" in asked and "rests on no stored" not in asked
    assert "chosen" not in asked
    assert sorted((path, path.stat().st_mtime_ns) for path in (project / "figures").rglob("*")) == before


def test_audit_tells_a_stored_run_that_does_not_come_out_again(project, tmp_path, inside, capsys):
    copy = tmp_path / "copy"
    shutil.copytree(project, copy)
    assert inside(copy, "audit", "2") == 0
    assert "2 of 2 recomputed runs are identical" in capsys.readouterr().out
    stores = [Store(copy / "data" / "results" / "quick" / "ch04" / name, 4, name) for name in ("slopes", "chosen")]
    runs = stores[0].read()
    key, run = next(iter(runs.items()))
    stores[0].pack(runs | {key: replace(run, versions={"processor": f"another than {processor()}"})})
    runs |= stores[1].read()
    assert inside(copy, "audit", str(len(runs))) == 0 and "made on" not in capsys.readouterr().out
    notebook = copy / "notebooks" / "ch04_demonstration.ipynb"
    notebook.write_text(notebook.read_text().replace("(5 + ", "(6 + "))
    assert inside(copy, "run", "--audit", str(len(runs))) == 1
    changed = capsys.readouterr().out
    assert f"0 of {len(runs)}" in changed and changed.count("DIFFERENT in curve") == len(runs)
    assert changed.count(f"(made on processor another than {processor()}, here {processor()})") == 1


def test_a_stamp_over_a_refactoring_and_none_over_a_change(project, tmp_path, inside, capsys):
    copy = tmp_path / "copy"
    shutil.copytree(project, copy)
    notebook = copy / "notebooks" / "ch04_demonstration.ipynb"
    notebook.write_text(notebook.read_text().replace('config[\\"tasks\\"] * (5', '1 * config[\\"tasks\\"] * (5'))
    assert inside(copy, "audit", "1", "--stamp") == 0
    said = capsys.readouterr().out
    assert said.count("identical (made by older code)") == 2
    assert "2 of 2 recomputed runs are identical" in said and said.count("runs are stamped: audited 1 of") == 2
    assert inside(copy, "run", "--why", "F4.1") == 0
    asked = capsys.readouterr().out
    assert "8 stored, 0 stale" in asked and "8 stamped: made by other code, but audited 1 of 8 at commit" in asked
    notebook.write_text(notebook.read_text().replace("(5 + ", "(6 + "))
    assert inside(copy, "audit", "1", "--stamp") == 1
    said = capsys.readouterr()
    assert "stamped: audited" not in said.out and "error: runs came out differently, so what is stale stays" in said.err
    assert "chosen of chapter 4, slopes of chapter 4" in said.err


def test_a_failing_chapter_is_reported_and_the_rest_is_made(tmp_path, inside, capsys):
    root = make_project(tmp_path)
    write_notebook(root / "notebooks" / "ch02_broken.ipynb", ["# Two", "# More", "1 / 0"])
    assert inside(root, "run", "--profile", "smoke") == 1
    said = capsys.readouterr()
    assert "error: ch02_broken.ipynb, cell [3]: ZeroDivisionError: division by zero" in said.err
    assert said.err.endswith("error: not made: chapter 2 (see above)\n")
    assert (root / "figures" / "latest" / "smoke" / "F4.1.png").exists()
    assert (root / "figures" / "latest" / "smoke" / "book" / "chapters" / "ch02_broken.html").exists()


def test_ctrl_c_ends_with_one_line_and_no_kernel(tmp_path):
    write_notebook(tmp_path / "notebooks" / "ch04_slow.ipynb",
                   ["# Slow", "import os, pathlib, time", "pathlib.Path('kernel').write_text(str(os.getpid()))",
                    "time.sleep(100)"])
    environment = os.environ | {"LIFELONG_ROOT": str(tmp_path), "PYTHONPATH": str(REPOSITORY)}
    running = subprocess.Popen([sys.executable, "-m", "lifelong_lib", "run"], env=environment, cwd=tmp_path, text=True,
                               stderr=subprocess.PIPE, start_new_session=True)
    wait_for((tmp_path / "kernel").exists)
    time.sleep(0.3)
    running.send_signal(signal.SIGINT)
    said = running.communicate(timeout=30)[1]
    assert running.returncode == 130 and said.splitlines()[-1].startswith("error: interrupted; what was stored stays")
    assert "Traceback" not in said
    kernel = int((tmp_path / "kernel").read_text())
    wait_for(lambda: not os.path.exists(f"/proc/{kernel}"))


def wait_for(condition, seconds: float = 30) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "waited too long"
        time.sleep(0.05)


def test_a_missing_package_and_a_full_disk_are_one_line(monkeypatch, capsys, tmp_path):
    hidden = tmp_path / "papermill.py"
    hidden.write_text("raise ModuleNotFoundError(name='papermill')")
    done = command(REPOSITORY, "compare", PYTHONPATH=f"{tmp_path}:{REPOSITORY}")
    assert done.returncode == 2 and done.stderr.count("\n") == 1 and "the package papermill is missing" in done.stderr

    def full(*_):
        raise OSError(28, "No space left on device", "F4.1.csv")

    monkeypatch.setattr("lifelong_lib.__main__.report.accept", full)
    assert main(["accept"]) == 2
    assert capsys.readouterr().err == "error: No space left on device: F4.1.csv\n"


@pytest.fixture
def script(tmp_path):
    """reproduce.sh in an empty folder, where `python3.11 -m venv` and pip are shell stand-ins that note their calls."""
    shutil.copyfile(REPOSITORY / "reproduce.sh", tmp_path / "reproduce.sh")
    (tmp_path / "environment.txt").write_text("six==1.17.0\n")
    (tmp_path / "lifelong_lib").mkdir()
    tools = tmp_path / "tools"
    tools.mkdir()
    (tools / "python3.11").write_text(f"""#!/bin/bash
echo "$*" >> {tmp_path}/calls
if [ "$1" = "-c" ]; then echo True; fi
if [ "$*" = "-m pip --version" ]; then [ ! -e "$(dirname "$0")/without_pip" ]; exit; fi
if [ "$1 $2" = "-m venv" ]; then mkdir -p "$3/bin"; cp "$0" "$3/bin/python"; touch "$3/pyvenv.cfg"; fi
if [ "$1 $2" = "-m pip" ]; then exit "$(cat {tmp_path}/pip_fails 2>/dev/null || echo 0)"; fi
""")
    (tools / "python3.11").chmod(0o755)
    return tmp_path


def call(root, *arguments, **variables):
    environment = {"PATH": f"{root}/tools:/usr/bin:/bin"} | variables
    typed = ["bash", str(root / "reproduce.sh"), *arguments]
    done = subprocess.run(typed, env=environment, capture_output=True, text=True)
    calls = (root / "calls").read_text().splitlines() if (root / "calls").exists() else []
    (root / "calls").unlink(missing_ok=True)
    return done, [line for line in calls if not line.startswith(("-c ", "-m pip --version"))]


def test_set_up_happens_once_and_an_interrupted_one_is_repeated(script):
    (script / "pip_fails").write_text("1")
    done, calls = call(script)
    assert done.returncode == 2 and "error: pip could not install" in done.stderr and "-m lifelong_lib run" not in calls
    (script / "pip_fails").unlink()
    install = "-m pip install --quiet --no-input --disable-pip-version-check -r environment.txt"
    assert call(script)[1] == [install, "-m lifelong_lib run"]
    assert call(script, "audit", "3")[1] == ["-m lifelong_lib audit 3"]
    assert call(script, "--plan")[1] == ["-m lifelong_lib run --plan"]
    assert call(script, "--help")[1] == ["-m lifelong_lib --help"]
    (script / "environment.txt").write_text("six==1.16.0\n")
    assert call(script, "test")[1] == [install, "-m lifelong_lib test"]


def test_another_interpreter_skips_the_set_up(script):
    done, calls = call(script, "lab", LIFELONG_PYTHON=f"{script}/tools/python3.11")
    assert calls == ["-m lifelong_lib lab"] and not (script / ".venv").exists()
    done, _ = call(script, LIFELONG_PYTHON="/no/such/python")
    assert done.returncode == 2 and done.stderr == "error: LIFELONG_PYTHON=/no/such/python is not a program\n"
    done, _ = call(script, LIFELONG_PYTHON="/bin/true")
    assert done.returncode == 2 and "LIFELONG_PYTHON=/bin/true is no Python" in done.stderr


def test_an_environment_without_pip_is_made_anew_and_a_foreign_folder_is_not_touched(script):
    call(script)
    (script / ".venv" / "bin" / "without_pip").touch()
    (script / ".venv" / "installed.txt").unlink()
    assert call(script)[1][0] == "-m venv .venv" and not (script / ".venv" / "bin" / "without_pip").exists()
    shutil.rmtree(script / ".venv")
    (script / ".venv").mkdir()
    (script / ".venv" / "mine").touch()
    done, calls = call(script)
    assert done.returncode == 2 and ".venv is no virtual environment; move it away" in done.stderr and not calls
    assert (script / ".venv" / "mine").exists()


def test_a_link_leads_to_the_project_and_nothing_is_touched_beside_it(script):
    elsewhere = script / "elsewhere"
    (elsewhere / ".venv").mkdir(parents=True)
    (elsewhere / "reproduce.sh").symlink_to("../reproduce.sh")
    typed = ["bash", str(elsewhere / "reproduce.sh"), "lab"]
    done = subprocess.run(typed, env={"PATH": f"{script}/tools:/usr/bin:/bin"}, capture_output=True, text=True)
    assert done.returncode == 0 and (script / ".venv" / "pyvenv.cfg").exists()
    assert list((elsewhere / ".venv").iterdir()) == []
    shutil.copyfile(script / "reproduce.sh", elsewhere / "copy.sh")
    done = subprocess.run(["bash", str(elsewhere / "copy.sh")], capture_output=True, text=True)
    assert done.returncode == 2 and "is not the project's folder" in done.stderr


def test_packages_of_other_programs_stay_outside(script):
    python = script / "tools" / "python3.11"
    python.write_text(python.read_text() + f'echo "$PYTHONPATH" >> {script}/calls\n')
    surroundings = {"PYTHONPATH": "/opt/ros/lib", "PYTHONHOME": "/opt/ros"}
    assert call(script, "lab", LIFELONG_PYTHON=str(python), **surroundings)[1][-1] == str(script)


def test_text_is_read_as_utf8_whatever_the_locale(script):
    python = script / "tools" / "python3.11"
    python.write_text(python.read_text() + f'echo "$PYTHONUTF8" >> {script}/calls\n')
    assert call(script, "lab", LIFELONG_PYTHON=str(python), LC_ALL="C")[1][-2:] == ["-m lifelong_lib lab", "1"]


def test_an_old_python_is_refused_in_one_line(script):
    for name in ("python3.11", "python3", "python", "python3.12", "python3.13"):
        (script / "tools" / name).write_text("#!/bin/sh\nexit 1\n")
        (script / "tools" / name).chmod(0o755)
    done, _ = call(script)
    assert done.returncode == 2 and "no Python 3.11 or newer found" in done.stderr.splitlines()[-1]
    done, _ = call(script, LIFELONG_PYTHON=f"{script}/tools/python3")
    assert done.returncode == 2 and done.stderr.count("\n") == 1 and "3.11 or newer" in done.stderr
