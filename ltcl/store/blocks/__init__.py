# SPDX-License-Identifier: BSD-3-Clause
"""Stores: transports on disk that grow block by block, as zarr 3 groups.

block_store     `BlockStore`: create, open, write, read, finalize, verify
rows            `StoredRows`: one channel as a matrix that is never loaded whole
layout          sizes and how T is cut; creating, finishing, turning, verifying: what its name says
shelf           `Shelf`: arrays that are kept for a while, and taken away as a whole
aside           folders that appear whole or not at all, whatever ends the process
entries, extras, nodes, sealed      a block, a small array, a zarr array, a document with its checksum
"""

from ltcl.store.blocks.block_store import BlockStore
from ltcl.store.blocks.layout import Layout
from ltcl.store.blocks.rows import StoredRows

__all__ = ["BlockStore", "Layout", "StoredRows"]
