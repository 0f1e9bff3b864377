# SPDX-License-Identifier: BSD-3-Clause
"""`PictureLog`: the pictures of a scan that asks for its patterns batch by batch, in a store."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from itertools import islice
from typing import Any

import numpy as np
import scipy.sparse

from ltcl.acquisition.scanning.pictures import Picture, ScanCamera
from ltcl.acquisition.scratch import scratch_array
from ltcl.errors import AcquisitionError
from ltcl.store import BlockStore

BATCH_SIZE = 16
"""Patterns of a batch."""


class PictureLog:
    """Pictures in the order of a scan's requests, a batch in each block of a store.

    The next request depends on nothing but the pictures before. So a scan that was stopped is run
    again from its start with the pictures of the log, to the bit the same, until it asks for a new
    one. Without a camera that is an AcquisitionError. `done` counts the pictures that were asked
    for; `names` are those of their patterns, with the photographs if they were taken now.
    """

    def __init__(
        self, store: BlockStore, camera: ScanCamera | None, progress: Callable[[int], None]
    ) -> None:
        self.done = 0
        self.names: list[str] = []
        self._store = store
        self._camera = camera
        self._progress = progress
        self._batches = 0

    @property
    def can_take(self) -> bool:
        """False if the next batch is not in the store, and there is no camera."""
        return self._camera is not None or self._is_written(self._batches)

    def keep(self, name: str, make: Callable[[], np.ndarray]) -> np.ndarray:
        """The array that the store has by this name; at first it is made, and kept."""
        if name not in self._store.extras:
            self._store.extra(name, make())
        return self._store.extra(name)

    def announce(self, patterns: Iterable[np.ndarray]) -> None:
        """Announce the patterns of the next batches that are not in the store."""
        if self._camera is None:
            return
        size = self._store.layout.block_rows
        batch = self._batches
        while self._is_written(batch):
            batch += 1
        stored = (batch - self._batches) * size
        self._camera.announce(islice(patterns, stored, None), size)

    def take(self, patterns: list[np.ndarray]) -> list[Picture]:
        """The pictures of the next batch of patterns, as many as a block has at most."""
        batch = self._batches
        self._batches += 1
        if self._is_written(batch):
            pictures = self._read(batch, len(patterns))
            self._name([""] * len(patterns))
            self._count(len(patterns))
            return pictures
        if self._camera is None:
            raise AcquisitionError(
                f"{self._store.path}: the next batch of patterns is not photographed"
            )
        pictures = self._camera.take(patterns, self._count)
        self._name([f" ({name})" for name in self._camera.names])
        self._camera.keep_lamp_gain(self._store)
        self._write(batch, pictures)
        return pictures

    def name_photographs(self, photographs: Sequence[str]) -> None:
        """Name the photographs of the first patterns, which were taken before the scan."""
        for place, photograph in enumerate(photographs):
            self.names[place] = f"pattern {place + 1} ({photograph})"

    def put(self, pictures: Sequence[Picture]) -> None:
        """Keep the pictures of the next batch, which were taken before."""
        self._write(self._batches, pictures)
        self._batches += 1

    def _read(self, batch: int, expected: int) -> list[Picture]:
        """Pictures of a batch in the store, which must be as many as expected."""
        layout = self._store.layout
        _, pixels = layout.block_shape(batch, "columns")
        shape = (expected, layout.channels, pixels)
        # A batch of many pixels would fill the memory.
        values = scratch_array(shape, np.float32)
        variances = scratch_array(shape, np.float32)
        for channel in range(layout.channels):
            # Batches of a scan have variances.
            block: Any = self._store.block(channel, batch)
            stored = len(block.variance) // pixels
            if stored != expected:
                raise AcquisitionError(
                    f"{self._store.path} has {stored} pictures in batch {batch}; "
                    f"it must have {expected}: it is that of another scan"
                )
            values[:, channel] = np.reshape(block.matrix.data, (-1, pixels))
            variances[:, channel] = np.reshape(block.variance, (-1, pixels))
        pictures = []
        for value, variance in zip(values, variances, strict=True):
            pictures.append(Picture(value=value, variance=variance))
        return pictures

    def _write(self, batch: int, pictures: Sequence[Picture]) -> None:
        """Commit the pictures of a batch, each a full column of its block."""
        layout = self._store.layout
        shape = layout.block_shape(batch, "columns")
        _, pixels = shape
        column = np.tile(np.arange(pixels, dtype=np.int32), len(pictures))
        # Rows of a batch that is not full are empty.
        ends = np.minimum(np.arange(shape[0] + 1), len(pictures)) * pixels
        for channel in range(layout.channels):
            value = np.concatenate([picture.value[channel] for picture in pictures])
            variance = np.concatenate([picture.variance[channel] for picture in pictures])
            matrix = scipy.sparse.csr_array((value, column, ends.astype(np.int32)), shape=shape)
            self._store.write(channel, batch, matrix, variance)

    def _is_written(self, batch: int) -> bool:
        channels = range(self._store.layout.channels)
        return all((channel, batch) in self._store.written for channel in channels)

    def _name(self, photographs: Sequence[str]) -> None:
        """Name the next patterns, with their photographs."""
        for photograph in photographs:
            self.names.append(f"pattern {len(self.names) + 1}{photograph}")

    def _count(self, pictures: int) -> None:
        self.done += pictures
        self._progress(self.done)
