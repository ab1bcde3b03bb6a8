"""The web pages that a run ends with: every figure beside the reference, the verdicts, the chapters, what failed.

Sphinx and myst-nb build them from the executed notebooks and the files in `figures/latest/<profile>`.
"""

from __future__ import annotations

import csv
import html
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import nbformat
from docutils import nodes
from docutils.utils.math import MathError
from docutils.utils.math.latex2mathml import tex2mathml
from sphinx.util import logging

from .fingerprint import SOURCES
from .notebooks import cell_ids, made_ids
from .report import order, read_json, verdict_counts
from .runs import ROOT, ReproductionError

CONFIGURATION = """
project = html_title = "Lifelong reinforcement learning on mobile robots, reproduced"
author = "The lifelong reproduction authors"
extensions = ["myst_nb", "lifelong_lib.reproduction.book"]
html_theme = "sphinx_book_theme"
html_theme_options = {"home_page_in_toc": True, "use_download_button": False, "use_fullscreen_button": False}
html_static_path = ["_static"]
html_css_files = ["book.css"]
html_copy_source = html_show_sphinx = html_show_copyright = False
html_last_updated_fmt = None
html_math_renderer = "mathml"
nb_execution_mode = "off"
nb_output_stderr = "remove"
nb_ipywidgets_js = {}
myst_enable_extensions = ["dollarmath", "amsmath", "deflist"]
suppress_warnings = ["myst.header", "mystnb.unknown_mime_type"]
"""


def build_book(folder: Path, reference: Path) -> Path:
    """Builds the web pages in `folder`/book from the executed notebooks and the results; returns index.html.

    They need no network: formulas become MathML, and every picture, style and script is a file of the book.
    """
    claims = read_json(folder / "claims.json", [])
    homes = {identifier: path.stem for path in sorted((folder / "notebooks").glob("ch*.ipynb"))
             for identifier in made_ids(path)}
    with tempfile.TemporaryDirectory(prefix="lifelong-book-") as temporary:
        source, out = Path(temporary, "source"), Path(temporary, "out")
        (source / "chapters").mkdir(parents=True)
        (source / "conf.py").write_text(CONFIGURATION)
        _copy_pictures(folder, reference, source / "_static")
        for path in sorted((folder / "notebooks").glob("ch*.ipynb")):
            nbformat.write(_chapter_page(path), source / "chapters" / path.name)
        pages = {"index": _front_page(folder, reference, claims, homes), "claims": _claims_page(claims, homes),
                 "not_reproduced": _missing_page(claims), "deviations": (ROOT / "DEVIATIONS.md").read_text(),
                 "recordings": _recordings_page(folder), "provenance": _provenance_page(folder)}
        for name, text in pages.items():
            (source / f"{name}.md").write_text(text)
        command = [sys.executable, "-m", "sphinx", "-b", "html", "-q", "-E", "-d", f"{temporary}/doctrees",
                   str(source), str(out)]
        done = subprocess.run(command, cwd=SOURCES, capture_output=True, text=True)
        if done.returncode:
            raise ReproductionError(f"the book could not be built: {' '.join(done.stderr.split())[:300]}")
        sys.stderr.write(done.stderr.replace(f"{source}/", ""))
        shutil.rmtree(folder / "book", ignore_errors=True)
        shutil.move(out, folder / "book")
    return folder / "book" / "index.html"


def _copy_pictures(folder: Path, reference: Path, static: Path) -> None:
    for name, place in (("latest", folder), ("reference", reference), ("recordings", folder / "recordings")):
        (static / name).mkdir(parents=True)
        for path in sorted(place.glob("*.png")):
            shutil.copyfile(path, static / name / path.name)
    shutil.copyfile(Path(__file__).with_name("book.css"), static / "book.css")


def _chapter_page(path: Path) -> nbformat.NotebookNode:
    """The executed copy with a place to link to before every cell that makes a result, and without clock times."""
    notebook, cells = nbformat.read(path, as_version=4), []
    notebook.metadata.pop("papermill", None)
    for cell in notebook.cells:
        cell.metadata.pop("papermill", None)
        anchors = "".join(f'<a id="{name}"></a>' for name in cell_ids(cell.source) if cell.cell_type == "code")
        cells += [nbformat.v4.new_markdown_cell(anchors, id=f"at-{cell.id}"[:64])] if anchors else []
        cells.append(cell)
    notebook.cells = cells
    return notebook


