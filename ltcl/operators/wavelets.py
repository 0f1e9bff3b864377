# SPDX-License-Identifier: BSD-3-Clause
"""Orthonormal 2-D wavelets, periodized, on grids of any size (`kernels/wavelet.cl`).

A launch makes one large level. The small ones take one launch together: a GPU makes them in the
local memory of a work-group for each right-hand side (`kernels/wavelet_tail.cl`).

Coefficients stand as PyWavelets arranges them (`coeffs_to_array`); if all sides halve evenly they
equal those of its ``wavedec2(..., mode="periodization")``. If one does not, PyWavelets repeats the
last sample; here it stands for fewer pixels than the others and passes by the filters into the
approximation: as many coefficients as pixels, and one of a constant picture on every grid.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pywt

from ltcl import checks
from ltcl.device import Array, Device, vectors
from ltcl.device.kernels import Queued, in_order
from ltcl.errors import InputError
from ltcl.operators import bases
from ltcl.operators.bases import PIXELS, Basis, bind_grid, bind_group
from ltcl.operators.epilogue import Epilogue
from ltcl.operators.pyramid import HATS, PYRAMID, Hats, Pyramid

# Wavelets that are compared where no basis is named, the best one first.
COMPARED_WAVELETS = ("db2", "haar", "db4")
EXAMPLES = ", ".join(COMPARED_WAVELETS)
WAVELET_NAME = f"an orthonormal wavelet of PyWavelets, such as {EXAMPLES}"
# Compiled, so that no type checker knows its names.
_pywt: Any = pywt
# Deviation from orthonormality: that of dmey is 2e-3.
MAX_FILTER_DEVIATION = 1e-7
# Pairs of coefficients that a CPU computes in one wide load.
CPU_PAIRS = 8


class Wavelet(Basis):
    """The coefficients of a picture in orthonormal wavelets: W W^T = W^T W = I.

    Parameters
    ----------
    device : Device
    grid : (h, w)
        Of any sides.
    name : str
        An orthonormal wavelet of PyWavelets, "haar", "db2" (the paper's), "sym8", ...; InputError
        for others.
    levels : int, optional
        Number of splits of the approximation; until one pixel is left when not given.

    Examples
    --------
    A constant picture has one coefficient, its norm sqrt(15):

    >>> import ltcl, numpy
    >>> from ltcl.operators import Wavelet
    >>> W = Wavelet(ltcl.open_device(), (3, 5), "db2")
    >>> print(abs(W @ numpy.ones(15)).round(4)[:3])
    [3.873 0.    0.   ]
    """

    def __init__(
        self, device: Device, grid: tuple[int, int], name: str = "db2", levels: int | None = None
    ) -> None:
        self._taps = device.upload(filters(name))
        h, w = checks.grid("grid", grid)
        super().__init__(device, grid, name, h * w, self._taps)
        max_levels = (max(self.grid) - 1).bit_length()
        if levels is None:
            self.levels = max_levels
        else:
            self.levels = checks.count("levels", levels, least=0, most=max_levels)
        sizes = []
        for level in range(self.levels + 1):
            rows, columns = self._sides(level)
            sizes.append(rows * columns)
        self._large_levels = _count_large_levels(device, sizes)
        # Numbers that the small levels keep in the local memory of a GPU.
        self._local_numbers = _local_numbers(sizes, self._large_levels)
        # The approximations of levels 1, 2, ... stand one behind the other; wide loads reach a
        # spare pixel between.
        approximation_sizes = [size + 1 for size in sizes[1:]]
        starts = np.cumsum([0, *approximation_sizes])
        self._starts = device.upload(starts, np.int32)
        self._scratch_size = sum(approximation_sizes)

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Name, grid and levels."""
        return {**super().to_arrays(), "levels": np.array(self.levels)}

    def _sides(self, level: int) -> tuple[int, int]:
        """Rows and columns of the approximation after `level` splits."""
        h, w = self.grid
        size = 2**level
        return -(-h // size), -(-w // size)

    def _bind_transform(self, x: Array, out: Array, epilogue: Epilogue, transpose: bool) -> Queued:
        return self.bind_planes(x, out, epilogue, transpose, planes=1)

    def bind_ordered(
        self, x: Array, out: Array, epilogue: Epilogue, transpose: bool, order: Array
    ) -> Queued | None:
        """The launches on a GPU, which reads and writes coefficients in any order."""
        if not self.takes_order:
            return None
        return self.bind_planes(x, out, epilogue, transpose, 1, order)

    @property
    def takes_order(self) -> bool:
        """True if its launches read and write coefficients in any order."""
        return self.levels > 0 and not self.device.is_cpu

    def bind_planes(
        self,
        x: Array,
        out: Array,
        epilogue: Epilogue,
        transpose: bool,
        planes: int,
        order: Array | None = None,
    ) -> Queued:
        """The launches of out = a (W x) + b y, or with W^T.

        With several `planes`, x and out (planes N,) are pictures one below the other, each of which
        is transformed. A GPU takes an `order` as `bind_ordered` does, of all planes.
        """
        y = epilogue.operand(x)
        if self.levels == 0:
            return vectors.bind_axpby(epilogue.a, x, epilogue.b, y, out)
        name = "join" if transpose else "split"
        k = x.columns
        pairs = CPU_PAIRS if k == 1 and self.device.is_cpu else 1
        taps = self._taps.shape[1]
        defines = {"TAPS": taps, "PAIRS": pairs}
        if order is not None:
            defines["ORDERED"] = 1
        height, width = self.grid
        arguments = {
            "height": height,
            "width": width,
            "levels": self.levels,
            "k": k,
            "scale": epilogue.a,
            "add_scale": epilogue.b,
            "starts": self._starts,
            "taps": self._taps,
            "x": x,
            "approximations": self.device.empty(self._scratch_size * k * planes),
            "add": y,
            "out": out,
        }
        if order is not None:
            arguments["order"] = order
        level_ranges = self._level_ranges()
        if transpose:
            level_ranges.reverse()
        launches = []
        for first, end in level_ranges:
            levels = {"first_level": first, "end_level": end, **arguments}
            is_small = end > self._large_levels
            file = "wavelet"
            if is_small and not self.device.is_cpu:
                file = "wavelet_tail"
                levels["space"] = self.device.local(self._local_numbers)
            kernel, pieces = self._kernel(file, name, k, **defines)
            if is_small:
                launch = bind_group(kernel, pieces * planes, **levels)
            else:
                launch = bind_grid(kernel, pieces, self._sides(end), planes, **levels)
            launches.append(launch)
        return in_order(launches)

    def _level_ranges(self) -> list[tuple[int, int]]:
        """The levels first .. end - 1 of each launch: large ones one by one, then the others."""
        launches = [(level, level + 1) for level in range(self._large_levels)]
        if self._large_levels < self.levels:
            launches.append((self._large_levels, self.levels))
        return launches


def _count_large_levels(device: Device, sizes: list[int]) -> int:
    """The number of levels, of so many pixels each, before those that one launch makes together.

    A GPU makes together what its work-groups turn over quickly and its local memory holds.
    """
    small = bases.small_level_pixels(device)
    levels = len(sizes) - 1
    for level in range(levels):
        fits = device.is_cpu or 4 * _local_numbers(sizes, level) <= device.local_memory
        if sizes[level] <= small and fits:
            return level
    return levels


def _local_numbers(sizes: list[int], first_level: int) -> int:
    """Numbers of the levels from `first_level` on that a work-group keeps at a time."""
    return sum(sizes[first_level : first_level + 3])


def filters(name: Any) -> np.ndarray:
    """Low-pass and high-pass filter of an orthonormal wavelet, (2, taps) float64.

    They are those of reconstruction, `rec_lo` and `rec_hi` of PyWavelets: with low-pass h_0 ..
    h_(t-1) the high-pass is g_i = (-1)^i h_(t-1-i). Both are orthonormal, to each other and to
    themselves moved by pairs, and h sums to sqrt(2), so that a constant has one coefficient.
    """
    if name not in _pywt.wavelist(kind="discrete"):
        raise InputError(f"wavelet is {name!r}; it must be {WAVELET_NAME}")
    wavelet = _pywt.Wavelet(name)
    taps = np.array([wavelet.rec_lo, wavelet.rec_hi])
    if not _deviation(taps) < MAX_FILTER_DEVIATION:
        raise InputError(f"wavelet {name} is not orthonormal; it must be {WAVELET_NAME}")
    return taps


def _deviation(taps: np.ndarray) -> float:
    """The largest deviation of the products of filters, shifted by pairs, from those of a basis."""
    length = taps.shape[1]
    deviations = []
    for shift in range(0, length, 2):
        products = taps[:, shift:] @ taps[:, : length - shift].T
        expected = np.eye(2) if shift == 0 else np.zeros((2, 2))
        deviations.append(np.max(np.abs(products - expected)))
    return float(np.max(deviations))


def basis(device: Device, grid: tuple[int, int], name: str) -> Basis | None:
    """The basis called `name` for pictures of h x w pixels.

    Parameters
    ----------
    device : Device
    grid : (h, w)
    name : str
        "pixels" (None: no basis is needed), "pyramid", "hats", or an orthonormal wavelet of
        PyWavelets: "haar", "db2", "db4", ...; InputError for others.

    Examples
    --------
    >>> import ltcl
    >>> from ltcl.operators import basis
    >>> basis(ltcl.open_device(), (8, 8), "db2").orthonormal
    True
    """
    if name == PIXELS:
        return None
    if name == PYRAMID:
        return Pyramid(device, grid)
    if name == HATS:
        return Hats(device, grid)
    return Wavelet(device, grid, name)
