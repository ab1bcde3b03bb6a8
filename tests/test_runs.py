"""Runs: the same bytes wherever they are computed, nothing lost, nothing stale or damaged used in silence."""

import errno
import importlib
import json
import os
import signal
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import numpy as np
import pytest

from lifelong_lib.reproduction import backends, fingerprint, runs
from lifelong_lib.reproduction.runs import Chapter, NotStored, ReproductionError, run_card, run_grid

CONFIGS = [{"domain": "cart-pole", "tasks": 3}, {"tasks": 2, "domain": "bicycle"}]
SCALE = 2.0


def helper(x):
    return SCALE * x


def experiment(config, seed):
    draws = np.random.default_rng(seed).normal(size=(config["tasks"], 4))
    return {
        "curve": helper(draws),
        "gram": (draws @ draws.T).T,
        "n": config["tasks"],
        "names": ["a", "bc"],
        "gap": np.nan,
    }


def count_calls(config, seed):
    with open(config["log"], "a") as log:
        log.write("x")
    return {"x": 1.0}


def fail_at_two(config, seed):
    if config["step"] == 2:
        raise ZeroDivisionError("no tasks\nleft")
    return {"x": config["step"]}


@pytest.fixture
def root(tmp_path, monkeypatch):
    monkeypatch.setattr(runs, "ROOT", tmp_path)
    monkeypatch.delenv("LIFELONG_OPTIONS", raising=False)
    return tmp_path


@pytest.fixture
def options(monkeypatch):
    return lambda **given: monkeypatch.setenv("LIFELONG_OPTIONS", json.dumps(given))


def chapter(profile="quick", seeds=2, workers=1):
    return Chapter(4, profile, seeds, workers)


def files(folder, pattern="*.npz"):
    return {path.name: path.read_bytes() for path in Path(folder).rglob(pattern)}


def serial_bytes(root):
    run_grid(chapter(), "grid", experiment, CONFIGS)
    return files(root / "data")


def report(root, profile="quick", name="grid"):
    return json.loads((root / "figures" / "latest" / profile / "runs" / f"ch04-{name}.json").read_text())


# ---- where runs are computed does not matter ----


@pytest.mark.parametrize("backend", ["loky", "dask"])
def test_worker_processes_give_the_bytes_of_a_serial_run(root, monkeypatch, options, backend):
    expected = serial_bytes(root)
    assert sorted(expected) == [
        f"domain={d},tasks={n}-s{s}.npz" for d, n in (("bicycle", 2), ("cart-pole", 3)) for s in (0, 1)
    ]
    monkeypatch.setattr(runs, "ROOT", root / backend)
    options(backend=backend)
    results = run_grid(chapter(workers=2), "grid", experiment, CONFIGS)
    assert files(root / backend / "data") == expected
    assert [(run.config["domain"], run.seed) for run in results] == [
        (domain, seed) for domain in ("cart-pole", "bicycle") for seed in (0, 1)
    ]


def test_seeds_depend_on_chapter_name_config_and_seed_only(root):
    first = run_grid(chapter(), "grid", experiment, CONFIGS, seeds=[5])
    again = run_grid(Chapter(4, "smoke", 1, 1), "grid", experiment, [dict(reversed(CONFIGS[0].items()))], seeds=[3, 5])
    np.testing.assert_array_equal(first[0].values["curve"], again[1].values["curve"])
    assert not np.array_equal(again[0].values["curve"], again[1].values["curve"])
    other = run_grid(chapter(), "other", experiment, CONFIGS, seeds=[5])
    assert not np.array_equal(first[0].values["curve"], other[0].values["curve"])


def test_resume_computes_only_what_is_missing(root):
    expected = serial_bytes(root)
    for path in root.rglob("*bicycle*s1.*"):
        path.unlink()
    results = run_grid(chapter(), "grid", experiment, CONFIGS)
    assert files(root / "data") == expected
    assert (report(root)["computed"], report(root)["read"]) == (1, 3)
    assert results[0].values["n"].shape == () and results[0].values["names"].tolist() == ["a", "bc"]


SCRIPT = """
import json, sys, time
from pathlib import Path
import numpy as np
from lifelong_lib.reproduction.runs import Chapter, ReproductionError, run_grid

def slow(config, seed):
    time.sleep(config["pause"])
    return {"x": np.random.default_rng(seed).normal(size=3)}

if __name__ == "__main__":
    try:
        run_grid(Chapter(4, "quick", 10, 2), "slow", slow, [{"pause": 0.15}])
    except ReproductionError as error:
        sys.exit(f"error: {error}")
"""


