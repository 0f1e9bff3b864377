# SPDX-License-Identifier: BSD-3-Clause
"""`Rig`: what a set-up of projector and camera must offer. `Shots`: the one way the package uses it.

`Shots` checks what goes into a rig and what comes back, counts the photographs, and scales their codes:
    value = code / full scale,    full scale = 2^bits - 1 of an integer camera, 1 of a float one.
"""

from __future__ import annotations

import importlib
import math
from collections.abc import Iterable
from typing import Any, Protocol

import cv2
import numpy as np

from ltcl import checks
from ltcl.errors import AcquisitionError, InputError, InputTypeError, LtclError

SHORTEST, LONGEST = 1e-4, 30.0
"""Seconds that a rig without `exposures` must be able to expose for."""
_SAME = 1e-3  # relative difference of exposures that no camera keeps apart
_CELLS = 8  # a side, of the digest of a photograph


class Rig(Protocol):
    """A projector and a camera that looks at what it lights.

    Nothing else is needed. Used where a rig has it: `exposures`, the seconds the camera offers, ascending
    (else any from 1e-4 to 30); `bits` in use in a uint16 image (else 16); `prepare(shots)`, called with the
    (codes, seconds) that come next; `describe()`, a dict of plain JSON for the records, which must be equal
    when a scan is resumed (but for what is measured anew, such as "survey"); `recall(codes, seconds, image)`,
    called with a photograph of an earlier session in place of `photograph`; `keeps_photographs`, whether it
    stores them itself; `number` of the last photograph and `file_name(number)`, for messages; `close()`.
    """

    @property
    def projector_grid(self) -> tuple[int, int]:
        """(h, w) of the projector's pixels."""
        ...

    @property
    def channels(self) -> int:
        """1 for grey, 3 for RGB: of the codes that go in and of the photographs that come back."""
        ...

    def photograph(self, codes: np.ndarray, seconds: float) -> np.ndarray:
        """What the camera gives after `seconds` of light under `codes`, (h, w) or (h, w, 3) in [0, 1].

        Returns uint8, uint16 or float of (H, W) or (H, W, 3), always the same; full scale of a float is 1.
        """
        ...


