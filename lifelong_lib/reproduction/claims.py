"""The ledger: what the thesis claims, what a run measured, and what follows.

`data/thesis/claims.toml` holds every claim and every published number. A claim has parts; a part is one number with
bounds, measured once a seed. If the 95 % bootstrap interval of its mean lies inside the bounds, the part holds; if it
lies beside them, the part is contradicted; across an edge, it is undecided. A claim holds if all its parts do and is
contradicted if one is. A negative control, the same numbers with the claimed cause switched off, must not hold.
"""

import html
import tomllib
from types import SimpleNamespace

import numpy as np

from lifelong_lib.reproduction.files import ROOT, ReproductionError, read_json, require, write_json
from lifelong_lib.reproduction.labels import VERDICTS, order
from lifelong_lib.reproduction.runs import PROFILES
from lifelong_lib.reproduction.statistics import bootstrap_interval, paired_permutation, standard_error

LEDGER = ROOT / "data" / "thesis" / "claims.toml"
FEWEST_SAMPLES = 3  # two numbers of one sign happen by chance in every second experiment
KINDS = ("value", "order", "sign", "shape")
CLAIM_KEYS = {"id", "chapter", "statement", "source", "kind", "profile", "control", "tolerance_origin", "parts"}
PART_KEYS = {"at_least", "at_most", "thesis", "tolerance", "measure", "decides"}


class Claim(SimpleNamespace):
    """One row of `claims.json`; thesis, measured, interval, n, test and p are those of its weakest deciding part."""

    def __repr__(self):
        low, high = self.interval or (np.nan, np.nan)
        chance = "" if self.p is None else f", p = {self.p:.2g}"
        return (f"{self.id} {self.verdict}: {self.statement} | {self.test.rpartition(': ')[0]}: {self.measured:.3g} "
                f"[{low:.3g}, {high:.3g}], n = {self.n}{chance}; thesis: {self.thesis}; control {self.control_verdict}"
                + (f" ({self.remark})" if self.remark else ""))

    def _repr_html_(self):
        name, rest = repr(self).split(":", 1)
        return f"<p><b>{html.escape(name)}</b>:{html.escape(rest)}</p>"


def check_claim(chapter, identity, parts, control=None):
    """Judge the claim `identity`, write its row to `<chapter.folder>/claims.json` and return it as a Claim.

    `parts`: {label of the ledger: samples (n_seeds,)}, all labels of the claim; `control`: the same (or fewer) labels
    measured with the cause switched off, None only where the ledger says that there is no control.
    Raises ReproductionError for an unknown claim or label, a missing part or control, and numbers that are not finite.
    """
    known = ledger()
    names = [name for name, entry in known.items() if entry["chapter"] == chapter.number]
    require(identity in names,
            f"claims.toml has no claim '{identity}' in chapter {chapter.number}: it has {', '.join(names)}")
    entry = known[identity]
    judged = _judge_parts(entry, dict.fromkeys(entry["parts"]) | parts)  # in the ledger's order, None where missing
    weakest = min((part for part in judged if part["decides"]),
                  key=lambda part: (_strength(part["verdict"]), part["margin"]))  # fmt: skip
    verdict, remark = weakest["verdict"], ""
    control_verdict, control_parts = _judge_control(entry, control)
    if control_verdict == "holds" and verdict == "holds":
        verdict, remark = "undecided", "the control holds too, so the cause is not shown"
    if PROFILES.index(chapter.profile) < PROFILES.index(entry["profile"]):
        verdict, remark = "not tested", f"needs the profile {entry['profile']}"
    row = {key: entry[key] for key in ("id", "chapter", "statement", "source", "kind", "control", "tolerance_origin")}
    row |= {key: weakest[key] for key in ("thesis", "measured", "interval", "n", "p")}
    row |= {"test": f"{weakest['label']}: {weakest['test']}", "verdict": verdict, "remark": remark, "parts": judged}
    row |= {"control_verdict": control_verdict, "control_parts": control_parts}
    row |= {"stand_in": entry.get("stand_in", ""), "profile": chapter.profile}
    path = chapter.folder / "claims.json"
    rows = [old for old in read_json(path, []) if old["id"] in known.keys() - {identity}]
    write_json(path, sorted([*rows, row], key=lambda row: order(row["id"])))
    return Claim(**row)


def _strength(verdict):
    """A number that is higher for a stronger verdict."""
    return -list(VERDICTS).index(verdict)


