# SPDX-License-Identifier: BSD-3-Clause
"""Transport files by extension: transports (`load`, `save`) and contents (`read`, `write`)."""

from __future__ import annotations

import functools
import logging
import os
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.errors import FileError, InputTypeError
from ltcl.files import as_path, check_mapped_file, input_file, replace_file, unknown_extension
from ltcl.solvers import Inverse
from ltcl.store import block_store, hdf5, matlab, matrix_market, npz
from ltcl.store.combined import CombinedRecord, combined_record, combined_transport
from ltcl.store.guards import about, floats
from ltcl.store.record import INVERSE_FORMAT, CompressedRecord, Matrix, StoreRecord
from ltcl.transport.first_bounce import DARK_THRESHOLD
from ltcl.transport.projectors import CombinedTransport
from ltcl.transport.transport import Transport, check_transport

logger = logging.getLogger(__name__)


def load(
    path: str | os.PathLike[str],
    *,
    variable: str | Sequence[str] | None = None,
    grid: tuple[int, int] | None = None,
    camera_grid: tuple[int, int] | None = None,
    first_bounce: str | np.ndarray | None = None,
    on_dark: str = "mask",
    dark_threshold: float = DARK_THRESHOLD,
    device: Any = None,
    noise: Any = None,
) -> Transport:
    """Load a transport, `picture = T @ pattern`.

    Parameters
    ----------
    path
        A .npz file (SciPy's sparse layouts, or arrays: `T` (M, N) or (3, M, N), and perhaps `grid`,
        `camera_grid`, `first_bounce`, `mixing`, or a compressed transport), a .npy, .mtx, .h5 or
        .mat file (versions 5 and 7.3, `LTM` (M, N) or (M, N, 3)), or the folder of a store.
    variable
        Name of the matrix in a .npz, .h5 or .mat file, with its groups in .h5 ("entry/data/T"), or
        three names of colours ("red,green,blue"); else T (in .mat LTM), or the only matrix.
    grid, camera_grid
        (h, w) of projector and camera; needed where they are not in the file, and preferred to its
        own.
    first_bounce, on_dark, dark_threshold, device, noise
        As in `Transport`; None takes what is in the file, or else the diagonal, and noise is
        estimated.

    Values of up to 16 bits and float32 become float32, all others float64; compressed ones keep
    their bits. HDF5, .mtx and .mat keep no checksums: a flipped bit may be another number.
    FileError for a file that is missing, damaged, without a grid or no transport; MemoryLimitError
    where host or device have no room.

    Examples
    --------
    >>> import ltcl, tempfile, pathlib, numpy as np
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "T.npy"
    >>> np.save(path, np.eye(6, dtype=np.float32))
    >>> ltcl.load(path, grid=(2, 3)).shape
    (6, 6)
    """
    # `reload` loads the file once more, on any device.
    reload_options: dict[str, Any] = {
        "variable": variable,
        "grid": grid,
        "camera_grid": camera_grid,
        "first_bounce": first_bounce,
        "on_dark": on_dark,
        "dark_threshold": dark_threshold,
    }
    options: dict[str, Any] = {
        "first_bounce": first_bounce,
        "on_dark": on_dark,
        "dark_threshold": dark_threshold,
        "device": device,
        "noise": noise,
    }
    record = read(path, variable=variable)
    with about(path):
        if isinstance(record, CombinedRecord):
            T: Transport = _combined(record, grid, camera_grid, options)
        elif isinstance(record, CompressedRecord):
            if record.format == INVERSE_FORMAT:
                raise FileError("is an inverse, for ltcl.load_inverse; it must be a transport")
            T = Transport.from_arrays(record.arrays, grid=grid or camera_grid, **options)
        else:
            T = _transport(record, grid, camera_grid, options)
    T.reload = functools.partial(load, os.path.abspath(path), **reload_options)
    return T


def _combined(
    record: CombinedRecord, grid: Any, camera_grid: Any, options: dict[str, Any]
) -> Transport:
    """The transport of several projectors, which has all but its device in the file."""
    for name, value in (("grid", grid), ("camera_grid", camera_grid)):
        known = getattr(record, name)
        if value is not None and checks.grid(name, value) != known:
            raise FileError(f"is of several projectors; {name} is {value!r}, its own is {known}")
    for name in ("first_bounce", "noise"):
        if options[name] is not None:
            raise FileError(f"is of several projectors; {name} belongs to the T of each of them")
    return combined_transport(record, options["device"])


