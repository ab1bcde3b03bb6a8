"""Pages from the templates in `pages`, which know what a verdict means and how numbers are written."""

from pathlib import Path

from jinja2 import ChainableUndefined, Environment, FileSystemLoader

from lifelong_lib.reproduction.labels import VERDICTS
from lifelong_lib.reproduction.tables import readable

PAGES = Path(__file__).with_name("pages")  # templates, and the look of all pages


def page(name: str, **more) -> str:
    """Return the text of `pages`/name, filled in."""
    templates = Environment(loader=FileSystemLoader(PAGES), trim_blocks=True, undefined=ChainableUndefined)
    templates.filters["readable"] = readable
    return templates.get_template(name).render(verdicts=VERDICTS, **more)
