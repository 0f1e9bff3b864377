# SPDX-License-Identifier: BSD-3-Clause
"""The program run in this process, and small files to run it on."""

from __future__ import annotations

import contextlib
import io
import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ltcl
from ltcl import images, scenes
from ltcl.cli.main import main
from ltcl.device import Device
from tests import json_schema


@dataclass(frozen=True)
class Outcome:
    """How a run of `ltcl` ended and what it printed."""

    code: int
    out: str
    err: str

    @property
    def json(self) -> Any:
        """Of a run that ended well."""
        assert self.code == 0, self.err
        return self.document

    @property
    def document(self) -> Any:
        """The one JSON document on stdout."""
        return json.loads(self.out, parse_constant=lambda name: pytest.fail(f"{name} is no JSON"))

    def refused(self, *parts: str, code: int = 1) -> None:
        """One line on stderr with these parts, nothing on stdout."""
        assert (self.code, self.out, self.err.count("\n")) == (code, "", 1), self.err
        assert self.err.startswith("ltcl: error: ")
        assert [part for part in parts if part not in self.err] == [], self.err


Program = Callable[..., Outcome]


@pytest.fixture(scope="session")
def program() -> Program:
    """`ltcl` with these arguments; what --json prints is held against its schema."""

    def run(*arguments: object) -> Outcome:
        out, err = io.StringIO(), io.StringIO()
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            code = main([str(argument) for argument in arguments])
        outcome = Outcome(code, out.getvalue(), err.getvalue())
        if "--json" in arguments:
            json_schema.check(arguments, outcome.document)
        return outcome

    return run


@pytest.fixture(scope="session")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Holds the input files; nothing is written there by the program."""
    return tmp_path_factory.mktemp("inputs")


@pytest.fixture(scope="session")
def transport(folder: Path, device: Device) -> Path:
    """A corner of two walls, grey, grid 5 x 10."""
    scene = scenes.dihedral(5, albedo=0.6)
    ltcl.save(
        folder / "corner.npz", scene.transport(first_bounce=scene.first_bounce, device=device)
    )
    return folder / "corner.npz"


@pytest.fixture(scope="session")
def colour_transport(folder: Path, device: Device) -> Path:
    """A corner of three walls in colour, grid 4 x 12."""
    scene = scenes.box(4, sides=3, albedo=[(0.9, 0.2, 0.2), (0.2, 0.8, 0.3), (0.7, 0.7, 0.7)])
    ltcl.save(folder / "room.npz", scene.transport(first_bounce=scene.first_bounce, device=device))
    return folder / "room.npz"


@pytest.fixture(scope="session")
def compressed(folder: Path, transport: Path) -> Path:
    """The corner of two walls as wavelet coefficients."""
    ltcl.save(folder / "compressed.npz", ltcl.compress(ltcl.load(transport), 0.05, basis="haar"))
    return folder / "compressed.npz"


@pytest.fixture(scope="session")
def inverse(folder: Path, transport: Path) -> Path:
    ltcl.save_inverse(
        folder / "inverse.npz", ltcl.invert(ltcl.load(transport), 1e-3, basis="pixels")
    )
    return folder / "inverse.npz"


def write(path: Path, picture: Any) -> Path:
    images.write(path, np.asarray(picture, np.float32))
    return path


@pytest.fixture(scope="session")
def picture(folder: Path) -> Path:
    """Within reach of `transport`: 5 x 10, linear, between 0.3 and 0.4."""
    return write(folder / "sky.exr", np.random.default_rng(1).uniform(0.3, 0.4, (5, 10)))


@pytest.fixture(scope="session")
def large_picture(folder: Path) -> Path:
    """A PNG in colour, 20 x 30."""
    return write(folder / "large.png", scenes.landscape(20, 30))


@pytest.fixture(scope="session")
def results(
    program: Program, transport: Path, picture: Path, large_picture: Path, folder: Path
) -> Any:
    """The folder and the JSON of compensate, separate and relight on two pictures, all in one folder."""
    out, report = folder.with_name("results"), {}
    out.mkdir()
    (out / "mine.txt").write_text("mine")
    common = f"--on-dark mask --encoding linear --grid 5x10 --resize --json --out {out}".split()
    solving = ["--first-bounce", "exact", "--rtol", "1e-4", "--method", "chebyshev"]
    for command, more in (
        ("compensate", solving),
        ("separate", [*solving, "--bounces", 2]),
        ("relight", []),
    ):
        report[command] = program(command, transport, picture, large_picture, *common, *more).json
    return out, report


@pytest.fixture(scope="session")
def simulated(program: Program, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A corner of two walls, 4 x 8, in a room that is not dark; nothing is photographed here."""
    out = tmp_path_factory.mktemp("simulated") / "scan"
    options = ["--size", 4, "--strategy", "pixel", "--response", "film", "--ambient", 0.05]
    assert (
        program("simulate", "dihedral", "--out", out, *options, "--projector-response", "film").code
        == 0
    )
    return out


@pytest.fixture(scope="session")
def acquired(program: Program, simulated: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same, all photographed; not to be changed."""
    scan = Path(shutil.copytree(simulated, tmp_path_factory.mktemp("acquired") / "scan"))
    assert program("acquire", "run", scan).code == 0
    return scan