def _transport(
    record: StoreRecord, grid: Any, camera_grid: Any, options: dict[str, Any]
) -> Transport:
    """The transport of a record of matrices; `options` are those of `Transport`."""
    M, N = record.shape
    grid = _grid("grid", grid or record.grid, N, "projector")
    camera_grid = camera_grid or record.camera_grid
    if camera_grid is not None or M != N:
        camera_grid = _grid("camera_grid", camera_grid, M, "camera")
    first_bounce = options["first_bounce"]
    if isinstance(first_bounce, str) and first_bounce == "exact":
        record = record.in_memory()  # all entries are needed at once
    if first_bounce is None:
        first_bounce = "diagonal"
        if record.first_bounce is not None and camera_grid in (None, grid):
            first_bounce = record.first_bounce
    settings = options | {
        "first_bounce": first_bounce,
        "mixing": record.mixing,
        "noise": options["noise"] or record.noise,
    }
    return Transport(record.matrices, grid, camera_grid=camera_grid, **settings)


def _grid(name: str, grid: Any, pixels: int, device: str) -> tuple[int, int]:
    """A grid of so many pixels of a projector or camera, which must be known."""
    if grid:
        return checks.grid(name, grid, pixels)
    advice = f"give {name}=(h, w)"
    side = round(pixels**0.5)
    if side * side == pixels:
        advice += f", perhaps {name}=({side}, {side})"
    raise FileError(f"has no grid of the {pixels} {device} pixels; {advice}")


def save(path: str | os.PathLike[str], T: Transport) -> None:
    """Save a transport; an earlier file at `path` is replaced whole or not at all.

    A transport of several projectors (`ltcl.combine`) is an .npz.

    .npz and .zarr keep everything, and they alone compressed operators; .h5 all else, and .mat
    (version 5, less than 4 GiB a variable), but for noise; .npy (dense only) the matrix; .mtx (one
    channel) matrix and grids. An estimate of noise is not saved, and of pixels dropped by
    ``on_dark="mask"`` a first bounce of 0.

    FileError where the extension is unknown, the format cannot hold this transport, or the file
    cannot be written; InputTypeError for 3 x 3 blocks, or operators that are no compressed S F.

    Examples
    --------
    >>> import ltcl, tempfile, pathlib, numpy as np
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "T.npz"
    >>> ltcl.save(path, ltcl.Transport(np.eye(6), grid=(2, 3)))
    >>> ltcl.load(path).grid
    (2, 3)
    """
    check_transport(T, square=False)
    if isinstance(T, CombinedTransport):
        write(path, combined_record(T))
        return
    if T.blocks is not None:
        raise InputTypeError(
            "T has 3 x 3 blocks between colours; only one matrix or three can be saved"
        )
    has_entries = any(isinstance(matrix, Matrix) for matrix in T.matrices)
    if not has_entries:
        write(path, CompressedRecord(T.to_arrays()))
        return
    matrices = []
    for matrix in T.matrices:
        if isinstance(matrix, np.ndarray):
            matrix = floats("T", check_mapped_file(matrix))
        matrices.append(matrix)
    first_bounce = None
    if T.is_square:
        first_bounce = T.first_bounce
    record = StoreRecord(
        matrices=tuple(matrices),
        grid=T.grid,
        camera_grid=T.camera_grid,
        first_bounce=first_bounce,
        mixing=T.mixing,
        noise=T.measured_noise,
    )
    write(path, record)


