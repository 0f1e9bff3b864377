# SPDX-License-Identifier: BSD-3-Clause
"""Finished scans of several projectors as one transport, and what the projectors are fed.

The ambient light of each scan is that of the room and the black of all projectors. Codes stand side
by side, each projector's on its own pixels, by its own response.
"""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.acquisition.calibration import Setup
from ltcl.acquisition.projectors.view import ProjectorView, read_view
from ltcl.acquisition.projectors.warp import MIN_SIDE, Warp
from ltcl.acquisition.radiometry import Response
from ltcl.errors import FileError, InputError
from ltcl.files import as_path, input_file, replace_file
from ltcl.store import BlockStore, load
from ltcl.transport.projectors import CombinedTransport, combine
from ltcl.transport.projectors.montage import Montage

# File beside the store of a scan of one projector of several: its map, and the pixels of T.
FACTS_SUFFIX = ".projector.json"
# End of the name of the file of a map, after the name of the projector.
MAP_SUFFIX = ".map.npz"
# Names of arrays in the file of a combination.
PLACES = "places_{}"
RESPONSE = "response_{}"
NAME = "name_{}"


@dataclass(frozen=True, kw_only=True, eq=False)
class FedProjector:
    """A projector that is fed codes for light on the pixels of its T."""

    warp: Warp
    response: Response
    name: str

    def codes(self, light: np.ndarray) -> np.ndarray:
        """Codes (h, w[, 3]) on its own pixels for light on the pixels of T."""
        return self.warp.enlarged(self.response.codes(self._in_channels(light)))

    def light(self, codes: np.ndarray) -> np.ndarray:
        """Mean light on the pixels of T of codes (h, w[, 3]) on its own pixels."""
        return self.warp.reduced(self.response.linear(self._in_channels(codes)))

    def _in_channels(self, picture: np.ndarray) -> np.ndarray:
        if self.response.channels == 3 and picture.ndim == 2:
            return np.repeat(picture[..., None], 3, axis=-1)
        return picture


@dataclass(frozen=True, kw_only=True, eq=False)
class CombinedSetup:
    """The codes that the projectors of a combination are fed, as `Setup` tells those of one.

    Attributes
    ----------
    projectors : tuple of FedProjector
    channels : 1 or 3
    ambient : (h, w[, 3]), optional
        Light under black projectors, where T is the scan of one alone; a combination has it itself.

    Examples
    --------
    >>> import ltcl
    >>> CombinedSetup.of(ltcl.scenes.dihedral(4).transport()) is None  # no combination of scans
    True
    """

    projectors: tuple[FedProjector, ...]
    channels: int
    ambient: np.ndarray | None = None
    # Several responses: codes are made of light here, not by one curve.
    response = None

    @classmethod
    def of(cls, T: Any) -> CombinedSetup | None:
        """The set-up that `combine_scans` has left in a combination; None for others."""
        arrays = getattr(T, "displays", None)
        if not arrays:
            return None
        projectors = []
        for number, member in enumerate(T.transports):
            names = (PLACES.format(number), RESPONSE.format(number))
            for name in names:
                if name not in arrays:
                    raise FileError(f"array {name!r} is missing")
            places, response = (arrays[name] for name in names)
            _check_places(names[0], places, member.grid)
            # Files of earlier versions have no names.
            name = str(arrays.get(NAME.format(number), f"projector {number + 1}"))
            projectors.append(
                FedProjector(warp=Warp(places, member.grid), response=Response(response), name=name)
            )
        return cls(projectors=tuple(projectors), channels=T.channels)

    @classmethod
    def of_scan(cls, path: str | os.PathLike[str]) -> CombinedSetup | None:
        """The set-up of one of several projectors alone, by its store; None for other stores."""
        store = as_path(path)
        if not has_facts(store):
            return None
        setup = Setup.of(store)
        facts = read_facts(store)
        projector = FedProjector(
            warp=Warp.of(facts.view().mapping, facts.side),
            response=setup.calibration.projector,
            name=facts.name,
        )
        return cls(projectors=(projector,), channels=setup.channels, ambient=setup.ambient)

    @property
    def names(self) -> tuple[str, ...]:
        """The name of each projector."""
        return tuple(projector.name for projector in self.projectors)

    @cached_property
    def light_montage(self) -> Montage:
        """The places of light, on the pixels of T."""
        grids = [projector.warp.grid for projector in self.projectors]
        return Montage(tuple(grids))

    @cached_property
    def montage(self) -> Montage:
        """The places of codes, on the pixels of the projectors."""
        grids = [projector.warp.pixels for projector in self.projectors]
        return Montage(tuple(grids))

    @property
    def grid(self) -> tuple[int, int]:
        """(h, w) of the transport."""
        return self.light_montage.grid

    @property
    def pixels(self) -> tuple[int, int]:
        """(h, w) of the codes of all projectors side by side."""
        return self.montage.grid

    def codes(self, pattern: Any) -> np.ndarray:
        """Codes, float32 on the projectors' pixels side by side, for light (h, w[, 3]).

        The light is relative to white, and clipped to [0, 1].
        """
        values = checks.finite("pattern", checks.real("pattern", pattern)).astype(np.float32)
        light = np.clip(values, 0.0, 1.0)
        shares = self.light_montage.split(light)
        codes = []
        for projector, share in zip(self.projectors, shares, strict=True):
            codes.append(projector.codes(share))
        return self.montage.join(codes)

    def light(self, codes: Any) -> np.ndarray:
        """Light (h, w[, 3]), relative to white, of codes in [0, 1] on the projectors' pixels."""
        values = checks.finite("codes", checks.real("codes", codes)).astype(np.float32)
        lights = []
        for projector, own in zip(self.projectors, self.montage.split(values), strict=True):
            lights.append(projector.light(own))
        return self.light_montage.join(lights)


