# SPDX-License-Identifier: BSD-3-Clause
"""Pages for those who report and contribute: they name what exists, and their rig scans."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer
import yaml

import ltcl
from ltcl.acquisition import VirtualRig
from ltcl.cli.main import build_program

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "SECURITY.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / ".github").rglob("*.md"))]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_pages_for_contributors_name_what_exists(page: Path) -> None:
    """Commands, links, and files of the repository in code, but for those with a NAME to choose."""
    text = page.read_text(encoding="utf-8")
    program: Any = typer.main.get_command(build_program())
    for first, second in re.findall(r"`ltcl ([a-z]+)(?: ([a-z]+))?", text):
        command = program.commands[first]
        assert second in getattr(command, "commands", {second: None}), (first, second)
    links = [target.partition("#")[0] for target in re.findall(r"\]\((?!https?:)([^)]+)\)", text)]
    files = re.findall(r"`((?:ltcl|kernels|tests|bench|docs|\.ci)/[\w./*]+)`", text)
    assert [
        file for file in [*links, *files] if "NAME" not in file and not (ROOT / file).exists()
    ] == []


def test_issue_templates_have_a_name_and_say_what_they_are_for() -> None:
    templates = [page for page in PAGES if page.parent.name == "ISSUE_TEMPLATE"]
    assert {page.stem for page in templates} == {"bug", "scan", "question"}
    for page in templates:
        _, front, body = page.read_text(encoding="utf-8").split("---\n", 2)
        assert {"name", "about", "labels"} == yaml.safe_load(front).keys()
        assert "ltcl doctor" in body or page.stem == "question"


@pytest.mark.rare
def test_the_rig_of_the_page_scans(device, tmp_path, monkeypatch) -> None:
    """The rig of the page, with a projector and a camera that are one virtual rig."""
    monkeypatch.chdir(tmp_path)
    (code,) = re.findall(
        r"```py\n(.*?)```", (ROOT / "CONTRIBUTING.md").read_text("utf-8"), re.DOTALL
    )
    corner = ltcl.scenes.dihedral(8, albedo=(0.7, 0.6, 0.5))
    room = VirtualRig(corner.transport(device=device), corner.grid, bits=16)

    class Projector:
        def show(self, codes: np.ndarray) -> None:
            self.codes = codes

        def expose(self, seconds: float) -> np.ndarray:
            return room.photograph(self.codes, seconds)

    both = Projector()
    names: dict[str, Any] = {"ltcl": ltcl, "projector": both, "camera": both}
    exec(code, names)  # noqa: S102 - our own page
    white = np.ones((*corner.grid, 3))
    seen = names["T"] @ white
    true = room.radiance(white)
    assert np.linalg.norm(seen - true) < 0.05 * np.linalg.norm(true)
