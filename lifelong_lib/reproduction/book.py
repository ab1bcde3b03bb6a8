"""The web pages that a run ends with: every figure beside the reference, the verdicts, the chapters, what failed.

Sphinx and myst-nb build them from the executed notebooks and the files in `figures/latest/<profile>`.
"""

import html
import json
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

from lifelong_lib.reproduction.children import last_words, surroundings
from lifelong_lib.reproduction.files import ROOT, read_json, require
from lifelong_lib.reproduction.fingerprint import SOURCES
from lifelong_lib.reproduction.grid import read_summaries
from lifelong_lib.reproduction.labels import VERDICTS, order
from lifelong_lib.reproduction.notebooks import made_ids, named_in_calls
from lifelong_lib.reproduction.report import verdict_counts
from lifelong_lib.reproduction.tables import Table, readable

CONFIGURATION = """
project = html_title = "Lifelong reinforcement learning on mobile robots, reproduced"
author = "The lifelong reproduction authors"
extensions = ["myst_nb", "lifelong_lib.reproduction.book"]
html_theme = "sphinx_book_theme"
html_theme_options = {"home_page_in_toc": True, "use_download_button": False, "use_fullscreen_button": False}
html_static_path = ["_static"]
html_css_files = ["book.css"]
html_copy_source = html_show_sphinx = html_show_copyright = False
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
    copies = sorted((folder / "notebooks").glob("ch*.ipynb"))
    places = {name: (path.stem, headings[0]) for path in copies for name, headings in made_ids(path).items()}
    pages = {"index": _front_page(folder, reference, claims, places), "claims": _claims_page(claims, places),
             "not_reproduced": _missing_page(claims), "deviations": (ROOT / "DEVIATIONS.md").read_text(),
             "recordings": _recordings_page(folder), "provenance": _provenance_page(folder)}
    contents = [f"chapters/{path.stem}" for path in copies] + list(pages)[1:]
    pages["index"] += "\n\n```{toctree}\n:hidden:\n" + "\n".join(contents) + "\n```\n"
    with tempfile.TemporaryDirectory(prefix="lifelong-book-") as temporary:
        source, out = Path(temporary, "source"), Path(temporary, "out")
        for name, place in (("latest", folder), ("reference", reference), ("recordings", folder / "recordings")):
            (source / "_static" / name).mkdir(parents=True)
            for path in sorted(place.glob("*.png")):
                shutil.copyfile(path, source / "_static" / name / path.name)
        shutil.copyfile(Path(__file__).with_name("book.css"), source / "_static" / "book.css")
        (source / "conf.py").write_text(CONFIGURATION)
        (source / "chapters").mkdir()
        for path in copies:
            nbformat.write(_chapter_page(path), source / "chapters" / path.name)
        for name, text in pages.items():
            (source / f"{name}.md").write_text(text)
        command = [sys.executable, "-m", "sphinx", "-b", "html", "-q", "-E", "-d", f"{temporary}/doctrees",
                   str(source), str(out)]
        done = subprocess.run(command, cwd=SOURCES, env=surroundings(), capture_output=True, text=True)
        require(done.returncode == 0, f"the book could not be built: {last_words(done.stderr)}")
        sys.stderr.write(done.stderr.replace(f"{source}/", ""))
        shutil.rmtree(folder / "book", ignore_errors=True)
        shutil.move(out, folder / "book")
    return folder / "book" / "index.html"


def _chapter_page(path: Path) -> nbformat.NotebookNode:
    """The executed copy with a place to link to before every cell that makes a result."""
    notebook, cells = nbformat.read(path, as_version=4), []
    for cell in notebook.cells:
        anchors = "".join(f'<a id="{name}"></a>' for name in named_in_calls(cell.source) if cell.cell_type == "code")
        cells += [nbformat.v4.new_markdown_cell(anchors, id=f"at-{cell.id}"[:64])] if anchors else []
        cells.append(cell)
    notebook.cells = cells
    return notebook


def _link(identifier: str, places: dict, inside: str, about: str = "") -> str:
    """A link to the cell that makes a result; to the claims page when no chapter of this run does."""
    address = f"chapters/{places[identifier][0]}.html#{identifier}" if identifier in places else "claims.html"
    return f'<a href="{address}" title="{html.escape(about)}">{inside}</a>'


def _badge(verdict: str, text: str) -> str:
    meaning = html.escape(VERDICTS[verdict])
    return f'<span class="verdict {verdict.replace(" ", "-")}" title="{meaning}">{text} {verdict}</span>'


def _counts(claims: list[dict]) -> str:
    return " ".join(_badge(verdict, str(number)) for verdict, number in verdict_counts(claims).items())


def _front_page(folder: Path, reference: Path, claims: list[dict], places: dict) -> str:
    rests = [set(grid.makes) for grid in read_summaries(folder)]
    compared = {row["id"]: row for row in read_json(folder / "comparison.json", {}).get("results", [])}
    parts = ["# Lifelong reinforcement learning on mobile robots, reproduced",
             f"Made at the profile **{folder.name}**. [The claims of the thesis](claims.md): {_counts(claims)}",
             "Left: what this run made. Right: the committed reference. A badge is a claim that rests on the same "
             "runs; it leads to the place in the chapter where it is judged."]
    for name in sorted((path.stem for path in folder.glob("[FT]*.csv")), key=order):
        heading, row = places.get(name, ("", ""))[1], compared.get(name, {})
        said = "; ".join(f"{key} {row[key]}" for key in ("data", "picture") if row.get(key))
        shown = [f"_static/{kind}/{name}.png" for kind, place in (("latest", folder), ("reference", reference))
                 if (place / f"{name}.png").exists()]
        images = "".join(f'<a href="{file}"><img src="{file}" alt="{name}"></a>' for file in shown)
        badges = [_link(claim["id"], places, _badge(claim["verdict"], claim["id"]), claim["statement"])
                  for claim in claims if any({name, claim["id"]} <= makes for makes in rests)]
        parts += [f"## {heading}" if name in heading else f"## {name} {heading}",
                  f'{_link(name, places, "in its chapter")} <span class="same">{html.escape(said)}</span>',
                  f'<div class="pair">{images}</div>' if images else (folder / f"{name}.md").read_text(),
                  " ".join(badges)]
    return "\n\n".join(parts)


def _part(claim: dict) -> str:
    """The weakest deciding part, whose numbers stand for the claim."""
    return html.escape(claim.get("test", "").rpartition(": ")[0])


def _measured(claim: dict) -> str:
    low_high = ", ".join(map(readable, claim.get("interval") or []))
    return readable(claim.get("measured")) + (f" ({low_high})" if low_high else "")


def _claims_page(claims: list[dict], places: dict) -> str:
    rows = [{"claim": _link(claim["id"], places, claim["id"]), "statement": html.escape(claim["statement"]),
             "weakest part": _part(claim), "thesis": claim.get("thesis"), "measured (interval)": _measured(claim),
             "seeds": claim.get("n"), "p": claim.get("p"), "verdict": _badge(claim["verdict"], ""),
             "with its cause switched off": claim.get("control_verdict")} for claim in claims]
    return "\n\n".join(["# The claims", _counts(claims), repr(Table(rows)) if rows else "", ""])


def _missing_page(claims: list[dict]) -> str:
    """The claims that do not hold, each with the sections of findings.md that are headed by its id."""
    path = ROOT / "data" / "thesis" / "findings.md"
    introduction, *sections = re.split(r"^## +", path.read_text() if path.exists() else "", flags=re.MULTILINE)
    findings = dict(section.partition("\n")[::2] for section in sections)
    parts = ["# What did not reproduce and why", re.sub(r"^# .*", "", introduction, flags=re.MULTILINE)]
    for claim in [claim for claim in claims if claim["verdict"] != "holds"]:
        why = [text for title, text in findings.items() if claim["id"] in re.findall(r"C\d+\.\d+", title)]
        parts += [f"## {claim['id']}: {claim['verdict']}", html.escape(claim["statement"]),
                  f"{_part(claim)} (thesis: {claim.get('thesis')}): {_measured(claim)}. {claim.get('remark', '')}",
                  *(why or ["Not explained yet."] * (claim["verdict"] != "not tested"))]
    parts += [f"## {title}\n{text}" for title, text in findings.items() if not re.match(r"C\d", title)]
    return "\n\n".join(parts)


def _recordings_page(folder: Path) -> str:
    parts = ["# Recordings", "Open one with `.venv/bin/rerun FILE`; the viewer's time line plays it."]
    for path in sorted((folder / "recordings").glob("*.rrd")):
        parts += [f"## {path.stem}", f'<a href="../recordings/{path.name}">recordings/{path.name}</a>',
                  f'<p><img src="_static/recordings/{path.stem}.png" alt="still of {path.stem}"></p>']
    return "\n\n".join(parts)


def _provenance_page(folder: Path) -> str:
    made = read_json(folder / "provenance.json", {"chapters": {}})
    runs = [{"chapter": chapter, "experiment": name, **counts}
            for chapter, entry in made["chapters"].items() for name, counts in entry["runs"].items()]
    return "\n\n".join(["# Where this comes from", "Stale runs were made by another state of the code. "
                        "Stamped ones too, but an audit computed some of them again and found no difference.",
                        repr(Table(runs)) if runs else "", f"```json\n{json.dumps(made, indent=1)}\n```"])


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
