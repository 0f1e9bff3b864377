# SPDX-License-Identifier: BSD-3-Clause
"""What `compress` is given: a transport, operators or rows of one, as R of every channel."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.compression.fit import Problem
from ltcl.compression.sources import Interreflection, RowSource, source
from ltcl.compression.streamed import Streamed
from ltcl.device import Device, open_device
from ltcl.errors import InputError, InputTypeError, MemoryLimitError
from ltcl.operators import Operator, ScaledColumns, Shifted
from ltcl.transport import Transport, require


@dataclass(frozen=True)
class Given:
    """R of every channel, and what else a transport is made of; `nbytes` is what T takes."""

    problems: list[Problem]
    F: np.ndarray
    grid: tuple[int, int]
    nbytes: int
    masked: bool = False
    mixing: np.ndarray | None = None


def given(T: Any, grid: Any, first_bounce: Any, device: Device | str | None, memory: int | None) -> Given:
    """Whatever `compress` takes, checked."""
    if isinstance(T, Transport):
        return _of_transport(T, memory, {"grid": grid, "first_bounce": first_bounce, "device": device})
    if _are_operators(T):  # their products are at hand, their rows are made of those
        F = "diagonal" if first_bounce is None else first_bounce
        return _of_transport(Transport(T, _grid(grid), F, device=device), memory, {})
    return _of_rows(T, grid, first_bounce, device, memory)


def as_it_stands(T: Transport, memory: int | None = None) -> Given:
    """A transport that may be compressed: its R~ is what is written, by products with it."""
    problems = [Problem(source("R of T", S.R), S.R, T.grid, memory) for S in T.systems]
    return Given(problems, np.atleast_2d(T.first_bounce), T.grid, T.nbytes, bool(T.masked.any()), T.mixing)


def _of_transport(T: Transport, memory: int | None, others: dict[str, Any]) -> Given:
    for name, value in others.items():
        if value is not None:
            raise InputError(f"{name} is given, but T is a Transport, which has its own; leave it out")
    require(T)
    if T.error > 0.0:
        raise InputError(
            f"T is compressed already, with an error of {T.error:.2g}; compress what it came from"
        )
    if T.is_compressed:  # but exact, as of an adaptive scan
        return as_it_stands(T, memory)
    F = np.atleast_2d(T.first_bounce)
    rows = [Interreflection(source("T", matrix), f) for matrix, f in zip(T.matrices, F, strict=True)]
    try:
        operators, nbytes = [S.R for S in T.systems], T.nbytes or _dense(F)
    except MemoryLimitError:
        operators, nbytes = [_streamed(T.device, R, memory) for R in rows], _dense(F)
    problems = [Problem(R, A, T.grid, memory) for R, A in zip(rows, operators, strict=True)]
    return Given(problems, F, T.grid, nbytes, bool(T.masked.any()), T.mixing)


def _of_rows(T: Any, grid: Any, first_bounce: Any, device: Device | str | None, memory: int | None) -> Given:
    if isinstance(T, (list, tuple)) and len(T) not in (1, 3):
        raise InputError(f"T has {len(T)} channels; it must be one, or three for RGB")
    parts = [source("T", part) for part in (T if isinstance(T, (list, tuple)) else [T])]
    n = parts[0].shape[0]
    for part in parts:
        if tuple(part.shape) != (n, n):
            raise InputError(f"T has shape {tuple(part.shape)}; it must be square, (N, N), to have an S")
        part.rows(0, 1)  # of rows that end with the matrix nobody sees that one too many was given
    shape = checks.grid("grid", _grid(grid), n)
    chosen = device if isinstance(device, Device) else open_device(device)
    F = _first_bounce(parts, first_bounce, chosen, memory)
    rows = [Interreflection(part, f) for part, f in zip(parts, F, strict=True)]
    problems = [Problem(R, _streamed(chosen, R, memory), shape, memory) for R in rows]
    return Given(problems, F, shape, _dense(F))


def _dense(F: np.ndarray) -> int:
    """Bytes of T in float32, of its first bounces (channels, N)."""
    return 4 * F.size * F.shape[1]


def _streamed(device: Device, R: Interreflection, memory: int | None) -> Operator:
    """R = T F^-1 - I by products with the rows of T as they are read."""
    lit = R.F > 0
    scaled = ScaledColumns(Streamed(device, R.T, memory), np.where(lit, 1.0 / np.where(lit, R.F, 1.0), 0.0))
    return Shifted(scaled, None if lit.all() else lit)


def _grid(grid: Any) -> Any:
    if grid is None:
        raise InputError("grid is None, but T is no Transport; it must be (h, w), the projector's pixels")
    return grid


def _are_operators(T: Any) -> bool:
    parts = T if isinstance(T, (list, tuple)) else [T]
    return all(hasattr(part, "matvec") and not isinstance(part, RowSource) for part in parts)


def _first_bounce(parts: Sequence[RowSource], given: Any, device: Device, memory: int | None) -> np.ndarray:
    n = parts[0].shape[0]
    if given is None:
        F = np.stack([Streamed(device, part, memory).diagonal() for part in parts])
    elif isinstance(given, str):
        raise InputTypeError(f"first_bounce is {given!r}; of rows it must be an array (N,), or None")
    else:
        F = checks.finite("first_bounce", checks.real("first_bounce", given)).astype(np.float64)
        F = np.broadcast_to(checks.shape("first_bounce", F, (n,), (len(parts), n)), (len(parts), n))
    dark = np.flatnonzero(np.any(F <= 0.0, axis=0))
    if len(dark):
        raise InputError(
            f"first_bounce is zero or negative at {len(dark)} of {n} pixels, the first {dark[0]}; it must be "
            "positive; make a Transport with on_dark='mask' of it"
        )
    return F
