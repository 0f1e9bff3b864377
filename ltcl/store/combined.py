# SPDX-License-Identifier: BSD-3-Clause
"""The record of several projectors: that of each T_k, and how they share their light.

In a file the arrays of projector k have names that begin with ``projector_k.``, those of S between
camera pixels, where it was given, ``scene.``; weights and blacks of the caller are ``blend_k`` and
``blacks``; what is known of the projectors of scans begins with ``display_``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ltcl.errors import FileError, InputTypeError
from ltcl.store.record import CompressedRecord, StoreRecord
from ltcl.transport.projectors import CombinedTransport, combine
from ltcl.transport.projectors.montage import Montage
from ltcl.transport.transport import Transport

COMBINED_FORMAT = "ltcl-combined-1"
# Beginning of the names of `CombinedTransport.displays`.
DISPLAY = "display_"


@dataclass(frozen=True, kw_only=True, eq=False)
class CombinedRecord:
    """Contents of a file of several projectors.

    Attributes
    ----------
    members : tuple of StoreRecord
    scene : StoreRecord or CompressedRecord, optional
    settings : mapping of arrays
        ``balance``, ``blend`` and ``black`` as text, ``blend_k`` and ``blacks``.
    """

    members: tuple[StoreRecord, ...]
    scene: StoreRecord | CompressedRecord | None
    settings: Mapping[str, np.ndarray]

    first_bounce = None
    mixing = None
    noise = None

    def __post_init__(self) -> None:
        if not self.members:
            raise FileError("is of several projectors, but holds none")
        for number, member in enumerate(self.members):
            if member.grid is None or member.camera_grid is None:
                raise FileError(f"projector_{number} has no grid, or no camera_grid")

    @property
    def grid(self) -> tuple[int, int]:
        """Pixels of all patterns side by side."""
        grids = [member.grid or (1, 1) for member in self.members]
        return Montage(tuple(grids)).grid

    @property
    def camera_grid(self) -> tuple[int, int]:
        """Pixels of the camera."""
        return self.members[0].camera_grid or (1, 1)

    @property
    def shape(self) -> tuple[int, int]:
        """(M, N): camera pixels, and pixels of all patterns side by side."""
        height, width = self.grid
        return self.members[0].shape[0], height * width


def combined_record(T: CombinedTransport) -> CombinedRecord:
    """The record of a combination."""
    members = []
    for number, member in enumerate(T.transports):
        record = _record(f"transports[{number}]", member)
        if not isinstance(record, StoreRecord):
            raise InputTypeError(f"transports[{number}] is compressed; only matrices are stored")
        members.append(record)
    settings: dict[str, np.ndarray] = {
        "balance": np.array(T.balance),
        "black": np.array(T.black),
    }
    if isinstance(T.blend, str):
        settings["blend"] = np.array(T.blend)
    else:
        for number, weights in enumerate(T.blend):
            settings[f"blend_{number}"] = np.asarray(weights, np.float64)
    if T.blacks is not None:
        settings["blacks"] = np.stack(T.black_pictures())
    for name, array in T.displays.items():
        settings[f"{DISPLAY}{name}"] = array
    scene = None
    if T.given_scene is not None:
        scene = _record("scene", T.given_scene)
    return CombinedRecord(members=tuple(members), scene=scene, settings=settings)


def _record(name: str, T: Transport) -> StoreRecord | CompressedRecord:
    matrices = []
    for matrix in T.matrices:
        stored = matrix.tocsr() if hasattr(matrix, "row_blocks") else matrix
        matrices.append(stored)
    if not all(hasattr(matrix, "dtype") and hasattr(matrix, "max") for matrix in matrices):
        if T.is_square:
            return CompressedRecord(T.to_arrays())
        raise InputTypeError(f"{name} shows no entries; only arrays and sparse matrices are stored")
    first_bounce = None
    if T.is_square:
        first_bounce = T.first_bounce
    return StoreRecord(
        matrices=tuple(matrices),
        grid=T.grid,
        camera_grid=T.camera_grid,
        first_bounce=first_bounce,
        mixing=T.mixing,
        noise=T.measured_noise,
    )


def combined_transport(record: CombinedRecord, device: Any) -> CombinedTransport:
    """The combination of a record, on a device that is opened at its first use."""
    scene = None
    if isinstance(record.scene, CompressedRecord):
        scene = Transport.from_arrays(record.scene.arrays, device=device)
    elif record.scene is not None:
        scene = _transport(record.scene, device)
    settings = record.settings
    blend: Any = str(settings["blend"]) if "blend" in settings else []
    if not isinstance(blend, str):
        for number in range(len(record.members)):
            if f"blend_{number}" not in settings:
                raise FileError(f"array 'blend_{number}' is missing")
            blend.append(settings[f"blend_{number}"])
    T = combine(
        [_transport(member, device) for member in record.members],
        blend=blend,
        balance=float(settings["balance"]),
        blacks=settings.get("blacks"),
        black=str(settings["black"]),
        scene=scene,
        device=device,
    )
    for name, array in settings.items():
        if name.startswith(DISPLAY):
            T.displays[name.removeprefix(DISPLAY)] = array
    return T


def _transport(record: StoreRecord, device: Any) -> Transport:
    first_bounce: Any = record.first_bounce
    return Transport(
        record.matrices,
        record.grid or (1, 1),
        "diagonal" if first_bounce is None else first_bounce,
        camera_grid=record.camera_grid,
        device=device,
        mixing=record.mixing,
        noise=record.noise,
    )
