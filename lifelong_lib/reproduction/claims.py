"""The ledger: what the thesis claims, what a run measured, and what follows.

`data/thesis/claims.toml` holds every claim, every published number and the rules of judging. A claim has parts; a part
is one number with bounds, measured once a seed. If the 95 % interval of its centre lies inside the bounds, the part
holds; if it lies beside them, the part is contradicted; across or on an edge, it is undecided. A claim holds if all its
parts do and is contradicted if one is. A negative control measures the same numbers with the claimed cause switched
off: a part whose control holds too shows nothing, and the claim is undecided.
"""

import html
from collections.abc import Mapping
from types import SimpleNamespace

import numpy as np

from lifelong_lib.reproduction import statistics
from lifelong_lib.reproduction.files import ROOT, ReproductionError, read_json, read_toml, require, write_json
from lifelong_lib.reproduction.labels import VERDICTS, order
from lifelong_lib.reproduction.runs import PROFILES

LEDGER = ROOT / "data" / "thesis" / "claims.toml"
KINDS = ("value", "order", "sign", "shape")
CENTRES = {  # the centre, its interval, and from how many samples on that decides anything
    "mean": (np.mean, statistics.mean_interval, 3),  # two numbers of one sign are chance in every second experiment
    "interquartile mean": (statistics.interquartile_mean, statistics.interquartile_interval, 24),  # of six numbers with
    # five of one sign it would not see the sixth
}
CLAIM_KEYS = {"id", "chapter", "statement", "source", "kind", "profile", "control", "tolerance_origin", "parts"}
OPTIONAL_KEYS = {"stand_in", "centre"}
PART_KEYS = {"at_least", "at_most", "thesis", "tolerance", "unit", "measure", "decides", "control"}


class Claim(SimpleNamespace):
    """One row of `claims.json`; thesis, measured, interval, n, test and p are those of its weakest deciding part."""

    def __repr__(self):
        return f"{self.id} {self.verdict}: {self.statement} | {self.because}"

    def _repr_html_(self):
        name, rest = repr(self).split(":", 1)
        return f"<p><b>{html.escape(name)}</b>:{html.escape(rest)}</p>"


def check_claim(chapter, identity, parts, control=None):
    """Judge the claim `identity`, write its row to `<chapter.folder>/claims.json` and return it as a Claim.

    `parts`: {label of the ledger: samples (n_seeds,)}, all labels of the claim; `control`: the same labels measured
    with the cause switched off, or a list of several such controls, of which the one nearest to holding counts, part by
    part; parts for which the ledger says "none: why" may be left out.
    Raises ReproductionError for an unknown claim or label, a missing part or control, and numbers that are not finite.
    """
    known = ledger()
    names = [name for name, entry in known.items() if entry["chapter"] == chapter.number]
    require(identity in names,
            f"claims.toml has no claim '{identity}' in chapter {chapter.number}: it has {', '.join(names)}")
    entry = known[identity]
    row = judge(entry, parts, [control] if isinstance(control, Mapping) else control or [])
    if PROFILES.index(chapter.profile) < PROFILES.index(entry["profile"]):
        row |= {"verdict": "not tested", "because": f"it needs the profile {entry['profile']}"}
    row["profile"] = chapter.profile
    path = chapter.folder / "claims.json"
    rows = [old for old in read_json(path, []) if old["id"] in known.keys() - {identity}]
    write_json(path, sorted([*rows, row], key=lambda row: order(row["id"])))
    return Claim(**row)


