# SPDX-License-Identifier: BSD-3-Clause
"""`ltcl acquire import`."""

from __future__ import annotations

import numpy as np

import ltcl
from ltcl import images
from ltcl.acquisition.captures.map_file import read_map
from ltcl.acquisition.geometry import GrayCode


def test_photographs_become_files(program, tmp_path, device):
    folder = tmp_path / "photographs"
    folder.mkdir()
    for number, pattern in enumerate(GrayCode((6, 10)).patterns()):
        light = np.kron(pattern, np.ones((4, 4)))[..., None] * [0.6, 0.5, 0.4]
        images.write(folder / f"{number}.png", light)
    out = tmp_path / "out"
    report = program("acquire", "import", folder, "--grid", "6x10", "--out", out, "--json").json
    assert report["files"] == ["map.npz", "direct.npz"]
    assert report["photographs"] == 16
    assert read_map(out / "map.npz").camera_grid == (24, 40)
    T = ltcl.load(out / "direct.npz", device=device)
    np.testing.assert_allclose(T.first_bounce[:, T.masked == 0].mean(axis=1), [0.6, 0.5, 0.4], 0.02)
    lines = program("acquire", "import", folder, "--grid", "6x10", "--out", tmp_path / "text").out
    assert "map.npz: 1e+02 %" not in lines
    assert "the camera sees 100 % of the projector" in lines
    again = program("acquire", "import", folder, "--grid", "6x10", "--out", out, "--order", "no")
    again.assert_refused("no: no such file", "opencv")
