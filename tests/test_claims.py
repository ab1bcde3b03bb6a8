"""The ledger judges as its own rules say, and claims.toml agrees with itself."""

import json
from types import SimpleNamespace

import numpy as np
import pytest

from lifelong_lib.reproduction import claims
from lifelong_lib.reproduction.files import ReproductionError, read_json
from lifelong_lib.reproduction.runs import PROFILES

ENTRY = """
[[claim]]
id = "C4.2"
chapter = 4
statement = "A lies above B."
source = "figure 4.2"
kind = "sign"
profile = "quick"
control = "{control}"
tolerance_origin = "none needed"
[claim.parts.gap]
at_least = 0
[claim.parts.level]
thesis = 0.9
tolerance = 0.1
"""
NONE = "none: nothing to switch off"
ABOVE, ACROSS, BELOW = [1.0, 1.1, 0.9, 1.0], [1.0, -1.0, 0.5, -0.4], [-1.0, -1.1, -0.9, -1.0]
NEAR, FAR = [0.90, 0.91, 0.92, 0.89], [0.5, 0.51, 0.52, 0.5]


@pytest.fixture
def chapter(tmp_path):
    return SimpleNamespace(number=4, profile="quick", seeds=4, folder=tmp_path / "latest")


@pytest.fixture
def write(tmp_path, monkeypatch):
    """Put other text in the place of claims.toml."""
    monkeypatch.setattr(claims, "LEDGER", tmp_path / "claims.toml")
    return lambda text: claims.LEDGER.write_text(text)


@pytest.mark.parametrize("gap, level, verdict", [
    (ABOVE, NEAR, "holds"), (ACROSS, NEAR, "undecided"), (BELOW, NEAR, "contradicted"),
    (ABOVE, FAR, "contradicted"), (ACROSS, FAR, "contradicted"), (ABOVE[:2], NEAR[:2], "undecided"),
    (ABOVE[:1], NEAR[:1], "undecided"), (ABOVE, [1.01, 0.98, 1.02, 0.97], "undecided"),
    (ABOVE, [1.2, 1.21, 1.2, 1.19], "contradicted"),
])
def test_verdict_follows_from_the_intervals_of_all_parts(chapter, write, gap, level, verdict):
    write(ENTRY.format(control=NONE))
    claim = claims.check_claim(chapter, "C4.2", {"gap": gap, "level": level})
    assert (claim.verdict, claim.control_verdict) == (verdict, "none")


def test_row_reports_the_weakest_part(chapter, write):
    write(ENTRY.format(control=NONE))
    claim = claims.check_claim(chapter, "C4.2", {"gap": ABOVE, "level": FAR})
    assert claim.test.startswith("level: ") and claim.thesis == "0.9 ± 0.1" and claim.n == 4
    assert claim.measured == np.mean(FAR) and claim.interval[0] <= claim.measured <= claim.interval[1] < 0.8
    assert claim.p == 2 / 16  # all four lie below the lower bound, 0.8
    claim = claims.check_claim(chapter, "C4.2", {"gap": ACROSS, "level": NEAR})
    assert claim.test.startswith("gap: ") and claim.thesis == "at least 0"


@pytest.mark.parametrize("control, control_verdict, verdict", [
    ({"gap": BELOW}, "contradicted", "holds"), ({"gap": ACROSS}, "undecided", "holds"),
    ({"gap": ABOVE}, "holds", "undecided"), ({"gap": ABOVE, "level": FAR}, "contradicted", "holds"),
])
def test_a_control_that_holds_too_takes_the_verdict_away(chapter, write, control, control_verdict, verdict):
    write(ENTRY.format(control="descriptors shuffled"))
    claim = claims.check_claim(chapter, "C4.2", {"gap": ABOVE, "level": NEAR}, control)
    assert (claim.control_verdict, claim.verdict) == (control_verdict, verdict)
    assert bool(claim.remark) == (verdict == "undecided")


def test_the_test_is_against_the_nearest_bound(chapter, write):
    write(ENTRY.format(control=NONE))
    claim = claims.check_claim(chapter, "C4.2", {"gap": ABOVE, "level": [1.0, 1.01, 0.98, 0.98]})
    assert claim.test == "level: sign flips of the samples against 1, two-sided"
    assert claim.p == 4 / 8  # +-0.01 +-0.02 +-0.02 is 0.03 or more in size for four of eight signs


def test_a_small_profile_measures_but_does_not_decide(chapter, write):
    write(ENTRY.format(control=NONE))
    chapter.profile = "smoke"
    claim = claims.check_claim(chapter, "C4.2", {"gap": BELOW, "level": NEAR})
    assert claim.verdict == "not tested" and claim.measured == pytest.approx(-1.0) and "quick" in claim.remark


def test_a_part_may_be_reported_without_deciding(chapter, write):
    write(ENTRY.format(control=NONE) + "decides = false\n")
    claim = claims.check_claim(chapter, "C4.2", {"gap": ABOVE, "level": FAR})
    assert claim.verdict == "holds" and [part["verdict"] for part in claim.parts] == ["holds", "contradicted"]


