# SPDX-License-Identifier: BSD-3-Clause
"""Transport files by extension: transports (`load`, `save`), and what files hold (`read`, `write`).

An .npz holds SciPy's `save_npz` layouts; or named arrays, `T` (M, N) or (3, M, N) or the only
matrix; or, by its `format`, a compressed transport, an inverse, or three sparse channels
("ltcl-rgb-csr-1": `shape`, `indptr_0`, `indices_0`, `data_0` to `data_2`); and perhaps `EXTRAS`.
Not compressed, as light hardly shrinks.
"""

from __future__ import annotations

import functools
import logging
import os
import zipfile
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse

from ltcl import checks
from ltcl.errors import FileError, InputError, InputTypeError
from ltcl.files import (
    as_path,
    check_mapped_file,
    input_file,
    replace_file,
    unknown_extension,
)
from ltcl.solvers import Inverse
from ltcl.store import block_store, exchange, record
from ltcl.store.record import CSR, Matrix, Parts, Record, about
from ltcl.transport.first_bounce import DARK_THRESHOLD
from ltcl.transport.transport import Transport, check_transport

COMPRESSED, INVERSE, RGB = "ltcl-compressed-1", "ltcl-inverse-1", "ltcl-rgb-csr-1"
_INDICES = ("indices", "indptr", "row", "col", "coords", "offsets")