def _check_places(name: str, places: np.ndarray, grid: tuple[int, int]) -> None:
    is_map = places.ndim == 2 and places.dtype.kind in "iu" and places.size > 0
    if not is_map or places.min() < -1 or places.max() >= grid[0] * grid[1]:
        raise FileError(f"array {name!r} is no map to {grid[0]} x {grid[1]} pixels")


def facts_path(store: Path) -> Path:
    """File beside the store of a scan of one of several projectors."""
    if store.name in ("", ".."):
        store = store.resolve()
    return store.with_suffix(FACTS_SUFFIX)


def has_facts(store: Path) -> bool:
    """True if this is the store of a scan of one of several projectors, with its facts beside."""
    return store.is_dir() and facts_path(store).exists()


def write_facts(store: Path, *, view: Path, side: int) -> None:
    """Keep how the pixels of T belong to those of the projector: its map, and their side."""
    name = view.name if _is_beside(view, store) else str(view.resolve())
    with replace_file(facts_path(store)) as temporary:
        temporary.write_text(json.dumps({"map": name, "side": side}) + "\n", encoding="utf-8")


def _is_beside(view: Path, store: Path) -> bool:
    return view.resolve().parent == store.resolve().parent


@dataclass(frozen=True, kw_only=True, eq=False)
class ScanFacts:
    """How the pixels of T belong to those of one of several projectors.

    Attributes
    ----------
    path : Path
        File of the map.
    side : int
        Camera pixels along a side of a pixel of T.
    """

    path: Path
    side: int

    @property
    def name(self) -> str:
        """The name of the projector."""
        return self.path.name.removesuffix(MAP_SUFFIX)

    def view(self) -> ProjectorView:
        """Read the map."""
        return read_view(self.path)


def read_facts(store: Path) -> ScanFacts:
    """Read the facts that `write_facts` has kept; FileError if they are damaged."""
    path = facts_path(store)
    try:
        facts = json.loads(input_file(path).read_text(encoding="utf-8"))
        view = path.parent / str(facts["map"])
        side = checks.count("side", facts["side"], least=MIN_SIDE)
    except (ValueError, KeyError, TypeError, InputError) as error:
        raise FileError(f"{path}: is damaged: {error}") from None
    return ScanFacts(path=view, side=side)


def combine_scans(
    stores: Sequence[str | os.PathLike[str]],
    *,
    device: Any = None,
    **options: Any,
) -> CombinedTransport:
    """Combine the scans of a folder with several projectors; `ltcl combine` does.

    Parameters
    ----------
    stores : sequence of paths
        Stores that `ltcl acquire run` made of an acquisition.toml with several [[projector]].
    device : Device or str, optional
        As in `ltcl.combine`.
    **options
        ``blend``, ``balance`` and ``black`` of `ltcl.combine`. Black is that of the scans, with the
        ambient light.

    Returns
    -------
    CombinedTransport
        Its file keeps what the projectors are fed.

    Raises
    ------
    FileError, InputError
        A store is not finished, or not of such a scan; those of `ltcl.combine`.

    Examples
    --------
    >>> combine_scans(["left.zarr", "right.zarr"])
    Traceback (most recent call last):
    ltcl.errors.FileError: left.zarr: no such folder
    """
    members = []
    displays: dict[str, np.ndarray] = {}
    ambient = []
    for number, path in enumerate(as_path(store) for store in stores):
        store = BlockStore.open(path)
        if not store.final or not has_facts(path):
            raise InputError(
                f"{path}: is no finished scan of one of several projectors, as 'ltcl acquire run' "
                "makes of an acquisition.toml with [[projector]]"
            )
        setup = Setup.of(store)
        facts = read_facts(path)
        warp = Warp.of(facts.view().mapping, facts.side)
        displays[NAME.format(number)] = np.array(facts.name)
        displays[PLACES.format(number)] = warp.places
        displays[RESPONSE.format(number)] = setup.calibration.projector.values
        ambient.append(setup.ambient)
        members.append(load(path, on_dark="mask", device=device))
    shapes = [np.shape(picture) for picture in ambient]
    if len(set(shapes)) == 1:
        black = np.mean(ambient, axis=0)
        options["blacks"] = [black, *[np.zeros_like(black)] * (len(members) - 1)]
    T = combine(members, device=device, **options)
    T.displays = displays
    return T