class Shots:
    """Photographs of a rig: checked, counted, float32 in [0, 1] of full scale.

    InputTypeError for a rig that lacks a member, InputError where one cannot be used.

    Attributes
    ----------
    grid : (h, w)
        Of the projector.
    channels : 1 or 3
    exposures : tuple of float, or None
        The seconds that the camera offers, ascending; None: any from 1e-4 to 30.
    count : int
        Photographs taken.
    camera_grid, levels : (H, W), int
        Of the camera, 256 of 8 bits; None before the first photograph, levels also of a float camera.
    digest : dict
        Of the first photograph under "black" and under "white": its seconds, and means over 8 x 8 cells.
    keeper : object or None
        With find(codes, seconds), asked before the rig is, and add(codes, seconds, image).
    record : object or None
        With add(codes, seconds, photograph, number), called after each photograph.

    Examples
    --------
    >>> from ltcl.acquisition import VirtualRig
    >>> shots = Shots(VirtualRig(np.eye(2) / 2, grid=(1, 2), gain=None, read=0, black=0, response="linear"))
    >>> shots.photograph([[0, 1]], seconds=1).round(2)
    array([[0. , 0.5]], dtype=float32)
    >>> shots.count, shots.camera_grid, shots.levels
    (1, (1, 2), 256)
    """

    def __init__(self, rig: Rig) -> None:
        require_members("rig", rig, "projector_grid", "channels", "photograph")
        self.rig = rig
        self.grid = checks.grid("rig.projector_grid", rig.projector_grid)
        self.channels = checks.one_of("rig.channels", rig.channels, (1, 3))
        self.exposures = _exposures(getattr(rig, "exposures", None))
        self.count = 0
        self.digest: dict[str, dict[str, Any]] = {}
        self.keeper: Any = None
        self.record: Any = None
        self.asking = False
        self._kind: tuple[tuple[int, ...], np.dtype] | None = None

    @property
    def number(self) -> int:
        """Of the last photograph: the rig's own where it has one, else `count`."""
        return getattr(self.rig, "number", self.count)

    @property
    def camera_grid(self) -> tuple[int, int] | None:
        """(H, W) of the photographs; None before the first."""
        return None if self._kind is None else (self._kind[0][0], self._kind[0][1])

    @property
    def levels(self) -> int | None:
        """How many codes there are; None of a float camera, or before the first photograph."""
        largest = None if self._kind is None else _largest(self.rig, self._kind[1])
        return None if largest is None else largest + 1

    def name(self, number: int) -> str:
        """What messages call a photograph: its number, and its file where the rig has one."""
        file = getattr(self.rig, "file_name", lambda _: None)(number)
        return f"photograph {number}" if file is None else f"photograph {number} ({file})"

    def prepare(self, shots: Iterable[tuple[Any, float]]) -> None:
        """Announce the (codes, seconds) that come next, in order, to a rig that writes lists for a person."""
        announce = getattr(self.rig, "prepare", None)
        if announce is not None:
            announce((as_codes(x, self.grid, self.channels), self._seconds(s)) for x, s in shots)

    def photograph(self, codes: Any, seconds: float) -> np.ndarray:
        """One photograph, codes over full scale: float32, (H, W) or (H, W, 3).

        Parameters
        ----------
        codes : (h, w), or (h, w, 3) of a rig with three channels
            What the projector is fed, in [0, 1]; (h, w) feeds all its channels alike.
        seconds : float
            Of exposure; one of `exposures` where the rig has them.

        Raises
        ------
        InputError, InputTypeError
            Codes of another shape or outside [0, 1], seconds that the camera does not have.
        AcquisitionError
            The rig failed, or returned an unusable image or one unlike the first; its number is named.
            `PhotographMissing` where a person has yet to take it.
        """
        codes, seconds = as_codes(codes, self.grid, self.channels), self._seconds(seconds)
        self.asking = True
        known = None if self.keeper is None else self.keeper.find(codes, seconds)
        image = self._from_rig(codes, seconds) if known is None else known
        scaled = self._scaled(self.name(getattr(self.rig, "number", self.count + 1)), image)
        if known is None and self.keeper is not None:
            self.keeper.add(codes, seconds, np.asarray(image))
        self.asking = False
        self.count += 1
        if len(self.digest) < 2:
            self._summarize(codes, seconds, scaled)
        if self.record is not None:
            self.record.add(codes, seconds, scaled, self.number)
        return scaled

    def describe(self) -> dict[str, Any]:
        """Plain JSON for the records: what the rig says of itself, the grids, and the photographs so far."""
        describe = getattr(self.rig, "describe", None)
        return {
            "rig": {"kind": type(self.rig).__name__} if describe is None else describe(),
            "projector_grid": list(self.grid),
            "camera_grid": None if self.camera_grid is None else list(self.camera_grid),
            "channels": self.channels,
            "levels": self.levels,
            "digest": self.digest,
            "photographs": self.count,
        }

    def close(self) -> None:
        """Close the rig, where it can be closed."""
        getattr(self.rig, "close", lambda: None)()

    def __enter__(self) -> Shots:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _from_rig(self, codes: np.ndarray, seconds: float) -> Any:
        try:
            return self.rig.photograph(codes, seconds)
        except LtclError:
            raise
        except Exception as error:
            reason = " ".join(f"{type(error).__name__}: {error}".split())
            raise AcquisitionError(f"photograph {self.count + 1}: the rig failed with {reason}") from error

    def _seconds(self, seconds: Any) -> float:
        seconds = as_seconds(seconds)
        if self.exposures is None:
            return checks.number("seconds", seconds, least=SHORTEST, most=LONGEST)
        return exact("seconds", seconds, self.exposures)

    def _scaled(self, name: str, image: Any) -> np.ndarray:
        """The image over full scale; the first good one sets shape and type of all."""
        if image is None:
            raise AcquisitionError(f"{name} is None; it must be an image")
        image = np.asarray(image)
        check_photograph(name, image, self.channels, self._kind)
        scaled = to_unit(name, image, self.rig)
        self._kind = image.shape, image.dtype
        return scaled

    def _summarize(self, codes: np.ndarray, seconds: float, image: np.ndarray) -> None:
        for name, code in (("black", 0.0), ("white", 1.0)):
            if name not in self.digest and np.all(codes == code):
                size = min(_CELLS, image.shape[1]), min(_CELLS, image.shape[0])
                cells = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
                self.digest[name] = {"seconds": seconds, "cells": cells.astype(float).round(5).tolist()}


def nearest(exposures: Iterable[float] | None, seconds: float) -> float:
    """The exposure of a camera whose ratio to `seconds` is nearest to 1; None: it has any from 1e-4 to 30.

    >>> nearest((0.1, 1.0), 0.3), nearest((0.1, 1.0), 0.4), nearest(None, 50.0)
    (0.1, 1.0, 30.0)
    """
    if exposures is None:
        return float(min(max(seconds, SHORTEST), LONGEST))
    return min(exposures, key=lambda offered: abs(math.log(offered / seconds)))


