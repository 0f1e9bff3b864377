# SPDX-License-Identifier: BSD-3-Clause
"""The zarr.json of a store: a zarr group whose attributes are sealed by a checksum.

The checksum is the SHA-256 of the same bytes with zeros in its place.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

from ltcl.errors import FileError, InputError
from ltcl.files import input_file, replace_file
from ltcl.store.layout import StoreLayout

BEGINNING = b'{"attributes": {"checksum": "'
UNSEALED = b"0" * 64


def write_document(
    root: Path, layout: StoreLayout, provenance: Any, state: Any, **files: Any
) -> None:
    """Seal and write the zarr.json of a store; `files` has the SHA-256 of the files of a final one."""
    attributes = {
        "checksum": UNSEALED.decode(),
        "ltcl": asdict(layout),
        "provenance": provenance,
        "state": state,
        **files,
    }
    group = {"attributes": attributes, "zarr_format": 3, "node_type": "group"}
    try:
        raw = json.dumps(group, allow_nan=False).encode()
    except (TypeError, ValueError) as error:
        raise InputError(f"attributes are not plain JSON: {str(error)!a:.150}") from None
    checksum = hashlib.sha256(raw).hexdigest().encode()
    with replace_file(root / "zarr.json") as temporary:
        temporary.write_bytes(raw.replace(UNSEALED, checksum, 1))


def read_document(file: Path) -> dict[str, Any]:
    """The attributes in a zarr.json; FileError if a byte of it has changed."""
    raw = input_file(file).read_bytes()
    after_checksum = raw[len(BEGINNING) + len(UNSEALED) :]
    unsealed = BEGINNING + UNSEALED + after_checksum
    checksum = hashlib.sha256(unsealed).hexdigest().encode()
    if not raw.startswith(BEGINNING + checksum):
        raise FileError(f"{file.name} is damaged, or not written by ltcl: its checksum differs")
    return json.loads(raw)["attributes"]


def is_store(folder: Path) -> bool:
    """True if a folder holds a store of ltcl, damaged or not."""
    document = folder / "zarr.json"
    return document.is_file() and document.read_bytes().startswith(BEGINNING)
