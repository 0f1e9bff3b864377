# SPDX-License-Identifier: BSD-3-Clause
"""`Rig`: what a set-up of projector and camera must offer. `Shots`: the one way the package uses it.

`Shots` checks what goes into a rig and what comes back, counts the photographs, and scales their codes:
    value = code / full scale,    full scale = 2^bits - 1 of an integer camera, 1 of a float one.
`shot_key` and `fingerprint` recognize photographs and matrices in a later run.
"""

from __future__ import annotations

import contextlib
import hashlib
import importlib
import math
from collections.abc import Iterable, Iterator
from typing import Any, Protocol

import cv2
import numpy as np
import scipy.sparse

from ltcl import checks
from ltcl.errors import AcquisitionError, InputError, InputTypeError, LtclError

SHORTEST, LONGEST = 1e-4, 30.0  # seconds that a rig without `exposures` must be able to expose for
_SAME = 1e-3  # relative difference of exposures that no camera distinguishes
_CELLS = 8  # along a side of the digest of a photograph
_Kind = tuple[tuple[int, ...], np.dtype]  # shape and type of a photograph


class Rig(Protocol):
    """A projector, (h, w), and a camera that looks at what it lights; `channels` are 1 for grey, 3 for RGB.

    Nothing else is needed. Used where a rig has it: `exposures`, the seconds the camera offers, ascending
    (else any from 1e-4 to 30); `bits` in use in a uint16 image (else 16); `prepare(shots)`, called with the
    (codes, seconds) that come next; `describe()`, a dict of plain JSON for the records, which must be equal
    when a scan is resumed (but for what is measured anew, such as "survey"); `recall(codes, seconds, image)`,
    called with a photograph of an earlier session in place of `photograph`; `keeps_photographs`, whether it
    stores them itself; `number` of the last photograph and `file_name(number)`, for messages; `close()`.
    """

    projector_grid: tuple[int, int]
    channels: int

    def photograph(self, codes: np.ndarray, seconds: float) -> np.ndarray:
        """What the camera gives after `seconds` of light under `codes`, (h, w) or (h, w, 3) in [0, 1].

        Returns uint8, uint16 or float of (H, W) or (H, W, 3), always the same; full scale of a float is 1.
        """
        ...


class Closing(contextlib.AbstractContextManager):
    """What `close` gives back, a `with` closes."""

    def close(self) -> None:
        """Give back what was opened."""

    def __exit__(self, *_: object) -> None:
        self.close()

    @contextlib.contextmanager
    def _closed_on_error(self) -> Iterator[None]:
        try:
            yield
        except BaseException:
            self.close()
            raise