def load(
    path: str | os.PathLike[str],
    *,
    variable: str | None = None,
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
        Name of the matrix in a .npz, .h5 or .mat file; else T (in .mat LTM), or the only matrix.
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
    options: dict[str, Any] = {
        "first_bounce": first_bounce,
        "on_dark": on_dark,
        "dark_threshold": dark_threshold,
    }
    again = options | {
        "variable": variable,
        "grid": grid,
        "camera_grid": camera_grid,
    }  # on any device
    options |= {"device": device, "noise": noise}
    content = read(path, variable=variable)
    with about(path):
        if isinstance(content, Parts):
            if content.format == INVERSE:
                raise FileError("is an inverse, for ltcl.load_inverse; it must be a transport")
            T = Transport.from_arrays(content.arrays, grid=grid or camera_grid, **options)
        else:
            M, N = content.shape
            grid = _grid("grid", grid or content.grid, N, "projector")
            camera_grid = camera_grid or content.camera_grid
            if camera_grid is not None or M != N:
                camera_grid = _grid("camera_grid", camera_grid, M, "camera")
            if isinstance(first_bounce, str) and first_bounce == "exact":
                content = content.in_memory()  # which needs all entries at once
            if first_bounce is None:  # on another grid there is no S
                known = content.first_bounce if camera_grid in (None, grid) else None
                options["first_bounce"] = "diagonal" if known is None else known
            options |= {"mixing": content.mixing, "noise": noise or content.noise}
            T = Transport(content.matrices, grid, camera_grid=camera_grid, **options)
    T.reload = functools.partial(load, os.path.abspath(path), **again)
    return T


def _grid(name: str, grid: Any, pixels: int, whose: str) -> tuple[int, int]:
    if grid:
        return checks.grid(name, grid, pixels)
    side = round(pixels**0.5)
    example = f", perhaps {name}=({side}, {side})" if side * side == pixels else ""
    raise FileError(f"has no grid of the {pixels} {whose} pixels; give {name}=(h, w){example}")


def save(path: str | os.PathLike[str], T: Transport) -> None:
    """Save a transport; an earlier file at `path` is replaced whole or not at all.

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
    if check_transport(T, square=False).blocks is not None:
        raise InputTypeError(
            "T has 3 x 3 blocks between colours; only one matrix or three can be saved"
        )
    if not any(isinstance(M, Matrix) for M in T.matrices):
        return write(path, Parts(T.to_arrays()))
    matrices = [
        record.floats("T", check_mapped_file(M)) if isinstance(M, np.ndarray) else M
        for M in T.matrices
    ]
    F = T.first_bounce if T.is_square else None
    write(path, Record(tuple(matrices), T.grid, T.camera_grid, F, T.mixing, T.measured_noise))


def save_inverse(path: str | os.PathLike[str], inverse: Inverse) -> None:
    """Save what `ltcl.invert` made as .npz, whole or not at all; FileError where that is not possible.

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
        raise InputTypeError(
            f"inverse is a {type(inverse).__name__}; it must be what ltcl.invert(T) gives"
        )
    write(path, Parts(inverse.to_arrays(), INVERSE))


def load_inverse(path: str | os.PathLike[str], *, device: Any = None) -> Inverse:
    """Load an inverse of `save_inverse` onto a device (see `open_device`); errors are those of `load`."""
    content: Any = read(path)
    with about(path):
        if getattr(content, "format", None) != INVERSE:
            raise FileError("is no inverse, as ltcl.save_inverse writes it")
        return Inverse.from_arrays(content.arrays, device)


def read(path: str | os.PathLike[str], *, variable: str | None = None) -> Record | Parts:
    """A `Record`, or `Parts` of a compressed transport or of an inverse; errors are those of `load`."""
    suffix = find(path := as_path(path))
    if variable is not None and suffix in (".npy", ".mtx", ".zarr"):
        raise FileError(
            f"{path}: variable is {variable!r}, but the matrix of this format has no name"
        )
    if suffix != ".zarr":
        input_file(path)
    elif path.is_dir() and not (path / "zarr.json").exists():
        raise FileError(
            f"{path}: is a folder with neither zarr.json, of a store, nor acquisition.toml"
        )
    with about(path, reading=True):
        return FORMATS[suffix][0](path, *([] if variable is None else [variable]))


def write(path: str | os.PathLike[str], content: Record | Parts) -> None:
    """Write a transport file whole or not at all; errors are those of `save`."""
    suffix = find(
        path := as_path(path), inverse=isinstance(content, Parts) and content.format == INVERSE
    )
    lost, bare = f"{path}: {path.suffix} does not keep", suffix in (".npy", ".mtx")
    if isinstance(content, Parts):
        if suffix not in (".npz", ".zarr"):
            raise FileError(f"{lost} compressed transports; .npz and .zarr do")
    elif bare and content.mixing is not None:
        raise FileError(f"{lost} how the projector's colours mix; .npz does")
    elif bare or suffix == ".mat":
        F, diagonals = content.first_bounce, [T.diagonal() for T in content.matrices]
        other = bare and F is not None and not np.allclose(F, diagonals, rtol=1e-6, atol=0)
        if names := ["the first bounce"] * other + ["the noise"] * (content.noise is not None):
            logging.getLogger(__name__).warning("%s %s; .npz does", lost, " and ".join(names))
    with about(path):
        content = content.in_memory() if isinstance(content, Record) else content
        with nullcontext(path) if suffix == ".zarr" else replace_file(path) as place:
            FORMATS[suffix][1](place, content)


def find(path: Path, *, inverse: bool = False) -> str:
    """The extension by which the format of `path` is known; a folder may be a store by any other."""
    suffix = path.suffix.lower()
    if inverse and suffix != ".npz":
        raise FileError(f"{path}: the extension is {path.suffix!r}; inverses are .npz")
    if suffix not in FORMATS and not path.is_dir():
        raise FileError(f"{path}: {unknown_extension(path)}; transports are {', '.join(FORMATS)}")
    return suffix if suffix in FORMATS else ".zarr"


def _read_npz(path: Path, variable: str | None = None) -> Record | Parts:
    headers = _headers(path)
    with np.load(path, allow_pickle=False) as archive:

        def load(name: str) -> np.ndarray:
            array = archive[name]
            if array.dtype.kind in "SU" and array.size == 1:
                return array.astype(str).reshape(())
            return np.asarray(checks.real(f"array {name!r}", array), array.dtype.newbyteorder("="))

        layout = str(load("format")) if "format" in headers else None
        if layout in (COMPRESSED, INVERSE):
            return Parts({name: load(name) for name in headers if name != "format"}, layout)
        shapes = {
            n: s for n, (s, dtype) in headers.items() if dtype.kind in "fiubc" or n[:6] == "noise_"
        }
        matrices: dict[str, Any] = {}
        if layout and variable is None:
            if "shape" not in headers:
                raise FileError(f"array 'format' is {layout!r:.60}, which is unknown")
            M, N = checks.grid("array 'shape'", load("shape").tolist())
            for name, (_, dtype) in headers.items():
                if (
                    name.startswith(_INDICES) and dtype.kind not in "iu"
                ):  # SciPy would truncate them
                    raise FileError(f"array {name!r} holds {dtype}; it must hold integers")
            entries = path.stat().st_size // 8  # about, and enough to bound the rows
            if layout != RGB:
                matrices["T"] = record.sparse(lambda: scipy.sparse.load_npz(path), (M, N), entries)
            for k, channel in enumerate(record.CHANNELS if layout == RGB else ()):
                arrays = tuple(load(f"{name}_{k}") for name in CSR)
                make = functools.partial(scipy.sparse.csr_array, arrays, shape=(M, N))
                matrices[channel] = record.sparse(make, (M, N), entries)
        shapes |= dict.fromkeys(matrices, (1, 1))
        return record.assemble(
            shapes, lambda n: matrices[n] if n in matrices else load(n), variable
        )


def _headers(path: Path) -> dict[str, tuple[tuple[int, ...], np.dtype]]:
    """Shape and type of each array by name, after they were compared with the sizes that are stored."""
    headers, size = {}, path.stat().st_size
    with zipfile.ZipFile(path) as archive:
        for info in archive.infolist():
            name, most = (
                info.filename.removesuffix(".npy"),
                record.EXPANSION * min(info.compress_size, size),
            )
            with archive.open(info) as stream:
                version = "1_0" if np.lib.format.read_magic(stream) == (1, 0) else "2_0"
                shape, _, dtype = getattr(np.lib.format, f"read_array_header_{version}")(stream)
                rest = info.file_size - stream.tell()
            record.declared(f"array {name!r}", dtype, shape, min(rest, most), rest)
            headers[name] = (shape, dtype)
    return headers


def _write_npz(path: Path, content: Record | Parts) -> None:
    if isinstance(content, Parts):
        arrays: dict[str, Any] = {"format": content.format, **content.arrays}
    elif content.dense:
        arrays = content.arrays()
    else:  # one matrix as SciPy writes it: bytes, and a flag for csr_array
        ends = [""] if len(content.matrices) == 1 else ["_0", "_1", "_2"]
        header = {
            "format": RGB if ends[1:] else np.array(b"csr"),
            "_is_array": True,
            "shape": content.shape,
        }
        csr = zip(ends, content.matrices, strict=True)
        arrays = content.arrays() | header | {n + end: getattr(T, n) for end, T in csr for n in CSR}
    np.savez(path, **arrays)


def _read_npy(path: Path) -> Record:
    mapped = np.lib.format.open_memmap(path, "r")  # reads the header and allocates nothing
    fits = 2 * mapped.nbytes <= checks.host_memory()
    return record.assemble({"T": mapped.shape}, lambda _: np.array(mapped) if fits else mapped)


def _write_npy(path: Path, content: Record) -> None:
    if not content.dense:
        raise InputError("T is sparse, and .npy holds dense arrays only; save it as .npz")
    np.save(path, content.arrays()["T"], allow_pickle=False)


FORMATS: dict[str, tuple[Callable[..., Any], Callable[[Path, Any], None]]] = {
    ".npz": (_read_npz, _write_npz),
    ".npy": (_read_npy, _write_npy),
    ".mtx": (exchange.read_mtx, exchange.write_mtx),
    **dict.fromkeys((".h5", ".hdf5"), (exchange.read_hdf5, exchange.write_hdf5)),
    ".mat": (exchange.read_mat, exchange.write_mat),
    ".zarr": (block_store.read, block_store.write),
}
