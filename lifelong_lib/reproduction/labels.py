"""Names that stand under results: ids such as F4.2, T4.1 and C4.5, their order, and what a verdict means."""

import re

from lifelong_lib.reproduction.files import require

VERDICTS = {  # from strong to weak
    "holds": "the whole interval of what we measured lies where the thesis says",
    "undecided": "the interval also covers the other side, or the claim's negative control holds too",
    "contradicted": "the whole interval lies elsewhere",
    "not tested": "this profile is too small to tell",
}


def order(identifier: str) -> list:
    """["F", 4, ".", 9] for F4.9, which comes before F4.10; the second entry is the chapter."""
    return [int(part) if part.isdigit() else part for part in re.findall(r"\d+|\D+", identifier)]


def check_identity(chapter, identity, letter):
    """Raise ReproductionError unless `identity` is a name such as F4.2 that belongs to `chapter`."""
    message = f"'{identity}' is no id of this chapter: use {letter}{chapter.number}.1 and so on"
    require(re.fullmatch(rf"{letter}{chapter.number}\.\d+", identity), message)
