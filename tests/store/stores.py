# SPDX-License-Identifier: BSD-3-Clause
"""Small matrices and stores of known entries, and acquisitions that end at a given moment."""

from __future__ import annotations

import hashlib
import os
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
import scipy.sparse

import ltcl
from ltcl.store import BlockStore

PACKAGE = os.path.dirname(ltcl.__file__)


def dense(M: int = 12, N: int = 12, dtype: str = "float32", seed: int = 1) -> np.ndarray:
    """(M, N) with a strong diagonal, as a transport has."""
    T = np.random.default_rng(seed).random((M, N))
    np.fill_diagonal(T, 5 + T.diagonal())
    return T.astype(dtype)


def sparse(
    N: int = 12, dtype: str = "float32", seed: int = 1, pattern: int = 1
) -> scipy.sparse.csr_array:
    """(N, N) csr; equal `pattern` gives equal places, `seed` the values."""
    keep = np.random.default_rng(pattern).random((N, N)) < 0.3
    np.fill_diagonal(keep, True)
    return scipy.sparse.csr_array(np.where(keep, dense(N, N, dtype, seed), 0).astype(dtype))


def transport(rows: int = 10, columns: int = 12, channel: int = 0) -> scipy.sparse.csr_array:
    """(rows, columns) float32 with empty rows and a strong diagonal."""
    rng = np.random.default_rng([rows, columns, channel])
    T = np.where(rng.random((rows, columns)) < 0.4, rng.random((rows, columns)), 0.0)
    np.fill_diagonal(T, 2.0 + channel)
    T[3:4] = 0.0
    return scipy.sparse.csr_array(T.astype(np.float32))


def variance(T: scipy.sparse.csr_array) -> scipy.sparse.csr_array:
    """Variances, as many, each telling where it belongs."""
    values = np.arange(1, T.nnz + 1, dtype=np.float32)
    return scipy.sparse.csr_array((values, T.indices, T.indptr), shape=T.shape)


def make(path: Path, **options: Any) -> BlockStore:
    """An empty store for `transport()`: blocks of 3, the last one of less."""
    sizes = {"shape": (10, 12), "grid": (3, 4), "camera_grid": (2, 5), "block_rows": 3, **options}
    return BlockStore.create(path, **sizes)


def batch(store: BlockStore, T: scipy.sparse.csr_array, block: int) -> scipy.sparse.csr_array:
    """The columns of T in a batch, as rows."""
    start, stop = store.layout.span(block, "columns")
    return scipy.sparse.csr_array(T[:, start:stop].T)


def fill(
    store: BlockStore, *, with_variance=False, final=True, report=lambda c, b: None
) -> BlockStore:
    """Every batch of `transport()` that is missing; `report` each."""
    for channel, block in store.missing():
        T = transport(*store.layout.shape, channel)
        V = batch(store, variance(T), block).data if with_variance else None
        store.write(channel, block, batch(store, T, block), V)
        report(channel, block)
    if final:
        store.finalize()
    return store


def rows(store: BlockStore, channel: int = 0) -> np.ndarray:
    """T of a store, by its rows."""
    blocks = (store.block(channel, number).matrix for number in range(store.layout.blocks()))
    return np.concatenate([block.toarray() for block in blocks])


def contents(path: Path) -> dict[str, str]:
    """SHA-256 of every file by its name."""
    files = [file for file in path.rglob("*") if file.is_file()]
    return {
        str(file.relative_to(path)): hashlib.sha256(file.read_bytes()).hexdigest() for file in files
    }


def acquire(path: Path, report: Callable[[int, int], Any] = lambda c, b: None) -> None:
    """Acquire: begin or resume, write what is missing, `report` every block, finish."""
    sizes: dict[str, Any] = {"shape": (12, 12), "camera_grid": None, "block_rows": 5, "channels": 3}
    store = BlockStore.open(path) if path.exists() else make(path, **sizes)
    if not store.final:
        fill(store, with_variance=True, final=False, report=report)
        if "response" not in store.extras:
            store.extra("response", np.arange(5.0))
        store.update(finished=True)
    # Or remove what a process that was killed at the very end has left.
    store.finalize(memory=64 * 40)


def in_child(work: Callable[[], None]) -> int:
    """Process id of a child that does `work`, and ends with 0, or with 2 of Ctrl-C."""
    if child := os.fork():
        return child
    try:
        work()
        os._exit(0)
    except KeyboardInterrupt:
        os._exit(2)
    finally:
        os._exit(1)


def status_of(child: int) -> int:
    """0 or the number of the signal, negative."""
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def at_line(number: int, act: Callable[[], None]) -> list[int]:
    """Call `act` at the line of ltcl's code with that number; returns the lines so far, growing."""
    count = [0]

    def line(frame: FrameType, event: str, _: Any) -> Any:
        if event == "line":
            count[0] += 1
            if count[0] == number:
                act()
        return line

    def call(frame: FrameType, event: str, _: Any) -> Any:
        return line if frame.f_code.co_filename.startswith(PACKAGE) else None

    sys.settrace(call)
    return count


def interrupt() -> None:
    """End the process as Ctrl-C does."""
    raise KeyboardInterrupt


def kill() -> None:
    """Without a chance to clean up."""
    os.kill(os.getpid(), signal.SIGKILL)
