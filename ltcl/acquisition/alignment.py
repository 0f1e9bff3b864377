# SPDX-License-Identifier: BSD-3-Clause
"""`align`: a T of any camera on the projector's grid, so that it has an S, and bounces.

T itself says where each camera pixel looks: relit by T, Gray code is decoded as photographs of it
would be (`ltcl.acquisition.geometry`), and its map resamples the rows of T as a scan's photographs
are. Where camera pixels do not separate projector pixels along some side, means of the rows that
see a projector pixel best are sharper, and are taken. With the weights W of this resampling, the
aligned T is W T. Noise of camera pixels is taken as independent.

Measured on a corner of 16 x 32 pixels: with 2, 2.5 and 3 camera pixels to a projector pixel's side
entries of T are off by 0.3 to 0.5 % in the Frobenius norm, with 1.7 by 2.3 %. With fewer than one,
projector pixels that share a camera pixel are not seen, but for one of them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy.sparse

from ltcl.acquisition.geometry import Correspondence, GrayCode, Resampling, decode
from ltcl.errors import InputError
from ltcl.transport.first_bounce import ENTRIES
from ltcl.transport.noise import Noise
from ltcl.transport.transport import Transport, check_transport

# Share of a pixel's light, beside its neighbours', that is its own: with less, T is another one.
# Measured: 0.96 with 1.3 camera pixels to a side, 0.29 with 0.6.
MIN_SHARPNESS = 0.7


@dataclass(frozen=True, kw_only=True, eq=False)
class Alignment:
    """Result of `ltcl.align`.

    Attributes
    ----------
    transport : Transport
        T on the projector's grid. Projector pixels that no camera pixel shows are masked.
    resampling : Resampling
        ``resampling.apply(photograph)`` is a photograph on that grid, as `ltcl.separate` takes it.
    mapping : Correspondence
        The map from camera pixels to projector coordinates.

    Examples
    --------
    >>> import ltcl, numpy
    >>> pictures = ltcl.scenes.dihedral(4).transport().to_numpy().reshape(4, 8, -1)
    >>> matrix = pictures.repeat(2, axis=0).repeat(2, axis=1).reshape(128, -1)
    >>> T = ltcl.Transport(matrix, (4, 8), camera_grid=(8, 16))
    >>> a = ltcl.align(T)
    >>> a.resampling.apply(T @ numpy.ones((4, 8))).shape
    (4, 8)
    """

    transport: Transport
    resampling: Resampling
    mapping: Correspondence


def align(T: Transport, **settings: Any) -> Alignment:
    """Bring T onto the projector's grid, as `ltcl.acquire` brings photographs onto it.

    Parameters
    ----------
    T : Transport
        A transport whose camera has other pixels than the projector, with arrays, sparse matrices
        or rows of a store.
    **settings
        Further arguments of the new `Transport`, such as ``first_bounce="exact"``.

    Returns
    -------
    Alignment

    Raises
    ------
    InputError
        T does not show which projector pixel most of its camera pixels see, is an operator, or is
        on the projector's grid already.

    Examples
    --------
    >>> import ltcl, numpy
    >>> scene = ltcl.scenes.dihedral(6, albedo=0.5)
    >>> pictures = scene.transport().to_numpy().reshape(6, 12, -1)
    >>> T = pictures.repeat(3, axis=0).repeat(3, axis=1).reshape(648, -1)  # 3 x 3 camera pixels
    >>> a = ltcl.align(ltcl.Transport(T, (6, 12), camera_grid=(18, 36)))
    >>> (
    ...     a.transport.is_square,
    ...     bool(numpy.allclose(a.transport.to_numpy(), pictures.reshape(72, -1))),
    ... )
    (True, True)
    """
    check_transport(T, square=False)
    if T.scene is not T:
        raise InputError(
            "T is of several projectors, whose bounces are found in the camera's pixels: "
            "ltcl.separate takes it as it is"
        )
    if T.camera_grid == T.grid:
        raise InputError(f"T has a camera_grid {T.camera_grid}, that of its projector already")
    matrices = _matrices_in_memory(T)
    mapping = decode([T @ pattern for pattern in GrayCode(T.grid).patterns()], T.grid)
    brightness = sum(matrices)
    candidates = [Resampling.of(mapping), _brightest_rows(brightness, T)]
    sharpness = [_sharpness(R.weights @ brightness, T.grid) for R in candidates]
    if max(sharpness) < MIN_SHARPNESS:
        raise InputError(
            f"T has {T.camera_grid} camera pixels, which separate only {max(sharpness):.0%} of the "
            f"light of neighbouring projector pixels, {T.grid}; they must be smaller, or the scan "
            "has to be of larger projector pixels"
        )
    resampling = candidates[int(np.argmax(sharpness))]
    aligned_matrices = [resampling.weights @ matrix for matrix in matrices]
    if T.blocks is not None:
        rows = [aligned_matrices[:3], aligned_matrices[3:6], aligned_matrices[6:]]
        aligned_matrices = rows
    if "noise" not in settings and T.measured_noise is not None:
        settings["noise"] = _resample_noise(T.measured_noise, resampling)
    aligned = Transport(aligned_matrices, T.grid, mixing=T.mixing, **settings)
    return Alignment(transport=aligned, resampling=resampling, mapping=mapping)


def _matrices_in_memory(T: Transport) -> list[Any]:
    """All matrices of T as arrays or csr_array; operators are refused."""
    matrices = list(T.matrices)
    if T.blocks is not None:
        matrices = [block for row in T.blocks for block in row]
    in_memory = []
    for matrix in matrices:
        if hasattr(matrix, "row_blocks"):
            matrix = matrix.tocsr()
        if not isinstance(matrix, ENTRIES):
            kind = type(matrix).__name__
            raise InputError(f"T holds a {kind}; it must hold arrays, sparse matrices or a store")
        in_memory.append(matrix)
    return in_memory


def _brightest_rows(brightness: Any, T: Transport) -> Resampling:
    """Means of the camera pixels that see the same projector pixel best."""
    pixels = np.asarray(brightness.argmax(axis=1)).ravel()
    is_lit = ~T.unlit
    counts = np.bincount(pixels[is_lit], minlength=T.shape[1])
    shares = np.where(is_lit, 1.0 / np.maximum(counts[pixels], 1), 0.0)
    camera_pixels = np.arange(len(pixels))
    weights = scipy.sparse.csr_array(
        (shares.astype(np.float32), (pixels, camera_pixels)), (T.shape[1], T.shape[0])
    )
    coverage = (counts > 0).astype(np.float32).reshape(T.grid)
    return Resampling(weights, coverage, T.grid, T.camera_grid)


def _sharpness(matrix: Any, grid: tuple[int, int]) -> float:
    """Share of the light of a pixel and its neighbours that is its own, on average of all pixels.

    It is 1 if the grids are aligned and nothing is blurred; unseen pixels count as 0.
    """
    width = grid[1]
    own = np.maximum(matrix.diagonal(), 0.0)
    near = own.copy()
    for step in (1, width):
        beside = np.abs(matrix.diagonal(step))
        near[: len(beside)] += beside
        beside = np.abs(matrix.diagonal(-step))
        near[-len(beside) :] += beside
    shares = np.divide(own, near, out=np.zeros_like(own), where=near > 0)
    return float(shares.mean())


def _resample_noise(noise: Noise, resampling: Resampling) -> Noise:
    """The noise of rows that are weighted sums, as if it were independent from row to row."""
    squares = resampling.weights.power(2)
    rows = noise.rows @ squares.T
    white = np.full_like(rows, np.inf)
    if np.isfinite(noise.white).all():
        white = noise.white @ squares.T
    return replace(noise, rows=rows, white=white)