def exact(name: str, seconds: float, exposures: Iterable[float]) -> float:
    """The exposure that equals `seconds` to 0.1 %; InputError where the rig has none."""
    offered = nearest(exposures, seconds)
    if not math.isclose(offered, seconds, rel_tol=_SAME):
        raise InputError(f"{name} is {seconds:g}; it must be an exposure, the nearest is {offered:g}")
    return offered


def as_codes(codes: Any, grid: tuple[int, int], channels: int) -> np.ndarray:
    """`codes` as contiguous float32 (h, w) or (h, w, 3); InputError for another shape or outside [0, 1]."""
    array = checks.real("codes", codes)
    checks.shape("codes", array, *([grid] if channels == 1 else [grid, (*grid, 3)]))
    checks.finite("codes", array)
    if array.min() < 0 or array.max() > 1:
        raise InputError(f"codes reach from {array.min():g} to {array.max():g}; they must be in [0, 1]")
    return np.ascontiguousarray(array, dtype=np.float32)


def as_seconds(seconds: Any) -> float:
    """`seconds` as a positive float."""
    return checks.number("seconds", seconds, above=0.0)


def require_members(name: str, value: Any, *members: str) -> None:
    """Refuse an object without one of the members."""
    missing = [member for member in members if not hasattr(value, member)]
    if missing:
        raise InputTypeError(f"{name} is a {type(value).__name__} without {', '.join(missing)}")


def check_photograph(
    name: str, image: np.ndarray, channels: int, first: tuple[tuple[int, ...], np.dtype] | None = None
) -> None:
    """Refuse what is no photograph of so many channels, or another shape and type than the `first`."""
    if image.dtype not in (np.uint8, np.uint16) and image.dtype.kind != "f":
        raise AcquisitionError(f"{name} holds {image.dtype}; it must hold uint8, uint16 or float")
    if image.ndim < 2 or image.shape[2:] != (() if channels == 1 else (3,)) or image.size == 0:
        expected = "(H, W)" if channels == 1 else "(H, W, 3)"
        raise AcquisitionError(f"{name} has shape {image.shape}; it must be {expected}, not empty")
    if first is not None and first != (image.shape, image.dtype):
        expected = f"{first[1]} {first[0]}, as the first was"
        raise AcquisitionError(f"{name} is {image.dtype} {image.shape}; it must be {expected}")


def load_extra(module: str, extra: str, what: str, instead: str = "") -> Any:
    """Import `module`, which `what` needs, of an extra of ltcl; AcquisitionError tells how to install it."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        missing = isinstance(error, ModuleNotFoundError)
        fault = "is not installed" if missing else f"cannot be loaded ({' '.join(str(error).split())})"
        raise AcquisitionError(
            f'{what} needs {module}, which {fault}; install it with pip install "ltcl[{extra}]"{instead}'
        ) from None


def to_unit(name: str, image: np.ndarray, source: Any) -> np.ndarray:
    """A photograph of a rig or a camera as float32, codes over full scale.

    AcquisitionError where it exceeds the `bits` of `source`, or is not finite.

    >>> to_unit("photograph 1", np.array([[0, 51, 255]], np.uint8), None).round(2)
    array([[0. , 0.2, 1. ]], dtype=float32)
    """
    largest = _largest(source, image.dtype)
    if largest is None:
        with np.errstate(over="ignore"):
            scaled = image.astype(np.float32, copy=False)
        if bad := int(np.count_nonzero(~np.isfinite(scaled))):
            raise AcquisitionError(f"{name} has {bad} NaN or infinite value(s); all must be finite")
        return scaled
    if image.max() > largest:
        raise AcquisitionError(f"{name} reaches {image.max()}; by rig.bits the largest code is {largest}")
    return image * np.float32(1.0 / largest)


def _largest(rig: Any, dtype: np.dtype) -> int | None:
    if dtype.kind == "f":
        return None
    if dtype == np.uint8:
        return 255
    bits = getattr(rig, "bits", None)
    return (1 << (16 if bits is None else checks.count("rig.bits", bits, least=9, most=16))) - 1


def _exposures(value: Any) -> tuple[float, ...] | None:
    if value is None:
        return None
    offered = checks.finite("rig.exposures", checks.real("rig.exposures", value))
    if offered.ndim != 1 or offered.size == 0 or offered[0] <= 0 or np.any(np.diff(offered) <= 0):
        raise InputError(f"rig.exposures is {value!r}; it must be positive seconds in ascending order")
    return tuple(float(seconds) for seconds in offered)
