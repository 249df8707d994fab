"""The documentation site: ``make docs`` builds it without network, and it opens from disk."""

import re
import shutil
from importlib.metadata import files
from pathlib import Path
from typing import Any

from docutils import nodes
from sphinx.application import Sphinx
from sphinx.errors import ExtensionError

import sb3_cure

HERE = Path(__file__).parent

project = "sb3_cure"
author = "The sb3_cure developers"
copyright = author
version = release = sb3_cure.__version__

extensions = ["myst_nb", "sphinx_copybutton", "sphinx.ext.autodoc", "sphinx.ext.mathjax"]
exclude_patterns = ["_build"]
suppress_warnings = ["myst.header"]  # tables begin with small headings

myst_enable_extensions = ["amsmath", "attrs_inline", "colon_fence", "deflist", "dollarmath"]
myst_heading_anchors = 4
nb_execution_mode = "off"  # the outputs are those of `make notebooks`
nb_merge_streams = True

autodoc_inherit_docstrings = False
autodoc_member_order = "bysource"
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented_params"
autodoc_typehints_format = "short"
add_module_names = False

html_theme = "furo"
html_title = f"sb3_cure {release}"
# Equations are drawn as SVG by one script, which comes with a package: nothing is loaded from elsewhere.
mathjax_path = "tex-svg.js"
mathjax = next(file.locate() for file in files("sphinx-mathjax-offline") or () if file.name == mathjax_path)
html_static_path = ["_static", str(mathjax)]
html_css_files = ["custom.css"]
html_show_sourcelink = False
html_copy_source = False
html_theme_options = {"footer_icons": []}
pygments_style = "friendly"
pygments_dark_style = "github-dark"

# Pages that lie elsewhere in the repository are copied, so that links between them and these pages work.
for folder in ("notebooks", "results"):
    shutil.rmtree(HERE / folder, ignore_errors=True)
    for page in (HERE.parent / folder).rglob("*"):
        if page.suffix in {".ipynb", ".md", ".png"} and ".ipynb_checkpoints" not in page.parts:
            copy = HERE / page.relative_to(HERE.parent)
            copy.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(page, copy)


def links_into_the_site(app: Sphinx, docname: str, source: list[str]) -> None:
    """Links that work in the repository lead, on the site, to the pages that `notebooks` and `results` have there."""
    copied = r"(?=(?:notebooks|results)/[^)#]*\.(?:ipynb|md|png)[)#])"
    if docname.startswith("results/"):
        source[0] = source[0].replace("](../docs/", "](../")
        if not source[0].startswith("# "):
            source[0] = f"# {Path(docname).parent.name}\n\n{source[0]}"
        if docname.count("/") > 1:  # tables of one experiment, which pages link to
            source[0] = f"---\norphan: true\n---\n\n{source[0]}"
    elif not docname.startswith("notebooks/"):  # which lie beside `results` on the site, too
        source[0] = re.sub(r"(\]\((?:\.\./)*)\.\./" + copied, r"\1", source[0])


def escape_shapes(app: Sphinx, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    """Asterisks in shapes, as in [B, *shape], are no emphasis."""
    lines[:] = [re.sub(r"(\[(?:[\w.]+, )*)\*(?=\w)", r"\1\\*", line) for line in lines]


def mark_tables(app: Sphinx, doctree: nodes.document) -> None:
    """Tables of sentences become cards on a phone (custom.css), with the names of the columns in them."""
    for table in doctree.findall(nodes.table):
        head, *rows = ([*row.children] for row in table.findall(nodes.row))
        if not any(len(cell.astext()) > 40 for row in rows for cell in row[1:]):
            continue
        table["classes"].append("sentences")
        for row in rows:
            for name, cell in list(zip(head, row, strict=True))[1:]:
                if not cell.astext():
                    cell["classes"].append("empty")
                elif name.astext():
                    cell.children[0].insert(0, nodes.inline("", f"{name.astext()}: ", classes=["column"]))


def check_loads(app: Sphinx, exception: Exception | None) -> None:
    """The site opens from disk and without network: no page loads anything from elsewhere."""
    for page in Path(app.outdir).rglob("*.html") if exception is None else ():
        for tag in re.findall(r"<(?:script|link|img|iframe|video)\b[^>]*>", page.read_text(encoding="utf-8")):
            if re.search(r"""(?:src|href)=["'](?:https?:)?//""", tag):
                raise ExtensionError(f"{page} loads from the network: {tag}")


def setup(app: Sphinx) -> None:
    app.connect("source-read", links_into_the_site)
    app.connect("autodoc-process-docstring", escape_shapes)
    app.connect("doctree-read", mark_tables)
    app.connect("build-finished", check_loads)
