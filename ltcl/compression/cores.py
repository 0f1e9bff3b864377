# SPDX-License-Identifier: BSD-3-Clause
"""How the numbers of a core are stored: sparse rows, or tiles of a width and a precision, within an error."""

from __future__ import annotations

import functools
import os
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ltcl.device import Device, vectors
from ltcl.operators import CSR, Operator, Tiles
from ltcl.operators.narrow import PRECISIONS
from ltcl.operators.packing import Packed, pack
from ltcl.theory import two_norm

_WIDTHS = (1, 8, 16)
_MORE = 1.5  # times the fewest bytes: what takes more is not timed
_ALIKE = 1.25  # times the least seconds x bytes: alike
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
    """The core that `choose` takes of those whose rounding has a 2-norm of at most `allowance`.

    Under ``LTCL_TUNE=0`` nothing is timed and the smallest is taken. Of cores that are all beyond the
    `budget`, it is the smallest as well.
    """
    options = [
        (packed.nbytes, functools.partial(_tiles, device, width, packed))
        for width, packed in _within(device, matrix, allowance)
    ]
    options.append((8 * matrix.nnz + 4 * (matrix.shape[0] + 1), functools.partial(_csr, device, matrix)))
    smallest = min(options, key=lambda option: option[0])
    most = smallest[0] if _untimed() else min(budget, _MORE * smallest[0])
    cores = [make() for nbytes, make in options if nbytes <= most] or [smallest[1]()]
    return cores[choose([(core.seconds, core.nbytes) for core in cores], launch(device))]


def choose(costs: Sequence[tuple[float | None, int]], least: float) -> int:
    """Which of several (seconds, bytes) is best: that of the least product, of those alike the fewest bytes.

    Seconds below the `least` count as these. Where one was not timed, bytes alone decide.

    >>> choose([(1e-3, 900), (2e-3, 400), (2e-3, 390)], 1e-4), choose([(1e-3, 40), (2e-3, 50)], 4e-3)
    (2, 0)
    """
    products = [max(spent, least) * nbytes for spent, nbytes in costs if spent is not None]
    if len(products) < len(costs):
        products = [0.0] * len(costs)
    alike = [place for place, product in enumerate(products) if product <= _ALIKE * min(products)]
    return min(alike, key=lambda place: costs[place][1])


def seconds(operator: Operator) -> float | None:
    """Least seconds of a few products on the device; None under ``LTCL_TUNE=0``."""
    if _untimed():
        return None
    x = operator.device.upload(np.ones(operator.shape[1], np.float32))
    out = operator.apply(x)
    return _least(operator.device, lambda: operator.apply(x, out))


def launch(device: Device) -> float:
    """Least seconds that anything takes there, one number long; 0 under ``LTCL_TUNE=0``."""
    if _untimed():
        return 0.0
    x = vectors.fill(device.empty(1), 0.0)
    return _least(device, lambda: vectors.fill(x, 0.0))


def _least(device: Device, run: Callable[[], object]) -> float:
    times = []
    device.finish()
    for _ in range(_REPEATS):
        start = time.perf_counter()
        run()
        device.finish()
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


def _csr(device: Device, matrix: Any) -> Core:
    operator = CSR(device, matrix)
    return Core(operator, "csr", 1, "float32", operator.nbytes, 0.0, seconds(operator))
