# SPDX-License-Identifier: BSD-3-Clause
"""Patterns of several projectors side by side in one picture, aligned at the top."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import scipy.sparse

from ltcl import checks
from ltcl.errors import InputError


@dataclass(frozen=True)
class Montage:
    """The places of projectors of these `grids` in the picture of all of them.

    Examples
    --------
    >>> montage = Montage(((2, 2), (1, 3)))
    >>> montage.grid
    (2, 5)
    >>> [pattern.shape for pattern in montage.split(np.zeros((2, 5, 3)))]
    [(2, 2, 3), (1, 3, 3)]
    """

    grids: tuple[tuple[int, int], ...]

    @cached_property
    def grid(self) -> tuple[int, int]:
        """Height of the highest pattern, and the sum of all widths."""
        return max(h for h, _ in self.grids), sum(w for _, w in self.grids)

    @cached_property
    def lefts(self) -> tuple[int, ...]:
        """The first column of each pattern."""
        widths = [w for _, w in self.grids]
        return tuple(np.cumsum([0, *widths[:-1]]).tolist())

    @property
    def pixels(self) -> int:
        """Pixels of the picture, with those below patterns that are not the highest."""
        height, width = self.grid
        return height * width

    @cached_property
    def places(self) -> tuple[np.ndarray, ...]:
        """The pixel of the picture for each pixel of each projector, (N_k,)."""
        pixels = np.arange(self.pixels).reshape(self.grid)
        places = []
        for (h, w), left in zip(self.grids, self.lefts, strict=True):
            places.append(pixels[:h, left : left + w].ravel())
        return tuple(places)

    @cached_property
    def is_empty(self) -> np.ndarray:
        """Pixels (N,) of the picture that belong to no projector."""
        is_empty = np.ones(self.pixels, bool)
        for places in self.places:
            is_empty[places] = False
        return is_empty

    def vector(self, values: Sequence[np.ndarray]) -> np.ndarray:
        """Values (N_k, ...) of the pixels of each projector in the picture, (N, ...); else 0."""
        whole = np.zeros((self.pixels, *values[0].shape[1:]), np.result_type(*values))
        for places, own in zip(self.places, values, strict=True):
            whole[places] = own
        return whole

    def columns(self, matrices: Sequence[Any]) -> Any:
        """Join (M, N_k) of each projector into a matrix (M, N): sparse if all are, else float32."""
        shape = (matrices[0].shape[0], self.pixels)
        if any(not scipy.sparse.issparse(matrix) for matrix in matrices):
            checks.fits_host("T of all projectors", 4 * shape[0] * shape[1])
            whole = np.zeros(shape, np.float32)
            for places, matrix in zip(self.places, matrices, strict=True):
                if scipy.sparse.issparse(matrix):
                    matrix = matrix.toarray()
                whole[:, places] = matrix
            return whole
        rows = []
        columns = []
        values = []
        for places, matrix in zip(self.places, matrices, strict=True):
            entries = scipy.sparse.coo_array(matrix)
            rows.append(entries.row)
            columns.append(places[entries.col])
            values.append(entries.data)
        coordinates = (np.concatenate(rows), np.concatenate(columns))
        return scipy.sparse.csr_array((np.concatenate(values), coordinates), shape=shape)

    def join(self, patterns: Sequence[Any]) -> np.ndarray:
        """The picture of one pattern (h, w), (h, w, 3), or frames of these, for each projector."""
        if len(patterns) != len(self.grids):
            raise InputError(
                f"pattern has {len(patterns)} patterns; it must have one for each of "
                f"{len(self.grids)} projectors"
            )
        arrays = [checks.real("pattern", pattern) for pattern in patterns]
        leads = set()
        endings = set()
        for number, (array, grid) in enumerate(zip(arrays, self.grids, strict=True)):
            lead, ending = _around_grid(f"pattern[{number}]", array, grid)
            leads.add(lead)
            endings.add(ending)
        if len(leads) > 1 or len(endings) > 1:
            shapes = [array.shape for array in arrays]
            raise InputError(
                f"pattern has patterns of shapes {shapes}; they must agree in frames and colours"
            )
        lead = leads.pop()
        whole = np.zeros((*lead, *self.grid, *endings.pop()), np.result_type(*arrays))
        for place, array in zip(self._windows(len(lead)), arrays, strict=True):
            whole[place] = array
        return whole

    def split(self, picture: Any) -> tuple[np.ndarray, ...]:
        """The pattern of each projector, with the frames and colours of the picture; copies."""
        picture = np.asarray(picture)
        lead, _ = _around_grid("pattern", picture, self.grid)
        return tuple(picture[place].copy() for place in self._windows(len(lead)))

    def _windows(self, lead: int) -> list[tuple[slice, ...]]:
        """The window of each projector, behind so many axes of frames."""
        windows = []
        for (h, w), left in zip(self.grids, self.lefts, strict=True):
            windows.append((*[slice(None)] * lead, slice(h), slice(left, left + w)))
        return windows


def _around_grid(
    name: str, array: np.ndarray, grid: tuple[int, int]
) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """The axes of frames before a grid, and those of colours behind it."""
    if array.shape[-3:] == (*grid, 3):
        return array.shape[:-3], (3,)
    if array.shape[-2:] == grid:
        return array.shape[:-2], ()
    raise InputError(
        f"{name} has shape {array.shape}; it must be {grid}, {(*grid, 3)} or frames of these"
    )
