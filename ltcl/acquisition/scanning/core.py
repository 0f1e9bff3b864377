# SPDX-License-Identifier: BSD-3-Clause
"""What an adaptive scan found as the arrays of a compressed transport (`ltcl.transport`): T = C W.

It is kept as S diag(1) with S = T = I + R: R = C W - I takes 1 from C at every pixel's own cell, and the
first bounce stands beside it. Loaded, `Transport` divides the columns by F when it makes its own S = T F^-1.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import scipy.sparse

from ltcl import first_bounce
from ltcl.acquisition.scanning.adaptive import Core
from ltcl.acquisition.scanning.cells import Cells
from ltcl.store import BlockStore


def arrays(core: Core, mixing: np.ndarray | None = None, sigmas: float = 0.0) -> dict[str, np.ndarray]:
    """The arrays of the transport of a core, which is completed.

    A first bounce that is not above 0 by `sigmas` standard deviations is 0, so that its pixel can be masked.

    Examples
    --------
    >>> from ltcl.acquisition.scanning.adaptive import Entries
    >>> core = Core(Cells((1, 2)), 1)
    >>> one = np.ones((1, 2))
    >>> core.add(0, Entries(np.array([0, 1]), np.array([0, 1]), 0.5 * one, 0.01 * one))
    >>> core.add(1, Entries(np.array([0, 0]), np.array([0, 1]), 0.2 * one, 0.01 * one))
    >>> from ltcl.transport import from_arrays
    >>> print(from_arrays(arrays(core)) @ np.array([[1.0, 0.0]]))
    [[0.6 0.1]]
    """
    core.complete()
    cells, matrices = core.cells, core.matrices()
    n = cells.grid[0] * cells.grid[1]
    own, noise = (
        np.stack([diagonal(cells, part) for part in parts]) for parts in (matrices, core.matrices("variance"))
    )
    F = first_bounce.certain(own, noise, sigmas)
    found: dict[str, Any] = {"grid": np.array(cells.grid), "first_bounce": F}
    if mixing is not None:
        found["mixing"] = mixing
    found |= {"basis_0.name": np.array("pyramid"), "basis_0.grid": np.array(cells.grid)}
    for c, C in enumerate(matrices):
        R = C.copy()
        R.data[R.indices == np.repeat(np.arange(n), np.diff(R.indptr))] -= 1.0
        found[f"columns_{c}"] = np.ones(n)
        found |= {f"system_{c}.sign": np.array(1.0), f"system_{c}.solution_error": np.array(0.0)}
        found |= {
            f"system_{c}.R.{name}": np.asarray(part)
            for name, part in {
                "kind": "compressed",
                "error": 0.0,
                "out": -1,
                "into": 0,
                "diagonal": own[c] - 1.0,
                "core.kind": "csr",
                "core.error": 0.0,
                "core.shape": np.array(R.shape, np.int64),
                "core.data": R.data.astype(np.float32),
                "core.indices": R.indices.astype(np.int32),
                "core.indptr": R.indptr.astype(np.int64),
            }.items()
        }
    return found


def variances(core: Core) -> dict[str, np.ndarray]:
    """The variance of the entries of a core that is complete, in `core_variance_0` and so on."""
    return {f"core_variance_{c}": part.data for c, part in enumerate(core.matrices("variance"))}


@dataclass(frozen=True, eq=False)
class Stored:
    """C of each channel, (M, cells), and the variance of its entries, as a store has them.

    Examples
    --------
    >>> C = scipy.sparse.csr_array([[0.5, 0.0, 0.1], [0.0, 0.5, 0.1]])
    >>> Stored(Cells((1, 2)), [C]).product(np.array([[1.0, 0.0]]))
    array([[0.6, 0.1]])
    """

    cells: Cells
    matrices: list[scipy.sparse.csr_array]
    variances: list[scipy.sparse.csr_array] = field(default_factory=list)

    @classmethod
    def of(cls, store: BlockStore) -> Stored:
        """Of a store of `arrays`."""
        cells, parts = Cells(store.layout.grid), ([], [])
        for c in range(store.layout.channels):
            names = [f"system_{c}.R.core.{name}" for name in ("data", "indices", "indptr")]
            data, indices, indptr = (np.array(store.extra(name)) for name in names)
            shape = (len(indptr) - 1, cells.offsets[-1])
            data[indices == np.repeat(np.arange(shape[0]), np.diff(indptr))] += 1.0  # R = C W - I
            for part, values in zip(parts, (data, store.extra(f"core_variance_{c}")), strict=True):
                part.append(scipy.sparse.csr_array((np.array(values), indices, indptr), shape=shape))
        return cls(cells, *parts)

    def product(self, pattern: np.ndarray) -> np.ndarray:
        """T p of a pattern (h, w), (channels, M)."""
        sums = self.cells.sums(pattern)
        return np.stack([C @ sums for C in self.matrices])


def diagonal(cells: Cells, C: scipy.sparse.csr_array) -> np.ndarray:
    """diag(C W), (N,): of each pixel the cells that it is in, on all levels."""
    pixels = np.arange(cells.grid[0] * cells.grid[1])
    parts = [C[pixels, cells.of_pixels(level)] for level in range(cells.top + 1)]
    return np.sum([part.toarray() if scipy.sparse.issparse(part) else part for part in parts], axis=0)


def between(cells: Cells, C: scipy.sparse.csr_array, pixels: np.ndarray) -> np.ndarray:
    """C W where rows and columns of some pixels meet, dense."""
    levels = range(cells.top + 1)
    of = np.stack([cells.of_pixels(level)[pixels] for level in levels])
    one = np.broadcast_to(np.arange(len(pixels)), of.shape)
    W = scipy.sparse.csr_array(
        (np.ones(of.size), (of.ravel(), one.ravel())), shape=(cells.offsets[-1], len(pixels))
    )
    return (C[pixels] @ W).toarray()
