# SPDX-License-Identifier: BSD-3-Clause
"""`Rig`: the interface of a set-up of projector and camera. `Shots`: the one way it is used.

`Shots` checks codes before they go into a rig and images that come from it, counts the
photographs, and scales their codes:
    value = code / full scale,    full scale = 2^bits - 1 of an integer camera, 1 of a float one,

or the white level of a camera that is full below that.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import math
from collections.abc import Iterable, Iterator
from typing import Any, Protocol

import cv2
import numpy as np

from ltcl import checks
from ltcl.acquisition.scratch import row_strips
from ltcl.errors import AcquisitionError, InputError, InputTypeError, LtclError

# Seconds that a rig without `exposures` must be able to expose for.
SHORTEST = 1e-4
LONGEST = 30.0
# Relative difference of exposures that no camera distinguishes.
EXPOSURE_TOLERANCE = 1e-3
# Cells along a side of the digest of a photograph.
DIGEST_SIDE = 8

# Shape and type of a photograph.
ImageFormat = tuple[tuple[int, ...], np.dtype]


class RigError(InputError):
    """InputError about the rig, not about another argument of `ltcl.acquire`."""


class Rig(Protocol):
    """A projector of (h, w) pixels, and a camera that looks at what it lights.

    `channels` is 1 for grey, 3 for RGB. Optional members:

    exposures : tuple of float
        Seconds that the camera offers, ascending; without it any from 1e-4 to 30.
    bits : int
        Bits in use in a uint16 image; without it 16.
    white_level : float
        Code from which on a pixel may be saturated, if that is below full scale.
    prepare(shots)
        Called with the (codes, seconds) that come next.
    describe()
        A dict of plain JSON, equal when a scan is resumed, except for values that are measured
        again, such as "survey".
    recall(codes, seconds, image)
        Called for a photograph of an earlier session.
    keeps_photographs : bool
        Whether the rig stores its photographs itself.
    lit : (h, w) bool
        Pixels that get direct light; without it all do.
    number, file_name(number)
        Number of the last photograph, and the file of a photograph, for messages.
    close()
        Called at the end.
    """

    projector_grid: tuple[int, int]
    channels: int

    def photograph(self, codes: np.ndarray, seconds: float) -> np.ndarray:
        """Photograph the projection of `codes`, (h, w) or (h, w, 3) in [0, 1], for `seconds`.

        Returns uint8, uint16 or float of (H, W) or (H, W, 3), always the same; full scale of a
        float is 1.
        """
        ...


class Closing(contextlib.AbstractContextManager):
    """Context manager that calls `close()` at its end."""

    def close(self) -> None:
        """Release what was opened."""

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

    Attributes
    ----------
    exposures : tuple of float, optional
        Seconds that the camera offers; None: any from 1e-4 to 30.
    count : int
        Photographs so far.
    image : ndarray
        The last photograph as the rig returned it.
    camera_grid, levels : tuple of int, int
        Size of a photograph and number of its codes (256 for 8 bits), known after the first
        photograph; levels is None for floats.
    digest : dict
        For the first photographs under "black" and "white": their seconds, and means over 8 x 8
        cells.

    Raises
    ------
    InputTypeError
        The rig lacks a member.
    InputError
        A member of the rig cannot be used.

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
        self.grid = checks.grid("rig.projector_grid", rig.projector_grid)
        self.projector_grid = self.grid
        self.channels = checks.one_of("rig.channels", rig.channels, (1, 3))
        exposures = getattr(rig, "exposures", None)
        self.exposures = as_exposures("rig.exposures", exposures)
        self.count = 0
        self.image = np.zeros((0, 0))
        self.camera_grid: tuple[int, int] | None = None
        self.levels: int | None = None
        # (camera_grid, levels) of the scan that is resumed.
        self.expected: tuple[Any, Any] | None = None
        self.digest: dict[str, dict[str, Any]] = {}
        self._format: ImageFormat | None = None
        try:
            json.dumps(self.describe(), allow_nan=False)
        except (TypeError, ValueError, RecursionError) as error:
            raise InputTypeError(f"rig.describe() must return plain JSON: {error}") from None

    @property
    def number(self) -> int:
        """Number of the last photograph, by the rig if it counts them, else `count`."""
        return getattr(self.rig, "number", self.count)

    @property
    def keeps_photographs(self) -> bool:
        """True if the rig stores its photographs itself, as one that a person operates does."""
        return getattr(self.rig, "keeps_photographs", False)

    def name(self, number: int) -> str:
        """Name of a photograph in messages: its number, and its file if the rig has one."""
        name = f"photograph {number}"
        file_name = getattr(self.rig, "file_name", None)
        file = None if file_name is None else file_name(number)
        if file is None:
            return name
        return f"{name} ({file})"

    def prepare(self, shots: Iterable[tuple[Any, float]]) -> None:
        """Announce the (codes, seconds) that come next, in order, to a rig that lists them."""
        prepare = getattr(self.rig, "prepare", None)
        if prepare is not None:
            prepare([as_shot(self, codes, seconds) for codes, seconds in shots])

    def photograph(self, codes: Any, seconds: float, stored: Any = None) -> np.ndarray:
        """Take one photograph of codes (h, w[, 3]) in [0, 1].

        Parameters
        ----------
        codes : array_like
            Codes of the projector, (h, w) or (h, w, 3) in [0, 1].
        seconds : float
            Exposure, which the camera must offer.
        stored : ndarray, optional
            Image of an earlier run, used instead of a new photograph.

        Returns
        -------
        ndarray
            float32 of full scale, (H, W) or (H, W, 3).

        Raises
        ------
        InputError
            The codes or the seconds cannot be used.
        AcquisitionError
            The rig fails, or the image cannot be used.
        """
        self.expose(codes, seconds, stored)
        return scale_codes(self.image, self.rig)

    def expose(self, codes: Any, seconds: float, stored: Any = None) -> None:
        """Take one photograph as `photograph` does, which leaves it in `image`, not scaled."""
        codes, seconds = as_shot(self, codes, seconds)
        # Two photographs need not be in memory at once.
        self.image = np.zeros((0, 0))
        if stored is None:
            self.image = self._expose(codes, seconds)
        else:
            recall = getattr(self.rig, "recall", None)
            if recall is not None:
                recall(codes, seconds, stored)
            self.image = np.asarray(stored)
        name = self.name(getattr(self.rig, "number", self.count + 1))
        try:
            check_photograph(name, self.image, self.rig, self._format)
        except InputError as error:
            raise RigError(*error.args) from None
        self._record_format(name)
        self.count += 1
        self._record_digest(codes, seconds)

    def describe(self) -> dict[str, Any]:
        """Plain JSON for records: the rig's own description, grids, and the photographs so far."""
        rig = {"kind": type(self.rig).__name__}
        describe = getattr(self.rig, "describe", None)
        if describe is not None:
            rig = describe()
        return {
            "rig": rig,
            "projector_grid": self.grid,
            "channels": self.channels,
            "camera_grid": self.camera_grid,
            "levels": self.levels,
            "digest": self.digest,
            "photographs": self.count,
        }

    def close(self) -> None:
        """Close the rig, if it can be closed."""
        close = getattr(self.rig, "close", None)
        if close is not None:
            close()

    def _expose(self, codes: np.ndarray, seconds: float) -> np.ndarray:
        """A new image of the rig, whatever it holds."""
        try:
            return np.asarray(self.rig.photograph(codes, seconds))
        except LtclError:
            raise
        except Exception as error:
            reason = " ".join(f"{type(error).__name__}: {error}".split())
            text = f"photograph {self.count + 1}: the rig failed with {reason}"
            raise AcquisitionError(text) from error

    def _record_format(self, name: str) -> None:
        """Record size and levels of the last image; they must be those of a resumed scan."""
        image = self.image
        self._format = image.shape, image.dtype
        self.camera_grid = image.shape[0], image.shape[1]
        self.levels = _code_levels(image.dtype, self.rig)
        sizes = self.camera_grid, self.levels
        if self.expected is not None and self.expected != sizes:
            text = "{} pixels and {} levels"
            expected = text.format(*self.expected)
            raise RigError(
                f"{name} has {text.format(*sizes)}; "
                f"it must have {expected}, as the scan was begun with, or another store"
            )

    def _record_digest(self, codes: np.ndarray, seconds: float) -> None:
        """Keep means over cells of the first photograph of black, and of the first of white."""
        for view, code in (("black", 0.0), ("white", 1.0)):
            if view in self.digest or not np.all(codes == code):
                continue
            rounded = self._cells().astype(float).round(5).tolist()
            self.digest[view] = {"seconds": seconds, "cells": rounded}

    def _cells(self) -> np.ndarray:
        """Means of the last photograph over cells, (8, 8[, 3]); one channel after the other."""
        height, width = self.image.shape[:2]
        size = min(DIGEST_SIDE, width), min(DIGEST_SIDE, height)
        channels = []
        for plane in np.moveaxis(np.atleast_3d(self.image), 2, 0):
            scaled = scale_codes(np.ascontiguousarray(plane), self.rig)
            channels.append(cv2.resize(scaled, size, interpolation=cv2.INTER_AREA))
        cells = np.stack(channels, axis=-1)
        return cells if self.image.ndim == 3 else cells[..., 0]


