# SPDX-License-Identifier: BSD-3-Clause
"""The site: `python -m pip install ".[docs]" && sphinx-build -W --keep-going docs site`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import ltcl

DOCS = Path(__file__).resolve().parent
sys.path += [str(DOCS), str(DOCS.parent / "bench")]  # gallery_figures; what the paper's figures share with it

project = "ltcl"
author = "ltcl developers"
copyright = author
version = release = ltcl.__version__

extensions = [
    "myst_parser",
    "numpydoc",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx_gallery.gen_gallery",
]
# Sphinx-gallery reads these, and writes pages below `auto_`; one on times would load scripts from elsewhere.
exclude_patterns = ["tutorials", "examples", "**sg_execution_times.rst"]

myst_enable_extensions = ["dollarmath", "deflist", "fieldlist"]
myst_heading_anchors = 3
numpydoc_show_class_members = False

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
html_theme_options = {"show_prev_next": False, "navigation_with_keys": False}
