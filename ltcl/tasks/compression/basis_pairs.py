# SPDX-License-Identifier: BSD-3-Clause
"""`Bases`: the two bases that R is written between, R = W_out^T C W_in, and weights of columns.

A number c of column l that is dropped costs light of energies e about c^2 e_l. It is weighted by
sqrt(1 + N e_l), for single pixels and for pictures.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse

from ltcl.device import Device, open_device
from ltcl.errors import InputError, InputTypeError
from ltcl.operators import Basis, Compressed, SubsetBasis, Tiles, Wavelet, basis
from ltcl.operators.bases import PIXELS, multiresolution_order, restrict_to_support
from ltcl.operators.stored import basis_of
from ltcl.operators.wavelets import COMPARED_WAVELETS, WAVELET_NAME, filters
from ltcl.tasks.compression.coefficients import Coefficients, Progress, coefficients, quantize
from ltcl.tasks.compression.sources import SourceRows

# Ending of the name of a basis for rows alone.
ROWS = " rows"
# Bases that are compared where none is named, in this order.
INVERSE_NAMES = (*COMPARED_WAVELETS, PIXELS)
# Pictures of random signs, by which noise is estimated.
SIGN_PICTURES = 32


def basis_names(names: Any, *, for_inverse: bool = False) -> list[str]:
    """Check the names of one basis or of several, and return them as a list."""
    if isinstance(names, str):
        names = [names]
    is_list = isinstance(names, (list, tuple)) and len(names) > 0
    if not is_list or not all(isinstance(name, str) for name in names):
        raise InputTypeError(
            f"basis is {names!r}; it must be a name, such as db2, or a list of names"
        )
    for name in names:
        if for_inverse and name.endswith(ROWS):
            raise InputError(
                f"basis is {name!r}; an inverse needs the same basis on both sides, such as 'db2'"
            )
        if name == PIXELS:
            continue
        try:
            filters(name.removesuffix(ROWS))
        except InputError as error:
            raise InputError(
                f"basis is {name!r}; it must be {PIXELS}, or {WAVELET_NAME}, "
                f"with {ROWS!r} after its name for rows alone"
            ) from error
    return list(names)


@dataclass(frozen=True, kw_only=True)
class Bases:
    """The bases of R = W_out^T C W_in; None is pixels.

    Attributes
    ----------
    device : Device
    name : str
    out, into : Basis or None
    weights : (N,)
        Weights of columns, at least 1: the root of 1 + N e, the squares that a number which is
        dropped costs a single pixel, and light of energies e.
    """

    device: Device
    name: str
    out: Basis | None
    into: Basis | None
    weights: np.ndarray

    @classmethod
    def named(cls, device: Device, grid: tuple[int, int], name: str, light: Any = None) -> Bases:
        """Bases of a name on a grid, with weights by `light` (N, k) of norm 1."""
        W = basis(device, grid, name.removesuffix(ROWS))
        if isinstance(W, Wavelet):
            # Large coefficients then lie side by side, in fewer tiles.
            order = multiresolution_order(grid, W.levels)
            W = SubsetBasis(device, grid, order, of=W)
        weights = np.ones(grid[0] * grid[1])
        if light is not None:
            weights = np.sqrt(1.0 + len(light) * energies(W, light))
        out = None if name.endswith(ROWS) else W
        return cls(device=device, name=name, out=out, into=W, weights=weights)

    def compressed(self, core: Any, allowance: float) -> Compressed:
        """R~ of a core with weights, rounded by about `allowance` in the 2-norm: see `quantize`.

        Where both sides have one basis, it is without coefficients that the core does not touch.
        """
        values = (core.data / self.weights[core.indices]).astype(core.dtype)
        core = scipy.sparse.csr_array((values, core.indices, core.indptr), core.shape)
        out = self.out
        into = self.into
        if into is not None and out is into:
            core, into = restrict_to_support(core, into)
            out = into
        tiles = Tiles(self.device, quantize(core, allowance))
        return Compressed(tiles, out, into, 0.0)

    def gather(
        self, R: SourceRows, progress: Progress = lambda share: None, **limits: Any
    ) -> Coefficients:
        """The numbers of R, times the weights, within the `limits` of `coefficients`."""
        out = None if self.out is None else CoefficientAnalysis(self.out)
        weights = self.weights[:, None].astype(np.float32)
        into = CoefficientAnalysis(self.into, weights)
        return coefficients(R, out, into, progress=progress, **limits)

    def noise(self, variances: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Standard deviations of rows and columns of weighted numbers, each within 13 %.

        `variances` (2, N) are of rows and columns of R; pictures of random signs show what the
        bases make of them.
        """
        random = np.random.default_rng(0)
        pixels = variances.shape[1]
        signs = random.choice([-1.0, 1.0], (pixels, SIGN_PICTURES))
        row_noise, column_noise = np.sqrt(variances)
        rows = np.sqrt(energies(self.out, row_noise[:, None] * signs))
        columns = np.sqrt(energies(self.into, column_noise[:, None] * signs))
        return rows, self.weights * columns


def energies(W: Basis | None, x: np.ndarray) -> np.ndarray:
    """Mean squares of coefficients of x (N, k), k a multiple of `COLUMNS`; None means pixels."""
    if W is not None:
        x = CoefficientAnalysis(W)(x.astype(np.float32))
    return np.mean(np.square(x, dtype=np.float64), axis=1)


@dataclass(frozen=True)
class CoefficientAnalysis:
    """The coefficients W x of light x (N, k) on the host in float32, times weights; None is pixels.

    An unpickled one opens the device of its process.
    """

    W: Basis | None
    weights: np.ndarray | None = None

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """The coefficients of columns (N, k)."""
        if self.W is not None:
            x = self.W.apply(self.W.device.upload(x)).get()
        if self.weights is not None:
            x = self.weights * x
        return x

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[Any, ...]]:
        if self.W is None:
            return CoefficientAnalysis, (None, self.weights)
        return _unpickle_analysis, (self.W.to_arrays(), self.weights)


def _unpickle_analysis(arrays: Any, weights: np.ndarray | None) -> CoefficientAnalysis:
    W = basis_of(_device_of_worker(), arrays)
    return CoefficientAnalysis(W, weights)


@functools.cache
def _device_of_worker() -> Device:
    """The device of this process, which is kept as long as the process runs."""
    return open_device()
