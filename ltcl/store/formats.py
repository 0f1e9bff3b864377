# SPDX-License-Identifier: BSD-3-Clause
"""Transport files by extension: transports (`load`, `save`), and what files hold (`read`, `write`)."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse

from ltcl import checks
from ltcl.errors import FileError, InputTypeError
from ltcl.files import as_path, input_file, replace_file, unknown_extension
from ltcl.solvers import Inverse
from ltcl.store import block_store, exchange, npz
from ltcl.store.record import Matrix, Parts, Record, about, floats
from ltcl.transport import Transport, from_arrays, to_arrays

logger = logging.getLogger(__name__)


class Format(NamedTuple):
    """How files of a format are read and written, and what they keep."""

    read: Callable[..., Any]
    write: Callable[[Path, Any], None]
    variables: bool = True  # whether arrays have names
    first_bounce: bool = True
    compressed: bool = False


_ZARR = Format(block_store.read, block_store.write, variables=False, compressed=True)
_HDF5 = Format(exchange.read_hdf5, exchange.write_hdf5)
FORMATS: dict[str, Format] = {
    ".npz": Format(npz.read, npz.write, compressed=True),
    ".npy": Format(npz.read_npy, npz.write_npy, variables=False, first_bounce=False),
    ".mtx": Format(exchange.read_mtx, exchange.write_mtx, variables=False, first_bounce=False),
    ".h5": _HDF5,
    ".hdf5": _HDF5,
    ".mat": Format(exchange.read_mat, exchange.write_mat),
    ".zarr": _ZARR,
}


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
        (h, w) of projector and camera; needed where they are not in the file, and preferred to its own.
    first_bounce, on_dark, device
        As in `Transport`; a first bounce of None takes the file's, or else "diagonal".

    Returns
    -------
    Transport
        Values of up to 16 bits and float32 are float32, all others float64; a compressed one has the same
        bits as it was saved. HDF5, .mtx and .mat keep no checksums: a flipped bit may be another number.

    Raises
    ------
    FileError
        The file is missing, damaged, of an unknown format, without a grid, or holds no valid transport.
    MemoryLimitError
        It does not fit the memory of the host or of the device.

    Examples
    --------
    >>> import tempfile, pathlib, numpy as np
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "T.npy"
    >>> np.save(path, np.eye(6, dtype=np.float32))
    >>> load(path, grid=(2, 3)).shape
    (6, 6)
    """
    path = as_path(path)
    record = read(path, variable=variable)
    with about(path):
        if isinstance(record, Parts):
            own: dict[str, Any] = {"grid": grid or camera_grid, "first_bounce": first_bounce}
            return from_arrays(record.arrays, **own, on_dark=on_dark, device=device)
        M, N = record.shape
        grid = checks.grid("grid", grid or record.grid or _unknown("grid", N, "projector"), N)
        camera_grid = camera_grid or record.camera_grid
        if camera_grid is not None or M != N:
            camera_grid = checks.grid("camera_grid", camera_grid or _unknown("camera_grid", M, "camera"), M)
        if first_bounce is None:
            # On another camera grid there is no S, and the file's first bounce means nothing.
            stored = record.first_bounce if camera_grid in (None, grid) else None
            first_bounce = "diagonal" if stored is None else stored
        matrices = record.matrices if len(record.matrices) == 3 else record.matrices[0]
        own = {"on_dark": on_dark, "mixing": record.mixing}
        return Transport(matrices, grid, first_bounce, camera_grid, device, **own)


def _unknown(name: str, pixels: int, whose: str) -> tuple[int, int]:
    side = round(pixels**0.5)
    example = f", perhaps {name}=({side}, {side})" if side * side == pixels else ""
    raise FileError(f"has no grid of the {pixels} {whose} pixels; give {name}=(h, w){example}")


