# SPDX-License-Identifier: BSD-3-Clause
"""Transports on disk: load one from, and save one to, .npz, .npy, .mtx, .h5, .mat and .zarr.

Everything that a file declares is checked before memory is taken for it; pickles are never loaded.
"""

from ltcl.store.block_store import ArrayLog, BlockStore
from ltcl.store.formats import load, load_inverse, save, save_inverse
from ltcl.store.record import Parts, Record, StoredRows

__all__ = ["ArrayLog", "BlockStore", "Parts", "Record", "StoredRows"]
__all__ += ["load", "load_inverse", "save", "save_inverse"]
