"""claims.toml keeps its own rules: nothing of the thesis is refused, and where nothing was learned nothing holds."""

from functools import partial

import numpy as np
import pytest

from lifelong_lib.reproduction import claims
from lifelong_lib.reproduction.files import ReproductionError
from lifelong_lib.reproduction.runs import PROFILES
from lifelong_lib.reproduction.statistics import mean_interval

LEDGER = claims.ledger()
PARTS = [(name, label) for name, entry in LEDGER.items() for label in entry["parts"]]
# Claims about one learner or about costs: no method is set against another one that it could be swapped with.
NOTHING_TO_SWAP = {"C3.5", "C3.6", "C3.8", "C3.9", "C4.12"}


@pytest.mark.parametrize(("name", "label"), PARTS)
def test_bounds_never_refuse_the_thesiss_own_number(name, label):
    part = LEDGER[name]["parts"][label]
    low, high = part.get("at_least", -np.inf), part.get("at_most", np.inf)
    assert low < part.get("thesis", np.nan) < high or "thesis" not in part
    assert "tolerance" not in part or (np.isinf(low) and np.isinf(high) and part["tolerance"] > 0)


def test_numbers_of_the_thesis_come_from_its_tables_and_figures():
    table, curves, starts = claims.published("T4.1"), claims.published("F4.2"), claims.published("F4.3")
    begin = {name: curves[name]["PG"][0] for name in ("SM", "CP", "BK")}
    begin["quadrotor"] = claims.published("F4.5")["quadrotor"]["PG"][0]
    gain = {name: curves[name]["PG"][1] - curves[name]["PG"][0] for name in ("SM", "CP", "BK")}
    lost = {name: (table["learned"][name][0] - table["copied"][name][0]) / (table["learned"][name][0] - begin[name])
            for name in begin}  # fmt: skip
    copies = {name: (starts[name]["Sinapov et al."] - starts[name]["PG"]) / gain[name] for name in gain}
    known = {f"{name}: lost by copying": share for name, share in lost.items()}
    known["SM loses less than any other system"] = min(lost["CP"], lost["BK"], lost["quadrotor"]) - lost["SM"]
    known["CP: Sinapov et al. minus trained PG"] = copies["CP"]
    lower = min(copies["SM"], copies["BK"])
    known["CP minus the lower of SM and BK: Sinapov et al. minus trained PG"] = copies["CP"] - lower
    parts = LEDGER["C4.1"]["parts"] | LEDGER["C4.6"]["parts"]
    assert {label: part["thesis"] for label, part in parts.items()} == pytest.approx(known, abs=0.02)


def test_the_thesiss_curves_pass_the_bounds_of_the_claims_that_are_read_off_them():
    mean = {name: {method: np.mean(ends) for method, ends in curves.items()}
            for name, curves in claims.published("F4.2").items() if name in ("SM", "CP", "BK")}  # fmt: skip
    for name, of in mean.items():
        first, last = claims.published("F4.2")[name]["PG"]
        start = claims.published("F4.3")[name]
        measured = {f"{name}: TaDeLL minus {rival}": of["TaDeLL"] - of[rival] for rival in ("PG-ELLA", "GO-MTL")}
        measured |= {f"{name}: zero-shot minus {label}": start["TaDeLL"] - start[rival]
                     for label, rival in (("trained PG", "PG"), ("Sinapov et al.", "Sinapov et al."))}  # fmt: skip
        close = (of["TaDeMTL"] - of["PG-ELLA"]) / 4 - abs(of["TaDeMTL"] - of["TaDeLL"])
        measured[f"{name}: a quarter of TaDeMTL's lead over PG-ELLA, less its gap to TaDeLL"] = close
        measured[f"{name}: the gap of TaDeLL and TaDeMTL, less a quarter of TaDeMTL's lead over PG-ELLA"] = -close
        for identity in ("C4.2", "C4.3", "C4.4", "C4.5"):
            for label, part in LEDGER[identity]["parts"].items():
                assert label not in measured or measured[label] / (last - first) > part["at_least"], label


# ------------------------------------------------------------------------------------- no effect, no verdict of holds

def without_effect(entry, swapped, rng):
    """Samples of each deciding part for a method that in the `swapped` samples changed its place with the baseline.

    A part that compares ("minus", "less", a gain or a growth) changes its sign. Of any other the baseline's number lies
    as far outside the nearest bound as the method's inside. Effects are large beside the slack of orders.
    """
    sign, found = np.where(swapped, -1, 1), {}
    for label, part in entry["parts"].items():
        low, high = part.get("at_least", -np.inf), part.get("at_most", np.inf)
        if "tolerance" in part:
            low, high = part["thesis"] - part["tolerance"], part["thesis"] + part["tolerance"]
        bound, inside = (low, 1) if np.isfinite(low) else (high, -1)
        middle = bound if abs(bound) > 0.02 else 0.0
        effect = inside * 0.4 * min(1.0, high - low) * sign
        if part["decides"]:
            found[label] = middle + effect * (1 + 0.2 * rng.standard_normal(len(swapped)))
    return found


def holds(entry, samples):
    return all(claims.judge_part(entry, label, numbers)["verdict"] == "holds" for label, numbers in samples.items())


@pytest.mark.parametrize("name", [name for name in LEDGER if name not in NOTHING_TO_SWAP])
def test_a_claim_seldom_holds_when_method_and_baseline_are_swapped_at_random(name, monkeypatch):
    monkeypatch.setitem(claims.CENTRES, "mean", (np.mean, partial(mean_interval, resamples=300), 3))  # for speed
    monkeypatch.setattr(claims.statistics, "paired_permutation", lambda *given: None)
    rng, entry = np.random.default_rng([*map(int, name[1:].split("."))]), LEDGER[name]
    n = 24 if name in ("C2.1", "C4.9", "C4.10", "C4.14", "C4.15") or entry["centre"] != "mean" else 6
    draws = 100 if n == 24 and entry["centre"] == "mean" else 300  # a bootstrap takes its time
    found = [holds(entry, without_effect(entry, rng.random(n) < 0.5, rng)) for _ in range(draws)]
    assert np.mean(found) <= 0.05
    assert holds(entry, without_effect(entry, np.zeros(n, bool), rng)), "the effect itself is not seen"


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
