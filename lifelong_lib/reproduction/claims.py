"""The ledger: what the thesis claims, what a run measured, and what follows.

`data/thesis/claims.toml` holds every claim and every published number. A claim has parts; a part is one number with
bounds, measured once a seed. If the 95 % bootstrap interval of its mean lies inside the bounds, the part holds; if it
lies beside them, the part is contradicted; across an edge, it is undecided. A claim holds if all its parts do and is
contradicted if one is. A negative control, the same numbers with the claimed cause switched off, must not hold.
"""

import html
import json
import tomllib
from dataclasses import asdict, dataclass

import numpy as np

from lifelong_lib.reproduction.runs import PROFILES, ROOT, ReproductionError, write_atomically
from lifelong_lib.reproduction.statistics import bootstrap_interval, paired_permutation, standard_error

LEDGER = ROOT / "data" / "thesis" / "claims.toml"
FEWEST_SAMPLES = 3  # two numbers of one sign happen by chance in every second experiment
VERDICTS = ("contradicted", "undecided", "holds")  # from weak to strong
KINDS = ("value", "order", "sign", "shape")
CLAIM_KEYS = {"id", "chapter", "statement", "source", "kind", "profile", "control", "tolerance_origin", "parts"}
PART_KEYS = {"at_least", "at_most", "thesis", "tolerance", "measure", "decides"}


@dataclass(frozen=True)
class Claim:
    """One row of `claims.json`; thesis, measured, interval, n, test and p are those of its weakest deciding part."""

    id: str
    chapter: int
    statement: str
    source: str
    kind: str
    thesis: str
    measured: float
    interval: list | None
    n: int
    test: str
    p: float | None
    verdict: str
    control: str
    control_verdict: str
    control_parts: list
    remark: str
    tolerance_origin: str
    stand_in: str
    profile: str
    parts: list

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
    entry = ledger().get(identity)
    if entry is None or entry["chapter"] != chapter.number:
        known = ", ".join(key for key, row in ledger().items() if row["chapter"] == chapter.number)
        raise ReproductionError(f"claims.toml has no claim '{identity}' in chapter {chapter.number}: it has {known}")
    judged = [_judge(identity, label, part, parts.get(label)) for label, part in entry["parts"].items()]
    _no_others(identity, entry, parts)
    deciding = [part for part in judged if part["decides"]]
    verdict, remark = overall(deciding), ""
    control_verdict, control_parts = _judge_control(identity, entry, control)
    if control_verdict == "holds" and verdict == "holds":
        verdict, remark = "undecided", "the control holds too, so the cause is not shown"
    if PROFILES.index(chapter.profile) < PROFILES.index(entry["profile"]):
        verdict, remark = "not tested", f"needs the profile {entry['profile']}"
    weakest = min(deciding, key=lambda part: (VERDICTS.index(part["verdict"]), part["margin"]))
    row = {key: entry[key] for key in ("id", "chapter", "statement", "source", "kind", "control", "tolerance_origin")}
    row |= {key: weakest[key] for key in ("thesis", "measured", "interval", "n", "p")}
    claim = Claim(**row, test=f"{weakest['label']}: {weakest['test']}", verdict=verdict, remark=remark, parts=judged,
                  control_verdict=control_verdict, control_parts=control_parts, profile=chapter.profile,
                  stand_in=entry.get("stand_in", ""))
    _store(chapter.folder / "claims.json", asdict(claim))
    return claim


def overall(parts):
    """Return the verdict of a claim from the verdicts of its judged `parts` (list of dicts)."""
    return VERDICTS[min((VERDICTS.index(part["verdict"]) for part in parts), default=1)]


def bounds(part):
    """Return (lowest, highest) value with which a part of the ledger still holds; infinite where it has no bound."""
    if "tolerance" in part:
        return part["thesis"] - part["tolerance"], part["thesis"] + part["tolerance"]
    return part.get("at_least", -np.inf), part.get("at_most", np.inf)


def published(identity):
    """Return the published numbers of a figure or table such as "F4.2", as nested dicts of numbers and lists."""
    tables = _read_ledger().get("published", {})
    if identity not in tables:
        raise ReproductionError(f"no published numbers for '{identity}' in claims.toml: it has {', '.join(tables)}")
    return tables[identity]


def ledger(path=None):
    """Return {id: claim} of claims.toml, every part with `decides` filled in; refuses a row that is not complete."""
    claims = {}
    for row in _read_ledger(path).get("claim", []):
        name = row.get("id", "(a claim without id)")
        wrong = _what_is_wrong(row) or (name in claims and "stands there twice")
        if wrong:
            raise ReproductionError(f"claims.toml: {name} {wrong}")
        claims[name] = row | {"parts": {label: {"decides": True} | part for label, part in row["parts"].items()}}
    return claims


