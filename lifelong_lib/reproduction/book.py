"""The web pages that a run ends with: every figure beside the reference, the verdicts, the chapters, what failed.

Sphinx and myst-nb build them from the executed notebooks and the files in `figures/latest/<profile>`.
"""

import errno
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
from sphinx.util import logging

from lifelong_lib.reproduction.children import last_words, surroundings
from lifelong_lib.reproduction.claims import ledger
from lifelong_lib.reproduction.costs import cost_table
from lifelong_lib.reproduction.files import ROOT, explained, read_json, read_toml, require
from lifelong_lib.reproduction.fingerprint import SOURCES
from lifelong_lib.reproduction.grid import read_reports
from lifelong_lib.reproduction.labels import order
from lifelong_lib.reproduction.notebooks import made_ids, named_in_calls
from lifelong_lib.reproduction.report import directions, reading, standings
from lifelong_lib.reproduction.templates import PAGES, page

DRAWS = re.compile(r"^fig, .*= panels\(", re.MULTILINE)  # such cells, and those of imports only, are folded
IMPORTS = re.compile(r"((from|import|    |\)).*\n?|\n)*")

SEEDS = re.compile(r'Chapter\(\d, profile, seeds or \{"smoke": (\d+), "quick": (\d+), "paper": (\d+)\}')
SIZES = re.compile(  # what a profile shrinks, a line each: shown as a table, the cell folded
    r"^([\w, ]+) = (?:seeds or )?chapter\.pick\(smoke=(.+), quick=(.+), paper=(.+)\)(?:  # (.+))?$", re.MULTILINE
)

REACHABLE = {  # for keyboards and screen readers: what the theme leaves out
    '<div class="output text_html">': '<div class="output text_html" tabindex="0">',
    '<div class="pst-scrollable-table-container">': '<div class="pst-scrollable-table-container" tabindex="0">',
    '<summary aria-label="Toggle hidden content">': "<summary>",
    'search-button-field search-button__button pst-js-only" title="Search" aria-label="Search"':
        'search-button-field search-button__button pst-js-only" title="Search"',
}

