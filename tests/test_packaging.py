# SPDX-License-Identifier: BSD-3-Clause
"""What a user installs: one version, typed, with its command and its kernels."""

from __future__ import annotations

import importlib
import re
import tomllib
from pathlib import Path

import ltcl

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))


def test_the_version_is_read_from_the_package() -> None:
    assert "version" in PROJECT["project"]["dynamic"]
    source = (ROOT / PROJECT["tool"]["hatch"]["version"]["path"]).read_text(encoding="utf-8")
    assert re.findall(r'^__version__ = "(\d+\.\d+\.\d+\S*)"$', source, re.MULTILINE) == [ltcl.__version__]


def test_the_changelog_knows_the_version() -> None:
    headings = re.findall(r"^## (.*)$", (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"), re.MULTILINE)
    assert ltcl.__version__ in headings[0]


def test_the_package_is_marked_as_typed() -> None:
    assert (Path(ltcl.__file__).parent / "py.typed").is_file()


def test_the_console_script_exists() -> None:
    module, _, function = PROJECT["project"]["scripts"]["ltcl"].partition(":")
    assert callable(getattr(importlib.import_module(module), function))


def test_the_wheel_takes_the_kernels_along() -> None:
    included = PROJECT["tool"]["hatch"]["build"]["targets"]["wheel"]["force-include"]
    assert included == {"kernels": "ltcl/kernels"}
    assert list((ROOT / "kernels").glob("*.cl")), "kernels/ holds no OpenCL source"


def test_source_archive_holds_all_that_its_tests_need() -> None:
    included = set(PROJECT["tool"]["hatch"]["build"]["targets"]["sdist"]["include"])
    assert included >= {"/ltcl", "/kernels", "/tests", "/bench", "/CHANGELOG.md", "/LICENSE", "/README.md"}


def test_readme_opens_with_the_two_commands() -> None:
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    block = re.search(r"^```sh\n(.*?)^```", readme, re.MULTILINE | re.DOTALL)
    assert block, "README.md has no ```sh block"
    demo, tests = block[1].splitlines()  # .ci/run runs these very lines
    assert "demo" in demo
    assert "pytest" in tests