def _badge(row: dict, homes: dict[str, str]) -> str:
    style = row["verdict"].replace(" ", "-")
    text = f'<span class="verdict {style}">{row["id"]} {row["verdict"]}</span>'
    return f'<a href="{_link(row["id"], homes)}" title="{html.escape(str(row["statement"]))}">{text}</a>'


def _link(identifier: str, homes: dict[str, str]) -> str:
    return f"chapters/{homes[identifier]}.html#{identifier}" if identifier in homes else "claims.html"


def _counts(claims: list[dict]) -> str:
    return " ".join(f'<span class="verdict {verdict.replace(" ", "-")}">{number} {verdict}</span>'
                    for verdict, number in verdict_counts(claims).items())


def _front_page(folder: Path, reference: Path, claims: list[dict], homes: dict[str, str]) -> str:
    rests = [set(read_json(path, {})["makes"]) for path in sorted((folder / "runs").glob("*.json"))]
    compared = {row["id"]: row for row in read_json(folder / "comparison.json", {}).get("results", [])}
    chapters = "\n".join(f"chapters/{path.stem}" for path in sorted((folder / "notebooks").glob("ch*.ipynb")))
    parts = ["# Lifelong reinforcement learning on mobile robots, reproduced",
             f'<p>Made at the profile <b>{folder.name}</b>. <a href="claims.html">The claims of the thesis</a>: '
             f"{_counts(claims)}</p>",
             "Left: what this run made. Right: the committed reference. A badge is a claim that rests on the same "
             "runs; it leads to the place in the chapter where it is judged."]
    for path in sorted(folder.glob("[FT]*.csv"), key=lambda path: order(path.stem)):
        name, row = path.stem, compared.get(path.stem, {})
        heading = next(iter(made_ids(folder / "notebooks" / f"{homes[name]}.ipynb")[name])) if name in homes else ""
        badges = " ".join(_badge(c, homes) for c in claims if any({name, c["id"]} <= makes for makes in rests))
        places = [(title, f"_static/{title}/{name}.png") for title, place in
                  (("latest", folder), ("reference", reference)) if (place / f"{name}.png").exists()]
        images = "".join(f'<a href="{file}"><img src="{file}" alt="{name}, {title}"></a>' for title, file in places)
        said = "; ".join(f"{key} {row[key]}" for key in ("data", "picture") if row.get(key))
        parts += [f"## {heading}" if name in heading else f"## {name} {heading}",
                  f'<p><a href="{_link(name, homes)}">in its chapter</a> '
                  f'<span class="same">{html.escape(said)}</span></p>',
                  f'<div class="pair">{images}</div>' if images else _table(folder / f"{name}.csv"), badges]
    parts.append("```{toctree}\n:hidden:\n" + chapters + "\nclaims\nnot_reproduced\ndeviations\nrecordings\n"
                 "provenance\n```\n")
    return "\n\n".join(parts)


def _rows(header: list[str], rows: list[list[str]]) -> str:
    """An HTML table; cells are HTML already."""
    def line(cells: list[str], tag: str) -> str:
        return "<tr>" + "".join(f"<{tag}>{cell}</{tag}>" for cell in cells) + "</tr>"
    body = "".join(line(row, "td") for row in rows)
    return f'<div class="wide"><table class="table">{line(header, "th")}{body}</table></div>'


def _table(path: Path) -> str:
    header, *rows = [[html.escape(_number(cell)) for cell in row] for row in csv.reader(path.read_text().splitlines())]
    return _rows(header, rows)


def _number(value: object) -> str:
    """A value as a reader wants it: four digits for numbers, a dash for nothing."""
    if value is None:
        return "–"
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(map(_number, value)) + "]"
    if isinstance(value, dict):
        return "; ".join(f"{key}: {_number(item)}" for key, item in value.items())
    try:
        return f"{float(value):.4g}" if "." in str(value) or "e" in str(value) else str(value)
    except ValueError:
        return str(value)