def read_claims(folder):
    """Return the rows of `<folder>/claims.json` (list of dicts, sorted by id), empty when no claim was checked yet."""
    path = folder / "claims.json"
    try:
        return json.loads(path.read_text(encoding="utf-8")) if path.exists() else []
    except ValueError as error:
        raise ReproductionError(f"{path} is damaged ({error}): delete it and run again") from error


def _read_ledger(path=None):
    path = path or LEDGER
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ReproductionError(f"cannot read {path}: {error.strerror}; restore it from the repository") from error
    except ValueError as error:
        raise ReproductionError(f"{path} is no valid TOML: {error}") from error


def _what_is_wrong(row):
    missing, unknown = CLAIM_KEYS - row.keys(), row.keys() - CLAIM_KEYS - {"stand_in"}
    if missing or unknown:
        return f"lacks {', '.join(sorted(missing))}" if missing else f"has the unknown key {', '.join(sorted(unknown))}"
    if row["kind"] not in KINDS or row["profile"] not in PROFILES:
        return f"needs a kind of {KINDS} and a profile of {PROFILES}"
    for label, part in row["parts"].items():
        low, high = bounds(part) if part.keys() <= PART_KEYS else (0, 0)
        if not low < high or not np.isfinite([low, high]).any():
            return f"part '{label}' needs bounds (at_least, at_most, or thesis and tolerance) and keys of {PART_KEYS}"
    return None


def _judge(identity, label, part, samples):
    """Return what one part measured: numbers, verdict, and the margin to its nearest bound in standard errors."""
    if samples is None:
        raise ReproductionError(f"claim {identity}: part '{label}' is missing; hand over its samples")
    samples = np.asarray(samples, dtype=float)
    if samples.ndim != 1 or not len(samples) or not np.isfinite(samples).all():
        raise ReproductionError(f"claim {identity}: '{label}' needs one finite number a seed, got {samples.tolist()}")
    (low, high), n, mean = bounds(part), len(samples), float(samples.mean())
    bottom, top = bootstrap_interval(samples, resamples=10_000)
    verdict = "undecided"
    if n >= FEWEST_SAMPLES:
        verdict = "holds" if low <= bottom and top <= high else verdict
        verdict = "contradicted" if top < low or bottom > high else verdict
    bound = low if mean - low < high - mean else high
    distance = min(mean - low, high - mean)
    error = standard_error(samples) if n > 1 else np.nan
    margin = distance / error if error > 0 else np.copysign(np.inf, distance) if distance else 0.0
    return {"label": label, "measure": part.get("measure", ""), "thesis": _expected(part), "measured": mean,
            "interval": [float(bottom), float(top)] if n > 1 else None, "n": n,
            "p": paired_permutation(samples - bound) if n > 1 else None, "margin": float(np.clip(margin, -1e9, 1e9)),
            "test": f"sign flips of the samples against {bound:g}, two-sided", "verdict": verdict,
            "decides": part["decides"]}


def _judge_control(identity, entry, control):
    if entry["control"].startswith("none: "):
        if control is not None:
            raise ReproductionError(f"claim {identity} has no control in claims.toml: describe it there first")
        return "none", []
    if not control:
        raise ReproductionError(f"claim {identity} needs its control ({entry['control']}): hand over control={{...}}")
    _no_others(identity, entry, control)
    judged = [_judge(identity, label, entry["parts"][label], samples) for label, samples in control.items()]
    return overall([part for part in judged if part["decides"]]), judged


def _no_others(identity, entry, samples):
    others = samples.keys() - entry["parts"].keys()
    if others:
        raise ReproductionError(f"claim {identity} has no part '{min(others)}': it has {', '.join(entry['parts'])}")


def _expected(part):
    if "tolerance" in part:
        return f"{part['thesis']:g} ± {part['tolerance']:g}"
    limits = [f"{key.replace('_', ' ')} {part[key]:g}" for key in ("at_least", "at_most") if key in part]
    return " and ".join(limits) + (f" (thesis: {part['thesis']:g})" if "thesis" in part else "")


def _store(path, row):
    known = ledger()
    kept = {old["id"]: old for old in read_claims(path.parent) if old["id"] in known} | {row["id"]: row}
    rows = [kept[key] for key in sorted(kept, key=lambda key: [int(number) for number in key[1:].split(".")])]
    write_atomically(path, json.dumps(rows, indent=1, ensure_ascii=False, allow_nan=False) + "\n")
