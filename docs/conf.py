# SPDX-License-Identifier: BSD-3-Clause
"""The site: `python -m pip install ".[docs]" && sphinx-build -W --keep-going docs site`.

Nothing in it is asked of another host: formulas are MathML, which browsers draw themselves.
"""

from __future__ import annotations

import sys
import tomllib
from pathlib import Path
from typing import Any

from docutils import nodes
from docutils.utils.math import latex2mathml
from sphinx.application import Sphinx

import ltcl

DOCS = Path(__file__).resolve().parent
# Gallery_figures; what the paper's figures share with it.
sys.path += [
    str(DOCS),
    str(DOCS.parent / "bench"),
]

# The public addresses of the project, of which there are none yet.
URLS = tomllib.loads((DOCS.parent / "pyproject.toml").read_text("utf-8"))["project"]["urls"]

project = "ltcl"
author = "ltcl developers"
copyright = author
version = release = ltcl.__version__

extensions = [
    "myst_parser",
    "numpydoc",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx_copybutton",
    "sphinx_design",
    "sphinx_gallery.gen_gallery",
]
templates_path = ["templates"]
default_role = "py:obj"  # `compensate` in a docstring is a link
nitpicky = False  # types in docstrings are words, not names
# Sphinx-gallery reads these, and writes pages below `auto_`; one on times would load scripts from
# elsewhere.
exclude_patterns = ["tutorials", "examples", "**sg_execution_times.rst"]

myst_enable_extensions = ["colon_fence", "deflist", "dollarmath", "fieldlist"]
myst_heading_anchors = 4
autodoc_typehints = "none"  # docstrings have them
autodoc_member_order = "bysource"
numpydoc_show_class_members = False
numpydoc_class_members_toctree = False
copybutton_prompt_text = r">>> |\.\.\. |\$ "
copybutton_prompt_is_regexp = True

sphinx_gallery_conf: dict[str, Any] = {
    "examples_dirs": ["tutorials", "examples"],
    "gallery_dirs": ["auto_tutorials", "auto_examples"],
    "filename_pattern": r"\.py$",  # all of them run
    "within_subsection_order": "FileNameSortKey",
    "abort_on_example_error": True,
    "image_scrapers": ["gallery_figures"],
    "capture_repr": ("_repr_html_",),
    "write_computation_times": False,
    "remove_config_comments": True,
    "download_all_examples": False,
    "show_memory": False,
}

html_theme = "pydata_sphinx_theme"
html_title = "ltcl"
html_baseurl = URLS.get("Documentation", "")
html_static_path = ["static"]
html_css_files = ["site.css"]
html_show_copyright = False
html_theme_options: dict[str, Any] = {
    "show_prev_next": False,
    "navigation_with_keys": False,
    "secondary_sidebar_items": ["page-toc"],
    "footer_start": [],
    "footer_end": [],
}
if "Repository" in URLS:
    html_theme_options["icon_links"] = [
        {"name": "Source", "url": URLS["Repository"], "icon": "fa-solid fa-code"}
    ]
html_sidebars = {"index": []}
html_math_renderer = "mathml"


def _inline(translator: Any, node: nodes.math) -> None:
    translator.body.append(latex2mathml.tex2mathml(node.astext(), as_block=False))
    raise nodes.SkipNode


def _display(translator: Any, node: nodes.math_block) -> None:
    formula = latex2mathml.tex2mathml(node.astext(), as_block=True)
    translator.body.append(f'<div class="math">{formula}</div>\n')
    raise nodes.SkipNode


def _append(app: Sphinx, docname: str, source: list[str]) -> None:
    """Pages whose end is written from the program, or from the schema of its reports."""
    from generated import PAGES

    if docname in PAGES:
        source[0] += PAGES[docname]()


def _write_schema(app: Sphinx) -> None:
    """Write the file to which the page on JSON links."""
    from generated import write_schema

    write_schema()


def setup(app: Sphinx) -> None:
    """Register all of this with Sphinx."""
    app.add_html_math_renderer("mathml", (_inline, None), (_display, None))
    app.connect("builder-inited", _write_schema)
    app.connect("source-read", _append)
