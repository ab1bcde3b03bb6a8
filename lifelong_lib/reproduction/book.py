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
from collections.abc import Iterator
from pathlib import Path

import nbformat
from docutils import nodes
from docutils.utils.math import MathError
from docutils.utils.math.latex2mathml import tex2mathml
from jinja2 import ChainableUndefined, Environment, FileSystemLoader
from sphinx.util import logging

from lifelong_lib.reproduction.children import last_words, surroundings
from lifelong_lib.reproduction.costs import cost_table
from lifelong_lib.reproduction.files import ROOT, read_json, require
from lifelong_lib.reproduction.fingerprint import SOURCES
from lifelong_lib.reproduction.grid import read_reports
from lifelong_lib.reproduction.labels import VERDICTS, order
from lifelong_lib.reproduction.notebooks import made_ids, named_in_calls
from lifelong_lib.reproduction.tables import readable

PAGES = Path(__file__).with_name("pages")  # templates, and the look of all pages

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
    made = read_json(folder / "provenance.json", {"chapters": {}})
    recordings = sorted(path.stem for path in (folder / "recordings").glob("*.rrd"))
    pages = {"claims": _page("claims", claims=claims, places=places), "not_reproduced": _missing_page(claims),
             "deviations": (ROOT / "DEVIATIONS.md").read_text(), "recordings": _page("recordings", names=recordings),
             "costs": _page("costs", rows=cost_table(ROOT / "data" / "results" / "paper")),
             "provenance": _page("provenance", made=made, text=json.dumps(made, indent=1))}
    contents = [f"chapters/{path.stem}" for path in copies] + list(pages)
    pages["index"] = _page("index", profile=folder.name, claims=claims, places=places, contents=contents,
                           results=_shown(folder, reference, claims, places))  # fmt: skip
    with tempfile.TemporaryDirectory(prefix="lifelong-book-") as temporary:
        source, out = Path(temporary, "source"), Path(temporary, "out")
        for name, place in (("latest", folder), ("reference", reference), ("recordings", folder / "recordings")):
            (source / "_static" / name).mkdir(parents=True)
            for path in sorted(place.glob("*.png")):
                shutil.copyfile(path, source / "_static" / name / path.name)
        shutil.copyfile(PAGES / "book.css", source / "_static" / "book.css")
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


def _page(name: str, **more) -> str:
    """A page from its template in `pages`, which knows what a verdict means."""
    templates = Environment(loader=FileSystemLoader(PAGES), trim_blocks=True, undefined=ChainableUndefined)
    templates.filters["readable"] = readable
    return templates.get_template(f"{name}.md").render(verdicts=VERDICTS, **more)


def _shown(folder: Path, reference: Path, claims: list[dict], places: dict) -> Iterator[dict]:
    """What the first page shows of every figure and table, with the claims that rest on the same runs."""
    rests = [set(grid.makes) for grid in read_reports(folder)]
    compared = {row["id"]: row for row in read_json(folder / "comparison.json", {}).get("results", [])}
    for name in sorted((path.stem for path in folder.glob("[FT]*.csv")), key=order):
        heading, row = places.get(name, ("", ""))[1], compared.get(name, {})
        pictures = [f"_static/{kind}/{name}.png" for kind, place in (("latest", folder), ("reference", reference))
                    if (place / f"{name}.png").exists()]  # fmt: skip
        yield {"id": name, "title": heading if name in heading else f"{name} {heading}", "pictures": pictures,
               "said": "; ".join(f"{key} {row[key]}" for key in ("data", "picture") if row.get(key)),
               "table": "" if pictures else (folder / f"{name}.md").read_text(),
               "claims": [claim for claim in claims if any({name, claim["id"]} <= makes for makes in rests)]}


def _missing_page(claims: list[dict]) -> str:
    """The claims that do not hold, each with the sections of findings.md that are headed by its id."""
    path = ROOT / "data" / "thesis" / "findings.md"
    introduction, *sections = re.split(r"^## +", path.read_text() if path.exists() else "", flags=re.MULTILINE)
    findings = dict(section.partition("\n")[::2] for section in sections)
    explained = [(claim, [text for title, text in findings.items() if claim["id"] in re.findall(r"C\d+\.\d+", title)])
                 for claim in claims if claim["verdict"] != "holds"]  # fmt: skip
    others = [(title, text) for title, text in findings.items() if not re.match(r"C\d", title)]
    introduction = re.sub(r"^# .*", "", introduction, flags=re.MULTILINE)
    return _page("not_reproduced", introduction=introduction, explained=explained, others=others)


def setup(app) -> dict:
    """Makes Sphinx write formulas as MathML, which browsers draw themselves: no script, no font, no network."""
    def draw(translator, node: nodes.Element) -> None:
        text = node.astext()
        tag = re.search(r"\\tag\{(.*?)\}", text)
        block = isinstance(node, nodes.math_block)
        try:
            drawn = tex2mathml(text.replace(tag.group(0), "") if tag else text, as_block=block)
        except (MathError, IndexError) as error:  # the second for a power of nothing, such as the unit $^2$
            logging.getLogger(__name__).warning("formula left as text (%s): %s", error, text, location=node)
            drawn = f"<code>{html.escape(text)}</code>"
        number = f'<span class="eqno">({tag.group(1)})</span>' if tag else ""
        translator.body.append(f'<div class="formula">{drawn}{number}</div>' if block else drawn)
        raise nodes.SkipNode
    app.add_html_math_renderer("mathml", inline_renderers=(draw, None), block_renderers=(draw, None))
    return {"parallel_read_safe": True}
