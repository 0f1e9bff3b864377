# SPDX-License-Identifier: BSD-3-Clause
"""Transports on disk: .npz, .npy, .mtx, .h5, .mat and .zarr, of checked sizes, without pickles."""

from ltcl.store.array_log import ArrayLog
from ltcl.store.block_store import BlockStore
from ltcl.store.combined import CombinedRecord
from ltcl.store.formats import load, load_inverse, save, save_inverse
from ltcl.store.record import CompressedRecord, StoredRows, StoreRecord

__all__ = [
    "ArrayLog",
    "BlockStore",
    "CombinedRecord",
    "CompressedRecord",
    "StoreRecord",
    "StoredRows",
    "load",
    "load_inverse",
    "save",
    "save_inverse",
]