def start(root, **more):
    (root / "script.py").write_text(SCRIPT)
    here = str(Path(__file__).parents[1])
    environment = os.environ | {"LIFELONG_ROOT": str(root), "PYTHONPATH": here}
    command = [sys.executable, str(root / "script.py")]
    return subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, text=True, start_new_session=True, **more)


def stop_in_the_middle(root, send):
    process = start(root)
    while len(files(root, "*.json")) < 2:
        assert process.poll() is None, process.stderr.read()
        time.sleep(0.02)
    send(process)
    _, errors = process.communicate(timeout=20)
    stored = files(root / "data", "*.json")
    assert 2 <= len(stored) < 10
    return process.returncode, errors, stored


def test_killed_in_the_middle_then_resumed_gives_the_bytes_of_an_uninterrupted_run(root, tmp_path_factory):
    code, _, stored = stop_in_the_middle(root, lambda process: process.kill())
    assert code == -signal.SIGKILL
    assert start(root).wait(timeout=30) == 0
    assert report(root, name="slow")["computed"] == 10 - len(stored)
    assert (
        stored.items() <= files(root / "data", "*.json").items()
    )  # records hold wall times: rewritten ones would differ
    whole = tmp_path_factory.mktemp("whole")
    assert start(whole).wait(timeout=30) == 0
    assert files(root / "data") == files(whole / "data")


def test_interrupt_ends_with_one_line_and_keeps_what_was_stored(root):
    code, errors, stored = stop_in_the_middle(root, lambda process: os.killpg(process.pid, signal.SIGINT))
    assert code == 1
    last = errors.replace("\r", "\n").strip().splitlines()
    assert "Traceback" not in errors and last[-1].startswith("error: interrupted: ")
    assert f"{len(stored)} of 10" in last[-1] and not list(root.rglob("*.part"))


# ---- what is stored ----


