"""Comparison with the reference, acceptance, provenance and the book."""

import hashlib
import json
import re
import shutil
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pytest
from conftest import command, write_notebook
from docutils import nodes

from lifelong_lib.reproduction import book
from lifelong_lib.reproduction.claims import ledger
from lifelong_lib.reproduction.comparison import compare, comparison_lines
from lifelong_lib.reproduction.files import ROOT, ReproductionError, read_json, read_toml, write_json
from lifelong_lib.reproduction.labels import order
from lifelong_lib.reproduction.report import accept, chapter_verdicts, directions, reading, standings


def results(folder: Path, value: str = "1.0", verdict: str = "holds", pixel: float = 0.0) -> Path:
    """A finished run with one figure and one claim."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "F4.1.csv").write_text(f"x,y\n1,{value}\n2,5.0\n")
    plt.imsave(folder / "F4.1.png", np.full((4, 5), pixel) * np.eye(4, 5), vmin=0, vmax=1)
    write_json(folder / "claims.json", [{"id": "C4.1", "verdict": verdict}])
    write_json(folder / "unit_costs.json", {"ch04/a": [1.0, 5], "ch04": 6.0, "pace": 2.0})
    return folder


def test_accepting_keeps_the_chapters_that_were_not_run(tmp_path):
    reference = results(tmp_path / "reference", value="7.0")
    for name in ("F4.2.csv", "F2.1.csv"):
        (reference / name).write_text("a\n1\n")
    write_json(reference / "claims.json", [{"id": "C4.9", "verdict": "holds"}, {"id": "C2.1", "verdict": "holds"}])
    write_json(reference / "unit_costs.json", {"ch02/b": [2.0, 7], "ch04/a": [9.0, 7], "pace": 1.0})
    latest = results(tmp_path / "latest")
    accept(latest, reference)
    assert sorted(path.name for path in reference.glob("*.csv")) == ["F2.1.csv", "F4.1.csv"]
    assert (reference / "F4.1.csv").read_bytes() == (latest / "F4.1.csv").read_bytes()
    assert [row["id"] for row in read_json(reference / "claims.json", [])] == ["C2.1", "C4.1"]
    costs = {"ch02/b": [2.0, 7], "ch04/a": [0.5, 5], "ch04": 3.0, "pace": 1.0}  # of the reference's faster machine
    assert read_json(reference / "unit_costs.json", {}) == costs
    write_json(reference / "unit_costs.json", {"ch04/a": [9.0, 0]})  # an old one, of a machine that nobody knows
    accept(latest, reference)
    assert read_json(reference / "unit_costs.json", {}) == read_json(latest / "unit_costs.json", {})
    assert comparison_lines(compare(latest, reference))[0].startswith("1 of 1")  # chapter 2 was not run


def test_nothing_to_accept_and_damaged_files_are_named(tmp_path):
    with pytest.raises(ReproductionError, match="nothing in"):
        accept(tmp_path / "latest", tmp_path / "reference")
    (tmp_path / "claims.json").write_text("[{")
    with pytest.raises(ReproductionError, match="claims.json is damaged"):
        read_json(tmp_path / "claims.json", [])
    assert sorted(["F4.10", "F4.9", "C4.1"], key=order) == ["C4.1", "F4.9", "F4.10"]


def test_a_chapter_begins_with_the_verdicts_of_the_references():
    rows = chapter_verdicts(2).rows
    assert [row["claim"] for row in rows] == [name for name, entry in ledger().items() if entry["chapter"] == 2]
    judged = {row["id"]: row for row in read_json(ROOT / "figures" / "reference" / "paper" / "claims.json", [])}
    assert all(row["verdict"] == f"{judged[row['claim']]['verdict']} at paper" for row in rows)
    assert all(len(row["because"]) <= 240 for row in rows)
    with pytest.raises(ReproductionError, match="chapter 1 has no claims"):
        chapter_verdicts(1)


def test_the_book_needs_no_network_and_shows_the_results(project):
    pages = project / "figures" / "latest" / "quick" / "book"
    for path in [*pages.rglob("*.html"), *pages.rglob("*.css")]:
        text = path.read_text()
        loaded = re.findall(r'(?:src|srcset)="([^"]*)"', text) + re.findall(r"<link[^>]*href=\"([^\"]*)\"", text)
        loaded += re.findall(r"url\(\s*[\"']?([^\"')]*)", text) + re.findall(r"@import[^;]*", text)
        assert not [address for address in loaded if re.match(r"(https?:)?//", address)], path
    front = (pages / "index.html").read_text()
    for expected in ("_static/latest/F4.1.png", "this run", "1 holds", "TaDeLL",
                     'href="chapters/ch04_demonstration.html#C4.1"', "data identical; picture identical", "A curve"):
        assert expected in front, expected
    assert "_static/reference/F4.1.png" not in front, "the same picture stands there once"
    for source in re.findall(r'src="([^"?]*)', front):
        assert (pages / source).exists(), source
    chapter = (pages / "chapters" / "ch04_demonstration.html").read_text()
    assert all(f'<a id="{name}"></a>' in chapter for name in ("F4.1", "T4.1", "C4.1"))
    assert 'data-default-mode="auto"' in front, "without one the theme complains in the browser's console"
    assert "<math" in chapter and "(4.1)" in chapter and "MathJax" not in chapter
    assert "The slope is above 2." in (pages / "claims.html").read_text()
    assert all(theirs not in chapter + front and ours in chapter + front for theirs, ours in book.REACHABLE.items())


def test_a_chapter_shows_results_first_folds_drawing_and_explains_below_a_verdict(tmp_path):
    cells = ["# A chapter", "from a import (\n    b,\n)\nimport c", "fig, axes = panels(1)\naxes[0].plot()",
             "def life(config):\n    return 1", 'check_claim(chapter, "C4.1", parts)']
    notebook = write_notebook(tmp_path / "ch04_some.ipynb", cells, None)
    claim = {"id": "C4.1", "chapter": 4, "statement": "a | b", "verdict": "contradicted", "profile": "paper"}
    page = book._chapter_page(notebook, [claim, claim | {"chapter": 5}], {"C4.1": (claim, ["Because."])})
    assert [cell.source.split("\n")[0] for cell in page.cells[:2]] == ["# A chapter", "## What came of it"]
    assert page.cells[1].source.count("a \\| b") == 1, "another chapter's claims stand elsewhere"
    assert ["hide-input" in cell.metadata.get("tags", []) for cell in page.cells[2:5]] == [True, True, False]
    assert "Because." in page.cells[-2].source and "why?" in page.cells[-2].source
    assert page.cells[-1].source.count("<summary>") == 5


def test_what_a_profile_shrinks_is_shown_as_a_table(tmp_path):
    lines = ['chapter = Chapter(4, profile, seeds or {"smoke": 2, "quick": 4, "paper": 24}.get(profile, 1), workers)',
             "tasks = chapter.pick(smoke=5, quick=14, paper=40)  # to learn | to know",
             "n = chapter.pick(smoke=1, quick=2, paper=3)",
             "lives = seeds or chapter.pick(smoke=2, quick=4, paper=48)  # where tails are heavy",
             "a, b = chapter.pick(smoke=(1, 2), quick=(3, 4), paper=(5, 6))  # two"]  # fmt: skip
    notebook = write_notebook(tmp_path / "ch04_some.ipynb", ["# A chapter", "\n".join(lines), lines[1]], None)
    table, cell, alone = book._chapter_page(notebook, [], {}).cells[1:4]
    assert [row.split(" | ")[0] for row in table.source.splitlines()[2:]] == \
        ["| `seeds`", "| `tasks`", "| `n`", "| `lives`", "| `a, b`"]
    assert "| `tasks` | 5 | 14 | 40 | to learn \\| to know |" in table.source
    assert "| `seeds` | 2 | 4 | 24 |" in table.source and "| (1, 2) | (3, 4) | (5, 6) | two |" in table.source
    assert cell.metadata["tags"] == ["hide-input"] and "tags" not in alone.metadata, "one such line stays code"


def test_every_chapter_with_experiments_of_the_thesis_asks_five_questions():
    asked = [question["chapter"] for question in read_toml(book.ROOT / "data" / "thesis" / "readers.toml")["question"]]
    assert {chapter: asked.count(chapter) for chapter in asked} == dict.fromkeys(range(2, 8), 5)


@pytest.mark.parametrize("rows, said", [
    ("one,A,0,1\none,A,5,2.5\none,B,0,9\none,B,5,-3\ntwo,A,7,0\n", "one: highest A (2.5), lowest B (-3)"),
    (",A,0,1\n,A,3,2\n,B,3,1\n", "highest A (2), lowest B (1)"),
    (",A,SM,1\n,B,SM,2\n,A,CP,3\n,B,CP,1\n", "SM: highest B (2), lowest A (1); CP: highest A (3), lowest B (1)"),
    (",A,SM,1\n,A,CP,3\n,A,BK,2\n", "highest CP (3), lowest SM (1)"),  # bars of one series
    ("x,A,,1\nx,B,,2\n", "x: highest B (2), lowest A (1)"),
])  # fmt: skip
def test_a_figure_is_read_where_its_curves_end(tmp_path, rows, said):
    (tmp_path / "F4.1.csv").write_text("panel,series,x,mean\n" + rows)
    assert reading(tmp_path / "F4.1.csv") == said


def test_below_a_figure_stands_what_it_shows(tmp_path):
    cells = ["# A", 'save_figure(chapter, "F4.1", fig)']
    notebook = write_notebook(tmp_path / "notebooks" / "ch04_some.ipynb", cells, None)
    (tmp_path / "F4.1.csv").write_text("panel,series,x,mean\n<a>,A,3,2\n<a>,B,3,1\n")
    page = book._chapter_page(notebook, [], {})
    assert "where curves end: &lt;a&gt;: highest A (2), lowest B (1).</p>" in page.cells[-2].source


def test_pictures_are_not_read(tmp_path):
    (tmp_path / "F4.1.csv").write_text("panel,row,column,value\n,0,0,1\n")
    assert reading(tmp_path / "F4.1.csv") == ""


def test_the_old_book_stays_until_the_new_one_is_whole(tmp_path, monkeypatch):
    for name in ("book", "new"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "index.html").write_text(name)

    def full(*places):
        (tmp_path / "book.part").mkdir()
        raise shutil.Error([("a", "b", "[Errno 28] No space left on device")] * 500)

    with monkeypatch.context() as broken, pytest.raises(ReproductionError, match="book: the disk is full") as caught:
        broken.setattr(book.shutil, "copytree", full)
        book.replace_folder(tmp_path / "book", tmp_path / "new")
    assert len(str(caught.value)) < 200 + len(str(tmp_path))
    assert (tmp_path / "book" / "index.html").read_text() == "book"
    book.replace_folder(tmp_path / "book", tmp_path / "new")
    assert (tmp_path / "book" / "index.html").read_text() == "new"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["book", "new"]


def test_the_same_results_make_the_same_book(project):
    folder, reference = (project / "figures" / kind / "quick" for kind in ("latest", "reference"))

    def digest() -> str:
        files = [path for path in sorted((folder / "book").rglob("*")) if path.is_file()]
        return hashlib.sha256(b"".join(str(path).encode() + path.read_bytes() for path in files)).hexdigest()

    before = digest()
    assert book.build_book(folder, reference) == folder / "book" / "index.html"
    assert digest() == before


def test_provenance_tells_versions_parameters_and_runs_without_dates(project):
    made = json.loads((project / "figures" / "latest" / "quick" / "provenance.json").read_text())
    assert made["profile"] == "quick" and len(made["lock"]) == 64 and made["versions"]["numpy"] == np.__version__
    assert made["chapters"]["ch04"]["parameters"]["scale"] == 1.0
    assert made["chapters"]["ch04"]["runs"]["slopes"] == {"wanted": 8, "computed": 8, "read": 0, "stale": 0,
                                                            "stamped": 0}
    assert not re.search(r"20\d\d-\d\d-\d\d", json.dumps(made["chapters"]))


def test_findings_stand_beside_the_claims_that_do_not_hold(tmp_path, monkeypatch):
    (tmp_path / "data" / "thesis").mkdir(parents=True)
    (tmp_path / "data" / "thesis" / "findings.md").write_text("# Findings\n## C4.1, C4.3\nBecause.\n## C4.2\nNo.\n")
    monkeypatch.setattr(book, "ROOT", tmp_path)
    rows = [{"id": f"C4.{n}", "verdict": verdict, "parts": []}
            for n, verdict in enumerate(("contradicted", "holds", "undecided", "not tested"), 1)]
    found = {claim["id"]: why for claim, why in book._explained(rows, book._findings()[2])}
    assert found == {"C4.1": ["Because.\n"], "C4.3": ["Because.\n"]}


def test_numbers_of_findings_come_from_the_ledger():
    part = {"label": "gain, zero-shot", "measured": 0.123456, "interval": [0.1, 0.15]}
    text = "A gain of {C4.5: gain, zero-shot} ({C4.5: gain, zero-shot, interval}), {as} it is."
    row = {"id": "C4.5", "verdict": "holds", "parts": [part]}
    assert book.with_numbers(text, [row]) == "A gain of 0.123 (0.1 to 0.15), {as} it is."
    with pytest.raises(ReproductionError, match=r"there is no number \{C4.6: gain\} in the ledger"):
        book.with_numbers("{C4.6: gain}", [])


def test_a_finding_about_no_claim_waits_for_the_claims_that_it_speaks_of():
    rows = [{"id": "C4.5", "verdict": "holds", "parts": [{"label": "gain", "measured": 0.1, "interval": [0, 1]}]},
            {"id": "C4.6", "verdict": "not tested", "parts": []}]
    sections = [("One", "A gain of {C4.5: gain}."), ("Both", "{C4.5: gain} and {C4.6: loss}"), ("None", "Words.")]
    assert list(book._with_known_numbers(sections, rows)) == [("One", "A gain of 0.1."), ("None", "Words.")]


def test_no_number_of_the_ledger_is_typed_into_a_finding():
    """A number with three digits or more that rounds one of its claim's, whose interval then stands there as well."""
    standing = {row["id"]: row for row in read_json(book.ROOT / "figures" / "reference" / "paper" / "claims.json", [])}
    typed = []
    for title, text in book._findings()[2].items():
        parts = [part for name in re.findall(r"C\d+\.\d+", title) for part in standing.get(name, {}).get("parts", [])]
        known = [number for part in parts for number in (part["measured"], *(part["interval"] or ()))]
        for word in re.findall(r"(?<![\w.])-?\d*\.\d+", re.sub(r"\{C.*?\}", "", text)):
            digits = len(word.partition(".")[2])
            if len(word.strip("-0.")) >= 3 and any(f"{number:.{digits}f}" == word for number in known):
                typed.append((title, word))
    assert not typed