def nearest(exposures: Iterable[float] | None, seconds: float) -> float:
    """The exposure whose ratio to `seconds` is nearest to 1; None offers any from 1e-4 to 30."""
    if exposures is None:
        return float(min(max(seconds, SHORTEST), LONGEST))

    def distance(offered: float) -> float:
        return abs(math.log(offered / seconds))

    return min(exposures, key=distance)


def as_exposures(name: str, offered: Any) -> tuple[float, ...] | None:
    """The seconds that a camera offers as floats, or None for any.

    InputError unless they are positive and ascend.
    """
    if offered is None:
        return None
    seconds = checks.finite(name, checks.real(name, offered))
    is_list = seconds.ndim == 1 and seconds.size > 0
    if not is_list or seconds[0] <= 0 or np.any(np.diff(seconds) <= 0):
        raise InputError(f"{name} is {offered!r}; it must be positive seconds, ascending")
    return tuple(map(float, seconds))


def offered_exposure(name: str, seconds: Any, exposures: Iterable[float] | None) -> float:
    """The exposure of a camera that equals `seconds` to 0.1 %; InputError if it has none."""
    if exposures is None:
        return checks.number(name, seconds, least=SHORTEST, most=LONGEST)
    offered = nearest(exposures, checks.number(name, seconds, above=0.0))
    if not math.isclose(offered, seconds, rel_tol=EXPOSURE_TOLERANCE):
        raise InputError(
            f"{name} is {seconds:g}; it must be an exposure, the nearest is {offered:g}"
        )
    return offered