@pytest.mark.parametrize("suffix", [".npz", ".json"])
@pytest.mark.parametrize(
    "damage", [lambda data: data[: len(data) // 2], lambda data: b"", lambda data: data[:-9] + b"123456789"]
)
def test_damaged_files_are_named_set_aside_and_recomputed(root, capsys, suffix, damage):
    expected = serial_bytes(root)
    victim = next(root.rglob(f"*cart-pole*s1{suffix}"))
    victim.write_bytes(damage(victim.read_bytes()))
    run_grid(chapter(), "grid", experiment, CONFIGS)
    assert files(root / "data") == expected and report(root)["computed"] == 1
    assert "domain=cart-pole,tasks=3-s1.npz is damaged" in capsys.readouterr().err
    assert victim.with_name(victim.name + ".damaged").exists()


def test_a_file_of_another_run_is_not_read(root):
    expected = serial_bytes(root)
    for suffix in (".npz", ".json"):
        one, other = (next(root.rglob(f"*cart-pole*s{seed}{suffix}")) for seed in (0, 1))
        other.write_bytes(one.read_bytes())
    run_grid(chapter(), "grid", experiment, CONFIGS)
    assert files(root / "data") == expected


def test_a_record_without_its_arrays_is_set_aside(root):
    expected = serial_bytes(root)
    next(root.rglob("*.npz")).unlink()
    run_grid(chapter(), "grid", experiment, CONFIGS)
    assert files(root / "data") == expected and len(files(root, "*.damaged")) == 1


def test_record_says_what_made_the_run(root):
    serial_bytes(root)
    record = json.loads(next(root.rglob("*cart-pole*s1.json")).read_text())
    assert (record["config"], record["seed"], record["chapter"]) == (CONFIGS[0], 1, 4)
    assert record["versions"]["numpy"] == np.__version__ and record["seconds"] > 0
    assert set(record["fingerprint"]) >= {"function experiment", "function helper", "global SCALE"}


@pytest.mark.parametrize(
    "values, key",
    [({"net": object()}, "net"), ({"ragged": [[1], [1, 2]]}, "ragged"), ({"none": None}, "none"), ({"a/b": 1}, "a/b")],
)
def test_values_that_are_no_arrays_are_refused_by_name(root, values, key):
    def returns(config, seed):
        return {"fine": 1} | ({"net": object()} if config["key"] == "net" else json.loads(config["values"]))

    config = {"key": key, "values": json.dumps(values, default=str)}
    with pytest.raises(ReproductionError, match=key) as caught:
        run_grid(chapter(), "bad", returns, [config])
    assert "\n" not in str(caught.value) and not files(root / "data")


@pytest.mark.parametrize("failing", [errno.ENOSPC, errno.EACCES])
def test_full_disk_is_one_line_and_leaves_no_part_behind(root, monkeypatch, failing):
    def replace(part, path):
        raise OSError(failing, os.strerror(failing))

    monkeypatch.setattr(runs.os, "replace", replace)
    with pytest.raises(ReproductionError, match="disk is full" if failing == errno.ENOSPC else "Permission") as caught:
        run_grid(chapter(), "grid", experiment, CONFIGS)
    assert "\n" not in str(caught.value) and not files(root, "*.part") and not files(root)


@pytest.mark.parametrize("workers", [1, 2])
def test_a_failing_run_is_named_and_the_others_stay(root, workers):
    with pytest.raises(ReproductionError, match="'steps' failed at .*2.*, seed 0: ZeroDivisionError: no tasks left$"):
        run_grid(chapter(workers=workers), "steps", fail_at_two, [{"step": 1}, {"step": 2}, {"step": 3}], seeds=1)
    if workers == 1:
        assert set(files(root / "data")) == {"step=1-s0.npz"}


def test_a_dying_worker_is_one_line(root):
    def die(config, seed):
        os._exit(3)

    with pytest.raises(ReproductionError, match="a worker process died"):
        run_grid(chapter(workers=2), "die", die, [{}])


def test_runs_do_not_see_each_other(root):
    memory = [0]

    def remembering(config, seed):
        memory[0] += 1
        return {"calls": memory[0]}

    assert run_grid(chapter(), "memory", remembering, [{}], seeds=3).stack("calls").tolist() == [1, 1, 1]


@pytest.mark.parametrize("workers", [1, 2])
def test_runs_use_one_thread(root, workers):
    def threads(config, seed):
        import threadpoolctl

        return {"threads": max(pool["num_threads"] for pool in threadpoolctl.threadpool_info())}

    assert run_grid(chapter(workers=workers), "threads", threads, [{}]).stack("threads").tolist() == [1, 1]

    def greedy(config, seed):
        import threadpoolctl

        threadpoolctl.threadpool_limits(2)
        return {"x": 1}

    with pytest.raises(ReproductionError, match="one thread"):
        run_grid(chapter(workers=workers), "greedy", greedy, [{}])


# ---- stale results ----


def notebook(code, name="notebook"):
    """A module made from text, readable by inspect like a notebook's cells."""
    import linecache
    import types

    module, code = types.ModuleType(name), textwrap.dedent(code)
    file = f"<cell {hash(code)}>"
    linecache.cache[file] = (len(code), None, code.splitlines(True), file)
    exec(compile(code, file, "exec"), module.__dict__)
    return module.experiment


CELL = '''
import numpy as np
rate = 0.5
unused = 1
METHODS = {"half": lambda x: x / 2}
def inner(x):
    return x * rate
def helper(x):
    # a comment
    return inner(x) + 1
def experiment(config, seed):
    """What it does."""
    return {"x": METHODS["half"](np.sum([helper(i) for i in range(3)]))}
'''


@pytest.mark.parametrize(
    "old, new, cause",
    [
        ('"""What it does."""', '"""Better words."""', None),
        ("# a comment", "# another", None),
        ("    return inner(x) + 1", "    return (inner(x)  +  1)", None),
        ("unused = 1", "unused = 2", None),
        ("rate = 0.5", "rate = 0.25", "global rate changed"),
        ("x * rate", "rate * x", "function inner changed"),
        ("range(3)", "range(4)", "function experiment changed"),
        ("x / 2", "x / 3", "function <lambda> changed"),
        ('seed):\n    """What', 'seed, n=rate):\n    """What', "function experiment changed"),
    ],
)
def test_fingerprint_follows_the_notebook(old, new, cause):
    assert old in CELL
    found = fingerprint.changes(
        fingerprint.fingerprint(notebook(CELL)), fingerprint.fingerprint(notebook(CELL.replace(old, new)))
    )
    assert found == ([cause] if cause else [])


def test_fingerprint_sees_new_and_gone_parts_and_defaults():
    parts = [fingerprint.fingerprint(notebook(f"n = {n}\ndef experiment(config, seed, k=n): return k")) for n in (1, 2)]
    assert fingerprint.changes(*parts) == ["function experiment changed"]
    assert fingerprint.changes({"module a": "1"}, {"module b": "1"}) == ["module a is gone", "module b is new"]


@pytest.mark.parametrize(
    "value, word",
    [
        ("object()", "a object"),
        ("open('/dev/null')", "TextIOWrapper"),
        ("type('Net', (), {'__module__': 'notebook'})", "class"),
    ],
)
def test_values_that_cannot_be_followed_are_refused(value, word):
    with pytest.raises(ReproductionError, match=f"'thing'.*{word}"):
        fingerprint.fingerprint(notebook(f"thing = {value}\ndef experiment(config, seed): return thing"))
    with pytest.raises(ReproductionError, match="made with def"):
        fingerprint.fingerprint(len)


@pytest.fixture
def library(tmp_path, monkeypatch):
    """A library of four modules: the notebook imports a, a imports sub.b, sub.b imports ..c relatively, d is unrelated."""
    package = tmp_path / "fakelib"
    (package / "sub").mkdir(parents=True)
    sources = {"__init__": "", "a": "from fakelib.sub import b\ndef f(x): return b.g(x)", "c": "def h(x): return x",
               "d": "", "sub/__init__": "", "sub/b": "from .. import c\ndef g(x):\n    return c.h(x)"}  # fmt: skip
    for name, text in sources.items():
        (package / f"{name}.py").write_text(text)
    monkeypatch.setattr(fingerprint, "LIBRARY", "fakelib")
    monkeypatch.setattr(fingerprint, "SOURCES", tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    importlib.invalidate_caches()
    yield package
    for name in [name for name in sys.modules if name.startswith("fakelib")]:
        del sys.modules[name]


@pytest.mark.parametrize("how", ["from fakelib import a", "from fakelib.a import f", "import fakelib.a as a"])
def test_fingerprint_reaches_library_modules_through_their_imports(library, how):
    call = "f(1)" if how.endswith(" f") else "a.f(1)"
    for text in (f"{how}\ndef experiment(config, seed):\n    return {call}",
                 f"def experiment(config, seed):\n    {how}\n    return {call}"):  # fmt: skip
        experiment = notebook(text)
        before = fingerprint.fingerprint(experiment)
        assert {p for p in before if p.startswith("module")} == {f"module fakelib.{m}" for m in ("a", "c", "sub.b")}
        (library / "d.py").write_text("x = 1")
        (library / "sub" / "b.py").write_text('"""Words."""\nfrom .. import c\ndef g(x):  # words\n    return c.h(x)')
        assert fingerprint.fingerprint(experiment) == before
        (library / "c.py").write_text(f"def h(x): return x + {len(text)}")
        assert fingerprint.changes(before, fingerprint.fingerprint(experiment)) == ["module fakelib.c changed"]


def test_a_whole_package_is_refused(library):
    with pytest.raises(ReproductionError, match="whole package"):
        fingerprint.fingerprint(notebook("import fakelib.a\ndef experiment(config, seed): return fakelib.a.f(1)"))


@pytest.mark.parametrize("profile", ["smoke", "quick"])
def test_stale_runs_are_recomputed(root, monkeypatch, profile):
    run_grid(chapter(profile), "grid", experiment, CONFIGS)
    monkeypatch.setitem(globals(), "SCALE", 4.0)
    doubled = run_grid(chapter(profile), "grid", experiment, CONFIGS)
    assert report(root, profile)["computed"] == 4 and report(root, profile)["causes"] == {"global SCALE changed": 4}
    monkeypatch.setitem(globals(), "SCALE", 2.0)
    single = run_grid(chapter(profile), "grid", experiment, CONFIGS)
    np.testing.assert_array_equal(doubled[0].values["curve"], 2 * single[0].values["curve"])


def test_paper_keeps_and_counts_stale_runs_unless_fresh(root, monkeypatch, options, capsys):
    run_grid(chapter("paper"), "grid", experiment, CONFIGS)
    stored = files(root / "data")
    monkeypatch.setitem(globals(), "SCALE", 4.0)
    kept = chapter("paper")
    run_grid(kept, "grid", experiment, CONFIGS)
    assert files(root / "data") == stored and report(root, "paper")["stale"] == 4
    assert "4 of 4 runs" in capsys.readouterr().err and "stale:    4 of 4 runs" in run_card(kept)
    options(fresh=True)
    run_grid(chapter("paper"), "grid", experiment, CONFIGS)
    assert files(root / "data") != stored and report(root, "paper")["stale"] == 0


# ---- plan and audit ----


def test_plan_computes_nothing_and_predicts(root, options, monkeypatch):
    plan, log = root / "plan.jsonl", root / "log"
    configs = [{"log": str(log), "n": n} for n in range(4)]
    run_grid(chapter(), "count", count_calls, configs[:1], seeds=2)
    for path in root.rglob("*.json"):
        record = json.loads(path.read_text())
        path.write_text(json.dumps(record | {"seconds": 3.0}))
    options(plan=str(plan))
    with pytest.raises(NotStored, match="6 of 8"):
        run_grid(chapter(workers=2), "count", count_calls, configs, seeds=2, makes=["F4.2", "C4.2"])
    run_grid(chapter(), "count", count_calls, configs[:1], seeds=2)
    with pytest.raises(NotStored):
        run_grid(chapter(), "never", count_calls, configs, seeds=2)
    first, second, third = map(json.loads, plan.read_text().splitlines())
    assert log.read_text() == "xx" and first["makes"] == ["F4.2", "C4.2"]
    assert [first[key] for key in ("wanted", "stored", "stale", "missing", "seconds")] == [8, 2, 0, 6, 9.0]
    assert second["seconds"] == 0 and third["seconds"] is None
    costs = root / "figures" / "reference" / "quick" / "unit_costs.json"
    runs.write_atomically(costs, json.dumps({"ch04/never": 0.5}))
    with pytest.raises(NotStored):
        run_grid(chapter(), "never", count_calls, configs, seeds=2)
    assert json.loads(plan.read_text().splitlines()[-1])["seconds"] == 4.0


def test_plan_leaves_damaged_files_alone(root, options):
    serial_bytes(root)
    victim = next(root.rglob("*.npz"))
    victim.write_bytes(b"")
    options(plan=str(root / "plan.jsonl"))
    with pytest.raises(NotStored, match="1 of 4"):
        run_grid(chapter(), "grid", experiment, CONFIGS)
    assert victim.exists() and not files(root, "*.damaged")


def test_audit_tells_equal_from_different(root, options, monkeypatch):
    serial_bytes(root)
    run_grid(chapter(), "second", experiment, CONFIGS)
    options(audit=8)
    for name in ("grid", "second"):
        run_grid(chapter(), name, experiment, CONFIGS)
        monkeypatch.setitem(globals(), "SCALE", 4.0)  # the second grid is stale, its curves come out differently
    rows = [json.loads(line) for line in (root / "figures/latest/quick/audit.jsonl").read_text().splitlines()]
    assert [(row["same"], row["stale"], row["differs"]) for row in rows] == [(True, False, [])] * 4 + [
        (False, True, ["curve"])
    ] * 4
    with pytest.raises(NotStored, match="2 of 6"):
        run_grid(chapter(seeds=3), "grid", experiment, CONFIGS)


def test_audit_draws_k_runs_of_the_chapter(root, options):
    serial_bytes(root)
    run_grid(chapter(), "second", experiment, CONFIGS)
    options(audit=3)
    for name in ("grid", "second"):
        run_grid(chapter(), name, experiment, CONFIGS)
    assert len((root / "figures/latest/quick/audit.jsonl").read_text().splitlines()) == 3


# ---- asking ----


@pytest.mark.parametrize(
    "configs",
    [[], [{"a": [1]}], [{"a": np.nan}], [{"a": 1}, {"a": 1}], [{"a": 1, "b": 2}, {"b": 2, "a": 1}], ["a"], [{"a b": 1}],
     [{"a": "x"}, {"a": "X"}], [{"a": np.int64(1)}]],
)  # fmt: skip
def test_bad_configurations_are_refused(root, configs):
    with pytest.raises(ReproductionError):
        run_grid(chapter(), "grid", experiment, configs)


@pytest.mark.parametrize("seeds", [0, -1, 1.5, "3", [], [1, 1], [-1], [True]])
def test_bad_seeds_are_refused(root, seeds):
    with pytest.raises(ReproductionError, match="seeds"):
        run_grid(chapter(), "grid", experiment, CONFIGS, seeds=seeds)


def test_different_configurations_never_share_a_file():
    values = [
        1,
        1.0,
        "1",
        True,
        "true",
        None,
        "null",
        "",
        "a b",
        "a_b",
        "a,c=1",
        "x" * 300,
        "x" * 301,
        "~",
        "1.0",
        "é",
        -0.0,
        0.0,
    ]
    configs = [{"a": value} for value in values] + [{}, {"a": "a", "c": 1}, {"a": 1, "b": 1}]
    names = [runs._file_name(config) for config in configs]
    assert len(set(names)) == len(names) and all(
        len(name) < 130 and name.isascii() and "/" not in name for name in names
    )
    assert runs._file_name({"tasks": 40, "domain": "cart-pole"}) == "domain=cart-pole,tasks=40"


@pytest.mark.parametrize(
    "given",
    [
        {"number": 9},
        {"number": True},
        {"profile": "full"},
        {"seeds": -1},
        {"seeds": 2.0},
        {"workers": 0},
        {"output_dir": None},
    ],
)
def test_bad_parameters_are_refused(root, given):
    with pytest.raises(ReproductionError, match=repr(next(iter(given.values())))):
        Chapter(**({"number": 4, "profile": "quick", "seeds": 1} | given))


@pytest.mark.parametrize(
    "text", ["{", "[]", '{"backend": "slurm"}', '{"fersh": true}', '{"audit": "5"}', '{"audit": 0}', '{"fresh": 1}']
)
def test_bad_options_are_refused(root, monkeypatch, text):
    monkeypatch.setenv("LIFELONG_OPTIONS", text)
    with pytest.raises(ReproductionError):
        chapter()


def test_an_absent_dask_scheduler_is_one_line(root, options):
    options(backend="dask", address="nowhere")
    with pytest.raises(ReproductionError, match="no Dask scheduler answers at nowhere"):
        run_grid(chapter(), "grid", experiment, CONFIGS)


def test_where_and_stack_name_what_is_missing(root):
    results = run_grid(chapter(seeds=3), "grid", experiment, CONFIGS)
    assert results.stack("curve", domain="bicycle").shape == (3, 2, 4) and len(results.where(domain="bicycle")) == 3
    for key, config, word in [("curve", {"domain": "boat"}, "cart-pole"), ("curve", {}, "2 configurations"),
                              ("curv", {"tasks": 2}, "curve"), ("curve", {"task": 2}, "task")]:  # fmt: skip
        with pytest.raises(ReproductionError, match=word):
            results.stack(key, **config)


def test_run_card_has_no_dates_and_is_the_same_twice(root):
    card = run_card(chapter())
    assert card == run_card(chapter()) and f"numpy {np.__version__}" in card and "quick" in card and "loky" in card
    assert str(time.localtime().tm_year) not in card.replace("versions", "")


def test_the_notebook_does_not_keep_the_progress_bar(root, monkeypatch):
    import nbformat
    from nbclient import NotebookClient

    monkeypatch.setenv("LIFELONG_ROOT", str(root))
    monkeypatch.delenv("PYTEST_CURRENT_TEST")  # ipykernel does not catch the standard error of a test
    cells = ["from lifelong_lib.reproduction.runs import Chapter, run_grid\nn = 3",
             "def half(x): return x / 2\ndef learn(config, seed): return {'x': half(n)}",
             "results = run_grid(Chapter(4, 'smoke', 2, 2), 'learn', learn, [{'tasks': 1}])\nresults.stack('x')"]  # fmt: skip
    book = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(text) for text in cells])
    NotebookClient(book, timeout=60, resources={"metadata": {"path": str(Path(__file__).parents[1])}}).execute()
    outputs = [output for cell in book.cells for output in cell.outputs]
    assert [output.data["text/plain"] for output in outputs] == ["array([1.5, 1.5])"]
    record = json.loads(next(root.rglob("*s1.json")).read_text())
    assert set(record["fingerprint"]) == {"function learn", "function half", "global n"}


def test_backends_refuse_an_unnamed_result():
    with pytest.raises(ReproductionError, match="dict"):
        backends._arrays([1, 2])
