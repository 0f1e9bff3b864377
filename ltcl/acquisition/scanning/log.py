# SPDX-License-Identifier: BSD-3-Clause
"""Pictures in the order in which a scan asked for them, kept in a store.

What an adaptive scan asks for next depends on nothing but the pictures before. So a scan that was stopped is
run again from its start with the pictures of the log, to the bit the same, until it asks for a new one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from itertools import islice

import numpy as np
import scipy.sparse

from ltcl.acquisition.scanning.pictures import Picture, Pictures
from ltcl.errors import AcquisitionError
from ltcl.store import BlockStore


class Log:
    """A store by columns, the pictures of a batch in each block.

    Attributes
    ----------
    done : int
        Pictures asked for so far.
    """

    def __init__(self, store: BlockStore, pictures: Pictures, tell: Callable[[int], None]) -> None:
        self._store, self._pictures, self._tell = store, pictures, tell
        self._batches = 0
        self.done = 0

    def announce(self, patterns: Iterable[np.ndarray]) -> None:
        """Tell the rig of the patterns of the next batches that are not in the store."""
        number = self._batches
        while self._written(number):
            number += 1
        size = self._store.layout.block_rows
        self._pictures.announce(islice(patterns, (number - self._batches) * size, None), size)

    def _written(self, number: int) -> bool:
        return all((c, number) in self._store.written for c in range(self._pictures.channels))

    def take(self, patterns: list[np.ndarray]) -> list[Picture]:
        """The pictures of the next batch of patterns, as many as a block has at most."""
        number, self._batches = self._batches, self._batches + 1
        if number >= self._store.layout.blocks("columns"):
            raise AcquisitionError(f"the scan asks for more than {number} batches; that is a fault of ltcl")
        if self._written(number):
            found = self._read(number, len(patterns))
            self._count(len(patterns))
        else:
            found = self._pictures.take(patterns, lambda: self._count(1))
            for c in range(self._pictures.channels):
                self._write(number, c, found)
        return found

    def _count(self, pictures: int) -> None:
        self.done += pictures
        self._tell(self.done)

    def _read(self, number: int, count: int) -> list[Picture]:
        blocks = [self._store.block(c, number, "columns") for c in range(self._pictures.channels)]
        rows, pixels = self._store.layout.block_shape(number, "columns")
        value = np.stack([block.matrix.data.reshape(-1, pixels) for block in blocks], axis=1)
        known = [block.variance for block in blocks if block.variance is not None]
        variance = np.stack([part.reshape(-1, pixels) for part in known], axis=1)
        if len(value) != count or count > rows:
            raise AcquisitionError(
                f"{self._store.path} holds {len(value)} pictures in batch {number}, but {count} are asked "
                "for; it is that of another scan"
            )
        return [Picture(*part) for part in zip(value, variance, strict=True)]

    def _write(self, number: int, c: int, found: list[Picture]) -> None:
        rows, pixels = self._store.layout.block_shape(number, "columns")
        value = np.concatenate([part.value[c] for part in found])
        variance = np.concatenate([part.variance[c] for part in found])
        places = np.tile(np.arange(pixels, dtype=np.int32), len(found))
        ends = np.minimum(np.arange(rows + 1), len(found)) * pixels  # rows without a picture are empty
        matrix = scipy.sparse.csr_array((value, places, ends), shape=(rows, pixels))
        self._store.write(c, number, matrix, variance)