def judge(entry, parts, controls=()):
    """Return the row of a claim: its `entry` of the ledger, what every part measured, the verdict and the reason."""
    judged = _judge_parts(entry, dict.fromkeys(entry["parts"]) | parts)  # in the ledger's order, None where missing
    controlled = _judge_controls(entry, controls)
    for part in judged:
        part["control_verdict"] = controlled.get(part["label"], {}).get("verdict", "none")
    deciding = [part for part in judged if part["decides"]]
    weakest = min(deciding, key=_strength)
    verdict = weakest["verdict"]
    idle = [part for part in deciding if part["verdict"] == part["control_verdict"] == "holds"]
    if verdict == "holds" and idle:
        verdict, weakest = "undecided", idle[0]
    row = {key: entry[key] for key in ("id", "chapter", "statement", "source", "kind", "control", "tolerance_origin")}
    row |= {key: weakest[key] for key in ("thesis", "measured", "interval", "n", "p")}
    row |= {"test": f"{weakest['label']}: {weakest['test']}", "verdict": verdict, "parts": judged}
    row |= {"because": _reason(deciding, idle), "centre": entry["centre"]}
    return row | {"control_verdict": _control_verdict(deciding), "control_parts": list(controlled.values()),
                  "stand_in": entry.get("stand_in", "")}  # fmt: skip


def _control_verdict(deciding):
    """That of the part whose control is nearest to holding: one that holds is one too many."""
    found = [part["control_verdict"] for part in deciding if part["control_verdict"] != "none"]
    return min(found, key=list(VERDICTS).index, default="none")


def _strength(part):
    """Larger for a stronger verdict, then for a larger margin."""
    return -list(VERDICTS).index(part["verdict"]), part["margin"]


def _reason(deciding, idle):
    """One line that says what a verdict follows from: the parts that do not hold, or the one that does so nearest."""
    shown = [part for part in deciding if part["verdict"] != "holds"] or idle or [min(deciding, key=_strength)]
    held = sum(part["verdict"] == "holds" for part in deciding)
    words = [f"{held} of {len(deciding)} parts hold", *map(_told, shown), f"control: {_control_verdict(deciding)}"]
    words += [f"the cause is not shown, as the control holds too in '{part['label']}'" for part in idle]
    return "; ".join(words)


def _told(part):
    interval = "no interval" if part["interval"] is None else "{:.3g} to {:.3g}".format(*part["interval"])
    number = f"{part['measured']:.3g} {part['unit']}".rstrip()
    words = f"{part['label']}: {number} ({interval}, n = {part['n']}), asked: {part['thesis']}"
    return f"{words}: {part['verdict']}" + (f", {part['power']}" if part["power"] else "")


def within_bounds(row):
    """Whether all numbers that decide a claim lie within their bounds, given its row; says nothing of intervals."""
    bounds = {label: _bounds(part) for label, part in ledger()[row["id"]]["parts"].items() if part["decides"]}
    measured = {part["label"]: part["measured"] for part in row["parts"]}
    return all(low < measured[label] < high for label, (low, high) in bounds.items() if label in measured)


def published(identity):
    """Return the published numbers of a figure or table such as "F4.2", as nested dicts of numbers and lists."""
    tables = read_toml(LEDGER).get("published", {})
    require(identity in tables, f"no published numbers for '{identity}' in claims.toml: it has {', '.join(tables)}")
    return tables[identity]


def ledger():
    """Return {id: claim} of claims.toml, `decides` and `centre` filled in; refuses a row that is not complete."""
    claims = {}
    for row in read_toml(LEDGER).get("claim", []):
        where = f"claims.toml: {row.get('id', '(a claim without id)')}"
        missing, unknown = CLAIM_KEYS - row.keys(), row.keys() - CLAIM_KEYS - OPTIONAL_KEYS
        require(not missing, f"{where} lacks {', '.join(sorted(missing))}")
        require(not unknown, f"{where} has the unknown key {', '.join(sorted(unknown))}")
        require(row["kind"] in KINDS, f"{where} needs a kind of {KINDS}")
        require(row["profile"] in PROFILES, f"{where} needs a profile of {PROFILES}")
        require(row.get("centre", "mean") in CENTRES, f"{where} needs a centre of {', '.join(CENTRES)}")
        require(row["id"] not in claims, f"{where} stands there twice")
        for label, part in row["parts"].items():
            low, high = _bounds(part)
            good = part.keys() <= PART_KEYS and low < high and np.isfinite([low, high]).any()
            require(good and part.get("control", "none: ").startswith("none: "),
                    f"{where} part '{label}' needs bounds (at_least, at_most, or thesis and tolerance), keys of "
                    f"{PART_KEYS}, and as its control 'none: why' or nothing")
        parts = {label: {"decides": True} | part for label, part in row["parts"].items()}
        claims[row["id"]] = {"centre": "mean"} | row | {"parts": parts}
    return claims


