# SPDX-License-Identifier: BSD-3-Clause
"""The input of a compression: R of every channel by its rows, and by products on a device."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.device import Device, open_device
from ltcl.errors import InputError, MemoryLimitError
from ltcl.operators import Dense, Host, Operator
from ltcl.tasks.compression.sources import SourceRows, interreflection_rows, source
from ltcl.transport.first_bounce import find_first_bounce, mask_dark
from ltcl.transport.noise import Noise
from ltcl.transport.transport import Transport, check_transport

# Pixels a side of the part of a picture on which bases are compared.
WINDOW_SIDE = 64


@dataclass(frozen=True, kw_only=True)
class CompressionProblem:
    """R (N, N) of one channel on a grid.

    Attributes
    ----------
    R : SourceRows
        R by its rows.
    operator : Operator
        Products with R.
    grid : (h, w)
    F : (N,), first bounce
    noise : (2, N), optional
        Factors of the variance of R, of its rows and columns.
    """

    R: SourceRows
    operator: Operator
    grid: tuple[int, int]
    F: np.ndarray
    noise: np.ndarray | None = None

    @property
    def pixels(self) -> int:
        """N."""
        return self.R.shape[0]

    def window(self) -> CompressionProblem:
        """R between the pixels in the middle of the picture; itself where these are all."""
        h, w = window_of(self.grid)
        if h * w == self.pixels:
            return self
        height, width = self.grid
        top = (height - h) // 2
        left = (width - w) // 2
        first_of_rows = np.arange(top, top + h) * width + left
        pixels = np.add.outer(first_of_rows, np.arange(w)).ravel()
        strips = []
        for first in first_of_rows.tolist():
            strips.append(self.R.rows(first, first + w)[:, pixels])
        R = np.concatenate(strips)
        noise = None
        if self.noise is not None:
            noise = self.noise[:, pixels]
        return CompressionProblem(
            R=source("R", R, self.R.memory),
            operator=Dense(self.operator.device, R),
            grid=(h, w),
            F=self.F[pixels],
            noise=noise,
        )


def window_of(grid: tuple[int, int]) -> tuple[int, int]:
    """The grid of the window of a picture."""
    return min(grid[0], WINDOW_SIDE), min(grid[1], WINDOW_SIDE)


@dataclass(frozen=True, kw_only=True)
class CompressionInputs:
    """R of every channel, keywords of the Transport that is made of them, and the bytes of T."""

    problems: list[CompressionProblem]
    settings: dict[str, Any]
    nbytes: int


def check_inputs(
    T: Any,
    grid: Any,
    first_bounce: Any,
    device: Device | str | None,
    noise: Noise | None,
    **reading: Any,
) -> CompressionInputs:
    """Check the input of `compress`: a Transport, operators or rows; `reading` as in `source`."""
    if isinstance(T, Transport):
        settings = {"grid": grid, "first_bounce": first_bounce, "device": device}
        for name, value in settings.items():
            if value is not None:
                raise InputError(
                    f"{name} is given, but T is a Transport, which has its own; leave it out"
                )
        check_transport(T)
        if T.error > 0.0:
            raise InputError(
                f"T is compressed already, with an error of {T.error:.2g}; "
                "compress the original transport"
            )
        return inputs_of_transport(T, noise, **reading)

    matrices = list(T) if isinstance(T, (list, tuple)) else [T]
    if len(matrices) not in (1, 3):
        raise InputError(f"T has {len(matrices)} channels; it must have 1, or 3 for RGB")
    if grid is None:
        raise InputError(
            "grid is None, but T is not a Transport; it must be (h, w), the projector's pixels"
        )
    if not all(_is_operator(matrix) for matrix in matrices):
        return _inputs_of_rows(matrices, grid, first_bounce, device, **reading)
    if first_bounce is None:
        first_bounce = "diagonal"
    transport = Transport(T, grid, first_bounce, device=device)
    return check_inputs(transport, None, None, None, None, **reading)


def _is_operator(matrix: Any) -> bool:
    return hasattr(matrix, "matvec") and not hasattr(matrix, "rows")


def _inputs_of_rows(
    matrices: list[Any], grid: Any, first_bounce: Any, device: Any, **reading: Any
) -> CompressionInputs:
    """R of matrices that are read by rows."""
    rows = [source("T", matrix, **reading) for matrix in matrices]
    n = rows[0].shape[0]
    for channel in rows:
        if channel.shape != (n, n):
            raise InputError(f"T has shape {channel.shape}; it must be square, (N, N)")
        # One row too many is not noticed where rows end with the matrix.
        channel.rows(0, 1)
    grid = checks.grid("grid", grid, n)
    if not isinstance(device, Device):
        device = open_device(device)
    if isinstance(first_bounce, str):
        raise InputError(
            f"first_bounce is {first_bounce!r}, but T is rows; give an array (N,), or None"
        )
    if first_bounce is None:
        first_bounce = "diagonal"
    F, _ = find_first_bounce(rows, first_bounce, lambda: device)
    F, *_ = mask_dark(F, F <= 0.0, grid, may_mask=False)
    problems = []
    for channel, f in zip(rows, F, strict=True):
        R = interreflection_rows(channel, f)
        problems.append(CompressionProblem(R=R, operator=Host(device, R), grid=grid, F=f))
    settings = {"grid": grid, "first_bounce": F}
    float32_bytes = 4 * F.size * n
    return CompressionInputs(problems=problems, settings=settings, nbytes=float32_bytes)


def inputs_of_transport(
    T: Transport, noise: Noise | None = None, **reading: Any
) -> CompressionInputs:
    """Rows of R of a square transport: read from T, or products where it is compressed."""
    F = np.atleast_2d(T.first_bounce)
    if T.is_compressed:
        rows = [source("R of T", S.R, **reading) for S in T.systems]
    else:
        rows = []
        for matrix, f in zip(T.matrices, F, strict=True):
            rows.append(interreflection_rows(source("T", matrix, **reading), f))
    nbytes = 0
    try:
        operators: list[Operator] = [S.R for S in T.systems]
        nbytes = T.nbytes
    except MemoryError:  # of the device, or of the host
        operators = [Host(T.device, R) for R in rows]
    if nbytes == 0:
        nbytes = 4 * T.channels * T.shape[1] ** 2

    problems = []
    for channel, R in enumerate(rows):
        operator = operators[channel]
        problem = CompressionProblem(R=R, operator=operator, grid=T.grid, F=F[channel])
        if noise is not None:
            problem = replace(problem, noise=_noise_factors(problem, noise, channel))
        problems.append(problem)
    settings = {
        "grid": T.grid,
        "first_bounce": F,
        "mixing": T.mixing,
        "noise": T.measured_noise if noise is None else noise,
        "on_dark": "mask" if T.masked.any() else "raise",
    }
    return CompressionInputs(problems=problems, settings=settings, nbytes=nbytes)


def _noise_factors(problem: CompressionProblem, noise: Noise, channel: int) -> np.ndarray:
    """Variance factors (2, N) of R = T F^-1 - I; photons count by the mean entry of a column."""
    F = problem.F
    ones = problem.operator.device.upload(np.ones(len(F), np.float32))
    column_sums = problem.operator.apply_transpose(ones).get().astype(np.float64)
    photons = noise.photons[channel] * F * np.maximum(column_sums, 0.0) / len(F)
    variance = noise.columns[channel] * (photons + noise.floor[channel] ** 2)
    columns = np.divide(variance, F**2, out=np.zeros(len(F)), where=F > 0)
    return np.stack([noise.rows[channel], columns])


@contextlib.contextmanager
def memory_errors(command: str, T: Any) -> Iterator[None]:
    """Turn NumPy's MemoryError into one that says how much R and its coefficients need."""
    try:
        yield
    except MemoryLimitError:
        raise
    except MemoryError as error:
        pixels = getattr(T, "shape", (0, 0))[-1]
        raise MemoryLimitError(
            f"{command} needs up to {checks.size(8 * pixels**2)} for {pixels} pixels, "
            f"more than the host has: {error}"
        ) from error
