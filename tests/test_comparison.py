"""Two runs side by side: numbers, pictures, verdicts and circumstances, the page, and the command's exit codes."""

import json
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pytest
from conftest import command

from lifelong_lib.reproduction.comparison import compare, comparison_lines, write_page
from lifelong_lib.reproduction.files import read_json, write_json

SHIFTED = "x,y\n1,{}\n2,5.0\n"


def results(folder: Path, value: str = "1.0", verdict: str = "holds", pixel: float = 0.0, processor: str = "A",
            measured: float = 2.0) -> Path:  # fmt: skip
    """A finished run with one figure and one claim."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "F4.1.csv").write_text(SHIFTED.format(value))
    plt.imsave(folder / "F4.1.png", np.full((4, 5), pixel) * np.eye(4, 5), vmin=0, vmax=1)
    parts = [{"label": "slope", "measured": measured, "interval": [measured - 0.5, measured + 0.5]}]
    write_json(folder / "claims.json", [{"id": "C4.1", "verdict": verdict, "parts": parts}])
    runs = {"slopes": {"wanted": 8, "stale": 2 * (processor == "B"), "stamped": 0}}
    chapter = {"parameters": {"scale": 1.0, "workers": 2, "output_dir": str(folder)}, "runs": runs}
    versions = {"numpy": "2.0", "processor": processor}
    write_json(folder / "provenance.json", {"profile": "quick", "versions": versions, "chapters": {"ch04": chapter}})
    return folder


@pytest.mark.parametrize("value, said, matters", [
    ("1.0", "identical", False), ("1.00", "equal within 1e-9", False), ("1.0000000001", "equal within 1e-9", False),
    ("1.00000001", "different by at most 1e-08", True), ("1.25", "different by at most 0.25", True),
    ("nan", "other text: 'nan' for '1.0'", True), ("one", "other text: 'one' for '1.0'", True),
    ("1.0 ± 0.2", "other text: '1.0 ± 0.2' for '1.0'", True),
    ("1.0,3", "other rows or columns", True), ("1.0\n3,4", "other rows or columns", True),
])  # fmt: skip
def test_data_are_compared_by_value(tmp_path, value, said, matters):
    found = compare(results(tmp_path / "a", value), results(tmp_path / "b"))
    (row,) = found["results"]
    assert (row["data"], row["picture"], row["matters"]) == (said, "identical", matters)
    assert found["same"] is not matters
    assert read_json(tmp_path / "a" / "comparison.json", None) == json.loads(json.dumps(found))


@pytest.mark.parametrize("tolerance, same", [(0.049, False), (0.051, True)])
def test_the_tolerance_is_a_part_of_the_largest_number_of_the_column(tmp_path, tolerance, same):
    found = compare(results(tmp_path / "a", "1.25"), results(tmp_path / "b"), tolerance)
    assert found["same"] == same
    (cell,) = found["results"][0]["cells"]
    assert cell == {"share": 0.05, "size": 0.25, "place": "x 1", "column": "y", "reference": "1.0", "latest": "1.25"}


def test_the_largest_difference_comes_first(tmp_path):
    ours, theirs = results(tmp_path / "a"), results(tmp_path / "b")
    (ours / "F4.1.csv").write_text("method,x,mean\nPG,0,1.1\nPG,5,3.0\nELLA,0,2.0\n")
    (theirs / "F4.1.csv").write_text("method,x,mean\nPG,0,1.0\nPG,5,2.0\nELLA,0,2.0\n")
    first, second = compare(ours, theirs)["results"][0]["cells"]
    assert (first["place"], first["latest"], second["place"]) == ("method PG, x 5", "3.0", "method PG, x 0")


def test_means_with_errors_are_compared_in_all_their_numbers(tmp_path):
    ours, theirs = results(tmp_path / "a"), results(tmp_path / "b")
    for folder, cell in ((ours, "0.50 ± 0.30"), (theirs, "0.50 ± 0.10")):
        (folder / "F4.1.csv").write_text(f"method,mean\nPG,{cell}\n")
    assert compare(ours, theirs)["results"][0]["data"] == "different by at most 0.2"


def test_measured_seconds_are_passed_over(tmp_path):
    ours, theirs = results(tmp_path / "a"), results(tmp_path / "b")
    for folder, took, score in ((ours, 3.0, 1.0), (theirs, 9.0, 1.0)):
        (folder / "F4.1.csv").write_text(f"what,mean\nseconds a task,{took}\nscore,{score}\n")
    found = compare(ours, theirs)
    assert found["results"][0]["data"] == "equal within 1e-9 but for measured seconds" and found["same"]
    (ours / "F4.1.csv").write_text("what,mean\nseconds a task,3.0\nscore,1.5\n")  # and nothing else is
    assert compare(ours, theirs)["results"][0]["data"] == "different by at most 0.5"


def test_seconds_that_are_a_result_are_compared(tmp_path):
    ours, theirs = results(tmp_path / "a"), results(tmp_path / "b")
    for folder, waited in ((ours, 3.0), (theirs, 9.0)):
        (folder / "F4.1.csv").write_text(f"driver,what,mean\nM,seconds to setting off,{waited}\n")
    assert compare(ours, theirs)["results"][0]["data"] == "different by at most 6"


def test_pictures_verdicts_and_missing_results_are_told(tmp_path):
    ours, theirs = results(tmp_path / "a", verdict="undecided", pixel=1.0), results(tmp_path / "b")
    (ours / "T4.10.csv").write_text("a\n1\n")
    (theirs / "T4.9.csv").write_text("a\n1\n")
    found = compare(ours, theirs)
    told = [(row["id"], row["data"], row["picture"]) for row in found["results"]]
    assert told == [("F4.1", "identical", "20 % of its points differ"), ("T4.9", "not made", ""),
                    ("T4.10", "no reference", "")]  # fmt: skip
    assert found["verdicts"] == [{"id": "C4.1", "reference": "holds", "latest": "undecided"}] and not found["same"]
    lines = "\n".join(comparison_lines(found))
    assert lines.startswith("0 of 3") and "holds -> undecided" in lines


def test_chapters_that_were_not_run_are_left_out(tmp_path):
    ours, theirs = results(tmp_path / "a"), results(tmp_path / "b")
    (theirs / "T7.1.csv").write_text("a\n1\n")
    found = compare(ours, theirs)
    assert [row["id"] for row in found["results"]] == ["F4.1"] and found["same"]


def test_numbers_that_leave_the_other_runs_interval_are_told(tmp_path):
    assert not compare(results(tmp_path / "a", measured=2.4), results(tmp_path / "b"))["moved"]
    (moved,) = compare(results(tmp_path / "a", measured=2.6), results(tmp_path / "b"))["moved"]
    assert moved == {"id": "C4.1", "label": "slope", "reference": 2.0, "latest": 2.6, "interval": [1.5, 2.5]}


@pytest.mark.parametrize("more, rounding", [({}, True), ({"verdict": "undecided"}, False), ({"measured": 3.0}, False)])
def test_another_processor_explains_what_moves_no_verdict_and_no_number(tmp_path, more, rounding):
    ours, theirs = results(tmp_path / "a", "1.25", processor="B", **more), results(tmp_path / "b")
    found = compare(ours, theirs)
    assert (found["rounding"], found["same"]) == (rounding, rounding)
    assert {"what": "versions processor", "reference": "A", "latest": "B"} in found["made"]
    assert found["not_made_now"] == {"latest": ["ch04 slopes: 2 of 8 runs stale"], "reference": []}
    assert ("within what another processor gives" in comparison_lines(found)[0]) == rounding


def test_what_made_two_runs_is_compared_without_folders_and_workers(tmp_path):
    ours, theirs = results(tmp_path / "a"), results(tmp_path / "b")
    assert compare(ours, theirs)["made"] == []
    about = read_json(ours / "provenance.json", {})
    about["chapters"]["ch04"]["parameters"]["scale"] = 2.0
    write_json(ours / "provenance.json", about)
    assert compare(ours, theirs)["made"] == [{"what": "ch04 scale", "reference": "1.0", "latest": "2.0"}]
    (theirs / "provenance.json").unlink()  # an old reference
    assert {row["reference"] for row in compare(ours, theirs)["made"]} == {"unknown"}


def test_the_page_shows_both_pictures_and_where_they_differ_what_matters_first(tmp_path):
    ours, theirs = results(tmp_path / "a", pixel=1.0), results(tmp_path / "b")
    for folder, value in ((ours, "7 < 8"), (theirs, "9")):
        (folder / "T4.2.csv").write_text(f"method,<b>\nPG,{value}\n")
    index = write_page(compare(ours, theirs), ours, theirs, tmp_path / "page")
    text = index.read_text()
    assert text.index("T4.2: beyond the tolerance") < text.index("<h2>F4.1</h2>")
    assert "&lt;b&gt; at method PG" in text and "7 &lt; 8" in text and "They differ." in text
    for caption in ("A", "B", "difference"):
        assert f'src="F4.1-{caption}.png"' in text
    drawn = plt.imread(tmp_path / "page" / "F4.1-difference.png")[..., :3]
    diagonal = np.eye(4, 5, dtype=bool)
    assert (drawn[diagonal] == drawn[0, 0]).all() and (drawn[~diagonal] == drawn[0, 1]).all()
    assert drawn[0, 0].argmax() == 0 and np.ptp(drawn[0, 1]) == 0, "vermilion on grey"


def test_two_equal_runs_leave_an_empty_page_and_old_pictures_go(tmp_path):
    ours, theirs = results(tmp_path / "a", pixel=1.0), results(tmp_path / "b")
    write_page(compare(ours, theirs), ours, theirs, tmp_path / "page")
    ours = results(tmp_path / "a")
    found = compare(ours, theirs)
    text = write_page(found, ours, theirs, tmp_path / "page").read_text()
    assert "Nothing differs." in text and [path.name for path in (tmp_path / "page").iterdir()] == ["index.html"]
    assert comparison_lines(found) == ["1 of 1 figures and tables are identical to the reference"]


def test_what_else_is_in_the_pages_folder_stays(tmp_path):
    ours, theirs, page = results(tmp_path / "a", pixel=1.0), results(tmp_path / "b"), tmp_path / "page"
    (page / "mine").mkdir(parents=True)
    for name in ("thesis.tex", "mine/F4.1-A.png", "photo-A.png"):
        (page / name).write_text("mine")
    write_page(compare(ours, theirs), ours, theirs, page)
    write_page(compare(results(tmp_path / "a"), theirs), ours, theirs, page)
    assert sorted(path.name for path in page.iterdir()) == ["index.html", "mine", "photo-A.png", "thesis.tex"]
    assert (page / "mine" / "F4.1-A.png").read_text() == "mine"


def test_runs_that_made_nothing_are_alike(tmp_path):
    assert compare(tmp_path, tmp_path)["same"]


def test_the_command_compares_any_two_folders_and_its_exit_code_says_if_they_differ(project, tmp_path):
    ours, theirs = results(tmp_path / "a", "1.25"), results(tmp_path / "b")
    differ = command(project, "compare", str(ours), str(theirs))
    assert differ.returncode == 1 and f"page: {ours}/comparison/index.html" in differ.stdout
    same = command(project, "compare", str(ours), str(theirs), "--tolerance", "0.1", "--json", "--page",
                   str(tmp_path / "page"))  # fmt: skip
    assert same.returncode == 0 and json.loads(same.stdout)["same"] and (tmp_path / "page" / "index.html").exists()


@pytest.mark.parametrize("words, said", [
    (["here"], "compare takes two folders, or none"), (["data", "data"], "data has no figures and no tables"),
    (["here", "nowhere"], "here is not there"),
    (["--tolerance", "-1"], "invalid share value"), (["--tolerance", "x"], "invalid share value"),
])  # fmt: skip
def test_bad_words_are_one_line(project, words, said):
    done = command(project, "compare", *words)
    assert done.returncode == 2 and said in done.stderr and done.stderr.count("\n") == 1
