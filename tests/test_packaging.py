# SPDX-License-Identifier: BSD-3-Clause
"""The installed package: one version, typed, with its command.

`.ci/check_archives.py` opens the archives.
"""

from __future__ import annotations

import importlib
import re
import tomllib
from pathlib import Path

import yaml

import ltcl

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))


def test_the_version_is_that_of_the_package_and_the_changelog_knows_it() -> None:
    assert "version" in PROJECT["project"]["dynamic"]
    source = (ROOT / PROJECT["tool"]["hatch"]["version"]["path"]).read_text(encoding="utf-8")
    assert re.findall(r'^__version__ = "(\d+\.\d+\.\d+\S*)"$', source, re.MULTILINE) == [
        ltcl.__version__
    ]
    headings = re.findall(
        r"^## (.*)$", (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"), re.MULTILINE
    )
    assert ltcl.__version__ in headings[0]


def test_types_and_the_console_script_come_along() -> None:
    assert (Path(ltcl.__file__).parent / "py.typed").is_file()
    module, _, function = PROJECT["project"]["scripts"]["ltcl"].partition(":")
    assert callable(getattr(importlib.import_module(module), function))


def test_archives_hold_the_kernels_and_all_that_tests_need() -> None:
    targets = PROJECT["tool"]["hatch"]["build"]["targets"]
    assert targets["wheel"]["force-include"] == {"kernels": "ltcl/kernels"}
    needed = {"/ltcl", "/kernels", "/tests", "/bench", "/docs", "/.ci", "/.github"}
    needed |= {"/LICENSE", "/CITATION.cff"}
    pages = {f"/{path.name}" for path in ROOT.glob("*.md")}
    assert {"/README.md", "/CHANGELOG.md", "/CONTRIBUTING.md", "/SECURITY.md"} <= pages
    assert needed | pages <= set(targets["sdist"]["include"])


def test_the_citation_is_of_this_version_and_of_the_paper() -> None:
    """The schema of the citation is checked by `.ci/run`."""
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert (citation["cff-version"], citation["type"]) == ("1.2.0", "software")
    assert (citation["version"], citation["license"]) == (
        ltcl.__version__,
        PROJECT["project"]["license"],
    )
    (paper,) = citation["references"]
    readme = " ".join((ROOT / "README.md").read_text(encoding="utf-8").split())
    assert f"*{paper['title']}*, {paper['journal']}, {paper['year']}" in readme
    assert all(author["family-names"] in readme for author in paper["authors"])


def test_the_changelog_of_a_version_fits_a_screen() -> None:
    newest = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8").split("\n## ")[1].splitlines()
    assert len(newest) <= 40
    assert max(map(len, newest)) <= 100
