# SPDX-License-Identifier: BSD-3-Clause
"""zarr.json documents that carry their own SHA-256: any changed byte shows, in the sum or in what it covers.

The sum stands first in the attributes and is that of the same bytes with zeros in its place.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from typing import Any

from ltcl.errors import FileError, InputError

LARGEST = 1 << 26  # bytes of a document: one line for each of a million blocks
_START = b'{"attributes": {"checksum": "'
_UNSEALED = b"0" * 64


def seal(attributes: Mapping[str, Any], node: Mapping[str, Any]) -> bytes:
    """A zarr.json of `node` with `attributes` and their checksum.

    Raises
    ------
    InputError
        The attributes are not plain JSON, or larger than `LARGEST`.

    Examples
    --------
    >>> unseal(seal({"answer": 42}, {"node_type": "group"}), "zarr.json")["attributes"]["answer"]
    42
    """
    whole = {"attributes": {"checksum": _UNSEALED.decode(), **attributes}, **node}
    try:
        raw = json.dumps(whole, allow_nan=False).encode()
    except (TypeError, ValueError, RecursionError) as error:
        raise InputError(f"attributes are not plain JSON: {str(error)!a:.150}") from None
    if len(raw) > LARGEST:
        raise InputError(f"attributes take {len(raw)} bytes; at most {LARGEST} can be kept")
    return raw.replace(_UNSEALED, _sum(raw), 1)


def unseal(raw: bytes, name: str) -> dict[str, Any]:
    """The document in `raw`, a file called `name`; refused if a byte of it has changed."""
    start, stop = len(_START), len(_START) + len(_UNSEALED)
    if not raw.startswith(_START):
        raise FileError(f"{name} is damaged, or not written by ltcl: it begins with {raw[:30]!r}")
    if _sum(raw[:start] + _UNSEALED + raw[stop:]) != raw[start:stop]:
        raise FileError(f"{name} is damaged: its checksum is not that of its bytes")
    try:
        return json.loads(raw)
    except (ValueError, RecursionError):
        raise FileError(f"{name} is no JSON") from None


def checksum(raw: bytes) -> str:
    """The sum that a sealed document carries."""
    return raw[len(_START) : len(_START) + len(_UNSEALED)].decode()


def _sum(raw: bytes) -> bytes:
    return hashlib.sha256(raw).hexdigest().encode()
