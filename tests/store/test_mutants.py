# SPDX-License-Identifier: BSD-3-Clause
"""Damaged files of every format: no crash, no error of a library, no memory for what is only declared.

LTCL_MUTANTS=4000 in the environment tries as many; by default it is a tenth. They are read in a process of
its own, ``python -m tests.store.test_mutants FOLDER COUNT SEED``: each file in turn has bits flipped, is cut,
gets bytes appended, or has bytes of its head replaced; of a store, one of its files.
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

import numpy as np
import scipy.io
import scipy.sparse

import ltcl
from ltcl.device import Device
from ltcl.errors import LtclError
from ltcl.store import Record, formats

from .stores import dense, sparse

ROOT = Path(__file__).resolve().parents[2]
COUNT = int(os.environ.get("LTCL_MUTANTS", "400"))
HEAD = 400


def mutant(good: bytes, draw: random.Random) -> bytes:
    """The same bytes but for some damage."""
    data, how = bytearray(good), draw.randrange(4)
    if how == 0:
        for _ in range(draw.choice((1, 1, 4))):
            data[draw.randrange(len(data))] ^= 1 << draw.randrange(8)
    elif how == 1:
        del data[draw.randrange(len(data)) :]
    elif how == 2:
        data += draw.randbytes(draw.choice((1, 8, 40)))
    else:
        place, size = draw.randrange(min(len(data), HEAD)), draw.choice((1, 4, 8))
        data[place : place + size] = bytes(
            draw.choice((0, 255, 57, 69, draw.randrange(256))) for _ in range(size)
        )
    return bytes(data)


def main(folder: Path, count: int, seed: int) -> None:
    """Print how many were read and refused, each other error in a line, and the growth of memory."""
    draw, raw, refused = random.Random(seed), [], 0  # noqa: S311 - damage, no secrets
    good = sorted(path for path in folder.iterdir() if path.name != "mutants")
    for path in good:  # so that memory is counted from a process that has read each once
        formats.read(path, inverse=None)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for number in range(count):
        original = good[number % len(good)]
        path = place = folder / "mutants" / f"{number}{original.suffix}"
        if original.is_dir():
            shutil.copytree(original, path)
            place = path / draw.choice(sorted(f.relative_to(path) for f in path.rglob("*") if f.is_file()))
            original = original / place.relative_to(path)
        else:
            path.parent.mkdir(exist_ok=True)
        place.write_bytes(mutant(original.read_bytes(), draw))
        try:
            formats.read(path, inverse=None)
        except LtclError as error:
            refused += 1
            if not str(error).startswith(f"{path}: ") or "\n" in str(error):
                raw.append(f"{original.name} {number}: {error}")
        except Exception as error:  # noqa: BLE001 - whatever there is, it is listed
            raw.append(f"{original.name} {number}: {type(error).__name__}: {error}")
        else:
            shutil.rmtree(path) if path.is_dir() else path.unlink()
    grown = 1024 * (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)
    outcome = {"read": count - refused - len(raw), "refused": refused, "raw": raw, "grown": grown}
    sys.stdout.write(json.dumps(outcome))


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
    command = [sys.executable, "-m", "tests.store.test_mutants", str(tmp_path), str(COUNT), "1"]
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


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]))
