# SPDX-License-Identifier: BSD-3-Clause
"""`Rig`: what a set-up of projector and camera must offer. `Shots`: the one way the package uses it.

`Shots` checks what goes into a rig and what comes back, counts the photographs, and scales their codes:
    value = code / full scale,    full scale = 2^bits - 1 of an integer camera, 1 of a float one,
so that everything behind it sees float32 and need not know the camera.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any, Protocol

import numpy as np

from ltcl import checks
from ltcl.errors import AcquisitionError, InputError, InputTypeError, LtclError

SHORTEST, LONGEST = 1e-4, 30.0
"""Seconds that a rig without `exposures` must be able to expose for."""
_SAME = 1e-3  # relative difference of exposures that no camera keeps apart


class Rig(Protocol):
    """A projector and a camera that looks at what it lights.

    Nothing else is needed. Used where a rig has it: `exposures`, the seconds the camera offers, ascending
    (else any from 1e-4 to 30); `bits` in use in a uint16 image (else 16); `prepare(shots)`, told of a list
    of (codes, seconds) before they are asked for; `describe()`, a dict of plain JSON for the records,
    which must be the same when a scan is resumed (but for `unchanged.PASSING`, such as "survey", where what
    is measured in each session stands); `recall(codes, seconds, image)`, told of a photograph that it took in
    an earlier session and is not asked for again; `keeps_photographs`, whether it keeps them itself;
    `number` of the last photograph, as whoever takes them counts; `close()`.
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


class Keeper(Protocol):
    """Photographs of an earlier session, and a place for those of this one: `kept`."""

    def find(self, codes: np.ndarray, seconds: float) -> np.ndarray | None:
        """The next one of these codes and seconds, as the rig gave it; None where it has to be taken."""
        ...

    def add(self, codes: np.ndarray, seconds: float, image: np.ndarray) -> None:
        """Keep one that was not found."""
        ...