def as_codes(codes: Any, grid: tuple[int, int], channels: int) -> np.ndarray:
    """`codes` as contiguous float32, (h, w) or (h, w, 3).

    InputError for another shape, or values outside [0, 1].
    """
    array = checks.real("codes", codes)
    shapes = [grid] if channels == 1 else [grid, (*grid, 3)]
    checks.shape("codes", array, *shapes)
    checks.finite("codes", array)
    if array.min() < 0 or array.max() > 1:
        raise InputError(
            f"codes reach from {array.min():g} to {array.max():g}; they must be in [0, 1]"
        )
    return np.ascontiguousarray(array, dtype=np.float32)


def as_shot(rig: Any, codes: Any, seconds: Any) -> tuple[np.ndarray, float]:
    """Codes by `as_codes` and seconds by `offered_exposure`, for a rig with checked members."""
    checked = as_codes(codes, rig.projector_grid, rig.channels)
    return checked, offered_exposure("seconds", seconds, rig.exposures)


def to_unit(
    name: str, image: np.ndarray, camera: Any, expected: ImageFormat | None = None
) -> np.ndarray:
    """A photograph of a rig or camera over full scale, float32.

    `expected` is the shape and type of earlier photographs. AcquisitionError, which begins with
    `name`, for an image that cannot be used.
    """
    check_photograph(name, image, camera, expected)
    return scale_codes(image, camera)