CONFIGURATION = """
project = html_title = "Lifelong reinforcement learning on mobile robots, reproduced"
author = "The lifelong reproduction authors"
extensions = ["myst_nb", "lifelong_lib.reproduction.book"]
html_theme = "sphinx_book_theme"
html_theme_options = {"home_page_in_toc": True, "use_download_button": False, "use_fullscreen_button": False,
                      "navbar_persistent": []}
html_static_path = ["_static"]
html_css_files = ["book.css"]
html_context = {"default_mode": "auto"}
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
    claims, standing = read_json(folder / "claims.json", []), standings(folder, reference.parent)
    copies = sorted((folder / "notebooks").glob("ch*.ipynb"))
    places = {name: (path.stem, headings[0]) for path in copies for name, headings in made_ids(path).items()}
    made = read_json(folder / "provenance.json", {"chapters": {}})
    recordings = sorted(path.stem for path in (folder / "recordings").glob("*.rrd"))
    introduction, others, findings = _findings()
    pages = {"claims": page("claims.md", claims=claims, standing=standing, places=places),
             "not_reproduced": page("not_reproduced.md", introduction=introduction,
                                     others=list(_with_known_numbers(others, standing)),
                                     explained=_explained(standing, findings), untested=_with("not tested", standing)),
             "deviations": (ROOT / "DEVIATIONS.md").read_text(), "recordings": page("recordings.md", names=recordings),
             "costs": page("costs.md", rows=cost_table(ROOT / "data" / "results" / "paper")),
             "provenance": page("provenance.md", made=made, text=json.dumps(made, indent=1))}  # fmt: skip
    contents = [f"chapters/{path.stem}" for path in copies] + list(pages)
    pages["index"] = page("index.md", profile=folder.name, claims=claims, standing=standing, places=places,
                           agree=directions(claims, standing), chapters=_chapters(copies, standing), contents=contents,
                           results=_shown(folder, reference, standing, places))  # fmt: skip
    explained = {claim["id"]: (claim, why) for claim, why in _explained(standing, findings)}
    with tempfile.TemporaryDirectory(prefix="lifelong-book-") as temporary:
        source, out = Path(temporary, "source"), Path(temporary, "out")
        for name, place in (("latest", folder), ("reference", reference), ("full", reference.parent / "paper"),
                            ("recordings", folder / "recordings")):
            (source / "_static" / name).mkdir(parents=True)
            for path in sorted(place.glob("*.png")):
                shutil.copyfile(path, source / "_static" / name / path.name)
        shutil.copyfile(PAGES / "book.css", source / "_static" / "book.css")
        (source / "conf.py").write_text(CONFIGURATION)
        (source / "chapters").mkdir()
        for path in copies:
            nbformat.write(_chapter_page(path, standing, explained), source / "chapters" / path.name)
        for name, text in pages.items():
            (source / f"{name}.md").write_text(text)
        command = [sys.executable, "-m", "sphinx", "-b", "html", "-q", "-E", "-d", f"{temporary}/doctrees",
                   str(source), str(out)]
        done = subprocess.run(command, cwd=SOURCES, env=surroundings(), capture_output=True, text=True)
        require(done.returncode == 0, f"the book could not be built: {last_words(done.stderr)}")
        sys.stderr.write(done.stderr.replace(f"{source}/", ""))
        for written in out.rglob("*.html"):
            text = written.read_text()
            for theirs, ours in REACHABLE.items():
                text = text.replace(theirs, ours)
            written.write_text(text)
        replace_folder(folder / "book", out)
    return folder / "book" / "index.html"


def replace_folder(folder: Path, new: Path) -> None:
    """Puts `new`, which may be on another disk, in the place of `folder`, which stays until the new one is whole."""
    part, old = folder.with_name(f"{folder.name}.part"), folder.with_name(f"{folder.name}.old")
    for left in (part, old):
        shutil.rmtree(left, ignore_errors=True)
    with explained(folder):
        try:
            shutil.copytree(new, part)
        except shutil.Error as error:  # a long list, one entry a file
            full = "No space" in str(error)
            raise OSError(errno.ENOSPC if full else errno.EIO, "not every page could be copied") from error
        if folder.exists():
            folder.rename(old)
        part.rename(folder)
        shutil.rmtree(old, ignore_errors=True)


def _chapter_page(path: Path, standing: list[dict], explained: dict) -> nbformat.NotebookNode:
    """The executed copy as a page: results after the opening, drawing folded, places to link, and below each figure a
    sentence that reads it, below a verdict its finding.

    A place to link to stands before every cell that makes a result.
    """
    notebook = nbformat.read(path, as_version=4)
    claims = [claim for claim in standing if claim["chapter"] == int(path.name[2:4])]
    cells = notebook.cells[:1]
    if claims:
        cells.append(nbformat.v4.new_markdown_cell(page("came_of_it.md", claims=claims), id="came-of-it"))
    for cell in notebook.cells[1:]:
        code = cell.source if cell.cell_type == "code" else None
        if code and "chapter_verdicts(" in code:
            continue  # here they stand already, with this run's
        sizes, names = (SIZES.findall(code), named_in_calls(code)) if code else ([], [])
        if len(sizes) > 3:
            text = page("sizes.md", seeds=SEEDS.findall(code), sizes=sizes)
            cells.append(nbformat.v4.new_markdown_cell(text, id=f"sizes-{cell.id}"[:64]))
        if code and (len(sizes) > 3 or DRAWS.search(code) or IMPORTS.fullmatch(code)):
            cell.metadata["tags"] = [*cell.metadata.get("tags", []), "hide-input"]
        anchors = "".join(f'<a id="{name}"></a>' for name in names)
        cells += [nbformat.v4.new_markdown_cell(anchors, id=f"at-{cell.id}"[:64])] if anchors else []
        cells.append(cell)
        for name in names:
            data = path.parents[1] / f"{name}.csv"
            if name.startswith("F") and data.exists() and (said := reading(data)):
                text = f'<p class="same">In numbers, where curves end: {html.escape(said)}.</p>'
                cells.append(nbformat.v4.new_markdown_cell(text, id=f"reading-{name}".replace(".", "-")))
            if name in explained:
                text = page("finding.md", claim=explained[name][0], why=explained[name][1])
                cells.append(nbformat.v4.new_markdown_cell(text, id=f"finding-{name}".replace(".", "-")))
    asked = read_toml(ROOT / "data" / "thesis" / "readers.toml").get("question", [])
    questions = [question for question in asked if question["chapter"] == int(path.name[2:4])]
    if questions:
        cells.append(nbformat.v4.new_markdown_cell(page("readers.md", questions=questions), id="five-questions"))
    notebook.cells = cells
    return notebook


def _with(verdict: str, claims: list[dict]) -> list[dict]:
    return [claim for claim in claims if claim["verdict"] == verdict]


def _chapters(copies: list[Path], standing: list[dict]) -> Iterator[dict]:
    """A line a chapter: what the thesis claims there, and what is known of it."""
    titles = {int(path.name[2:4]): (path.stem, nbformat.read(path, as_version=4).cells[0].source) for path in copies}
    for chapter in read_toml(ROOT / "data" / "thesis" / "chapters.toml").get("chapter", []):
        stem, text = titles.get(chapter["number"], ("", ""))
        title = text.partition("\n")[0].lstrip("# ") or f"Chapter {chapter['number']}"
        yield {"link": f"[{title}](chapters/{stem}.ipynb)" if stem else title, "claim": chapter["claim"],
               "claims": [claim for claim in standing if claim["chapter"] == chapter["number"]]}


def _shown(folder: Path, reference: Path, standing: list[dict], places: dict) -> Iterator[dict]:
    """What the first page shows of every figure and table, with the claims that rest on the same runs."""
    rests = [set(grid.makes) for grid in read_reports(folder)]
    compared = {row["id"]: row for row in read_json(folder / "comparison.json", {}).get("results", [])}
    for name in sorted((path.stem for path in folder.glob("[FT]*.csv")), key=order):
        heading, row = places.get(name, ("", ""))[1], compared.get(name, {})
        pictures = [("this run", "latest", folder), ("at full scale", "full", reference.parent / "paper")]
        if row.get("data") != "identical" and reference.name != "paper":
            pictures.append((f"the reference of {reference.name}", "reference", reference))
        claims = [claim for claim in standing if any({name, claim["id"]} <= makes for makes in rests)]
        yield {"id": name, "title": heading if name in heading else f"{name} {heading}",
               "pictures": [(caption, f"_static/{kind}/{name}.png") for caption, kind, place in pictures
                            if (place / f"{name}.png").exists()],
               "said": "; ".join(f"{key} {row[key]}" for key in ("data", "picture") if row.get(key)),
               "table": "" if (folder / f"{name}.png").exists() else (folder / f"{name}.md").read_text(),
               "claims": claims, "printed": "; ".join(_printed(claims)[:4])}  # fmt: skip


def _printed(claims: list[dict]) -> list[str]:
    """What the thesis prints of these claims, in words."""
    return [f"{label} {part['thesis']:g}" for claim in claims
            for label, part in ledger()[claim["id"]]["parts"].items() if "thesis" in part]


def _findings() -> tuple[str, list, dict[str, str]]:
    """findings.md: its beginning, its sections (title, text) about no claim, and {title: text} of all sections."""
    path = ROOT / "data" / "thesis" / "findings.md"
    introduction, *sections = re.split(r"^## +", path.read_text() if path.exists() else "", flags=re.MULTILINE)
    findings = {title: text for title, _, text in (section.partition("\n") for section in sections)}
    others = [(title, text) for title, text in findings.items() if not re.match(r"C\d", title)]
    return re.sub(r"^# .*", "", introduction, flags=re.MULTILINE), others, findings


def _with_known_numbers(sections: list, standing: list[dict]) -> Iterator[tuple[str, str]]:
    """Sections (title, text) whose claims have all been judged, with their numbers."""
    untested = {claim["id"] for claim in _with("not tested", standing)}
    for title, text in sections:
        if not untested & set(re.findall(r"\{(C\d+\.\d+):", text)):
            yield title, with_numbers(text, standing)


def with_numbers(text: str, standing: list[dict]) -> str:
    """Fill in `{C4.5: label of a part}` with what was measured, `{C4.5: label, interval}` with its interval."""
    parts = {f"{row['id']}: {part['label']}": part for row in standing
             if row["verdict"] != "not tested" for part in row["parts"]}  # fmt: skip

    def filled(found: re.Match) -> str:
        words = " ".join(found.group(1).split())
        name, interval = words.removesuffix(", interval"), words.endswith(", interval")
        require(name in parts, f"findings.md: there is no number {{{name}}} in the ledger")
        return "{:.3g} to {:.3g}".format(*parts[name]["interval"]) if interval else f"{parts[name]['measured']:.3g}"
    return re.sub(r"\{(C\d+\.\d+: [^}]+)\}", filled, text)


def _explained(standing: list[dict], findings: dict[str, str]) -> list[tuple[dict, list[str]]]:
    """The claims that are contradicted or undecided, each with the findings that are headed by its id."""
    return [(claim, [with_numbers(text, standing) for title, text in findings.items()
                     if claim["id"] in re.findall(r"C\d+\.\d+", title)])
            for claim in _with("contradicted", standing) + _with("undecided", standing)]  # fmt: skip


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
