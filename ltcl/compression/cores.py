# SPDX-License-Identifier: BSD-3-Clause
"""How the numbers of a core are stored: sparse rows, or tiles of a width and a precision, within an error."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from ltcl.device import Device
from ltcl.operators import CSR, Operator, Tiles
from ltcl.operators.narrow import PRECISIONS
from ltcl.operators.packing import Packed, pack
from ltcl.theory import two_norm

_WIDTHS = (1, 8, 16)
_MORE = 1.5  # times the fewest bytes: what takes more is not timed
_ALIKE, _LAUNCH = 1.15, 2e-5  # times the least seconds, and seconds more: noise, and bytes decide
_REPEATS = 7


@dataclass(frozen=True)
class Core:
    """A stored core.

    Attributes
    ----------
    operator : Operator
    format : str
        "csr" or "tiles".
    width, precision : int, str
        Of the tiles; 1 and "float32" of sparse rows.
    nbytes : int
        On the device, without what its transposed products need.
    quantisation : float
        Frobenius norm of what rounding changed, exact.
    seconds : float or None
        A product took, where it was timed.
    """

    operator: Operator
    format: str
    width: int
    precision: str
    nbytes: int
    quantisation: float
    seconds: float | None


def best(device: Device, matrix: Any, allowance: float, budget: float = float("inf")) -> Core:
    """The fastest core whose rounding has a 2-norm of at most `allowance`; the smallest of those alike.

    Under ``LTCL_TUNE=0`` nothing is timed and the smallest is taken. A core beyond the `budget` is taken only
    where all are.
    """
    options = list(_within(device, matrix, allowance))
    smallest = min(packed.nbytes for _, packed in options)
    fits = [option for option in options if option[1].nbytes <= budget] or options
    fits = [option for option in fits if option[1].nbytes <= _MORE * smallest]
    if _untimed():
        fits = sorted(fits, key=lambda option: option[1].nbytes)[:1]
    cores = [_tiles(device, *option) for option in fits]
    csr = 8 * matrix.nnz + 4 * (matrix.shape[0] + 1)
    if csr <= min(_MORE * smallest, budget):
        operator = CSR(device, matrix)
        cores.append(Core(operator, "csr", 1, "float32", operator.nbytes, 0.0, seconds(operator)))
    return choose(cores)


def choose(cores: list[Core]) -> Core:
    """The fastest, of those alike the smallest; the smallest where one was not timed."""
    times = [core.seconds for core in cores if core.seconds is not None]
    if len(times) == len(cores):
        most = max(_ALIKE * min(times), min(times) + _LAUNCH)
        cores = [core for core in cores if (core.seconds or 0.0) <= most]
    return min(cores, key=lambda core: core.nbytes)


def seconds(operator: Operator) -> float | None:
    """Least seconds of a few products on the device; None under ``LTCL_TUNE=0``."""
    if _untimed():
        return None
    x = operator.device.upload(np.ones(operator.shape[1], np.float32))
    out = operator.apply(x)
    operator.device.finish()
    times = []
    for _ in range(_REPEATS):
        start = time.perf_counter()
        operator.apply(x, out)
        operator.device.finish()
        times.append(time.perf_counter() - start)
    return min(times)


def _untimed() -> bool:
    return os.environ.get("LTCL_TUNE", "1") == "0"


def _within(device: Device, matrix: Any, allowance: float) -> Iterator[tuple[int, Packed]]:
    """Tiles of every width in the precisions that are good enough."""
    exact: CSR | None = None
    for precision in PRECISIONS:
        packed = pack(matrix, 1, precision)
        lost = packed.difference
        enough = precision == "float32" or min(lost) <= allowance
        if not enough and lost.frobenius <= np.sqrt(min(matrix.shape)) * allowance:
            exact = CSR(device, matrix) if exact is None else exact
            found = two_norm(exact, Tiles(device, packed), below=allowance, frobenius=lost.frobenius)
            enough = found.upper <= allowance
        if enough:
            yield from ((w, packed if w == 1 else pack(matrix, w, precision)) for w in _WIDTHS)


def _tiles(device: Device, width: int, packed: Packed) -> Core:
    tiles = Tiles(device, packed)
    return Core(tiles, "tiles", width, tiles.precision, tiles.nbytes, tiles.quantisation, seconds(tiles))