@pytest.mark.parametrize("parts, control, message", [
    ({"gap": ABOVE}, None, "part 'level' is missing"),
    ({"gap": ABOVE, "level": NEAR, "lvel": NEAR}, None, "no part 'lvel'"),
    ({"gap": [1.0, np.nan], "level": NEAR}, None, "'gap' needs one finite number a seed"),
    ({"gap": [], "level": NEAR}, None, "'gap' needs one finite number a seed"),
    ({"gap": ABOVE, "level": NEAR}, {"gap": ABOVE}, "has no control"),
])
def test_parts_and_controls_that_do_not_fit_the_ledger_are_refused(chapter, write, parts, control, message):
    write(ENTRY.format(control=NONE))
    with pytest.raises(ReproductionError, match=message):
        claims.check_claim(chapter, "C4.2", parts, control)
    write(ENTRY.format(control="descriptors shuffled"))
    with pytest.raises(ReproductionError, match=r"needs its control \(descriptors shuffled\)"):
        claims.check_claim(chapter, "C4.2", {"gap": ABOVE, "level": NEAR})
    with pytest.raises(ReproductionError, match=r"no claim 'C4.7' in chapter 4: it has C4\.2"):
        claims.check_claim(chapter, "C4.7", {})
    assert not chapter.folder.exists()


@pytest.mark.parametrize("old, new, message", [
    ("source", "sauce", "lacks source"), ('"sign"', '"sing"', "needs a kind"), ('"quick"', '"fast"', "a profile of"),
    ("at_least = 0", "at_leest = 0", "'gap' needs bounds"), ("at_least = 0", "thesis = 0", "'gap' needs bounds"),
    ("tolerance = 0.1", "tolerance = -0.1", "'level' needs bounds"), ("= 4\n", "= \n", "no valid TOML"),
    ("thesis = 0.9\n", "", "'level' needs bounds"),
])
def test_a_mistake_in_the_ledger_is_named(write, old, new, message):
    write(ENTRY.format(control=NONE).replace(old, new, 1))
    with pytest.raises(ReproductionError, match=message):
        claims.ledger()


def test_rows_are_replaced_and_sorted_and_valid_json(chapter, monkeypatch):
    entries = {name: {"parts": {"gap": {"at_least": 0, "decides": True}}, "control": NONE, "profile": "quick",
                      **dict.fromkeys(("statement", "source", "kind", "tolerance_origin"), ""), "id": name,
                      "chapter": int(name[1])} for name in ("C4.10", "C4.2", "C2.1")}
    monkeypatch.setattr(claims, "ledger", lambda: entries)
    for name in ("C4.10", "C4.2"):
        claims.check_claim(chapter, name, {"gap": ABOVE[:1]})
    claims.check_claim(SimpleNamespace(**vars(chapter) | {"number": 2}), "C2.1", {"gap": ABOVE})
    first = (chapter.folder / "claims.json").read_bytes()
    claims.check_claim(chapter, "C4.2", {"gap": ABOVE})
    rows = read_json(chapter.folder / "claims.json", [])
    assert [(row["id"], row["verdict"]) for row in rows] == [
        ("C2.1", "holds"), ("C4.2", "holds"), ("C4.10", "undecided")]
    assert {"statement", "thesis", "measured", "interval", "n", "test", "p", "profile", "parts"} <= rows[0].keys()
    claims.check_claim(chapter, "C4.2", {"gap": ABOVE[:1]})
    assert (chapter.folder / "claims.json").read_bytes() == first
    json.loads(first, parse_constant=pytest.fail)  # no NaN, no Infinity
    del entries["C4.10"]  # a claim that left the ledger leaves the file
    claims.check_claim(chapter, "C4.2", {"gap": ABOVE})
    assert [row["id"] for row in read_json(chapter.folder / "claims.json", [])] == ["C2.1", "C4.2"]
    (chapter.folder / "claims.json").write_text("[{")
    with pytest.raises(ReproductionError, match="damaged"):
        read_json(chapter.folder / "claims.json", [])


def test_a_claim_shows_itself_in_one_line(chapter, write):
    write(ENTRY.format(control=NONE).replace("A lies above B.", "A > B.").replace("level]", '"SM: level"]'))
    claim = claims.check_claim(chapter, "C4.2", {"gap": [x + 1 for x in ABOVE], "SM: level": [0.9, 0.9, 1.0, 0.9]})
    assert repr(claim).startswith("C4.2 holds: A > B. | SM: level: ") and "\n" not in repr(claim)
    assert "A &gt; B." in claim._repr_html_()


def test_the_ledger_has_every_claim_of_chapters_2_and_4_and_its_numbers_agree():
    ledger = claims.ledger()
    assert {name for name in ledger if name[1] in "24"} >= {"C2.1", *(f"C4.{i}" for i in range(1, 16))}
    for name, row in ledger.items():
        assert name.startswith(f"C{row['chapter']}.") and row["profile"] in PROFILES
        assert row["control"] != "none: " and any(part["decides"] for part in row["parts"].values())
    for domain, table in (("domain 1", "T4.2"), ("domain 2", "T4.3")):
        printed, parts = claims.published(table), ledger["C4.9"]["parts"]
        for kind, method, label in (("lifelong", "TaDeLL", "TaDeLL, lifelong"), ("zero_shot", "STL", "STL, new tasks"),
                                    ("zero_shot", "TaDeLL", "TaDeLL, zero-shot"), ("lifelong", "ELLA", "ELLA"),
                                    ("lifelong", "STL", "STL, lifelong tasks")):
            assert parts[f"{domain}: {label}"]["thesis"] == printed[kind][method][0]
    with pytest.raises(ReproductionError, match="no published numbers for 'F9.9'"):
        claims.published("F9.9")


def test_published_curves_agree_with_their_calibration_and_with_the_start_of_figure_4_3():
    curves, starts = claims.published("F4.2"), claims.published("F4.3")
    for system in ("SM", "CP", "BK"):
        calibration = curves["calibration"][system]
        assert [calibration[0], calibration[-1]] == pytest.approx(curves[system]["PG"], abs=0.05)
        assert starts[system].keys() == {"TaDeMTL", "TaDeLL", "Sinapov et al.", "PG"}