def save(path: str | os.PathLike[str], T: Transport) -> None:
    """Save a transport; an earlier file at `path` is replaced whole or not at all.

    .npz and .zarr keep everything, and they alone compressed operators; .h5 and .mat (version 5, less than
    4 GiB a variable) all else; .npy (dense only) the matrix; .mtx (one channel) matrix and grids. Pixels
    dropped by ``on_dark="mask"`` are saved with a first bounce of 0; loading needs the same again.

    FileError for an unknown extension, a format that cannot hold this transport, or a file that cannot be
    written; InputTypeError for 3 x 3 blocks, or operators that are no compressed S F.

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
        write(path, Parts(to_arrays(T)))
        return
    matrices = []
    for M in T.matrices:
        if isinstance(M, scipy.sparse.csr_array):
            M = scipy.sparse.csr_array((floats("T", M.data), M.indices, M.indptr), shape=M.shape)
        matrices.append(floats("T", M) if isinstance(M, np.ndarray) else M)
    F = T.first_bounce if T.is_square else None
    write(path, Record(tuple(matrices), T.grid, T.camera_grid, F, T.mixing))


def save_inverse(path: str | os.PathLike[str], inverse: Inverse) -> None:
    """Save what `ltcl.invert` made as .npz; an earlier file at `path` is replaced whole or not at all.

    FileError for another extension, or where the file cannot be written.

    Examples
    --------
    >>> import ltcl, pathlib, tempfile
    >>> T = ltcl.Transport([[0.5, 0.1], [0.1, 0.5]], grid=(1, 2))
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "inverse.npz"
    >>> ltcl.save_inverse(path, ltcl.invert(T, rtol=1e-3))
    >>> ltcl.load_inverse(path).error <= 1e-3
    True
    """
    if not isinstance(inverse, Inverse):
        raise InputTypeError(f"inverse is a {type(inverse).__name__}; it must be what ltcl.invert(T) gives")
    write(path, Parts(inverse.to_arrays(), npz.INVERSE))


def load_inverse(path: str | os.PathLike[str], *, device: Any = None) -> Inverse:
    """Load an inverse of `save_inverse` onto a device (as `open_device` takes it), with the same bits.

    FileError and MemoryLimitError as of `load`, and where the file holds something else.
    """
    content: Any = read(path, inverse=True)
    with about(path):
        return Inverse.from_arrays(content.arrays, device)


def read(
    path: str | os.PathLike[str], *, variable: str | None = None, inverse: bool | None = False
) -> Record | Parts:
    """A `Record`, or `Parts` of a compressed transport, or of an `inverse`; with None of either.

    Needs no device; errors and `variable` are those of `load`.
    """
    path = as_path(path)
    kind = find(path, inverse=inverse or False)
    if variable is not None and not kind.variables:
        raise FileError(f"{path}: variable is {variable!r}, but the matrix of this format has no name")
    if kind is not _ZARR:
        input_file(path)
    with about(path, reading=True):
        content = kind.read(path) if variable is None else kind.read(path, variable)
        is_inverse = isinstance(content, Parts) and content.format == npz.INVERSE
        if inverse not in (None, is_inverse):
            actual = "an inverse, for ltcl.load_inverse; it must be a transport"
            raise FileError(f"is {actual}" if is_inverse else "is no inverse, as ltcl.save_inverse writes it")
        return content


def write(path: str | os.PathLike[str], content: Record | Parts) -> None:
    """Write a transport file whole or not at all; errors are those of `save`."""
    path = as_path(path)
    kind = find(path, inverse=isinstance(content, Parts) and content.format == npz.INVERSE)
    lost = f"{path}: {path.suffix} does not keep"
    if isinstance(content, Parts):
        if not kind.compressed:
            raise FileError(f"{lost} compressed transports; .npz and .zarr do")
    elif not kind.first_bounce:
        if content.mixing is not None:
            raise FileError(f"{lost} how the projector's colours mix; .npz does")
        F, diagonals = content.first_bounce, [T.diagonal() for T in content.matrices]
        if F is not None and not np.allclose(F, diagonals, rtol=1e-6, atol=0):
            logger.warning("%s the first bounce; .npz does", lost)
    with about(path):
        if kind is _ZARR:
            kind.write(path, content)
            return
        with replace_file(path) as temporary:
            kind.write(temporary, content.in_memory() if isinstance(content, Record) else content)


def find(path: Path, *, inverse: bool = False) -> Format:
    """The format that the extension of `path` names; a folder may be a store by any other."""
    suffix = path.suffix.lower()
    if inverse and suffix != ".npz":
        raise FileError(f"{path}: the extension is {path.suffix!r}; inverses are .npz")
    if suffix not in FORMATS and not path.is_dir():
        raise FileError(f"{path}: {unknown_extension(path)}; transports are {', '.join(FORMATS)}")
    return FORMATS.get(suffix, _ZARR)
