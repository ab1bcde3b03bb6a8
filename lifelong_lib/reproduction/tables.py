"""Results as tables: a file with every digit, a file to read, and an object that a notebook shows."""

import csv
import html
import io
import math
from dataclasses import dataclass
from numbers import Integral, Real

from lifelong_lib.reproduction.files import require, write_atomically
from lifelong_lib.reproduction.labels import check_identity
from lifelong_lib.reproduction.statistics import standard_error


@dataclass(frozen=True)
class Table:
    """Rows (list of flat dicts) that display as a table in a notebook and as Markdown in a terminal."""

    rows: list

    def __repr__(self):
        names, *lines = self.cells()
        lines = [[cell.replace("|", "\\|") for cell in line] for line in (names, ["---"] * len(names), *lines)]
        return "\n".join(f"| {' | '.join(line)} |" for line in lines)

    def _repr_html_(self):
        head, *body = ["".join(f"<td>{html.escape(cell)}</td>" for cell in line) for line in self.cells()]
        head = head.replace("td>", "th>")
        return f"<table><thead><tr>{head}</tr></thead><tbody><tr>{'</tr><tr>'.join(body)}</tr></tbody></table>"

    def cells(self):
        """Return the table as lists of text, the column names first."""
        names = columns(self.rows)
        return [names, *([readable(row.get(name)) for name in names] for row in self.rows)]


def save_table(chapter, identity, rows):
    """Write `<identity>.csv` (every digit) and `<identity>.md` (to read) to the chapter's folder; return a Table.

    `identity`: id of the inventory, such as "T4.1"; `rows`: list of flat dicts of text, numbers or None.
    """
    check_identity(chapter, identity, "T")
    write_atomically(chapter.folder / f"{identity}.csv", csv_text(identity, rows))
    write_atomically(chapter.folder / f"{identity}.md", f"{Table(rows)!r}\n")
    return Table(rows)


def readable(value):
    """Return `value` as short text: four figures for a broken number, nothing for None, a dash for nan."""
    if isinstance(value, Real) and not isinstance(value, Integral):
        return "–" if math.isnan(value) else f"{value:.4g}"
    return "" if value is None else " ".join(str(value).split())


def with_error(samples, mean=".3f", error=".3f"):
    """Return the mean of `samples` (n,) and its standard error as text: "0.512 ± 0.021". `mean`, `error`: formats."""
    return f"{samples.mean():{mean}} ± {standard_error(samples):{error}}"


def columns(rows):
    """Return the names of all columns of `rows` in the order in which they first appear."""
    return list(dict.fromkeys(name for row in rows for name in row))


def csv_text(identity, rows):
    """Return `rows` as comma-separated text with the shortest digits that give each float back exactly."""
    nested = [name for row in rows for name, value in row.items() if not isinstance(value, str | Real | None)]
    mend = "hand over one flat dictionary for each drawn point"
    require(rows, f"{identity}: there are no rows; {mend}")
    require(not nested, f"{identity}: column '{', '.join(nested)}' holds more than a text or a number; {mend}")
    text = io.StringIO()
    writer = csv.DictWriter(text, columns(rows), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()
