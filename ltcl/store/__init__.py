# SPDX-License-Identifier: BSD-3-Clause
"""Transports on disk: .npz, .npy, .mtx, .h5, .mat and .zarr, whose declared sizes are checked; no pickles."""

from ltcl.store.block_store import ArrayLog, BlockStore
from ltcl.store.formats import load, load_inverse, save, save_inverse
from ltcl.store.record import Parts, Record, StoredRows

__all__ = ["ArrayLog", "BlockStore", "Parts", "Record", "StoredRows"]
__all__ += ["load", "load_inverse", "save", "save_inverse"]
