# SPDX-License-Identifier: BSD-3-Clause
"""Orthonormal 2-D wavelets, periodized, of grids of any size (`kernels/wavelet.cl`).

Coefficients stand as PyWavelets arranges them (`coeffs_to_array`), the approximation in the top left
corner. Where all sides halve evenly they equal those of its ``wavedec2(..., mode="periodization")``. Where
one does not, PyWavelets repeats the last sample, and has more coefficients than pixels. Here that sample,
which then stands for fewer pixels than the others, is carried beside the filters into the approximation: as
many coefficients as pixels, orthonormal, and a constant picture has one coefficient on every grid. A side
of one sample is left alone while the other goes on.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass
from typing import Any

import numpy as np
import pywt

from ltcl import checks
from ltcl.device import Array, Device, vectors
from ltcl.device.kernels import Kernel
from ltcl.errors import InputError
from ltcl.operators.base import MOST, group_of, lanes_of, widths
from ltcl.operators.bases import Basis

_pywt: Any = pywt  # compiled, so that no type checker knows its names
_SMALL = 4096  # pixels of a level from which on one launch does all the rest
_ITEMS = 64  # work-items that keep a CPU busy


class Wavelet(Basis):
    """A picture's coefficients in orthonormal wavelets: W W^T = W^T W = I.

    Parameters
    ----------
    device : Device
    grid : (h, w)
        Any, also of odd sides.
    name : str
        An orthonormal wavelet of PyWavelets: "haar", "db2" (the paper's), "sym8", "coif1", ...
    levels : int, optional
        How often the approximation is split; until one pixel is left when not given.

    Raises
    ------
    InputError
        Wavelets that are unknown or not orthonormal; more levels than the grid has.

    Examples
    --------
    >>> import ltcl, numpy
    >>> from ltcl.operators import Wavelet
    >>> W = Wavelet(ltcl.open_device(), (3, 5), "db2")
    >>> print(numpy.round(W @ numpy.ones(15), 4)[:3])  # sqrt(15), the norm, and nothing else
    [3.873 0.    0.   ]
    """

    def __init__(
        self, device: Device, grid: tuple[int, int], name: str = "db2", levels: int | None = None
    ) -> None:
        taps = filters(name)
        super().__init__(device, grid, name)
        self.levels = _levels(self.grid, levels)
        self._large = sum(h * w > _SMALL for h, w in map(self.sides, range(self.levels)))
        self._defines = {"TAPS": taps.shape[1]}
        self._taps = device.upload(taps)
        self._scratch = device.empty(0), device.empty(0)
        self._lock = threading.Lock()  # a transform must have the scratch to itself while it is queued

    @property
    def nbytes(self) -> int:
        """Bytes of the filters. Scratch of 1.25 N k numbers, k of the widest picture so far, comes on top."""
        return self._taps.nbytes

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Name, grid and levels."""
        return {**super().to_arrays(), "levels": np.array(self.levels)}

    def _product(self, x: Array, out: Array, scale: float, add: Array | None, transpose: bool) -> None:
        if x.size == 0:
            return
        if self.levels == 0:
            vectors.axpby(scale, x, 0.0 if add is None else 1.0, x if add is None else add, out)
            return
        with self._lock:
            lines, near = self._room(x.columns)
            task = _Task(self, x.columns, x, lines, near, (scale, int(add is not None)), add or out, out)
            (task.join if transpose else task.split)()

    def _room(self, k: int) -> tuple[Array, Array]:
        """Scratch for a picture of k right-hand sides, and for its first approximation."""
        h, w = self.grid
        needed = h * w * k, -(-h // 2) * -(-w // 2) * k
        if self._scratch[0].size < needed[0]:
            self._scratch = self.device.empty(needed[0]), self.device.empty(needed[1])
        return self._scratch

    def sides(self, level: int) -> tuple[int, int]:
        """Rows and columns of the approximation that is split `level` times already: (h, w) / 2^level, up."""
        h, w = self.grid
        return -(-h // 2**level), -(-w // 2**level)


@dataclass(frozen=True)
class _Task:
    """One transform of k right-hand sides: large levels in two launches each, all small ones in one."""

    W: Wavelet
    k: int
    x: Array
    lines: Array
    near: Array
    scaled: tuple[float, int]  # scale, and whether `add` counts
    add: Array
    out: Array

    def split(self) -> None:
        W, k, taps = self.W, self.k, self.W._taps
        source = self.x
        for level in range(W._large):
            (h, w), run, split_at, pitch = self._geometry(level)
            self._rows("split", h, w, h, W.grid[1], level, k, taps, source, self.lines)
            self._columns(
                "split", h, run, split_at, W.grid[0], level, run, split_at, pitch, *self.scaled, taps,
                self.lines, self.near, self.add, self.out,
            )  # fmt: skip
            source = self.near
        self._all("split", self.scaled, source, self.add, self.out)

    def join(self) -> None:
        W, k, taps = self.W, self.k, self.W._taps
        plain = (1.0, 0)
        if W._large:
            self._all("join", plain, self.x, self.near, self.near)
        else:
            self._all("join", self.scaled, self.x, self.add, self.out)
        for level in reversed(range(W._large)):
            (h, w), run, split_at, pitch = self._geometry(level)
            self._columns(
                "join", h, run, split_at, W.grid[0], level, run, split_at, pitch, taps,
                self.x, self.near, self.lines,
            )  # fmt: skip
            scaled, add, out = (
                (self.scaled, self.add, self.out) if level == 0 else (plain, self.near, self.near)
            )
            self._rows("join", h, w, h, W.grid[1], level, k, *scaled, taps, self.lines, add, out)

    def _geometry(self, level: int) -> tuple[tuple[int, int], int, int, int]:
        """Sides at a level; reals of its rows, of the approximation in them, and of a row of the picture."""
        h, w = self.W.sides(level)
        split_at = -(-w // 2) * self.k if level + 1 < self.W.levels else 0
        return (h, w), w * self.k, split_at, self.W.grid[1] * self.k

    def _kernel(self, name: str, lanes: int) -> Kernel:
        return self.W.device.kernel("wavelet", f"wavelet_{name}", K=lanes, **self.W._defines)

    def _rows(self, name: str, h: int, w: int, *arguments: Any) -> None:
        lanes = lanes_of(self.k)
        kernel = self._kernel(f"{name}_rows", lanes)
        pieces, pairs = -(-self.k // lanes), -(-w // 2)
        if self.W.device.is_cpu:
            kernel((1, min(pairs, -(-_ITEMS // h)), min(h, MOST)), (1, 1, 1), *arguments)
        else:
            kernel((pieces, min(pairs, MOST), min(h, MOST)), (*group_of(pieces), 1), *arguments)

    def _columns(self, name: str, h: int, run: int, split_at: int, *arguments: Any) -> None:
        lanes = lanes_of(min(part for part in (split_at, run - split_at) if part))
        kernel = self._kernel(f"{name}_columns", lanes)
        pieces, pairs = -(-split_at // lanes) + -(-(run - split_at) // lanes), -(-h // 2)
        if self.W.device.is_cpu:
            kernel((min(pieces, -(-_ITEMS // pairs)), min(pairs, MOST)), (1, 1), *arguments)
        else:
            kernel((pieces, min(pairs, MOST)), group_of(pieces), *arguments)

    def _all(self, name: str, scaled: tuple[float, int], source: Array, add: Array, out: Array) -> None:
        first, last = self.W._large, self.W.levels
        if first == last:
            return
        group = 1 if self.W.device.is_cpu else 16
        for offset, width, pieces in _pieces(self.k):
            self._kernel(f"{name}_all", width)(
                (group, group, pieces), (group, group, 1), *self.W.grid, first, last, self.k, offset, *scaled,
                self.W._taps, source, self.lines, self.near, add, out,
            )  # fmt: skip


def is_known(name: Any) -> bool:
    """Whether PyWavelets knows a discrete wavelet of this name."""
    return name in _pywt.wavelist(kind="discrete")


def filters(name: str) -> np.ndarray:
    """Low-pass and high-pass filter of an orthonormal wavelet, (2, taps) float64, in the order of samples.

    >>> filters("haar").round(4).tolist()
    [[0.7071, 0.7071], [0.7071, -0.7071]]
    """
    if not is_known(name):
        raise InputError(f"wavelet is {name!r}; it must be one of {families()}")
    wavelet = _pywt.Wavelet(name)
    taps = np.array([wavelet.rec_lo, wavelet.rec_hi])
    if not _orthonormal(taps):
        raise InputError(f"wavelet {name} is not orthonormal; it must be one of {families()}")
    return taps


def _orthonormal(taps: np.ndarray) -> bool:
    """Whether shifts by two are orthonormal to float32; "dmey" is to 2e-3 only."""
    length = taps.shape[1]
    shifts = [taps[:, 2 * s :] @ taps[:, : length - 2 * s].T for s in range(length // 2)]
    return bool(np.abs(np.array(shifts) - [np.eye(2) * (s == 0) for s in range(length // 2)]).max() < 1e-7)


def families() -> str:
    """The orthonormal wavelets that PyWavelets knows: haar, db1 to db38, ..."""
    names = [n for n in _pywt.wavelist(kind="discrete") if n != "dmey" and _pywt.Wavelet(n).orthogonal]
    numbers = {n.rstrip("0123456789"): [] for n in names}
    for n in names:
        numbers[n.rstrip("0123456789")].append(int("0" + n.lstrip("abcdefghijklmnopqrstuvwxyz")))
    return ", ".join(f"{f}{min(n)} to {f}{max(n)}" if any(n) else f for f, n in numbers.items())


def _levels(grid: tuple[int, int], levels: int | None) -> int:
    most = (max(grid) - 1).bit_length()
    if levels is None:
        return most
    if checks.count("levels", levels, least=0) > most:
        raise InputError(f"levels is {levels}; it must be at most {most} on a {grid[0]} x {grid[1]} grid")
    return int(levels)


def _pieces(k: int) -> list[tuple[int, int, int]]:
    """Cut k right-hand sides for launches: offset, width and how many of that width follow each other."""
    whole, rest = divmod(k, 8)
    cut = [(0, 8, whole)] if whole else []
    return cut + [(8 * whole + offset, width, 1) for offset, width in widths(rest)]
