# SPDX-License-Identifier: BSD-3-Clause
"""`Rig`: what a set-up of projector and camera must offer. `Shots`: the one way the package uses it.

`Shots` checks what goes into a rig and what comes back, counts the photographs, and scales their
codes:
    value = code / full scale,    full scale = 2^bits - 1 of an integer camera, 1 of a float one.
"""

from __future__ import annotations

import contextlib
import hashlib
import importlib
import json
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

    Optional: `exposures`, the seconds that the camera offers, ascending (else any from 1e-4 to 30);
    `bits` in use in a uint16 image (else 16); `prepare(shots)`, called with the (codes, seconds)
    that come next; `describe()`, a dict of plain JSON, equal when a scan is resumed (but for what
    is measured anew, such as "survey"); `recall(codes, seconds, image)`, called for a photograph of
    an earlier session; `keeps_photographs`, whether it stores them itself; `number` of the last
    photograph and `file_name(number)`, for messages; `close()`.
    """

    projector_grid: tuple[int, int]
    channels: int

    def photograph(self, codes: np.ndarray, seconds: float) -> np.ndarray:
        """What the camera gives after `seconds` of light under `codes`, (h, w) or (h, w, 3) in [0, 1].

        Returns uint8, uint16 or float of (H, W) or (H, W, 3), always the same; full scale of a
        float is 1.
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
        with contextlib.ExitStack() as opened:
            opened.callback(self.close)
            yield
            opened.pop_all()


class Shots(Closing):
    """Photographs of a rig: checked, counted, float32 in [0, 1] of full scale.

    InputTypeError for a rig that lacks a member, InputError where one cannot be used. `exposures`
    are None for any from 1e-4 to 30 s; `count` is of the photographs, `image` the last as the rig
    gave it. After the first there are `camera_grid`, `levels` (256 of 8 bits, None of floats), and
    `digest`: of the first under "black" and "white" the seconds, and means over 8 x 8 cells.

    Examples
    --------
    >>> from ltcl.acquisition import VirtualRig
    >>> shots = Shots(
    ...     VirtualRig(np.eye(2) / 2, grid=(1, 2), gain=None, read=0, black=0, response="linear")
    ... )
    >>> shots.photograph([[0, 1]], seconds=1).round(2)
    array([[0. , 0.5]], dtype=float32)
    >>> shots.count, shots.camera_grid, shots.levels
    (1, (1, 2), 256)
    """

    def __init__(self, rig: Rig) -> None:
        require_members("rig", rig, "projector_grid", "channels", "photograph")
        self.rig = rig
        self.grid = self.projector_grid = checks.grid("rig.projector_grid", rig.projector_grid)
        self.channels = checks.one_of("rig.channels", rig.channels, (1, 3))
        self.exposures = as_exposures("rig.exposures", getattr(rig, "exposures", None))
        self.count, self.image = 0, np.zeros((0, 0))
        self.camera_grid: tuple[int, int] | None = None
        self.levels: int | None = None
        self.expected: tuple[Any, Any] | None = None  # these two, of the scan that is resumed
        self.digest: dict[str, dict[str, Any]] = {}
        self._first: _Kind | None = None
        try:
            json.dumps(self.describe(), allow_nan=False)
        except (TypeError, ValueError, RecursionError) as error:
            raise InputTypeError(f"rig.describe() returns what is no plain JSON: {error}") from None

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
        getattr(self.rig, "prepare", list)(as_shot(self, *shot) for shot in shots)

    def photograph(self, codes: Any, seconds: float, stored: Any = None) -> np.ndarray:
        """One photograph of codes (h, w[, 3]) in [0, 1] over full scale: float32, (H, W) or (H, W, 3).

        `stored` is the image of an earlier run, in place of a new one. InputError for other codes,
        or seconds that the camera does not have; AcquisitionError where the rig fails, or the image
        cannot be used.
        """
        codes, seconds = as_shot(self, codes, seconds)
        if stored is not None:
            getattr(self.rig, "recall", lambda *_: None)(codes, seconds, stored)
        try:
            self.image = image = np.asarray(
                self.rig.photograph(codes, seconds) if stored is None else stored
            )
        except LtclError:
            raise
        except Exception as error:
            reason = " ".join(f"{type(error).__name__}: {error}".split())
            raise AcquisitionError(
                f"photograph {self.count + 1}: the rig failed with {reason}"
            ) from error
        name = self.name(getattr(self.rig, "number", self.count + 1))
        scaled = to_unit(name, image, self.rig, self._first)
        self._first = image.shape, image.dtype
        self.camera_grid, self.levels = (
            (image.shape[0], image.shape[1]),
            _levels(image.dtype, self.rig),
        )
        sizes = self.camera_grid, self.levels
        if self.expected is not None and self.expected != sizes:
            text = "{} pixels and {} levels"
            expected = (
                f"{text.format(*self.expected)}, as the scan was begun with, or another store"
            )
            raise InputError(f"{name} has {text.format(*sizes)}; it must have {expected}")
        self.count += 1
        for view, code in (("black", 0.0), ("white", 1.0)):
            if view not in self.digest and np.all(codes == code):
                size = min(_CELLS, image.shape[1]), min(_CELLS, image.shape[0])
                cells = cv2.resize(scaled, size, interpolation=cv2.INTER_AREA)
                self.digest[view] = {
                    "seconds": seconds,
                    "cells": cells.astype(float).round(5).tolist(),
                }
        return scaled

    def describe(self) -> dict[str, Any]:
        """Plain JSON for the records: what the rig says of itself, the grids, and the photographs so far."""
        rig = getattr(self.rig, "describe", lambda: {"kind": type(self.rig).__name__})()
        facts = {"rig": rig, "projector_grid": self.grid, "channels": self.channels}
        facts |= {"camera_grid": self.camera_grid, "levels": self.levels}
        return facts | {"digest": self.digest, "photographs": self.count}

    def close(self) -> None:
        """Close the rig, where it can be closed."""
        getattr(self.rig, "close", lambda: None)()


