"""The ledger judges as its own rules say."""

import json
from types import SimpleNamespace

import numpy as np
import pytest

from lifelong_lib.reproduction import claims
from lifelong_lib.reproduction.files import ReproductionError, read_json

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
    ([0.0, 0.0, 0.0], NEAR, "undecided"), (ABOVE, [0.8, 0.8, 0.8], "undecided"),  # on a bound is not inside
    (ABOVE, NEAR, "holds"), (ACROSS, NEAR, "undecided"), (BELOW, NEAR, "contradicted"),
    (ABOVE, FAR, "contradicted"), (ACROSS, FAR, "contradicted"), (ABOVE[:2], NEAR[:2], "undecided"),
    (ABOVE[:1], NEAR[:1], "undecided"), (ABOVE, [1.01, 0.98, 1.02, 0.97], "undecided"),
    ([1.0, 1.4, 0.2], NEAR, "undecided"),  # three of one sign, but Student's t reaches below zero
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
    assert claim.p is None and claim.parts[1]["test"] == "no p: sign flips of 4 samples cannot give less than 0.12"
    claim = claims.check_claim(chapter, "C4.2", {"gap": ABOVE, "level": FAR + FAR})
    assert claim.p == 2 / 256  # all eight lie below the lower bound, 0.8
    claim = claims.check_claim(chapter, "C4.2", {"gap": ACROSS, "level": NEAR})
    assert claim.test.startswith("gap: ") and claim.thesis == "at least 0"


@pytest.mark.parametrize("control, control_verdict, verdict", [
    ({"gap": BELOW, "level": FAR}, "contradicted", "holds"), ({"gap": ACROSS, "level": FAR}, "undecided", "holds"),
    ({"gap": ABOVE, "level": FAR}, "holds", "undecided"),  # the other part's control, which fails, does not save it
    ([{"gap": ACROSS, "level": FAR}, {"gap": BELOW, "level": FAR}], "undecided", "holds"),
    ([{"gap": [10, -8, 10, 10], "level": FAR}, {"gap": ABOVE}], "holds", "undecided"),  # not the higher mean
    ([{"gap": BELOW}, {"level": FAR}], "contradicted", "holds"),
])
def test_a_control_that_holds_too_takes_the_verdict_away(chapter, write, control, control_verdict, verdict):
    write(ENTRY.format(control="descriptors shuffled"))
    claim = claims.check_claim(chapter, "C4.2", {"gap": ABOVE, "level": NEAR}, control)
    assert (claim.control_verdict, claim.verdict) == (control_verdict, verdict)
    idle = "the cause is not shown, as the control holds too in 'gap'"
    assert (idle in claim.because) == (verdict == "undecided")
    assert claim.test.startswith("gap: ") or verdict == "holds"


def test_a_part_that_says_why_needs_no_control(chapter, write):
    write(ENTRY.format(control="descriptors shuffled") + 'control = "none: nothing to shuffle"\n')
    claim = claims.check_claim(chapter, "C4.2", {"gap": ABOVE, "level": NEAR}, {"gap": BELOW, "level": NEAR})
    assert (claim.verdict, claim.control_verdict) == ("holds", "contradicted")
    assert [part["control_verdict"] for part in claim.parts] == ["contradicted", "none"]
    assert [part["label"] for part in claim.control_parts] == ["gap"]
    with pytest.raises(ReproductionError, match=r"needs its control \(descriptors shuffled\) in 'gap'"):
        claims.check_claim(chapter, "C4.2", {"gap": ABOVE, "level": NEAR}, {"level": NEAR})


def test_the_test_is_against_the_nearest_bound(chapter, write):
    write(ENTRY.format(control=NONE))
    claim = claims.check_claim(chapter, "C4.2", {"gap": ABOVE, "level": [1.0, 1.01, 0.98, 0.98, 1.0, 1.0]})
    assert claim.test == "level: sign flips of the samples against 1, two-sided"
    assert claim.p == 4 / 8  # +-0.01 +-0.02 +-0.02 is 0.03 or more in size for four of eight signs


