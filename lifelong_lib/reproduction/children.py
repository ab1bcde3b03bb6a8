"""Child processes: what surrounds each of them, and what one said before it failed."""

import os
import sys
from pathlib import Path

DRAWING = Path(__file__).with_name("pages") / "matplotlibrc"  # in place of the user's own, which changes every figure
LOCALE = "C.UTF-8" if sys.platform == "linux" else "C"  # macOS has no C.UTF-8; Python reads UTF-8 under plain C too


def surroundings(**more: str) -> dict[str, str]:
    """The environment of a child process: ours, with a locale that is there on every machine, and `more`.

    A locale that ssh brings along need not be installed here: Sphinx ends at once then, and others print warnings. The
    user's settings of matplotlib stay outside: with another backend a notebook has no pictures.
    """
    ours = {name: value for name, value in os.environ.items() if name != "MPLBACKEND"}
    return ours | {"LC_ALL": LOCALE, "PYTHONUTF8": "1", "MATPLOTLIBRC": str(DRAWING)} | more


def terminal():
    """The stream of this process's own standard error: in a kernel, what is not kept in the notebook's outputs."""
    own = getattr(sys.stderr, "_original_stdstream_copy", None)  # where ipykernel keeps it
    return sys.stderr if own is None else open(own, "w", closefd=False)


def warn(message: str) -> None:
    """One line on the terminal: warnings.warn would put this machine's paths into the notebook."""
    print(f"warning: {message}", file=terminal(), flush=True)


def last_words(output: str, lines: int = 6, letters: int = 600) -> str:
    """The end of what a child said, on one line: a traceback names its cause last."""
    said = [" ".join(line.split()) for line in output.splitlines() if line.strip()]
    text = " / ".join(said[-lines:]) or "it said nothing"
    return text if len(text) <= letters else "..." + text[-letters:]
