# SPDX-License-Identifier: BSD-3-Clause
"""Damaged files of every format: no crash, no error of a library, no memory for what is only declared.

LTCL_MUTANTS=4000 in the environment tries as many; by default it is a tenth.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import scipy.io
import scipy.sparse

import ltcl
from ltcl.device import Device
from ltcl.store import Record, formats

from .helpers import dense, sparse

ROOT = Path(__file__).resolve().parents[2]
COUNT = int(os.environ.get("LTCL_MUTANTS", "400"))


def write_samples(folder: Path, device: Device) -> None:
    """Small good files of each kind and layout."""
    grid, rgb = (3, 4), tuple(sparse(seed=seed, pattern=seed) for seed in range(3))
    for name in ("dense.npz", "dense.npy", "dense.mtx", "dense.h5", "dense.mat", "dense.zarr"):
        formats.write(folder / name, Record((dense(),), grid))
    for name in ("sparse.npz", "sparse.mtx", "sparse.h5", "sparse.mat", "sparse.zarr"):
        formats.write(folder / name, Record((sparse(),), grid, first_bounce=np.ones(12)))
    formats.write(folder / "rgb.npz", Record(rgb, grid, mixing=np.eye(3)))
    np.savez_compressed(folder / "deflated.npz", T=dense(), grid=grid)
    for layout in ("csc", "coo", "bsr", "dia"):
        scipy.sparse.save_npz(folder / f"{layout}.npz", getattr(scipy.sparse, f"{layout}_array")(sparse()))
    scipy.io.savemat(folder / "5.mat", {"LTM": dense(), "grid": grid})
    scipy.io.savemat(folder / "5-sparse.mat", {"LTM": sparse().astype(float)})
    scipy.io.savemat(folder / "5-deflated.mat", {"LTM": sparse().astype(float)}, do_compression=True)
    T = ltcl.scenes.dihedral(4).transport()
    small = ltcl.compress(ltcl.Transport(T.matrices[0], T.grid, device=device), rtol=1e-2)
    for name in ("compressed.npz", "compressed.zarr"):
        ltcl.save(folder / name, small)
    ltcl.save_inverse(folder / "inverse.npz", ltcl.invert(T, 1e-2))


def test_damaged_files_of_every_format(tmp_path: Path, device: Device) -> None:
    write_samples(tmp_path, device)
    command = [sys.executable, "-m", "tests.store.mutants", str(tmp_path), str(COUNT), "1"]
    own = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, cwd=ROOT, env=own, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]  # a crash ends with a negative one
    outcome = json.loads(done.stdout)
    assert outcome["raw"] == []
    assert outcome["refused"] > 0.5 * COUNT
    assert (
        outcome["read"] > 0.05 * COUNT
    )  # many numbers of a .mtx or HDF5 file may be others and no less valid
    assert outcome["grown"] < 64 << 20