def save_inverse(path: str | os.PathLike[str], inverse: Inverse) -> None:
    """Save the result of `ltcl.invert` as .npz, whole or not at all; FileError if impossible.

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
        kind = type(inverse).__name__
        raise InputTypeError(f"inverse is a {kind}; it must be the result of ltcl.invert(T)")
    write(path, CompressedRecord(inverse.to_arrays(), INVERSE_FORMAT))


def load_inverse(path: str | os.PathLike[str], *, device: Any = None) -> Inverse:
    """Load an inverse of `save_inverse` onto a device; it raises the errors of `load`."""
    record = read(path)
    with about(path):
        if not isinstance(record, CompressedRecord) or record.format != INVERSE_FORMAT:
            raise FileError("is no inverse, as ltcl.save_inverse writes it")
        return Inverse.from_arrays(record.arrays, device)


def read(
    path: str | os.PathLike[str], *, variable: str | Sequence[str] | None = None
) -> StoreRecord | CompressedRecord | CombinedRecord:
    """Read a transport file; errors are those of `load`."""
    path = as_path(path)
    suffix = find(path)
    file_format = FORMATS[suffix]
    if variable is not None and not file_format.has_names:
        raise FileError(
            f"{path}: variable is {variable!r}, but the matrix of this format has no name"
        )
    if suffix != ".zarr":
        input_file(path)
    with about(path, reading=True):
        if file_format.has_names:
            return file_format.read(path, variable)
        return file_format.read(path)


def write(
    path: str | os.PathLike[str], record: StoreRecord | CompressedRecord | CombinedRecord
) -> None:
    """Write a transport file whole or not at all; errors are those of `save`."""
    path = as_path(path)
    is_inverse = isinstance(record, CompressedRecord) and record.format == INVERSE_FORMAT
    suffix = find(path, inverse=is_inverse)
    file_format = FORMATS[suffix]
    check_losses(path, file_format, record)
    with about(path):
        if isinstance(record, StoreRecord):
            record = record.in_memory()
        with nullcontext(path) if suffix == ".zarr" else replace_file(path) as place:
            file_format.write(place, record)


def check_losses(
    path: Path, file_format: Format, record: StoreRecord | CompressedRecord | CombinedRecord
) -> None:
    """Refuse a format that cannot hold `record`; warn if it drops what can be found again."""
    loss = f"{path}: {path.suffix} does not keep"
    if isinstance(record, CombinedRecord):
        if path.suffix.lower() != ".npz":
            raise FileError(f"{loss} several projectors; .npz does")
        return
    if isinstance(record, CompressedRecord):
        if not file_format.keeps_operators:
            raise FileError(f"{loss} compressed transports; .npz and .zarr do")
        return
    if not file_format.has_extras and record.mixing is not None:
        raise FileError(f"{loss} how the projector's colours mix; .npz does")
    lost = []
    if not file_format.has_extras and not _is_diagonal(record):
        lost.append("the first bounce")
    if not file_format.keeps_noise and record.noise is not None:
        lost.append("the noise")
    if lost:
        logger.warning("%s %s; .npz does", loss, " and ".join(lost))


def _is_diagonal(record: StoreRecord) -> bool:
    """True if the first bounce is the diagonal of T, or unknown."""
    if record.first_bounce is None:
        return True
    diagonals = [matrix.diagonal() for matrix in record.matrices]
    return np.allclose(record.first_bounce, diagonals, rtol=1e-6, atol=0)


def find(path: Path, *, inverse: bool = False) -> str:
    """Extension by which the format of `path` is known; a folder may be a store by any other."""
    suffix = path.suffix.lower()
    if inverse and suffix != ".npz":
        raise FileError(f"{path}: the extension is {path.suffix!r}; inverses are .npz")
    if suffix in FORMATS:
        return suffix
    if path.is_dir():
        return ".zarr"
    raise FileError(f"{path}: {unknown_extension(path)}; transports are {', '.join(FORMATS)}")


@dataclass(frozen=True, kw_only=True)
class Format:
    """Functions that read and write a format, and what it keeps beside the matrices."""

    read: Callable[..., Any]
    write: Callable[[Path, Any], None]
    has_names: bool = True  # whether arrays are told apart by name
    has_extras: bool = True  # grids, first bounce, mixing
    keeps_noise: bool = True
    keeps_operators: bool = False  # compressed ones


NPZ = Format(read=npz.read_npz, write=npz.write_npz, keeps_operators=True)
NPY = Format(
    read=npz.read_npy, write=npz.write_npy, has_names=False, has_extras=False, keeps_noise=False
)
MTX = Format(
    read=matrix_market.read_mtx,
    write=matrix_market.write_mtx,
    has_names=False,
    has_extras=False,
    keeps_noise=False,
)
HDF5 = Format(read=hdf5.read_hdf5, write=hdf5.write_hdf5)
MAT = Format(read=matlab.read_mat, write=matlab.write_mat, keeps_noise=False)
ZARR = Format(read=block_store.read, write=block_store.write, has_names=False, keeps_operators=True)
FORMATS: dict[str, Format] = {
    ".npz": NPZ,
    ".npy": NPY,
    ".mtx": MTX,
    ".h5": HDF5,
    ".hdf5": HDF5,
    ".mat": MAT,
    ".zarr": ZARR,
}
