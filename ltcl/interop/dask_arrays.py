# SPDX-License-Identifier: BSD-3-Clause
"""Dask's arrays: computed at the call, and given back in chunks of as many frames."""

from __future__ import annotations

from typing import Any

import dask.array
import numpy as np

from ltcl.interop.arrays import Kind, read


class DaskKind(Kind):
    """`dask.array.Array`."""

    def read(self, value: Any) -> np.ndarray:
        """The values, computed now."""
        return read(value.compute())

    def give(self, array: np.ndarray, like: Any) -> Any:
        """Chunks like those of `like` along a first axis of the same length; else one chunk."""
        chunks: list[Any] = list(array.shape)
        if array.ndim > 2 and like.ndim > 2 and len(array) == len(like):
            chunks[0] = like.chunks[0]
        as_chunks: Any = tuple(chunks)
        return dask.array.from_array(self.in_type_of(array, like), chunks=as_chunks)


def is_array(cls: type) -> bool:
    """True for the class of arrays, and those that derive from it."""
    return issubclass(cls, dask.array.Array)


KIND = DaskKind()
