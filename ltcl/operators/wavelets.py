# SPDX-License-Identifier: BSD-3-Clause
"""Orthonormal 2-D wavelets, periodized, of grids of any size (`kernels/wavelet.cl`).

Coefficients stand as PyWavelets arranges them (`coeffs_to_array`); where all sides halve evenly
they equal those of its ``wavedec2(..., mode="periodization")``. Where one does not, PyWavelets
repeats the last sample; here it stands for fewer pixels than the others and passes by the filters
into the approximation: as many coefficients as pixels, and one of a constant picture on every grid.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pywt

from ltcl import checks
from ltcl.device import Array, Device, vectors
from ltcl.errors import InputError
from ltcl.operators.bases import Basis, launch_grid, launch_group
from ltcl.operators.pyramid import Pyramid

_pywt: Any = pywt  # compiled, so that no type checker knows its names
SMALL_LEVEL_PIXELS = 4096  # pixels of a level from which on one launch does all the rest


class Wavelet(Basis):
    """A picture's coefficients in orthonormal wavelets: W W^T = W^T W = I.

    Parameters
    ----------
    grid : (h, w), of any sides
    name : str
        An orthonormal wavelet of PyWavelets, "haar", "db2" (the paper's), "sym8", ...; InputError
        for others.
    levels : int, how often the approximation is split; until one pixel is left when not given

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
        h, w = checks.grid("grid", grid)
        super().__init__(device, grid, name, h * w, self._taps)
        most = (max(self.grid) - 1).bit_length()
        self.levels = most if levels is None else checks.count("levels", levels, least=0, most=most)
        self._large = sum(
            h * w > SMALL_LEVEL_PIXELS for h, w in map(self._sides, range(self.levels))
        )
        # Where the approximations of levels 1, 2, ... begin, a spare pixel between: wide loads
        # reach there.
        pixels = [h * w + 1 for h, w in map(self._sides, range(1, self.levels + 1))]
        self._starts = device.upload(np.cumsum([0, *pixels]), np.int32)
        self._room = sum(pixels)

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Name, grid and levels."""
        return {**super().to_arrays(), "levels": np.array(self.levels)}

    def _sides(self, level: int) -> tuple[int, int]:
        """Rows and columns of the approximation after `level` splits."""
        h, w = self.grid
        return -(-h // 2**level), -(-w // 2**level)

    def _transform(
        self, x: Array, out: Array, a: float, b: float, y: Array, transpose: bool
    ) -> None:
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
            arguments = (
                *self.grid,
                first,
                last,
                levels,
                k,
                a,
                b,
                self._starts,
                self._taps,
                x,
                near,
                y,
                out,
            )
            if last <= self._large:
                launch_grid(kernel, pieces, *self._sides(last), *arguments)
            else:
                launch_group(kernel, pieces, *arguments)


def filters(name: Any) -> np.ndarray:
    """Low-pass and high-pass filter of an orthonormal wavelet, (2, taps) float64, in the order of samples."""
    offered = "an orthonormal wavelet of PyWavelets, such as haar, db2, sym8 or coif1"
    if name not in _pywt.wavelist(kind="discrete"):
        raise InputError(f"wavelet is {name!r}; it must be {offered}")
    wavelet = _pywt.Wavelet(name)
    taps = np.array([wavelet.rec_lo, wavelet.rec_hi])
    length = taps.shape[1]
    shifted = [
        taps[:, s:] @ taps[:, : length - s].T - np.eye(2) * (s == 0) for s in range(0, length, 2)
    ]
    if not np.max(np.abs(shifted)) < 1e-7:  # that of dmey is 2e-3
        raise InputError(f"wavelet {name} is not orthonormal; it must be {offered}")
    return taps


def basis(device: Device, grid: tuple[int, int], name: str) -> Basis | None:
    """The basis called `name` of pictures of h x w pixels.

    That is "pixels" (None: no basis is needed), "pyramid", or an orthonormal wavelet of PyWavelets:
    "haar", "db2", "db4", ...; InputError for others.

    >>> import ltcl
    >>> from ltcl.operators import basis
    >>> basis(ltcl.open_device(), (8, 8), "db2").orthonormal
    True
    """
    if name == "pixels":
        return None
    return Pyramid(device, grid) if name == "pyramid" else Wavelet(device, grid, name)
