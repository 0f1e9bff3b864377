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
    """Exit code and output of a run of `ltcl`."""

    code: int
    out: str
    err: str

    @property
    def json(self) -> Any:
        """The JSON document of a run that succeeded."""
        assert self.code == 0, self.err
        return self.document

    @property
    def document(self) -> Any:
        """The JSON document on stdout."""
        return json.loads(self.out, parse_constant=_refuse_constant)

    def assert_refused(self, *parts: str, code: int = 1) -> None:
        """Assert one line on stderr with these parts, and nothing on stdout."""
        assert self.code == code, self.err
        assert self.out == ""
        assert self.err.count("\n") == 1, self.err
        assert self.err.startswith("ltcl: error: ")
        for part in parts:
            assert part in self.err


def _refuse_constant(name: str) -> None:
    pytest.fail(f"{name} is not JSON")


Program = Callable[..., Outcome]


@pytest.fixture(scope="session")
def program() -> Program:
    """`ltcl` with these arguments; the output of --json is checked against its schema."""

    def run(*arguments: object) -> Outcome:
        out = io.StringIO()
        err = io.StringIO()
        words = [str(argument) for argument in arguments]
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            code = main(words)
        outcome = Outcome(code, out.getvalue(), err.getvalue())
        if "--json" in words:
            json_schema.check(words, outcome.document)
        return outcome

    return run


@pytest.fixture(scope="session")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of the input files; the program writes nothing there."""
    return tmp_path_factory.mktemp("inputs")


@pytest.fixture(scope="session")
def transport(folder: Path, device: Device) -> Path:
    """A corner of two walls, grey, grid 5 x 10."""
    scene = scenes.dihedral(5, albedo=0.6)
    T = scene.transport(first_bounce=scene.first_bounce, device=device)
    ltcl.save(folder / "corner.npz", T)
    return folder / "corner.npz"


@pytest.fixture(scope="session")
def colour_transport(folder: Path, device: Device) -> Path:
    """A corner of three walls in colour, grid 4 x 12."""
    albedo = [(0.9, 0.2, 0.2), (0.2, 0.8, 0.3), (0.7, 0.7, 0.7)]
    scene = scenes.box(4, sides=3, albedo=albedo)
    T = scene.transport(first_bounce=scene.first_bounce, device=device)
    ltcl.save(folder / "room.npz", T)
    return folder / "room.npz"


@pytest.fixture(scope="session")
def compressed(folder: Path, transport: Path) -> Path:
    """The corner of two walls as wavelet coefficients."""
    ltcl.save(folder / "compressed.npz", ltcl.compress(ltcl.load(transport), 0.05, basis="haar"))
    return folder / "compressed.npz"


@pytest.fixture(scope="session")
def inverse(folder: Path, transport: Path) -> Path:
    """The inverse of the corner of two walls."""
    inverse = ltcl.invert(ltcl.load(transport), 1e-3, basis="pixels")
    ltcl.save_inverse(folder / "inverse.npz", inverse)
    return folder / "inverse.npz"


def write(path: Path, picture: Any) -> Path:
    """Write a picture, and return its path."""
    images.write(path, np.asarray(picture, np.float32))
    return path


@pytest.fixture(scope="session")
def picture(folder: Path) -> Path:
    """A picture within reach of `transport`: 5 x 10, linear, between 0.3 and 0.4."""
    return write(folder / "sky.exr", np.random.default_rng(1).uniform(0.3, 0.4, (5, 10)))


@pytest.fixture(scope="session")
def large_picture(folder: Path) -> Path:
    """A PNG in colour, 20 x 30."""
    return write(folder / "large.png", scenes.landscape(20, 30))


@pytest.fixture(scope="session")
def results(
    program: Program, transport: Path, picture: Path, large_picture: Path, folder: Path
) -> Any:
    """Folder and reports of compensate, separate and relight on two pictures, all in one folder."""
    out = folder.with_name("results")
    out.mkdir()
    (out / "mine.txt").write_text("mine")
    solving = ["--first-bounce", "exact", "--rtol", "1e-4", "--method", "chebyshev"]
    options = {
        "compensate": solving,
        "separate": [*solving, "--bounces", 2],
        "relight": [],
    }
    common = [
        "--on-dark",
        "mask",
        "--encoding",
        "linear",
        "--grid",
        "5x10",
        "--resize",
        "stretch",
        "--json",
    ]
    reports = {}
    for command, more in options.items():
        arguments = [transport, picture, large_picture, *common, *more, "--out", out]
        reports[command] = program(command, *arguments).json
    return out, reports


@pytest.fixture(scope="session")
def simulated(program: Program, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a corner of two walls, 4 x 8, in a room that is not dark; not to be changed."""
    out = tmp_path_factory.mktemp("simulated") / "scan"
    curves = ["--response", "film", "--projector-response", "film"]
    options = ["--size", 4, "--strategy", "pixel", "--ambient", 0.05, *curves]
    assert program("simulate", "dihedral", "--out", out, *options).code == 0
    return out


@pytest.fixture(scope="session")
def acquired(program: Program, simulated: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same folder with all photographs; not to be changed."""
    scan = tmp_path_factory.mktemp("acquired") / "scan"
    shutil.copytree(simulated, scan)
    assert program("acquire", "run", scan).code == 0
    return scan
