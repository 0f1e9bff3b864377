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

from typing import Any

import numpy as np
import pywt

from ltcl import checks
from ltcl.device import Array, Device, vectors
from ltcl.errors import InputError
from ltcl.operators.bases import Basis, launch_grid, launch_group

_pywt: Any = pywt  # compiled, so that no type checker knows its names
_SMALL = 4096  # pixels of a level from which on one launch does all the rest


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
    >>> print(abs(W @ numpy.ones(15)).round(4)[:3])  # sqrt(15), the norm, and nothing else
    [3.873 0.    0.   ]
    """

    def __init__(
        self, device: Device, grid: tuple[int, int], name: str = "db2", levels: int | None = None
    ) -> None:
        self._taps = device.upload(filters(name))
        super().__init__(device, grid, name, None, self._taps)
        most = (max(self.grid) - 1).bit_length()
        self.levels = most if levels is None else checks.count("levels", levels, least=0, most=most)
        self._large = sum(h * w > _SMALL for h, w in map(self.sides, range(self.levels)))
        # Where the approximations of levels 1, 2, ... begin, a spare pixel between: wide loads reach there.
        pixels = [h * w + 1 for h, w in map(self.sides, range(1, self.levels + 1))]
        self._starts = device.upload(np.cumsum([0, *pixels]), np.int32)
        self._room = sum(pixels)

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Name, grid and levels."""
        return {**super().to_arrays(), "levels": np.array(self.levels)}

    def sides(self, level: int) -> tuple[int, int]:
        """Rows and columns of the approximation that is split `level` times already: (h, w) / 2^level, up."""
        h, w = self.grid
        return -(-h // 2**level), -(-w // 2**level)

    def _transform(self, x: Array, out: Array, a: float, b: float, y: Array, transpose: bool) -> None:
        if self.levels == 0:
            vectors.axpby(a, x, b, y, out)
            return
        name, k, levels = "join" if transpose else "split", x.columns, self.levels
        wide = 8 if k == 1 and self.device.is_cpu else 1
        kernel, pieces = self._kernel("wavelet", name, k, TAPS=self._taps.shape[1], PAIRS=wide)
        near = self.device.empty(self._room * k)
        launches = [(level, level + 1) for level in range(self._large)]
        launches += [(self._large, levels)] if self._large < levels else []
        for first, last in reversed(launches) if transpose else launches:
            arguments = (*self.grid, first, last, levels, k, a, b, self._starts, self._taps, x, near, y, out)
            if last <= self._large:
                launch_grid(kernel, pieces, *self.sides(last), *arguments)
            else:
                launch_group(kernel, pieces, *arguments)


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
    errors = [taps[:, s:] @ taps[:, : length - s].T - np.eye(2) * (s == 0) for s in range(0, length, 2)]
    return bool(np.max(np.abs(errors)) < 1e-7)


def families() -> str:
    """The orthonormal wavelets that PyWavelets knows: haar, db1 to db38, ..."""
    names = [n for n in _pywt.wavelist(kind="discrete") if n != "dmey" and _pywt.Wavelet(n).orthogonal]
    numbers = {n.rstrip("0123456789"): [] for n in names}
    for n in names:
        numbers[n.rstrip("0123456789")].append(int("0" + n.lstrip("abcdefghijklmnopqrstuvwxyz")))
    return ", ".join(f"{f}{min(n)} to {f}{max(n)}" if any(n) else f for f, n in numbers.items())