def check_photograph(
    name: str, image: np.ndarray, camera: Any, expected: ImageFormat | None = None
) -> None:
    """Refuse a photograph that `to_unit` cannot scale."""
    _check_image(name, image, camera.channels)
    _white_level(image.dtype, camera)
    if expected is not None and expected != (image.shape, image.dtype):
        shape, dtype = expected
        raise AcquisitionError(f"{name} is {image.dtype} {image.shape}; it must be {dtype} {shape}")
    if image.dtype.kind == "f":
        _check_finite(name, image)
        return
    largest = largest_code(image.dtype, camera)
    if image.max() > largest:
        raise AcquisitionError(
            f"{name} reaches {image.max()}; by rig.bits the largest code is {largest}"
        )


def scale_codes(image: np.ndarray, camera: Any) -> np.ndarray:
    """Codes of a checked photograph, or of a part of it, over full scale, float32."""
    white_level = _white_level(image.dtype, camera)
    if image.dtype.kind == "f":
        with np.errstate(over="ignore"):
            image = image.astype(np.float32, copy=False)
        if white_level is None:
            return image
    elif white_level is None:
        white_level = largest_code(image.dtype, camera)
    if white_level < image.max(initial=0):
        image = np.minimum(image, image.dtype.type(white_level))
    return image * np.float32(1.0 / white_level)


def _check_image(name: str, image: np.ndarray, channels: int) -> None:
    dtype = image.dtype
    if dtype not in (np.uint8, np.uint16) and dtype.kind != "f":
        raise AcquisitionError(f"{name} holds {dtype}; it must hold uint8, uint16 or float")
    colours = ()
    expected = "(H, W)"
    if channels == 3:
        colours = (3,)
        expected = "(H, W, 3)"
    shape = image.shape
    if len(shape) < 2 or shape[2:] != colours or image.size == 0:
        raise AcquisitionError(f"{name} has shape {shape}; it must be {expected}, not empty")


def _check_finite(name: str, image: np.ndarray) -> None:
    """Refuse an image of floats with values that are not finite as float32."""
    bad = 0
    for rows in row_strips(image.shape):
        with np.errstate(over="ignore"):
            strip = image[rows].astype(np.float32, copy=False)
        bad += int(np.count_nonzero(~np.isfinite(strip)))
    if bad:
        raise AcquisitionError(f"{name} has {bad} NaN or infinite value(s); all must be finite")


def _code_levels(dtype: np.dtype, camera: Any) -> int | None:
    """Number of codes of photographs of `dtype`; None for floats."""
    if dtype.kind == "f":
        return None
    white_level = _white_level(dtype, camera)
    if white_level is not None:
        return int(white_level) + 1
    return largest_code(dtype, camera) + 1


def largest_code(dtype: np.dtype, camera: Any) -> int:
    """The largest code that photographs of integers can have."""
    if dtype == np.uint8:
        return 255
    bits = getattr(camera, "bits", None)
    if bits is None:
        return 65535
    return (1 << checks.count("rig.bits", bits, least=8, most=16)) - 1


def _white_level(dtype: np.dtype, camera: Any) -> float | None:
    """White level of a camera whose photographs have this type; None for full scale."""
    level = getattr(camera, "white_level", None)
    if level is None:
        return None
    if dtype.kind == "f":
        return checks.number("rig.white_level", level, above=0.0)
    return checks.count("rig.white_level", level, most=largest_code(dtype, camera))


def require_members(name: str, value: Any, *members: str) -> None:
    """Refuse an object without one of the members."""
    missing = [member for member in members if not hasattr(value, member)]
    if missing:
        kind = type(value).__name__
        raise InputTypeError(f"{name} is a {kind} without {', '.join(missing)}")


def shot_key(codes: np.ndarray, *seconds: float) -> str:
    """128 bits of a photograph's codes and exposure, or of codes alone."""
    shape = repr(codes.shape).encode()
    exposure = np.array(seconds, np.float64).tobytes()
    content = shape + codes.tobytes() + exposure
    return hashlib.blake2b(content, digest_size=16).hexdigest()
