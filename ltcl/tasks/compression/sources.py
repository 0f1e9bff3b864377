# SPDX-License-Identifier: BSD-3-Clause
"""What is compressed: R of every channel by its rows, a block at a time, and by products on a device."""

from __future__ import annotations

import contextlib
import copy
import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy.sparse
import scipy.sparse.linalg

from ltcl import checks
from ltcl.batch.cluster import is_there, stream
from ltcl.device import Device, open_device
from ltcl.errors import InputError, InputTypeError, MemoryLimitError
from ltcl.operators import Dense, Host, Operator
from ltcl.transport import first_bounce as _first_bounce
from ltcl.transport.noise import Noise
from ltcl.transport.transport import Transport, check_transport

COLUMNS = 16  # blocks are of a multiple of this, so that kernels run alike whatever the block
_WINDOW = 64  # pixels a side of the part of a picture on which bases are compared
_PER_VALUE = 32  # bytes of host memory for a value of a block: float64, float32, transformed, kept
_BLOCK, _MOST = (
    1 << 27,
    512,
)  # bytes of a block unless `memory` says otherwise; rows: more do not help
_ITEMS = 512  # for workers, or up to twice as many: each costs the client some milliseconds


class Rows(scipy.sparse.linalg.LinearOperator):
    """A matrix (M, N) by its rows, of which memory holds a few; products read all of them, on the host.

    `fetch(start, stop)` reads rows of what they are made of, `make(start, stop, rows)` checks and
    makes them. With a Dask `client` its workers make them, and fetch them if they can, `there`;
    else rows are sent. `chunks` are how many rows are best fetched at once: of each time, or
    always.
    """

    client: Any = None
    there = False
    chunks: int | tuple[int, ...] = 1

    def __init__(self, shape: Any, fetch: Callable, make: Callable, memory: int | None) -> None:
        super().__init__(np.float64, shape)
        self.fetch, self.make, self.memory = fetch, make, memory

    def rows(self, start: int, stop: int) -> np.ndarray:
        """Rows start .. stop - 1, (stop - start, N)."""
        return self.make(start, stop, self.fetch(start, stop))

    def each(
        self, work: Callable, value: Callable = lambda: None, dtype: Any = np.float32
    ) -> Iterator[Any]:
        """`work(at, rows, value())` of all blocks that fit into `memory`, in order, here or on workers."""
        make, size = self.make, rows_at_once(self.shape[1], self.memory)
        fetch = self.fetch if self.there or self.client is None else None

        def task(item: tuple[list[Any], Any]) -> list[Any]:  # without `self`: workers get it
            (parts, value), results = item, []
            for start, stop, rows in parts:
                rows, count = fetch(start, stop) if fetch else rows, stop - start
                for i, j in cut(count, size):
                    block = make(start + i, start + j, rows[i : j if j < count else None])
                    results.append(
                        work(slice(start + i, start + j), np.asarray(block, dtype), value)
                    )
            return results

        if isinstance(self.chunks, int):
            spans = [*cut(self.shape[0], size * -(-self.chunks // size) if self.there else size)]
        else:
            spans = [*itertools.pairwise([0, *itertools.accumulate(self.chunks)])]
        parts = ((*span, None if fetch else self.fetch(*span)) for span in spans)
        many = 1 + len(spans) // _ITEMS if self.there else 1
        items = (([*itertools.islice(parts, many)], value()) for _ in range(0, len(spans), many))
        return itertools.chain.from_iterable(stream(self.client, task, items))

    def diagonal(self) -> np.ndarray:
        """The main diagonal, (min(M, N),) float64, not rounded: a first bounce may be made of it."""
        return np.concatenate(
            [*self.each(lambda at, rows, _: rows.diagonal(at.start).copy(), dtype=float)]
        )

    def _matmat(self, X: np.ndarray) -> np.ndarray:
        x = X.astype(np.float32)
        return np.concatenate([*self.each(lambda at, rows, _: rows @ x)]).astype(np.float64)

    def _rmatmat(self, X: np.ndarray) -> np.ndarray:
        x = X.astype(np.float32)
        return sum(
            self.each(lambda at, rows, _: rows.T @ x[at]), np.zeros((self.shape[1], X.shape[1]))
        )


def source(name: str, matrix: Any, memory: int | None = None, client: Any = None) -> Rows:
    """`matrix` by its rows, in blocks of `memory` bytes, which are checked as they are read.

    It is sparse, sliced as arrays, memory-mapped files, HDF5, zarr and Dask arrays are, has
    ``rows(start, stop)``, or is an operator, by products with its transpose.
    """
    if np.size(getattr(matrix, "shape", (0, 0))) != 2:
        raise InputError(f"{name} has shape {matrix.shape}; it must be (M, N)")
    if not hasattr(matrix, "shape") or not any(
        hasattr(matrix, a) for a in ("__getitem__", "rows", "matvec")
    ):
        kinds = "be an array, sparse, an operator, or have shape and rows(start, stop)"
        raise InputTypeError(f"{name} is a {type(matrix).__name__}; it must {kinds}")
    matrix = checks.csr(name, matrix) if scipy.sparse.issparse(matrix) else matrix
    columns, there = matrix.shape[1], client is not None and _is_there(client, matrix)
    scheduler = "synchronous" if there else client  # of Dask: a worker does not wait for others

    def fetch(start: int, stop: int) -> Any:
        if hasattr(matrix, "rows"):
            return matrix.rows(start, stop)
        if hasattr(matrix, "dask"):
            return matrix[start:stop].compute(scheduler=scheduler)
        if scipy.sparse.issparse(matrix) or not hasattr(matrix, "matvec"):
            return matrix[start:stop]
        units = np.zeros((matrix.shape[0], stop - start), np.float32)
        units[np.arange(start, stop), np.arange(stop - start)] = 1.0
        try:
            return np.ascontiguousarray(matrix.rmatmat(units).T)
        except (NotImplementedError, TypeError) as error:  # what SciPy raises, by its version
            raise InputError(
                f"{name} is a {type(matrix).__name__} without rmatvec or rows"
            ) from error

    def make(start: int, stop: int, rows: Any) -> np.ndarray:
        what = f"{name} in rows {start} to {stop - 1}"
        rows = checks.real(what, rows.toarray() if scipy.sparse.issparse(rows) else rows)
        return checks.shape(what, rows, (stop - start, columns))

    R = Rows(matrix.shape, fetch, make, memory)
    chunks = getattr(matrix, "chunks", None) or [
        1
    ]  # of Dask those of all rows, else how many are in each
    R.client, R.chunks, R.there = client, chunks[0], there
    return R


def _is_there(client: Any, matrix: Any) -> bool:
    """Whether workers can fetch rows: compute them (Dask), read files (zarr), or call `rows`."""
    from distributed import futures_of
    from distributed.protocol.pickle import dumps

    if root := getattr(getattr(matrix, "store", None), "root", None):
        return is_there(client, str(root))
    if hasattr(matrix, "dask"):
        return not futures_of(matrix)
    with contextlib.suppress(Exception):  # of whatever it holds that cannot be sent
        return hasattr(matrix, "rows") and bool(dumps(matrix, buffer_callback=lambda buffer: False))
    return False


def interreflection(T: Rows, F: np.ndarray) -> Rows:
    """R = T F^-1 - I by rows, in float64 and rounded once; of a masked pixel, F = 0, the column is 0."""
    R, lit, make_T = copy.copy(T), F > 0, T.make

    def make(start: int, stop: int, rows: Any) -> np.ndarray:
        block = checks.finite(f"T in rows {start} to {stop - 1}", make_T(start, stop, rows))
        block = block / np.where(lit, F, np.inf)
        here = np.arange(stop - start)
        block[here, start + here] -= lit[start:stop]
        return block.astype(np.float32)

    R.make = make
    return R


@dataclass(frozen=True)
class Problem:
    """R (N, N) of a channel, on a grid: rows, products, F (N,), and noise: variances of rows and columns."""

    R: Rows
    operator: Operator
    grid: tuple[int, int]
    F: np.ndarray
    noise: np.ndarray | None = None

    def window(self) -> Problem:
        """R between the pixels in the middle of the picture; itself where these are all."""
        h, w = window_of(self.grid)
        if h * w == self.R.shape[0]:
            return self
        top, left = (self.grid[0] - h) // 2, (self.grid[1] - w) // 2
        firsts = np.arange(top, top + h) * self.grid[1] + left  # of each row of the window
        pixels = np.add.outer(firsts, np.arange(w)).ravel()
        R = np.concatenate([self.R.rows(first, first + w)[:, pixels] for first in firsts.tolist()])
        rows, noise = (
            source("R", R, self.R.memory),
            None if self.noise is None else self.noise[:, pixels],
        )
        return Problem(rows, Dense(self.operator.device, R), (h, w), self.F[pixels], noise)


def window_of(grid: tuple[int, int]) -> tuple[int, int]:
    """The grid of the window of a picture."""
    return min(grid[0], _WINDOW), min(grid[1], _WINDOW)


@dataclass(frozen=True)
class Inputs:
    """R of every channel, keywords of a Transport that is made of it, and the bytes of T."""

    problems: list[Problem]
    settings: dict[str, Any]
    nbytes: int


def validate_inputs(
    T: Any,
    grid: Any,
    first_bounce: Any,
    device: Device | str | None,
    noise: Noise | None,
    **reading: Any,
) -> Inputs:
    """Whatever `compress` takes, checked: a Transport, operators, or rows; see `source` for `reading`."""
    if isinstance(T, Transport):
        for name, value in {"grid": grid, "first_bounce": first_bounce, "device": device}.items():
            if value is not None:
                raise InputError(
                    f"{name} is given, but T is a Transport, which has its own; leave it out"
                )
        check_transport(T)
        if T.error > 0.0:
            raise InputError(
                f"T is compressed already, with an error of {T.error:.2g}; compress its origin"
            )
        return of_transport(T, noise, **reading)
    matrices = list(T) if isinstance(T, (list, tuple)) else [T]
    if len(matrices) not in (1, 3):
        raise InputError(f"T has {len(matrices)} channels; it must be one, or three for RGB")
    if grid is None:
        raise InputError(
            "grid is None, but T is no Transport; it must be (h, w), the projector's pixels"
        )
    F = "diagonal" if first_bounce is None else first_bounce
    if all(hasattr(matrix, "matvec") and not hasattr(matrix, "rows") for matrix in matrices):
        return validate_inputs(
            Transport(T, grid, F, device=device), None, None, None, None, **reading
        )
    rows = [source("T", matrix, **reading) for matrix in matrices]
    n = rows[0].shape[0]
    for channel in rows:
        if channel.shape != (n, n):
            raise InputError(
                f"T has shape {channel.shape}; it must be square, (N, N), to have an S"
            )
        channel.rows(
            0, 1
        )  # of rows that end with the matrix nobody sees that one too many was given
    grid, device = (
        checks.grid("grid", grid, n),
        device if isinstance(device, Device) else open_device(device),
    )
    if isinstance(first_bounce, str):
        raise InputError(
            f"first_bounce is {first_bounce!r}, but T is rows; give an array (N,), or None"
        )
    F, _ = _first_bounce.find(rows, F, lambda: device)
    F, *_ = _first_bounce.mask_dark(F, F <= 0.0, grid, may_mask=False)
    R = [interreflection(channel, f) for channel, f in zip(rows, F, strict=True)]
    problems = [Problem(r, Host(device, r), grid, f) for r, f in zip(R, F, strict=True)]
    return Inputs(problems, {"grid": grid, "first_bounce": F}, 4 * F.size * n)  # in float32


def of_transport(T: Transport, noise: Noise | None = None, **reading: Any) -> Inputs:
    """Rows of R of a square transport: read from T, or products where it is compressed."""
    F, nbytes = np.atleast_2d(T.first_bounce), 4 * T.channels * T.shape[1] ** 2
    if T.is_compressed:
        R = [source("R of T", S.R, **reading) for S in T.systems]
    else:
        rows = [source("T", matrix, **reading) for matrix in T.matrices]
        R = [interreflection(channel, f) for channel, f in zip(rows, F, strict=True)]
    try:
        operators, nbytes = [S.R for S in T.systems], T.nbytes or nbytes
    except MemoryError:  # of the device, or of the host
        operators = [Host(T.device, rows) for rows in R]
    problems = [
        Problem(r, product, T.grid, f) for r, product, f in zip(R, operators, F, strict=True)
    ]
    if noise is not None:
        problems = [replace(p, noise=_noise_of(p, noise, c)) for c, p in enumerate(problems)]
    settings = {
        "grid": T.grid,
        "first_bounce": F,
        "mixing": T.mixing,
        "noise": noise or T.measured_noise,
    }
    return Inputs(problems, settings | {"on_dark": "mask" if T.masked.any() else "raise"}, nbytes)


def _noise_of(problem: Problem, noise: Noise, channel: int) -> np.ndarray:
    """Factors of the variance of R = T F^-1 - I; of photons, that of the mean entry of a column."""
    F, ones = problem.F, problem.operator.device.upload(np.ones(len(problem.F), np.float32))
    sums = problem.operator.apply_transpose(ones).get().astype(np.float64)
    light = noise.photons[channel] * F * np.maximum(sums, 0.0) / len(F) + noise.floor[channel] ** 2
    columns = np.divide(noise.columns[channel] * light, F**2, out=np.zeros(len(F)), where=F > 0)
    return np.stack([noise.rows[channel], columns])


def rows_at_once(values: int, memory: int | None = None) -> int:
    """How many rows of `values` numbers fit into `memory` bytes, a multiple of `COLUMNS`, or a refusal."""
    room = min(_BLOCK, checks.host_memory() // 4) if memory is None else memory
    count = min(room // (_PER_VALUE * max(values, 1)), _MOST) // COLUMNS * COLUMNS
    if count == 0:
        least = (
            f"{checks.size(COLUMNS * values * _PER_VALUE)}, for {COLUMNS} rows of {values} numbers"
        )
        raise MemoryLimitError(f"memory is {checks.size(room)}; it must be at least {least}")
    return count


@contextlib.contextmanager
def memory_errors(command: str, T: Any) -> Iterator[None]:
    """NumPy's MemoryError as one that says what all of R, and as many coefficients, need."""
    try:
        yield
    except MemoryLimitError:
        raise
    except MemoryError as error:
        pixels = getattr(T, "shape", (0, 0))[-1]
        needed = f"{command} needs up to {checks.size(8 * pixels**2)} for {pixels} pixels"
        raise MemoryLimitError(f"{needed}, more than the host gives: {error}") from error


def cut(count: int, size: int) -> Iterator[tuple[int, int]]:
    """(start, stop) of blocks of `size`."""
    return ((start, min(start + size, count)) for start in range(0, count, size))
