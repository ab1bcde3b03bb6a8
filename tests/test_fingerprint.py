"""What makes a result stale: code and values it uses, followed through the notebook and the library; words do not."""

import importlib
import linecache
import sys
import textwrap
import types

import pytest

from lifelong_lib.reproduction import fingerprint as module
from lifelong_lib.reproduction.files import ReproductionError
from lifelong_lib.reproduction.fingerprint import changes, fingerprint

CELL = '''
import numpy as np
rate = 0.5
unused = 1
RANGES = {"mass": (0.1, [1.0, 2.0]), "kind": "light", "limit": None}
if rate:
    def half(x):
        return x / 2
METHODS = {"half": half, "add": np.add}
def inner(x):
    return x * rate
def helper(x):
    # a comment
    return inner(x) + 1
def experiment(config, seed):
    """What it does."""
    def local(i):
        return helper(i)
    return {"x": METHODS["half"](np.sum([local(i) for i in range(3)])), "m": RANGES["mass"][0]}
'''


def notebook(code):
    """The experiment of a module made from text that inspect can read, as it can a notebook's cells."""
    space, code = types.ModuleType("notebook"), textwrap.dedent(code)
    file = f"<cell {hash(code)}>"
    linecache.cache[file] = (len(code), None, code.splitlines(True), file)
    exec(compile(code, file, "exec"), space.__dict__)
    return space.experiment


@pytest.mark.parametrize("old, new, causes", [
    ('"""What it does."""', '"""Better words."""', []),
    ("# a comment", "# another", []),
    ("return inner(x) + 1", "return (inner(x)  +  1)", []),
    ("unused = 1", "unused = 2", []),
    ("rate = 0.5", "rate = 0.25", ["global rate changed"]),
    ("rate = 0.5", "rate = True", ["global rate changed"]),
    ("[1.0, 2.0]", "[1.0, 2.5]", ["global RANGES changed"]),
    ("light", "heavy", ["global RANGES changed"]),
    ("None", "False", ["global RANGES changed"]),
    ("np.add", "np.subtract", ["global METHODS changed"]),
    ("x * rate", "rate * x", ["function inner changed"]),
    ("x / 2", "x / 3", ["function half changed"]),
    ("range(3)", "range(4)", ["function experiment changed"]),
    ("seed):", "seed, n=rate):", ["function experiment changed"]),
    ("x * rate", "x * unused", ["function inner changed", "global rate is gone", "global unused is new"]),
])  # fmt: skip
def test_fingerprint_follows_the_notebook(old, new, causes):
    assert old in CELL
    before, after = fingerprint(notebook(CELL)), fingerprint(notebook(CELL.replace(old, new)))
    assert changes(before, after) == causes


def test_values_taken_at_definition_count():
    cells = [f"n = {n}\ndef experiment(config, seed, k=n): return k" for n in (1, 2)]
    assert changes(*map(fingerprint, map(notebook, cells))) == ["function experiment changed"]


WRAPPED = """import functools
def keep(f):
    @functools.wraps(f)
    def wrapper(*given): return f(*given)
    return wrapper
@{}
def thing(x): return x
def experiment(config, seed): return thing(1)"""


@pytest.mark.parametrize("code, word", [
    ("def make(n):\n    def run(): return n\n    return run\nthing = make(1)", "made with def at the top of a cell"),
    ("thing = lambda x: x", "made with def at the top of a cell"), (WRAPPED.format("keep"), "made with def"),
    (WRAPPED.format("functools.cache"), "wrapped function"),
    ("def f(): return 1\nthing = f\ndef f(): return 2", "a second function f, .* another name"),
])  # fmt: skip
def test_functions_that_cannot_be_followed_are_refused_by_name(code, word):
    if "experiment" not in code:
        code += "\ndef experiment(config, seed): return f() + thing()"
    with pytest.raises(ReproductionError, match=f"'experiment' reads 'thing', .*{word}"):
        fingerprint(notebook(code))


