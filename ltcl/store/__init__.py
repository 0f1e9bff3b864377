# SPDX-License-Identifier: BSD-3-Clause
"""Transports on disk: load one from, and save one to, .npz, .npy, .mtx, .h5, .mat and .zarr.

Everything that a file declares is checked before memory is taken for it; pickles are never loaded. A .zarr
folder is a `BlockStore`: a scan grows in it batch by batch, and a finished T is read block by block.

formats         which extension, read and write; npz, mtx, hdf5, matlab, zarr_folder: one format each
headers         what files declare is checked here; record: what is in them
block_store     `BlockStore`: a log of batches (`array_log`), finalized as zarr (`zarr_arrays`)
rows            `StoredRows`: one channel as a matrix that is never loaded whole
"""

from __future__ import annotations

import os
from typing import Any

import numpy as np
import scipy.sparse

from ltcl import checks
from ltcl.errors import FileError, InputTypeError
from ltcl.files import as_path
from ltcl.solvers import Inverse
from ltcl.store import formats, headers
from ltcl.store.block_store import BlockStore
from ltcl.store.inverses import load_inverse, save_inverse
from ltcl.store.record import Matrix, Parts, Record
from ltcl.store.rows import StoredRows
from ltcl.transport import Transport, from_arrays, to_arrays

__all__ = ["BlockStore", "Parts", "Record", "StoredRows", "load", "load_inverse", "save", "save_inverse"]


def load(
    path: str | os.PathLike[str],
    *,
    variable: str | None = None,
    grid: tuple[int, int] | None = None,
    camera_grid: tuple[int, int] | None = None,
    first_bounce: str | np.ndarray | None = None,
    on_dark: str = "raise",
    device: Any = None,
) -> Transport:
    """Load a transport, `picture = T @ pattern`.

    Parameters
    ----------
    path
        A .npz file (SciPy's sparse layouts, or arrays: `T` (M, N) or (3, M, N), and perhaps `grid`,
        `camera_grid`, `first_bounce`, `mixing`, or a compressed transport), a .npy, .mtx, .h5 or .mat file
        (MATLAB's versions 5 and 7.3), or the folder of a store, whose blocks go to the device one by one.
    variable
        Name of the matrix in a .npz, .h5 or .mat file; else T (in .mat LTM), or the only matrix.
    grid, camera_grid
        (h, w) of projector and camera; needed where the file does not tell, and preferred to what it tells.
    first_bounce, on_dark, device
        As in `Transport`; a first bounce of None takes the file's, or else "diagonal".

    Returns
    -------
    Transport
        float32 values stay float32; 8- and 16-bit values become float32, all others float64. A compressed
        one is on its device at once, with the same bits as it was saved.

    Raises
    ------
    FileError
        The file is missing, empty, damaged, truncated, lies about a size, is of an unknown format, holds no
        transport or one that `Transport` refuses, or does not tell its grid.
    MemoryLimitError
        It does not fit the memory of the host or of the device.

    Notes
    -----
    HDF5, .mtx and .mat keep no checksums: a flipped bit may be another number. A .mtx that is cut inside its
    last number reads as one whose last number is shorter.

    Examples
    --------
    >>> import tempfile, pathlib, numpy as np
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "T.npy"
    >>> np.save(path, np.eye(6, dtype=np.float32))
    >>> load(path, grid=(2, 3)).shape
    (6, 6)
    """
    path = as_path(path)
    record = formats.read(path, variable=variable)
    with formats.about(path):
        if isinstance(record, Parts):
            same = {"grid": grid or camera_grid, "first_bounce": first_bounce}
            return from_arrays(record.arrays, **same, on_dark=on_dark, device=device)
        rows, columns = record.shape
        grid = checks.grid("grid", grid or record.grid or _unknown("grid", columns, "projector"), columns)
        camera_grid = camera_grid or record.camera_grid
        if camera_grid is not None or rows != columns:
            wanted = camera_grid or _unknown("camera_grid", rows, "camera")
            camera_grid = checks.grid("camera_grid", wanted, rows)
        if first_bounce is None:
            # On another camera grid there is no S, and the file's first bounce means nothing.
            stored = record.first_bounce if camera_grid in (None, grid) else None
            first_bounce = "diagonal" if stored is None else stored
        return Transport(
            record.matrices if len(record.matrices) == 3 else record.matrices[0],
            grid=grid,
            camera_grid=camera_grid,
            first_bounce=first_bounce,
            on_dark=on_dark,
            mixing=record.mixing,
            device=device,
        )


def save(path: str | os.PathLike[str], T: Transport) -> None:
    """Save a transport; an earlier file at `path` is replaced whole or not at all.

    Parameters
    ----------
    path
        .npz and .zarr keep everything, and they alone compressed operators; .h5 and .mat (version 5, less
        than 4 GiB a variable) all else; .npy (dense only) the matrix; .mtx matrix and grids, of three
        channels in T_r.mtx, T_g.mtx and T_b.mtx for T.mtx.
    T
        A transport made of matrices, or compressed.

    Raises
    ------
    FileError
        An unknown extension, a format that cannot hold this transport, or the file cannot be written.
    InputTypeError
        T is no Transport, of 3 x 3 blocks, or made of operators that are no compressed S F.

    Notes
    -----
    Pixels dropped by ``on_dark="mask"`` are saved with a first bounce of 0; loading needs the same again.

    Examples
    --------
    >>> import tempfile, pathlib, numpy as np
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "T.npz"
    >>> save(path, Transport(np.eye(6), grid=(2, 3)))
    >>> load(path).grid
    (2, 3)
    """
    if not isinstance(T, Transport):
        also = "; ltcl.save_inverse saves it" if isinstance(T, Inverse) else ""
        raise InputTypeError(f"T is a {type(T).__name__}; it must be a Transport{also}")
    if T.blocks is not None:
        raise InputTypeError("T has 3 x 3 blocks between colours; only one matrix or three can be saved")
    if not any(isinstance(matrix, Matrix) for matrix in T.matrices):
        formats.write(as_path(path), Parts(to_arrays(T)))
        return
    matrices = []
    for matrix in T.matrices:
        if isinstance(matrix, np.ndarray):
            matrix = headers.floats("T", matrix)
        elif isinstance(matrix, scipy.sparse.csr_array):
            parts = (headers.floats("T", matrix.data), matrix.indices, matrix.indptr)
            matrix = scipy.sparse.csr_array(parts, shape=matrix.shape)
        matrices.append(matrix)
    bounce = T.first_bounce if T.is_square else None
    formats.write(as_path(path), Record(tuple(matrices), T.grid, T.camera_grid, bounce, T.mixing))


def _unknown(name: str, pixels: int, whose: str) -> tuple[int, int]:
    side = round(pixels**0.5)
    example = f", perhaps {name}=({side}, {side})" if side * side == pixels else ""
    raise FileError(f"does not tell how the {pixels} {whose} pixels lie; give {name}=(h, w){example}")
