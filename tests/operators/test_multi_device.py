# SPDX-License-Identifier: BSD-3-Clause
"""Rows on several devices: solves, shares, refusals, the command line."""

from __future__ import annotations

import copy
import dataclasses
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.sparse

import ltcl
from ltcl.cli.main import main
from ltcl.device import Device, discovery, tuning
from ltcl.errors import InputError
from ltcl.operators import MultiDevice
from tests import gallery
from tests.operators.large import GRID, PIXELS, Stored, transport

pytestmark = pytest.mark.slow


@pytest.fixture
def two(monkeypatch: pytest.MonkeyPatch, device: Device) -> list[discovery.Description]:
    """Two devices: halves of the one here, or the same one twice if its driver cannot halve it."""
    import pyopencl as cl

    handles = [device.handle] * 2
    if device.handle.partition_max_sub_devices >= 2 and device.compute_units >= 2:
        half = [cl.device_partition_property.EQUALLY, device.compute_units // 2]
        handles = device.handle.create_sub_devices(half)[:2]
    descriptions = []
    for number, handle in enumerate(handles):
        description = dataclasses.replace(
            device.description,
            index=f"7:{number}",
            handle=handle,
            compute_units=handle.max_compute_units,
        )
        descriptions.append(description)
    monkeypatch.delenv("LTCL_DEVICE", raising=False)
    monkeypatch.setattr(discovery, "list_devices", lambda: descriptions)
    # None of another test, which had less memory.
    monkeypatch.setattr(discovery, "_opened", {})
    return descriptions


@pytest.mark.parametrize("method", ["gauss_seidel", "sor", "southwell", "monte_carlo"])
def test_methods_that_read_rows_say_where_these_are(two, method):
    S = ltcl.Transport(transport(), GRID, device="all").systems[0]
    with pytest.raises(InputError, match=rf"{method}.*devices"):
        ltcl.solve(S, np.ones(PIXELS), method)


@pytest.mark.slow
@pytest.mark.parametrize("method", ["auto", "chebyshev", "cg", "gmres", "neumann", "bicgstab"])
def test_methods_of_products_alone_solve_on_all_devices(two, method):
    S = ltcl.Transport(transport(), GRID, device="all").systems[0]
    b = np.ones(PIXELS)
    # "auto" tries, then surveys.
    for _ in range(3):
        solution = ltcl.solve(S, b, method, rtol=1e-5)
        residual = S.to_dense() @ solution.x - b
        assert np.linalg.norm(residual) <= 1.01e-5 * np.linalg.norm(b)


MATRICES: dict[str, Any] = {
    "dense": np.asarray,
    "sparse": scipy.sparse.csr_array,
    "stored": Stored,
}


def three_times_as_fast(device: Device, *_: Any) -> float:
    """Seconds of a product: the first device is three times as fast as the other."""
    return 1.0 if device.description.index == "all" else 3.0


@pytest.mark.parametrize(
    ("kind", "channels"),
    [
        ("dense", 3),
        ("sparse", 1),
        ("stored", 1),
        pytest.param("dense", 1, marks=pytest.mark.slow),
        pytest.param("sparse", 3, marks=pytest.mark.slow),
        pytest.param("stored", 3, marks=pytest.mark.slow),
    ],
)
def test_all_devices_give_the_answer_of_one(two, monkeypatch, kind, channels):
    monkeypatch.setattr(tuning, "seconds", three_times_as_fast)
    make = MATRICES[kind]
    matrices = [make(transport() * (1.0 + channel / 10)) for channel in range(channels)]
    one = ltcl.Transport(matrices, GRID)
    several = ltcl.Transport(matrices, GRID, device="all")
    devices = set()
    for S in several.systems:
        R: Any = S.R
        assert [part.shape[0] for _, part in R.parts] == [576, 192]
        devices |= {part.device for _, part in R.parts}
    assert len(devices) == 2

    light = np.full(GRID if channels == 1 else (*GRID, 3), 0.5, np.float32)
    picture = one @ light
    expected = ltcl.compensate(one, picture, method="chebyshev").pattern
    pattern = ltcl.compensate(several, picture, method="chebyshev").pattern
    assert np.linalg.norm(pattern - expected) <= 1e-6 * np.linalg.norm(expected)
    expected = ltcl.separate(one, picture, method="chebyshev").bounces
    bounces = ltcl.separate(several, picture, method="chebyshev").bounces
    assert np.linalg.norm(bounces - expected) <= 1e-6 * np.linalg.norm(expected)
    # In float64, on the host.
    fine = ltcl.solve(several.systems[0], np.ones(PIXELS), rtol=1e-12)
    assert fine.residual <= 1e-12


def test_a_rectangular_T_is_on_all_devices(two):
    matrix = gallery.vectors(12, 20) + 2.0
    light = np.ones((4, 5))
    one = ltcl.Transport(matrix, (4, 5), camera_grid=(3, 4))
    several = ltcl.Transport(matrix, (4, 5), camera_grid=(3, 4), device="all")
    assert isinstance(several.operators[0], MultiDevice)
    np.testing.assert_allclose(several @ light, one @ light, rtol=1e-6)


def test_all_devices_are_opened_once(two, monkeypatch):
    device = ltcl.open_device("all")
    assert ltcl.open_device(" ALL ") is device
    assert device.description.index == "all"
    assert [other.description.index for other in device.others] == ["7:1"]
    assert ltcl.open_device("7:1") is device.others[0]
    assert not ltcl.open_device().others
    T = ltcl.Transport(transport(), GRID, device=device)
    assert copy.deepcopy(T).device is device
    monkeypatch.setenv("LTCL_DEVICE", "all")
    assert ltcl.open_device() is device
    monkeypatch.setattr(discovery, "list_devices", lambda: two[:1])
    assert ltcl.open_device("all") is ltcl.open_device("7:0")


@pytest.mark.slow
def test_the_command_line_takes_all_devices(two, tmp_path, capsys):
    matrix = str(tmp_path / "T.npz")
    picture = str(tmp_path / "picture.exr")
    ltcl.save(matrix, ltcl.Transport(transport(), GRID))
    ltcl.images.write(picture, np.full(GRID, 0.5, np.float32))
    patterns = []
    for device in ("7:0", "all"):
        folder = tmp_path / device.replace(":", "-")
        command = ["compensate", matrix, picture, "--out", str(folder), "--device", device]
        assert main(command) == 0
        patterns.append(ltcl.images.read(folder / "picture_pattern.exr"))
    np.testing.assert_allclose(patterns[1], patterns[0], rtol=1e-5)


@pytest.mark.slow
def test_the_page_on_scale_runs(two, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    root = Path(__file__).resolve().parents[2]
    page = (root / "docs" / "guide" / "scale.md").read_text(encoding="utf-8")
    names: dict[str, Any] = {}
    for code in re.findall(r"```python\n(.*?)```", page, re.DOTALL):
        exec(code, names)  # noqa: S102
    assert isinstance(names["T"].systems[0].R, MultiDevice)
    assert names["patterns"].shape == (8, 24, 48)
    direct = 0.5 * names["T"].first_bounce.reshape(24, 48)
    assert abs(names["separated"].direct - direct).max() < 1e-3