class Shots(Closing):
    """Photographs of a rig: checked, counted, float32 in [0, 1] of full scale.

    InputTypeError for a rig that lacks a member, InputError where one cannot be used. `exposures` are None
    for any from 1e-4 to 30 s; `count` is of the photographs. After the first of them there are `camera_grid`,
    `levels` (256 of 8 bits, None of floats), and `digest`: of the first under "black" and "white" the
    seconds, and means over 8 x 8 cells. `image` is the last as the rig gave it.

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
        self.exposures: tuple[float, ...] | None = None
        if (offered := getattr(rig, "exposures", None)) is not None:
            seconds = checks.finite("rig.exposures", checks.real("rig.exposures", offered))
            if seconds.ndim != 1 or seconds.size == 0 or seconds[0] <= 0 or np.any(np.diff(seconds) <= 0):
                raise InputError(f"rig.exposures is {offered!r}; it must be positive seconds, ascending")
            self.exposures = tuple(map(float, seconds))
        self.count = 0
        self.camera_grid: tuple[int, int] | None = None
        self.levels: int | None = None
        self.expected: tuple[Any, Any] | None = None  # these two, of the scan that is resumed
        self.digest: dict[str, dict[str, Any]] = {}
        self.image = np.zeros((0, 0))
        self._first: _Kind | None = None

    @property
    def number(self) -> int:
        """Of the last photograph: the rig's own where it has one, else `count`."""
        return getattr(self.rig, "number", self.count)

    def name(self, number: int) -> str:
        """What messages call a photograph: its number, and its file where the rig has one."""
        file = getattr(self.rig, "file_name", lambda _: None)(number)
        return f"photograph {number}" if file is None else f"photograph {number} ({file})"

    def prepare(self, shots: Iterable[tuple[Any, float]]) -> None:
        """Announce the (codes, seconds) that come next, in order, to a rig that writes lists for a person."""
        announce = getattr(self.rig, "prepare", None)
        if announce is not None:
            announce(self._request(*shot) for shot in shots)

    def photograph(self, codes: Any, seconds: float, stored: Any = None) -> np.ndarray:
        """One photograph, codes over full scale: float32, (H, W) or (H, W, 3).

        `codes` are (h, w), for all channels of the projector alike, or (h, w, 3), in [0, 1]; `stored` is the
        image of an earlier run, in place of a new one. InputError for others, or seconds that the camera does
        not have; AcquisitionError, with the number, where the rig fails, or returns an unusable image or one
        unlike the first.
        """
        codes, seconds = self._request(codes, seconds)
        if stored is not None:
            getattr(self.rig, "recall", lambda *_: None)(codes, seconds, stored)
        try:
            self.image = image = np.asarray(self.rig.photograph(codes, seconds) if stored is None else stored)
        except LtclError:
            raise
        except Exception as error:
            reason = " ".join(f"{type(error).__name__}: {error}".split())
            raise AcquisitionError(f"photograph {self.count + 1}: the rig failed with {reason}") from error
        name = self.name(getattr(self.rig, "number", self.count + 1))
        scaled = to_unit(name, image, self.rig, self._first)
        self._first = image.shape, image.dtype
        self.camera_grid, self.levels = (image.shape[0], image.shape[1]), _levels(image.dtype, self.rig)
        if self.expected not in (None, (self.camera_grid, self.levels)):
            raise InputError(
                f"{name} has {self.camera_grid} pixels and {self.levels} levels; the scan was begun with "
                f"{self.expected[0]} and {self.expected[1]}: it must be that camera, or another store"
            )
        self.count += 1
        for view, code in (("black", 0.0), ("white", 1.0)):
            if view not in self.digest and np.all(codes == code):
                size = min(_CELLS, image.shape[1]), min(_CELLS, image.shape[0])
                cells = cv2.resize(scaled, size, interpolation=cv2.INTER_AREA)
                self.digest[view] = {"seconds": seconds, "cells": cells.astype(float).round(5).tolist()}
        return scaled

    def describe(self) -> dict[str, Any]:
        """Plain JSON for the records: what the rig says of itself, the grids, and the photographs so far."""
        return {
            "rig": getattr(self.rig, "describe", lambda: {"kind": type(self.rig).__name__})(),
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

    def _request(self, codes: Any, seconds: float) -> tuple[np.ndarray, float]:
        return as_codes(codes, self.grid, self.channels), exact("seconds", seconds, self.exposures)


def nearest(exposures: Iterable[float] | None, seconds: float) -> float:
    """The exposure of a camera whose ratio to `seconds` is nearest to 1; None: it has any from 1e-4 to 30.

    >>> nearest((0.1, 1.0), 0.3), nearest((0.1, 1.0), 0.4), nearest(None, 50.0)
    (0.1, 1.0, 30.0)
    """
    if exposures is None:
        return float(min(max(seconds, SHORTEST), LONGEST))
    return min(exposures, key=lambda offered: abs(math.log(offered / seconds)))


def exact(name: str, seconds: Any, exposures: Iterable[float] | None) -> float:
    """The exposure of a camera that equals `seconds` to 0.1 %; InputError where it has none."""
    if exposures is None:
        return checks.number(name, seconds, least=SHORTEST, most=LONGEST)
    offered = nearest(exposures, checks.number(name, seconds, above=0.0))
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


def to_unit(name: str, image: np.ndarray, camera: Any, first: _Kind | None = None) -> np.ndarray:
    """A photograph over full scale, float32; `camera` is a rig or a camera, with `channels` and maybe `bits`.

    AcquisitionError, which begins with `name`, for what is no photograph of so many channels, exceeds `bits`,
    is not finite, or has another shape and type than the `first`.
    """
    if image.dtype not in (np.uint8, np.uint16) and image.dtype.kind != "f":
        raise AcquisitionError(f"{name} holds {image.dtype}; it must hold uint8, uint16 or float")
    if image.ndim < 2 or image.shape[2:] != (() if camera.channels == 1 else (3,)) or image.size == 0:
        expected = "(H, W)" if camera.channels == 1 else "(H, W, 3)"
        raise AcquisitionError(f"{name} has shape {image.shape}; it must be {expected}, not empty")
    if first is not None and first != (image.shape, image.dtype):
        expected = f"{first[1]} {first[0]}, as the first was"
        raise AcquisitionError(f"{name} is {image.dtype} {image.shape}; it must be {expected}")
    levels = _levels(image.dtype, camera)
    if levels is None:
        with np.errstate(over="ignore"):
            scaled = image.astype(np.float32, copy=False)
        if bad := int(np.count_nonzero(~np.isfinite(scaled))):
            raise AcquisitionError(f"{name} has {bad} NaN or infinite value(s); all must be finite")
        return scaled
    if image.max() >= levels:
        raise AcquisitionError(f"{name} reaches {image.max()}; by rig.bits the largest code is {levels - 1}")
    return image * np.float32(1.0 / (levels - 1))


def _levels(dtype: np.dtype, camera: Any) -> int | None:
    """How many codes photographs of `dtype` have; None of floats."""
    if dtype.kind == "f":
        return None
    bits = getattr(camera, "bits", None)
    if dtype == np.uint8 or bits is None:
        return 1 << 8 * dtype.itemsize
    return 1 << checks.count("rig.bits", bits, least=9, most=16)


def require_members(name: str, value: Any, *members: str) -> None:
    """Refuse an object without one of the members."""
    if missing := [member for member in members if not hasattr(value, member)]:
        raise InputTypeError(f"{name} is a {type(value).__name__} without {', '.join(missing)}")


def load_extra(module: str, extra: str, what: str) -> Any:
    """Import `module`, which `what` needs, of an extra of ltcl; AcquisitionError tells how to install it."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        reason = f"{what} needs {module} ({' '.join(str(error).split())})"
        raise AcquisitionError(f'{reason}; install it with pip install "ltcl[{extra}]"') from None


def shot_key(codes: np.ndarray, *seconds: float) -> str:
    """128 bits of a photograph's codes and exposure, or of codes alone.

    >>> a, b = np.zeros((1, 2), np.float32), np.zeros((2, 1), np.float32)
    >>> shot_key(a, 1.0) == shot_key(a.copy(), 1.0), shot_key(a, 1.0) == shot_key(b, 1.0)
    (True, False)
    """
    content = repr(codes.shape).encode() + codes.tobytes() + np.array(seconds, np.float64).tobytes()
    return hashlib.blake2b(content, digest_size=16).hexdigest()


def fingerprint(*matrices: Any) -> str:
    """SHA-256 of all entries of arrays and sparse matrices, and of four sums u . (T v) of operators.

    4096 x 4096 entries in float32 take 0.1 s. Sums keep four digits, more than products in float32 vary.

    >>> T = np.eye(3)
    >>> fingerprint(T) == fingerprint(np.ones(9)), fingerprint(T) == fingerprint(T.copy())
    (False, True)
    """
    digest = hashlib.sha256()
    for matrix in matrices:
        if scipy.sparse.issparse(matrix):
            rows = scipy.sparse.csr_array(matrix, copy=not getattr(matrix, "has_canonical_format", False))
            rows.sum_duplicates()
            arrays = [rows.data, rows.indices.astype(np.int64), rows.indptr.astype(np.int64)]
        elif isinstance(matrix, np.ndarray):
            arrays = [matrix]
        else:
            random = np.random.default_rng(0)
            v = random.random(matrix.shape[1]).astype(matrix.dtype)
            sums = random.random((4, matrix.shape[0])) @ (matrix @ v)
            arrays = [np.array([f"{number:.4g}" for number in sums], "S16")]
        for array in arrays:
            digest.update(f"{array.dtype.str} {array.shape};".encode())
            digest.update(np.ascontiguousarray(array).data)
    return digest.hexdigest()