def nearest(exposures: Iterable[float] | None, seconds: float) -> float:
    """The exposure whose ratio to `seconds` is nearest to 1; of None, any from 1e-4 to 30."""
    if exposures is None:
        return float(min(max(seconds, SHORTEST), LONGEST))
    return min(exposures, key=lambda offered: abs(math.log(offered / seconds)))


def as_exposures(name: str, offered: Any) -> tuple[float, ...] | None:
    """The seconds that a camera offers as floats, or None for any; InputError unless they ascend from 0."""
    if offered is None:
        return None
    seconds = checks.finite(name, checks.real(name, offered))
    if seconds.ndim != 1 or seconds.size == 0 or seconds[0] <= 0 or np.any(np.diff(seconds) <= 0):
        raise InputError(f"{name} is {offered!r}; it must be positive seconds, ascending")
    return tuple(map(float, seconds))


def exact(name: str, seconds: Any, exposures: Iterable[float] | None) -> float:
    """The exposure of a camera that equals `seconds` to 0.1 %; InputError where it has none."""
    if exposures is None:
        return checks.number(name, seconds, least=SHORTEST, most=LONGEST)
    offered = nearest(exposures, checks.number(name, seconds, above=0.0))
    if not math.isclose(offered, seconds, rel_tol=_SAME):
        raise InputError(
            f"{name} is {seconds:g}; it must be an exposure, the nearest is {offered:g}"
        )
    return offered


def as_codes(codes: Any, grid: tuple[int, int], channels: int) -> np.ndarray:
    """`codes` as contiguous float32 (h, w) or (h, w, 3); InputError for another shape or outside [0, 1]."""
    array = checks.real("codes", codes)
    checks.shape("codes", array, *([grid] if channels == 1 else [grid, (*grid, 3)]))
    checks.finite("codes", array)
    if array.min() < 0 or array.max() > 1:
        raise InputError(
            f"codes reach from {array.min():g} to {array.max():g}; they must be in [0, 1]"
        )
    return np.ascontiguousarray(array, dtype=np.float32)


def as_shot(rig: Any, codes: Any, seconds: Any) -> tuple[np.ndarray, float]:
    """Codes by `as_codes` and seconds by `exact`, for a rig whose members are checked."""
    return as_codes(codes, rig.projector_grid, rig.channels), exact(
        "seconds", seconds, rig.exposures
    )


def to_unit(name: str, image: np.ndarray, camera: Any, first: _Kind | None = None) -> np.ndarray:
    """A photograph of a rig or camera over full scale, float32; AcquisitionError begins with `name`."""
    if image.dtype not in (np.uint8, np.uint16) and image.dtype.kind != "f":
        raise AcquisitionError(f"{name} holds {image.dtype}; it must hold uint8, uint16 or float")
    if (
        image.ndim < 2
        or image.shape[2:] != (() if camera.channels == 1 else (3,))
        or image.size == 0
    ):
        expected = "(H, W)" if camera.channels == 1 else "(H, W, 3)"
        raise AcquisitionError(f"{name} has shape {image.shape}; it must be {expected}, not empty")
    if first is not None and first != (image.shape, image.dtype):
        raise AcquisitionError(
            f"{name} is {image.dtype} {image.shape}; it must be {first[1]} {first[0]}"
        )
    levels = _levels(image.dtype, camera)
    if levels is None:
        with np.errstate(over="ignore"):
            scaled = image.astype(np.float32, copy=False)
        if bad := int(np.count_nonzero(~np.isfinite(scaled))):
            raise AcquisitionError(f"{name} has {bad} NaN or infinite value(s); all must be finite")
        return scaled
    if image.max() >= levels:
        raise AcquisitionError(
            f"{name} reaches {image.max()}; by rig.bits the largest code is {levels - 1}"
        )
    return image * np.float32(1.0 / (levels - 1))


def _levels(dtype: np.dtype, camera: Any) -> int | None:
    """How many codes photographs of `dtype` have; None of floats."""
    if dtype.kind == "f":
        return None
    bits = 8 if dtype == np.uint8 else getattr(camera, "bits", None) or 16
    return 1 << checks.count("rig.bits", bits, least=8, most=16)


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
    """128 bits of a photograph's codes and exposure, or of codes alone."""
    content = repr(codes.shape).encode() + codes.tobytes() + np.array(seconds, np.float64).tobytes()
    return hashlib.blake2b(content, digest_size=16).hexdigest()


def fingerprint(*matrices: Any) -> str:
    """SHA-256 of all entries of arrays and sparse matrices; of operators, of four sums u . (T v)."""
    digest = hashlib.sha256()
    for matrix in matrices:
        if scipy.sparse.issparse(matrix):
            rows = scipy.sparse.csr_array(
                matrix, copy=not getattr(matrix, "has_canonical_format", False)
            )
            rows.sum_duplicates()
            arrays = [rows.data, rows.indices.astype(np.int64), rows.indptr.astype(np.int64)]
        elif isinstance(matrix, np.ndarray):
            arrays = [matrix]
        else:
            random = np.random.default_rng(0)
            v = random.random(matrix.shape[1]).astype(matrix.dtype)
            sums = random.random((4, matrix.shape[0])) @ (matrix @ v)
            arrays = [
                np.array([f"{number:.4g}" for number in sums], "S16")
            ]  # products in float32 vary
        for array in arrays:
            digest.update(f"{array.dtype.str} {array.shape};".encode())
            digest.update(np.ascontiguousarray(array).data)
    return digest.hexdigest()