class Shots:
    """Photographs of a rig: checked, counted, float32 in [0, 1] of full scale.

    Parameters
    ----------
    rig : Rig

    Attributes
    ----------
    rig : Rig
        As given.
    grid : (h, w)
        Of the projector.
    channels : 1 or 3
    exposures : tuple of float, or None
        The seconds that the camera offers, ascending; None: any from 1e-4 to 30.
    count : int
        Photographs taken.
    number : int
        Of the last one: the rig's, where it has numbers of its own, else `count`.
    camera_grid : (H, W), or None
        Of the camera, once there was a photograph.
    levels : int, or None
        Codes of an integer camera, 256 of 8 bits, once there was a photograph; None of a float camera.
    keeper : Keeper, or None
        Asked before the rig is, and given what the rig gave.
    asking : bool
        Whether a photograph was asked for and did not come as it must be: then an error is the rig's.

    Raises
    ------
    InputTypeError
        `rig` lacks `projector_grid`, `channels` or `photograph`.
    InputError
        One of its attributes cannot be used.

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
        for name in ("projector_grid", "channels", "photograph"):
            if not hasattr(rig, name):
                raise InputTypeError(
                    f"rig is a {type(rig).__name__} without {name}; it must have projector_grid, channels "
                    "and photograph(codes, seconds)"
                )
        self.rig = rig
        self.grid = checks.grid("rig.projector_grid", rig.projector_grid)
        self.channels = rig.channels
        if self.channels not in (1, 3):
            raise InputError(f"rig.channels is {self.channels!r}; it must be 1 or 3")
        self.exposures = _exposures(getattr(rig, "exposures", None))
        self.count = 0
        self.keeper: Keeper | None = None
        self.asking = False
        self._first: tuple[tuple[int, ...], np.dtype] | None = None

    @property
    def number(self) -> int:
        """Of the last photograph, for messages."""
        return getattr(self.rig, "number", self.count)

    @property
    def camera_grid(self) -> tuple[int, int] | None:
        """(H, W) of the photographs; None before the first."""
        return None if self._first is None else (self._first[0][0], self._first[0][1])

    @property
    def levels(self) -> int | None:
        """How many codes there are; None of a float camera, or before the first photograph."""
        largest = None if self._first is None else _largest(self.rig, self._first[1])
        return None if largest is None else largest + 1

    def prepare(self, shots: Iterable[tuple[Any, float]]) -> None:
        """Tell the rig which (codes, seconds) come next, in order; nothing happens where it does not care.

        A rig that waits for a person writes all of them down at once, instead of one in every run.

        Raises
        ------
        InputError
            As in `photograph`.
        """
        tell = getattr(self.rig, "prepare", None)
        if tell is not None:
            tell((self._codes(codes), self._seconds(seconds)) for codes, seconds in shots)

    def photograph(self, codes: Any, seconds: float) -> np.ndarray:
        """One photograph.

        Parameters
        ----------
        codes : (h, w), or (h, w, 3) of a rig with three channels
            What the projector is fed, in [0, 1]; (h, w) feeds all its channels alike.
        seconds : float
            Of exposure; one of `exposures` where the rig has them.

        Returns
        -------
        np.ndarray
            float32, (H, W) or (H, W, 3), codes over full scale. A float camera may go past [0, 1].

        Raises
        ------
        InputError, InputTypeError
            Codes of another shape or outside [0, 1], seconds that the camera does not have.
        AcquisitionError
            The rig failed, or gave what is no photograph or one unlike the first; its number is named.
            `PhotographMissing` where a person has yet to take it.
        """
        codes, seconds = self._codes(codes), self._seconds(seconds)
        self.asking = True
        found = None if self.keeper is None else self.keeper.find(codes, seconds)
        image = self._asked(codes, seconds) if found is None else found
        scaled = self._checked(self.count + 1, image)
        if found is None and self.keeper is not None:
            self.keeper.add(codes, seconds, np.asarray(image))
        self.asking = False
        self.count += 1
        return scaled

    def describe(self) -> dict[str, Any]:
        """Plain JSON for the records: what the rig says of itself, the grids, and the count so far."""
        tell = getattr(self.rig, "describe", None)
        return {
            "rig": tell() if tell is not None else {"kind": type(self.rig).__name__},
            "projector_grid": list(self.grid),
            "camera_grid": None if self.camera_grid is None else list(self.camera_grid),
            "channels": self.channels,
            "levels": self.levels,
            "photographs": self.count,
        }

    def close(self) -> None:
        """Close the rig, where it can be closed."""
        end = getattr(self.rig, "close", None)
        if end is not None:
            end()

    def __enter__(self) -> Shots:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _asked(self, codes: np.ndarray, seconds: float) -> Any:
        try:
            return self.rig.photograph(codes, seconds)
        except LtclError:
            raise
        except Exception as error:
            reason = " ".join(f"{type(error).__name__}: {error}".split())
            raise AcquisitionError(f"photograph {self.count + 1}: the rig failed with {reason}") from error

    def _codes(self, codes: Any) -> np.ndarray:
        return as_codes(codes, self.grid, self.channels)

    def _seconds(self, seconds: Any) -> float:
        seconds = as_seconds(seconds)
        if self.exposures is None:
            return checks.number("seconds", seconds, least=SHORTEST, most=LONGEST)
        nearest = min(self.exposures, key=lambda offered: abs(math.log(offered / seconds)))
        if not math.isclose(nearest, seconds, rel_tol=_SAME):
            raise InputError(
                f"seconds is {seconds:g}; it must be an exposure of the rig, the nearest is {nearest:g}"
            )
        return nearest

    def _checked(self, number: int, image: Any) -> np.ndarray:
        """The scaled image; remembers the first for comparison, but only a good one."""
        name = f"photograph {number}"
        if image is None:
            raise AcquisitionError(f"{name} is None; it must be an image")
        image = np.asarray(image)
        check_photograph(name, image, self.channels)
        kind = (image.shape, image.dtype)
        if self._first is not None and kind != self._first:
            was, dtype = self._first
            raise AcquisitionError(
                f"{name} is {image.dtype} {image.shape}; it must be {dtype} {was}, as the first was"
            )
        scaled = to_unit(name, image, self.rig)
        self._first = kind
        return scaled


def as_codes(codes: Any, grid: tuple[int, int], channels: int) -> np.ndarray:
    """`codes` as contiguous float32 (h, w) or (h, w, 3) in [0, 1]; refuses what no projector can be fed."""
    array = checks.real("codes", codes)
    checks.shape("codes", array, *([grid] if channels == 1 else [grid, (*grid, 3)]))
    checks.finite("codes", array)
    if array.min() < 0 or array.max() > 1:
        raise InputError(f"codes reach from {array.min():g} to {array.max():g}; they must be in [0, 1]")
    return np.ascontiguousarray(array, dtype=np.float32)


def as_seconds(seconds: Any) -> float:
    """`seconds` as a float; refuses what is no time of exposure."""
    return checks.number("seconds", seconds, above=0.0)


def _exposures(given: Any) -> tuple[float, ...] | None:
    if given is None:
        return None
    offered = checks.finite("rig.exposures", checks.real("rig.exposures", given))
    if offered.ndim != 1 or offered.size == 0 or offered[0] <= 0 or np.any(np.diff(offered) <= 0):
        raise InputError(f"rig.exposures is {given!r}; it must be positive seconds in ascending order")
    return tuple(float(seconds) for seconds in offered)


def _largest(rig: Any, dtype: np.dtype) -> int | None:
    if dtype.kind == "f":
        return None
    if dtype == np.uint8:
        return 255
    bits = getattr(rig, "bits", None)
    return (1 << (16 if bits is None else checks.count("rig.bits", bits, least=9, most=16))) - 1


def to_unit(name: str, image: np.ndarray, source: Any) -> np.ndarray:
    """A photograph of a rig or a camera as float32, codes over full scale.

    Raises
    ------
    AcquisitionError
        It reaches past the bits that `source` says are in use, or is not finite.

    Examples
    --------
    >>> to_unit("photograph 1", np.array([[0, 51, 255]], np.uint8), None).round(2)
    array([[0. , 0.2, 1. ]], dtype=float32)
    """
    largest = _largest(source, image.dtype)
    if largest is None:
        with np.errstate(over="ignore"):
            scaled = image.astype(np.float32, copy=False)
        if not np.isfinite(scaled).all():
            bad = int(np.count_nonzero(~np.isfinite(scaled)))
            raise AcquisitionError(f"{name} has {bad} NaN or infinite value(s); all must be finite")
        return scaled
    if image.max() > largest:
        raise AcquisitionError(
            f"{name} reaches {image.max()}; rig.bits says that {largest} is the largest code"
        )
    return image * np.float32(1.0 / largest)


def check_photograph(name: str, image: np.ndarray, channels: int) -> None:
    """Refuse what is no photograph of so many channels, or an empty one."""
    if image.dtype not in (np.uint8, np.uint16) and image.dtype.kind != "f":
        raise AcquisitionError(f"{name} holds {image.dtype}; it must hold uint8, uint16 or float")
    colours = () if channels == 1 else (3,)
    if image.ndim < 2 or image.shape[2:] != colours or image.size == 0:
        wanted = "(H, W)" if channels == 1 else "(H, W, 3)"
        raise AcquisitionError(f"{name} has shape {image.shape}; it must be {wanted}, not empty")
