"""Child processes: what surrounds each of them, and what one said before it failed."""

import os
import sys

LOCALE = "C.UTF-8" if sys.platform == "linux" else "C"  # macOS has no C.UTF-8; Python reads UTF-8 under plain C too


def surroundings(**more: str) -> dict[str, str]:
    """The environment of a child process: ours with a locale that is there on every machine, and `more`.

    A locale that ssh brings along need not be installed here: Sphinx ends at once then, and others print warnings.
    """
    return os.environ | {"LC_ALL": LOCALE, "PYTHONUTF8": "1"} | more


def last_words(output: str, lines: int = 6, letters: int = 600) -> str:
    """The end of what a child said, on one line: a traceback names its cause last."""
    said = [" ".join(line.split()) for line in output.splitlines() if line.strip()]
    text = " / ".join(said[-lines:]) or "it said nothing"
    return text if len(text) <= letters else "..." + text[-letters:]