def _claims_page(claims: list[dict], homes: dict[str, str]) -> str:
    rows = [[f'<a href="{_link(row["id"], homes)}">{row["id"]}</a>']
            + [html.escape(_number(row.get(key))) for key in ("statement", "thesis", "measured", "interval", "n", "p")]
            + [_badge(row, homes), html.escape(_number(row.get("control_verdict")))] for row in claims]
    header = ["claim", "statement", "thesis", "measured", "interval", "seeds", "p", "verdict", "with it switched off"]
    return f"# The claims\n\n<p>{_counts(claims)}</p>\n\n{_rows(header, rows)}\n"


def _missing_page(claims: list[dict]) -> str:
    """The claims that do not hold, each with the section of findings.md that is headed by its id."""
    path = ROOT / "data" / "thesis" / "findings.md"
    text = path.read_text() if path.exists() else ""
    introduction, *sections = re.split(r"^## +", text, flags=re.MULTILINE)
    findings = dict(section.partition("\n")[::2] for section in sections)
    parts = ["# What did not reproduce and why", re.sub(r"^# .*", "", introduction, flags=re.MULTILINE).strip()]
    for row in [row for row in claims if row["verdict"] != "holds"]:
        said = [title for title in findings if row["id"] in re.split(r"[^\w.]+", title)]
        why = "\n\n".join(findings[title].strip() for title in said) or (
            "This profile is too small to decide it." if row["verdict"] == "not tested" else "Not explained yet.")
        parts += [f"## {row['id']}: {row['verdict']}", f"<p>{html.escape(row['statement'])}</p>",
                  f"<p>thesis {html.escape(_number(row.get('thesis')))}; measured "
                  f"{html.escape(_number(row.get('measured')))}, interval {_number(row.get('interval'))}</p>", why]
    parts += [f"## {title}\n{body}" for title, body in findings.items() if not re.match(r"C\d", title)]
    return "\n\n".join(parts) + "\n"


def _recordings_page(folder: Path) -> str:
    parts = ["# Recordings", "Open one with `.venv/bin/rerun FILE`; the viewer's time line plays it."]
    for path in sorted((folder / "recordings").glob("*.rrd")):
        still = path.with_suffix(".png").name
        caption = path.with_suffix(".md")
        parts += [f"## {path.stem}", caption.read_text() if caption.exists() else "",
                  f'<p><a href="../recordings/{path.name}">recordings/{path.name}</a></p>',
                  f'<p><img src="_static/recordings/{still}" alt="still of {path.stem}"></p>'
                  if path.with_suffix(".png").exists() else ""]
    return "\n\n".join(parts) + "\n"


def _provenance_page(folder: Path) -> str:
    made = read_json(folder / "provenance.json", {})
    chapters = made.get("chapters", {}).items()
    facts = [[html.escape(key), html.escape(_number(made.get(key)))]
             for key in ("profile", "commit", "lock", "machine", "versions")]
    runs = [[chapter, html.escape(name), *(str(counts[key]) for key in ("wanted", "computed", "read", "stale"))]
            for chapter, entry in chapters for name, counts in entry["runs"].items()]
    knobs = [[chapter, html.escape(_number(entry["parameters"]))] for chapter, entry in chapters]
    header = ["chapter", "experiment", "runs", "computed", "read", "made by older code"]
    return "\n\n".join(["# Where this comes from", _rows(["what", "value"], facts), "## Runs", _rows(header, runs),
                        "## Parameters", _rows(["chapter", "values"], knobs), ""])


def setup(app) -> dict:
    """Makes Sphinx write formulas as MathML, which browsers draw themselves: no script, no font, no network."""
    def draw(translator, node: nodes.Element) -> None:
        text = node.astext()
        tag = re.search(r"\\tag\{(.*?)\}", text)
        block = isinstance(node, nodes.math_block)
        try:
            drawn = tex2mathml(text.replace(tag.group(0), "") if tag else text, as_block=block)
        except MathError as error:
            logging.getLogger(__name__).warning("formula left as text (%s): %s", error, text, location=node)
            drawn = f"<code>{html.escape(text)}</code>"
        number = f'<span class="eqno">({tag.group(1)})</span>' if tag else ""
        translator.body.append(f'<div class="formula">{drawn}{number}</div>' if block else drawn)
        raise nodes.SkipNode
    app.add_html_math_renderer("mathml", inline_renderers=(draw, None), block_renderers=(draw, None))
    return {"parallel_read_safe": True}