def _bounds(part):
    """Lowest and highest value with which a part of the ledger still holds; infinite where it has no bound."""
    if "tolerance" in part:
        thesis = part.get("thesis", np.nan)  # which no bounds fit
        return thesis - part["tolerance"], thesis + part["tolerance"]
    return part.get("at_least", -np.inf), part.get("at_most", np.inf)


def _judge_controls(entry, controls):
    """{label: the judged part of the control that is nearest to holding}; refuses a part that lacks its control."""
    named = {label for label, part in entry["parts"].items() if _is_controlled(entry, part)}
    require(named or not controls, f"claim {entry['id']} has no control in claims.toml: describe it there first")
    found = {}
    for part in [part for control in controls for part in _judge_parts(entry, control)]:
        found[part["label"]] = max(part, found.get(part["label"], part), key=_strength)
    for label in sorted(named - found.keys()):
        require(not entry["parts"][label]["decides"], f"claim {entry['id']} needs its control ({entry['control']}) in "
                f"'{label}': hand over control={{...}} or say in claims.toml why there is none")  # fmt: skip
    return {label: part for label, part in found.items() if label in named}


def _is_controlled(entry, part):
    return not part.get("control", entry["control"]).startswith("none: ")


def _judge_parts(entry, samples):
    for label, numbers in samples.items():
        known = ", ".join(entry["parts"])
        require(label in entry["parts"], f"claim {entry['id']} has no part '{label}': it has {known}")
        require(numbers is not None, f"claim {entry['id']}: part '{label}' is missing; hand over its samples")
    return [judge_part(entry, label, numbers) for label, numbers in samples.items()]


def judge_part(entry, label, samples):
    """Return what one part measured: numbers, verdict, and the margin to its nearest bound in half intervals."""
    part, samples = entry["parts"][label], np.asarray(samples, dtype=float)
    if samples.ndim != 1 or not len(samples) or not np.isfinite(samples).all():
        raise ReproductionError(f"claim {entry['id']}: '{label}' needs one finite number a seed, got "
                                f"{samples.tolist()}")  # fmt: skip
    centre_of, interval_of, fewest = CENTRES[entry["centre"]]
    (low, high), n, centre, (bottom, top) = _bounds(part), len(samples), float(centre_of(samples)), interval_of(samples)
    verdict, power = "undecided", ""
    if n >= fewest:
        verdict = "holds" if low < bottom and top < high else verdict
        verdict = "contradicted" if top < low or bottom > high else verdict
    bound = low if centre - low < high - centre else high
    distance, reach = min(centre - low, high - centre), (top - bottom) / 2
    if verdict == "undecided" and reach > 0:
        needed = statistics.samples_needed(distance, reach, n)
        needed = needed and max(needed, fewest)
        power = f"{'more than 10,000' if needed is None else f'about {needed:,}'} samples would decide"
    p = statistics.paired_permutation(samples - bound, centre_of)
    test = f"sign flips of the samples against {bound:g}, two-sided" if p is not None else \
        f"no p: sign flips of {n} samples cannot give less than {2 / 2**n:.2g}"
    return {"label": label, "measure": part.get("measure", ""), "unit": part.get("unit", ""),
            "thesis": _expected(part), "measured": centre, "interval": [float(bottom), float(top)] if n > 1 else None,
            "n": n, "p": p, "test": test, "margin": float(distance / max(reach, 1e-9)) if n > 1 else 0.0,
            "verdict": verdict, "power": power, "decides": part["decides"]}


def _expected(part):
    if "tolerance" in part:
        return f"{part['thesis']:g} ± {part['tolerance']:g}"
    limits = [f"{key.replace('_', ' ')} {part[key]:g}" for key in ("at_least", "at_most") if key in part]
    return " and ".join(limits) + (f" (thesis: {part['thesis']:g})" if "thesis" in part else "")