def test_every_claim_that_does_not_hold_at_the_largest_scale_is_explained():
    references = book.ROOT / "figures" / "reference"
    explained = book._explained(standings(references / "quick", references), book._findings()[2])
    assert not [claim["id"] for claim, why in explained if not why]


def test_a_claim_stands_as_it_was_judged_at_the_largest_scale(tmp_path):
    def judged(profile, **verdicts):
        rows = [{"id": f"C4.{n[1:]}", "verdict": verdict, "profile": profile} for n, verdict in verdicts.items()]
        write_json(tmp_path / "reference" / profile / "claims.json", rows)
        return tmp_path / "reference" / profile
    judged("paper", n1="holds", n2="contradicted")
    folder = judged("quick", n1="not tested", n2="holds", n3="undecided", n4="not tested")
    found = {row["id"]: (row["verdict"], row["profile"]) for row in standings(folder, tmp_path / "reference")}
    expected = [("holds", "paper"), ("contradicted", "paper"), ("undecided", "quick")]
    assert [found[f"C4.{n}"] for n in (1, 2, 3)] == expected
    assert found["C4.4"] == ("not tested", "quick") and found["C4.5"] == ("not tested", "")
    own = standings(judged("paper", n1="undecided"), tmp_path / "reference")
    assert {row["id"]: row["verdict"] for row in own}["C4.1"] == "undecided", "at the same scale this run's counts"