def published(identity):
    """Return the published numbers of a figure or table such as "F4.2", as nested dicts of numbers and lists."""
    tables = _read_ledger().get("published", {})
    require(identity in tables, f"no published numbers for '{identity}' in claims.toml: it has {', '.join(tables)}")
    return tables[identity]


def ledger():
    """Return {id: claim} of claims.toml, every part with `decides` filled in; refuses a row that is not complete."""
    claims = {}
    for row in _read_ledger().get("claim", []):
        where = f"claims.toml: {row.get('id', '(a claim without id)')}"
        missing, unknown = CLAIM_KEYS - row.keys(), row.keys() - CLAIM_KEYS - {"stand_in"}
        require(not missing, f"{where} lacks {', '.join(sorted(missing))}")
        require(not unknown, f"{where} has the unknown key {', '.join(sorted(unknown))}")
        require(row["kind"] in KINDS, f"{where} needs a kind of {KINDS}")
        require(row["profile"] in PROFILES, f"{where} needs a profile of {PROFILES}")
        require(row["id"] not in claims, f"{where} stands there twice")
        for label, part in row["parts"].items():
            low, high = _bounds(part)
            good = part.keys() <= PART_KEYS and low < high and np.isfinite([low, high]).any()
            require(good, f"{where} part '{label}' needs bounds (at_least, at_most, or thesis and tolerance) "
                          f"and keys of {PART_KEYS}")
        claims[row["id"]] = row | {"parts": {label: {"decides": True} | part for label, part in row["parts"].items()}}
    return claims


def _read_ledger():
    try:
        return tomllib.loads(LEDGER.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ReproductionError(f"{LEDGER} is missing or no valid TOML ({error}); restore or mend it") from error


def _bounds(part):
    """Lowest and highest value with which a part of the ledger still holds; infinite where it has no bound."""
    if "tolerance" in part:
        thesis = part.get("thesis", np.nan)  # which no bounds fit
        return thesis - part["tolerance"], thesis + part["tolerance"]
    return part.get("at_least", -np.inf), part.get("at_most", np.inf)


def _judge_control(entry, control):
    if entry["control"].startswith("none: "):
        require(control is None, f"claim {entry['id']} has no control in claims.toml: describe it there first")
        return "none", []
    require(control, f"claim {entry['id']} needs its control ({entry['control']}): hand over control={{...}}")
    judged = _judge_parts(entry, control)
    verdicts = [part["verdict"] for part in judged if part["decides"]]
    return min(verdicts, key=_strength, default="undecided"), judged


def _judge_parts(entry, samples):
    for label, numbers in samples.items():
        known = ", ".join(entry["parts"])
        require(label in entry["parts"], f"claim {entry['id']} has no part '{label}': it has {known}")
        require(numbers is not None, f"claim {entry['id']}: part '{label}' is missing; hand over its samples")
    return [_judge(entry["id"], label, entry["parts"][label], numbers) for label, numbers in samples.items()]


def _judge(identity, label, part, samples):
    """What one part measured: numbers, verdict, and the margin to its nearest bound in standard errors."""
    samples = np.asarray(samples, dtype=float)
    if samples.ndim != 1 or not len(samples) or not np.isfinite(samples).all():
        raise ReproductionError(f"claim {identity}: '{label}' needs one finite number a seed, got {samples.tolist()}")
    (low, high), n, mean = _bounds(part), len(samples), float(samples.mean())
    bottom, top = bootstrap_interval(samples, resamples=10_000)
    verdict = "undecided"
    if n >= FEWEST_SAMPLES:
        verdict = "holds" if low <= bottom and top <= high else verdict
        verdict = "contradicted" if top < low or bottom > high else verdict
    bound = low if mean - low < high - mean else high
    distance, error = min(mean - low, high - mean), standard_error(samples)
    margin = np.clip(distance / error if error > 0 else 1e9 * np.sign(distance), -1e9, 1e9)
    return {"label": label, "measure": part.get("measure", ""), "thesis": _expected(part), "measured": mean,
            "interval": [float(bottom), float(top)] if n > 1 else None, "n": n,
            "p": paired_permutation(samples - bound) if n > 1 else None, "margin": float(margin),
            "test": f"sign flips of the samples against {bound:g}, two-sided", "verdict": verdict,
            "decides": part["decides"]}


def _expected(part):
    if "tolerance" in part:
        return f"{part['thesis']:g} ± {part['tolerance']:g}"
    limits = [f"{key.replace('_', ' ')} {part[key]:g}" for key in ("at_least", "at_most") if key in part]
    return " and ".join(limits) + (f" (thesis: {part['thesis']:g})" if "thesis" in part else "")
