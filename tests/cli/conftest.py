# SPDX-License-Identifier: BSD-3-Clause
"""The program run in this process, and small files to run it on."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.sparse

from ltcl import images, operators, scenes, store
from ltcl.cli.main import main
from ltcl.device import Device
from ltcl.transport import Transport


@dataclass(frozen=True)
class Outcome:
    """How a run of `ltcl` ended and what it printed."""

    code: int
    out: str
    err: str

    @property
    def json(self) -> Any:
        """What stdout holds, if that is one JSON document and nothing else."""
        return json.loads(self.out, parse_constant=lambda name: pytest.fail(f"{name} is no JSON"))

    def refused(self, *parts: str) -> None:
        """One line on stderr with these parts, nothing on stdout, exit code 1."""
        assert self.code == 1
        assert self.out == ""
        assert self.err.startswith("ltcl: error: ")
        assert self.err.count("\n") == 1
        for part in parts:
            assert part in self.err


Program = Callable[..., Outcome]


@pytest.fixture
def program(capsys: pytest.CaptureFixture[str]) -> Program:
    """`ltcl` with these arguments."""

    def run(*arguments: object) -> Outcome:
        capsys.readouterr()
        code = main([str(argument) for argument in arguments])
        out, err = capsys.readouterr()
        return Outcome(code, out, err)

    return run


@pytest.fixture(scope="session")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Holds the input files; nothing is written there by the program."""
    return tmp_path_factory.mktemp("inputs")


@pytest.fixture(scope="session")
def transport(folder: Path, device: Device) -> Path:
    """A corner of two walls, grey, grid 5 x 10."""
    scene = scenes.dihedral(5, albedo=0.6)
    path = folder / "corner.npz"
    store.save(path, scene.transport(first_bounce=scene.first_bounce, device=device))
    return path


@pytest.fixture(scope="session")
def colour_transport(folder: Path, device: Device) -> Path:
    """A corner of three walls in colour, grid 4 x 12."""
    scene = scenes.box(4, sides=3, albedo=[(0.9, 0.2, 0.2), (0.2, 0.8, 0.3), (0.7, 0.7, 0.7)])
    path = folder / "room.npz"
    store.save(path, scene.transport(first_bounce=scene.first_bounce, device=device))
    return path


@pytest.fixture(scope="session")
def picture(folder: Path) -> Path:
    """Within reach of `transport`: 5 x 10, linear, between 0.3 and 0.4."""
    path = folder / "sky.exr"
    images.write(path, np.random.default_rng(1).uniform(0.3, 0.4, (5, 10)).astype(np.float32))
    return path


@pytest.fixture(scope="session")
def large_picture(folder: Path) -> Path:
    """A PNG in colour, 20 x 30."""
    path = folder / "large.png"
    images.write(path, scenes.landscape(20, 30))
    return path


@pytest.fixture
def dark_transport(tmp_path: Path) -> Path:
    """Two of six projector pixels give no direct light."""
    T = np.eye(6) + 0.01
    T[2, 2] = T[4, 4] = 0.0
    path = tmp_path / "dark.npz"
    np.savez(path, T=T, grid=(2, 3))
    return path


@pytest.fixture(scope="session")
def compressed_transport(folder: Path, device: Device) -> Path:
    """The corner of two walls as wavelet coefficients, of which the least are dropped."""
    scene = scenes.dihedral(5, albedo=0.6)
    T = scene.transport(first_bounce=scene.first_bounce, device=device)
    W = operators.Wavelet(device, T.grid, "db2")
    R = T.systems[0].to_dense() - np.eye(50)
    C = W.to_dense() @ R @ W.to_dense().T
    core = operators.CSR(device, scipy.sparse.csr_array(np.where(np.abs(C) < 1e-3, 0.0, C)))
    S = operators.IdentityPlus(operators.Compressed(core, W, W), solution_error=0.0041)
    path = folder / "corner compressed.npz"
    F = T.first_bounce
    store.save(path, Transport(operators.ScaledColumns(S, F), T.grid, first_bounce=F))
    return path
