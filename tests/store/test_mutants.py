# SPDX-License-Identifier: BSD-3-Clause
"""Damaged files of every format: no crash, no library error, no memory for declared sizes.

LTCL_MUTANTS=4000 in the environment tries as many; by default it is a tenth. They are read in a
process of its own, ``python -m tests.store.test_mutants FOLDER COUNT``: each file (of a store, one
of its files) in turn has bits flipped, is cut, gets bytes appended, or has bytes of its head
replaced.
"""

from __future__ import annotations

import json
import os
import random
import resource
import shutil
import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest
import scipy.io
import scipy.sparse

import ltcl
from ltcl.device import Device
from ltcl.errors import LtclError
from ltcl.store import StoreRecord, formats

from .stores import dense, sparse

ROOT = Path(__file__).resolve().parents[2]
COUNT = int(os.environ.get("LTCL_MUTANTS", "400"))


def mutant(good: bytes, draw: random.Random) -> bytes:
    """The same bytes but for some damage."""
    data = bytearray(good)
    how = draw.randrange(4)
    if how == 0:
        for _ in range(draw.choice((1, 1, 4))):
            data[draw.randrange(len(data))] ^= 1 << draw.randrange(8)
    elif how == 1:
        del data[draw.randrange(len(data)) :]
    elif how == 2:
        data += draw.randbytes(draw.choice((1, 8, 40)))
    else:  # of the head
        place = draw.randrange(min(len(data), 400))
        size = draw.choice((1, 4, 8))
        data[place : place + size] = draw.choices((0, 255, 57, 69, draw.randrange(256)), k=size)
    return bytes(data)


def main(folder: Path, count: int) -> None:
    """Print how many were read and refused, each other error, and the growth of memory."""
    draw = random.Random(1)  # noqa: S311 - damage, no secrets
    raw = []
    refused = 0
    good = sorted(path for path in folder.iterdir() if path.name != "mutants")
    for path in good:  # so that memory is counted from a process that has read each once
        formats.read(path)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for number in range(count):
        original = good[number % len(good)]
        path = place = folder / "mutants" / f"{number}{original.suffix}"
        if original.is_dir():
            shutil.copytree(original, path)
            place = draw.choice(sorted(file for file in path.rglob("*") if file.is_file()))
        else:
            path.parent.mkdir(exist_ok=True)
            shutil.copy(original, path)
        place.write_bytes(mutant(place.read_bytes(), draw))
        try:
            formats.read(path)
        except Exception as error:  # noqa: BLE001 - whatever there is, it is listed
            refused += 1
            if (
                not isinstance(error, LtclError)
                or not str(error).startswith(f"{path}: ")
                or "\n" in str(error)
            ):
                raw.append(f"{original.name} {number}: {type(error).__name__}: {error}")
        shutil.rmtree(path) if path.is_dir() else path.unlink()
    grown = 1024 * (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)
    sys.stdout.write(json.dumps({"refused": refused, "raw": raw, "grown": grown}))


def write_samples(folder: Path, device: Device) -> None:
    """Small good files of each kind and layout."""
    grid = (3, 4)
    rgb = tuple(sparse(seed=seed, pattern=seed) for seed in range(3))
    for extension in (".npz", ".npy", ".mtx", ".h5", ".mat", ".zarr"):
        formats.write(folder / f"dense{extension}", StoreRecord((dense(),), grid))
        if extension != ".npy":
            formats.write(
                folder / f"sparse{extension}",
                StoreRecord((sparse(),), grid, first_bounce=np.ones(12)),
            )
    formats.write(folder / "rgb.npz", StoreRecord(rgb, grid, mixing=np.eye(3)))
    np.savez_compressed(folder / "deflated.npz", T=dense(), grid=grid)
    for layout in ("csc", "coo", "bsr", "dia"):
        scipy.sparse.save_npz(
            folder / f"{layout}.npz", getattr(scipy.sparse, f"{layout}_array")(sparse())
        )
    for name, LTM in (("full.mat", dense()), ("deflated.mat", sparse().astype(float))):
        scipy.io.savemat(
            folder / name, {"LTM": LTM, "note": "text"}, do_compression=name == "deflated.mat"
        )
    with h5py.File(folder / "7.3.mat", "w", userblock_size=512) as file:
        file["LTM"] = dense()
    scipy.io.mmwrite(folder / "symmetric.mtx", sparse() + sparse().T, symmetry="symmetric")
    T = ltcl.scenes.dihedral(4).transport()
    small = ltcl.compress(ltcl.Transport(T.matrices[0], T.grid, device=device), rtol=1e-2)
    for name in ("compressed.npz", "compressed.zarr"):
        ltcl.save(folder / name, small)
    ltcl.save_inverse(folder / "inverse.npz", ltcl.invert(T, 1e-2))


@pytest.mark.rare
def test_damaged_files_of_every_format(tmp_path: Path, device: Device) -> None:
    write_samples(tmp_path, device)
    command = [sys.executable, "-m", "tests.store.test_mutants", str(tmp_path), str(COUNT)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]  # a crash ends with a negative one
    outcome = json.loads(done.stdout)
    assert outcome["raw"] == []
    # Other numbers in .mtx or HDF5 are as valid.
    assert 0.5 * COUNT < outcome["refused"] < 0.95 * COUNT
    assert outcome["grown"] < 64 << 20


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]))