def test_a_small_run_points_the_way_of_a_verdict_or_not():
    def measured(number):  # C3.9 asks for a difference of 0.05 at most
        part = {"label": next(iter(ledger()["C3.9"]["parts"])), "measured": number}
        return [{"id": "C3.9", "profile": "quick", "verdict": "not tested", "parts": [part]}]

    for number, verdict, same in ((0, "holds", True), (1, "holds", False), (1, "contradicted", True)):
        standing = [{"id": "C3.9", "verdict": verdict, "profile": "paper"}]
        assert directions(measured(number), standing) == {same: ["C3.9"], not same: []}
    assert directions(measured(0), [{"id": "C3.9", "verdict": "undecided", "profile": "paper"}]) == {
        True: [], False: []}


def test_formulas_become_mathml_and_unknown_ones_stay_readable(project):
    source = r"\theta^{(t)} = \arg\min_{\mathbf{s}} \lVert s \rVert_1 + \frac{1}{T}\sum_{t=1}^{T} \boldsymbol{L} s"
    drawn = draw(source)
    assert drawn.startswith("<math") and "θ" in drawn
    assert draw(r"\nosuchmacro{x}") == r"<code>\nosuchmacro{x}</code>"
    assert draw("^2") == "<code>^2</code>"


def draw(formula: str) -> str:
    """What the book's renderer writes for an inline formula."""
    renderers = {}

    class App:
        def add_html_math_renderer(self, name, inline_renderers, block_renderers):
            renderers[name] = inline_renderers[0]

    class Translator:
        body: list = []

    book.setup(App())
    with pytest.raises(nodes.SkipNode):
        renderers["mathml"](Translator, nodes.math("", formula))
    return "".join(Translator.body)


def test_a_damaged_result_is_named_by_the_command(project, tmp_path):
    claims = project / "figures" / "latest" / "quick" / "claims.json"
    text = claims.read_text()
    claims.write_text(text[:20])
    done = command(project, "compare")
    claims.write_text(text)
    assert done.returncode == 2 and done.stderr.count("\n") == 1 and "claims.json is damaged" in done.stderr
