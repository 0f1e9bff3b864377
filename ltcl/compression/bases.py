# SPDX-License-Identifier: BSD-3-Clause
"""Bases in which R is written, by name, and R~ in one of them as the device has it."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import scipy.sparse

from ltcl.compression.coefficients import Coefficients, Progress, coefficients
from ltcl.compression.norms import estimate_norm
from ltcl.compression.sources import Rows
from ltcl.device import Device
from ltcl.errors import InputError, InputTypeError
from ltcl.operators import Basis, Compressed, SubsetBasis, Tiles, Wavelet, basis, smallest
from ltcl.operators.bases import multiresolution_order, restrict_to_support
from ltcl.operators.tiles import Packed
from ltcl.operators.wavelets import filters

PIXELS, ROWS = "pixels", " rows"
INVERSE_NAMES = ("db2", "haar", "db4", PIXELS)  # compared where none is named, in this order
_SIGNS = 32  # pictures of random signs


def validate_names(names: Any, *, for_inverse: bool = False) -> list[str]:
    """Names of one basis or of several, as a list."""
    names = [names] if isinstance(names, str) else names
    if not isinstance(names, (list, tuple)) or not all(isinstance(name, str) for name in names) or not names:
        raise InputTypeError(f"basis is {names!r}; it must be a name, such as db2, or a list of at least one")
    for name in names:
        if for_inverse and name.endswith(ROWS):
            raise InputError(f"basis is {name!r}; an inverse needs one basis on both sides, such as 'db2'")
        try:
            if name != PIXELS:
                filters(name.removesuffix(ROWS))
        except InputError as error:
            raise InputError(
                f"basis is {name!r}; it must be pixels, or an orthonormal wavelet such as haar, db2 or db4, "
                "with ' rows' behind it for rows alone"
            ) from error
    return list(names)


@dataclass(frozen=True)
class Bases:
    """R = out^T C into; None is pixels.

    `weights` (N,) of columns, at least 1, are the root of 1 + N e: the squares that a number which is dropped
    costs a single pixel, and light of energies e.
    """

    name: str
    out: Basis | None
    into: Basis | None
    weights: np.ndarray

    @classmethod
    def named(cls, device: Device, grid: tuple[int, int], name: str, light: Any = None) -> Bases:
        """Those of a name, on a grid, with weights by `light` (N, k) of norm 1."""
        W = basis(device, grid, name.removesuffix(ROWS))
        if isinstance(W, Wavelet):  # large coefficients then lie side by side, in fewer tiles
            order = multiresolution_order(grid, W.levels)
            W = SubsetBasis(device, grid, order, of=W)
        weights = np.sqrt(1.0 + (0.0 if light is None else len(light) * energies(W, light)))
        return cls(name, None if name.endswith(ROWS) else W, W, np.broadcast_to(weights, grid[0] * grid[1]))

    def restricted(self, core: Any) -> tuple[Any, Bases]:
        """Core without weights; without coefficients it does not touch, where both sides have one basis."""
        data = (core.data / self.weights[core.indices]).astype(core.dtype)
        core = scipy.sparse.csr_array((data, core.indices, core.indptr), core.shape)
        if self.into is None or self.out is not self.into:
            return core, self
        core, W = restrict_to_support(core, self.into)
        return core, replace(self, out=W, into=W)

    def operator(
        self, device: Device, core: Packed, error: float = 0.0, diagonal: np.ndarray | None = None
    ) -> Compressed:
        """R~ on the device, of a known `error` and with the `diagonal` (N,) of R."""
        return Compressed(Tiles(device, core), self.out, self.into, error, diagonal=diagonal)

    def gather(self, R: Rows, progress: Progress = lambda share: None, **limits: Any) -> Coefficients:
        """The numbers of R, times the weights, within the `limits` of `coefficients`."""
        weights = self.weights[:, None].astype(np.float32)

        def into(x: np.ndarray) -> np.ndarray:
            return weights * (x if self.into is None else _on_host(self.into, x))

        out = None if self.out is None else partial(_on_host, self.out)
        return coefficients(R, out, into, progress=progress, **limits)

    def noise(self, variances: Any) -> list[np.ndarray]:
        """Standard deviations of rows and columns of weighted numbers, of random signs: each within 13 %."""
        signs = np.random.default_rng(0).choice([-1.0, 1.0], (variances.shape[1], _SIGNS))
        sides = zip((self.out, self.into), variances, (1.0, self.weights), strict=True)
        return [weights * np.sqrt(energies(W, np.sqrt(each)[:, None] * signs)) for W, each, weights in sides]


def energies(W: Basis | None, x: np.ndarray) -> np.ndarray:
    """Mean squares of the coefficients of light x (N, k), k a multiple of `COLUMNS`; None is pixels."""
    return np.mean(np.square(x if W is None else _on_host(W, x.astype(np.float32)), dtype=np.float64), axis=1)


def _on_host(W: Basis, x: np.ndarray) -> np.ndarray:
    return W.apply(W.device.upload(x)).get()


def quantize(C: scipy.sparse.csr_array, allowance: float) -> Packed:
    """C in the tiles of fewest bytes whose rounding has a 2-norm of at most about `allowance`.

    That norm is estimated; who hands out the tiles measures what they are worth.
    """
    size = float(np.linalg.norm(C.data.astype(np.float64)))
    frobenius = allowance * math.sqrt(len(C.indptr) - 1)  # or less: the 2-norm of rounding is far below
    while True:
        packed = smallest(C, frobenius / size if size else 0.0)
        if packed.precision == "float32" or packed.difference[1] <= allowance:
            return packed
        if estimate_norm(scipy.sparse.csr_array(packed.matrix() - C))[0] <= allowance:
            return packed
        frobenius = 0.5 * packed.difference[0]