def test_a_robust_centre_is_judged_by_its_own_interval(chapter, write):
    outlier = [1.0, 1.1, 0.9, 1.0, 1.1, 0.9, 1.0, -30.0]
    write(ENTRY.format(control=NONE))
    assert claims.check_claim(chapter, "C4.2", {"gap": outlier, "level": NEAR}).verdict == "undecided"
    write(ENTRY.format(control=NONE).replace('kind = "sign"', 'kind = "sign"\ncentre = "interquartile mean"'))
    claim = claims.check_claim(chapter, "C4.2", {"gap": outlier * 3, "level": NEAR * 6})
    assert (claim.verdict, claim.centre, claim.parts[0]["measured"]) == ("holds", "interquartile mean", 0.975)


def test_the_reason_names_what_does_not_hold_and_how_many_samples_would_decide(chapter, write):
    text = ENTRY.format(control=NONE).replace("[claim.parts.level]", 'unit = "of a gain"\n[claim.parts.level]')
    write(text)
    claim = claims.check_claim(chapter, "C4.2", {"gap": [0.8, -0.2, 0.2, 0.4], "level": FAR})
    # The gap's spread is 0.416: with n samples t(0.975) + t(0.8) over the root of n has to be 0.3 / 0.416 = 0.72.
    assert claim.because == (
        "0 of 2 parts hold; gap: 0.3 of a gain (-0.362 to 0.962, n = 4), asked: at least 0: undecided, "
        "about 18 samples would decide; level: 0.508 (0.492 to 0.523, n = 4), asked: 0.9 ± 0.1: contradicted; "
        "control: none")
    claim = claims.check_claim(chapter, "C4.2", {"gap": ABOVE, "level": NEAR})
    assert claim.because == ("2 of 2 parts hold; level: 0.905 (0.884 to 0.926, n = 4), asked: 0.9 ± 0.1: holds; "
                             "control: none")  # fmt: skip


def test_a_small_profile_measures_but_does_not_decide(chapter, write):
    write(ENTRY.format(control=NONE))
    chapter.profile = "smoke"
    claim = claims.check_claim(chapter, "C4.2", {"gap": BELOW, "level": NEAR})
    assert claim.verdict == "not tested" and claim.measured == pytest.approx(-1.0) and "quick" in claim.because


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
    with pytest.raises(ReproductionError, match=r"needs its control \(descriptors shuffled\) in 'gap'"):
        claims.check_claim(chapter, "C4.2", {"gap": ABOVE, "level": NEAR})
    with pytest.raises(ReproductionError, match=r"no claim 'C4.7' in chapter 4: it has C4\.2"):
        claims.check_claim(chapter, "C4.7", {})
    assert not chapter.folder.exists()


@pytest.mark.parametrize("old, new, message", [
    ("source", "sauce", "lacks source"), ('"sign"', '"sing"', "needs a kind"), ('"quick"', '"fast"', "a profile of"),
    ("at_least = 0", "at_leest = 0", "'gap' needs bounds"), ("at_least = 0", "thesis = 0", "'gap' needs bounds"),
    ("tolerance = 0.1", "tolerance = -0.1", "'level' needs bounds"), ("= 4\n", "= \n", "no valid TOML"),
    ("thesis = 0.9\n", "", "'level' needs bounds"), ("at_least = 0", 'at_least = 0\ncontrol = "no"', "'none: why'"),
    ('"sign"', '"sign"\ncentre = "mode"', "needs a centre of mean"),
])
def test_a_mistake_in_the_ledger_is_named(write, old, new, message):
    write(ENTRY.format(control=NONE).replace(old, new, 1))
    with pytest.raises(ReproductionError, match=message):
        claims.ledger()


def test_rows_are_replaced_and_sorted_and_valid_json(chapter, monkeypatch):
    entries = {name: {"parts": {"gap": {"at_least": 0, "decides": True}}, "control": NONE, "profile": "quick",
                      **dict.fromkeys(("statement", "source", "kind", "tolerance_origin"), ""), "id": name,
                      "chapter": int(name[1]), "centre": "mean"} for name in ("C4.10", "C4.2", "C2.1")}
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
    claim = claims.check_claim(chapter, "C4.2", {"gap": [x + 1 for x in ABOVE], "SM: level": NEAR})
    assert repr(claim).startswith("C4.2 holds: A > B. | 2 of 2 parts hold; SM: level: 0.905 (0.884 to 0.926, n = 4)")
    assert "\n" not in repr(claim)
    assert "A &gt; B." in claim._repr_html_()