@pytest.mark.parametrize("value, word", [
    ("object()", "a object"), ("__import__('numpy').random.default_rng()", "Generator"), ("{0, 8}", "a set"),
    ("__import__('numpy').ones(2)", "a ndarray"), ("__import__('functools').partial(int, '3')", "a partial"),
    ("__import__('numpy').random.default_rng(1).normal", "a method"),
    ("__import__('lifelong_lib.transfer.ella').transfer.ella.ELLA(2).partial_fit", "a method"),
    ("type('Net', (), {'__module__': 'notebook'})", "class of the notebook"), ("[{'deep': iter([])}]", "iterator"),
    ("__import__('lifelong_lib.reproduction.runs').reproduction.runs.Chapter(4, 'quick', 1)", "a Chapter"),
])  # fmt: skip
def test_values_that_cannot_be_followed_are_refused_by_name(value, word):
    with pytest.raises(ReproductionError, match=f"'experiment' reads 'thing', .*{word}") as caught:
        fingerprint(notebook(f"thing = {value}\ndef experiment(config, seed): return thing"))
    assert "\n" not in str(caught.value)


def test_an_experiment_must_be_a_def():
    for no_def in (len, lambda config, seed: {}, "text"):
        with pytest.raises(ReproductionError, match="made with def"):
            fingerprint(no_def)


@pytest.fixture
def library(tmp_path, monkeypatch):
    """Four modules: the notebook imports a, which imports sub.b, which imports ..c relatively; d is beside the way."""
    package = tmp_path / "fakelib"
    (package / "sub").mkdir(parents=True)
    sources = {"__init__": "", "a": "from fakelib.sub import b\ndef f(x): return b.g(x)", "c": "def h(x): return x",
               "d": "", "sub/__init__": "", "sub/b": "from .. import c\ndef g(x):\n    return c.h(x)"}  # fmt: skip
    for name, text in sources.items():
        (package / f"{name}.py").write_text(text)
    monkeypatch.setattr(module, "LIBRARY", "fakelib")
    monkeypatch.setattr(module, "SOURCES", tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    importlib.invalidate_caches()
    yield package
    for name in [name for name in sys.modules if name.startswith("fakelib")]:
        del sys.modules[name]


@pytest.mark.parametrize("where", ["{how}\ndef experiment(config, seed):\n    return {call}",
                                   "def experiment(config, seed):\n    {how}\n    return {call}"])  # fmt: skip
@pytest.mark.parametrize("how, call", [("from fakelib import a", "a.f(1)"), ("from fakelib.a import f", "f(1)"),
                                       ("import fakelib.a as a", "a.f(1)")])  # fmt: skip
def test_fingerprint_reaches_library_modules_through_their_imports(library, how, call, where):
    experiment = notebook(where.format(how=how, call=call))
    before = fingerprint(experiment)
    assert {part for part in before if "module" in part} == {f"module fakelib.{name}" for name in ("a", "c", "sub.b")}
    (library / "d.py").write_text("x = 1")
    (library / "sub" / "b.py").write_text('"""Words."""\nfrom .. import c\ndef g(x):  # words\n    return c.h(x)')
    assert fingerprint(experiment) == before
    (library / "c.py").write_text("def h(x): return x + 1")
    assert changes(before, fingerprint(experiment)) == ["module fakelib.c changed"]


@pytest.mark.parametrize("code, package", [
    ("import fakelib.a\ndef experiment(config, seed): return fakelib.a.f(1)", "fakelib"),
    ("def experiment(config, seed):\n    from fakelib import sub\n    return sub.b.g(1)", "fakelib.sub"),
])  # fmt: skip
def test_a_whole_package_is_refused(library, code, package):
    with pytest.raises(ReproductionError, match=f"whole package.*from {package} import"):
        fingerprint(notebook(code))


def test_constants_of_the_library_count(library):
    text = "import dataclasses\n@dataclasses.dataclass\nclass Range:\n    low: float\nMASS = Range({})"
    found = []
    for low in (1.0, 2.0):
        (library / "d.py").write_text(text.format(low))
        sys.modules.pop("fakelib.d", None)
        importlib.invalidate_caches()
        sys.dont_write_bytecode = True
        found.append(fingerprint(notebook("from fakelib.d import MASS\ndef experiment(config, seed): return MASS.low")))
    assert changes(*found) == ["global MASS changed", "module fakelib.d changed"]
