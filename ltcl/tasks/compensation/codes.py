# SPDX-License-Identifier: BSD-3-Clause
"""Codes of frames and of the projector, as tables that the device looks up.

A table of light makes light of whole-number codes. On the way back the codes of a rising curve are
its places in a list of light: code n of 8 bits stands between the lights of the codes n - 1/2 and
n + 1/2. Codes of 16 bits and floats lie between the places of a list of 4097 codes, where the curve
is as good as straight. A grid of cells of equal width tells where in the list to begin.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from ltcl.errors import InputError, InputTypeError

# The types of codes, and their names in OpenCL C.
CODE_TYPES = {"uint8": "uchar", "uint16": "ushort", "float32": "float"}
WHITE_CODES = {"uint8": 255, "uint16": 65535, "float32": 1}
CODE_NAMES = ", ".join(map(repr, CODE_TYPES))
SRGB = "srgb"
LINEAR = "linear"
CURVES = (SRGB, LINEAR)
# Whole numbers are sRGB, floats linear.
AUTO = "auto"
DECODES = (AUTO, *CURVES)
# Codes, from 0 to 1, between which a curve is taken as straight: off by less than 1e-8.
LISTED_CODES = 4097
# Numbers of cells that are tried, until one bisection is enough.
CELL_COUNTS = (1024, 4096, 16384, 65536)
# Of the width of a cell: rounding may put light this far into the next one.
CELL_MARGIN = 1e-2

# Light of codes from 0 to 1, float64: of one curve, or of one of three channels.
Curve = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True, kw_only=True, eq=False)
class CodeTable:
    """A table by which light becomes codes; arrays are float32 and int32, as the device takes them.

    Attributes
    ----------
    thresholds : (channels, count)
        Ascending light, with an infinite one at the end, which no light reaches.
    starts : (channels, cells)
    first_light, cells_per_light : float
        Where the first cell begins, and how many there are in a unit of light.
    steps : int
        Bisections that find a place in a cell, of less than 2^steps; 0 where codes are light.
    is_between : bool
        True if codes lie between the places.
    code_step : float
        Codes from one place to the next, where they lie between.
    """

    thresholds: np.ndarray
    starts: np.ndarray
    first_light: float
    cells_per_light: float
    steps: int
    is_between: bool
    code_step: float = 1.0

    @classmethod
    def of_light(cls) -> CodeTable:
        """Codes that are light."""
        return cls(
            thresholds=np.zeros((1, 1), np.float32),
            starts=np.zeros((1, 1), np.int32),
            first_light=0.0,
            cells_per_light=0.0,
            steps=0,
            is_between=False,
        )

    @classmethod
    def of_curves(cls, curves: list[Curve], dtype: str) -> CodeTable:
        """Codes of a type whose light the curves tell, one curve a channel."""
        is_between = dtype != "uint8"
        white = WHITE_CODES[dtype]
        codes = np.linspace(0.0, 1.0, LISTED_CODES)
        if not is_between:
            codes = (np.arange(white) + 0.5) / white
        rows = [np.asarray(curve(codes), np.float32) for curve in curves]
        beyond = np.full((len(rows), 1), np.inf, np.float32)
        thresholds = np.hstack([np.stack(rows), beyond])
        best: CodeTable | None = None
        for cells in CELL_COUNTS:
            table = cls._with_cells(thresholds, cells, is_between)
            if best is None or table.steps < best.steps:
                best = table
            if best.steps == 1:
                break
        assert best is not None  # noqa: S101 - some number of cells was tried
        return dataclasses.replace(best, code_step=white / (LISTED_CODES - 1))

    @classmethod
    def _with_cells(cls, thresholds: np.ndarray, cells: int, is_between: bool) -> CodeTable:
        first = float(thresholds.min())
        last = float(thresholds[:, :-1].max())
        width = (last - first) / cells
        edges = first + width * np.arange(cells + 1)
        starts = []
        largest = 1
        for row in thresholds:
            begin = np.searchsorted(row, edges[:-1] - CELL_MARGIN * width, side="right")
            end = np.searchsorted(row, edges[1:] + CELL_MARGIN * width, side="right")
            # All that is brighter, or darker, is looked up in the outer cells.
            end[-1] = len(row) - 1
            begin[0] = 0
            starts.append(begin)
            largest = max(largest, int(np.max(end - begin)))
        return cls(
            thresholds=thresholds,
            starts=np.stack(starts).astype(np.int32),
            first_light=first,
            cells_per_light=1.0 / width,
            steps=largest.bit_length(),
            is_between=is_between,
        )


def srgb_light(codes: np.ndarray) -> np.ndarray:
    """The light of sRGB codes from 0 to 1."""
    # Imported here, as the package brings OpenCV.
    from ltcl.images.encoding import from_srgb

    return from_srgb(codes)


def light_of_codes(decode: str, dtype: np.dtype) -> np.ndarray:
    """The light of every whole-number code, (256,) or (65536,) float32; (1,) for floats."""
    if dtype.kind == "f":
        return np.zeros(1, np.float32)
    codes = np.linspace(0.0, 1.0, np.iinfo(dtype).max + 1)
    if decode != LINEAR:
        codes = srgb_light(codes)
    return codes.astype(np.float32)


def code_table(encode: Any, dtype: str, channels: int, white: float) -> CodeTable:
    """The codes of a projector.

    Parameters
    ----------
    encode : "srgb", "linear" or a response
        A response is an object with `linear`, which gives light of codes, such as
        `ltcl.acquisition.Response`: its light is relative to the projector's white.
    dtype : str
        "uint8", "uint16" or "float32".
    channels : 1 or 3
    white : float
        Light of the largest code, for the two names. Linear floats are the light as it is.

    Raises
    ------
    InputError, InputTypeError
        Another name, or a response of another number of channels.
    """
    if isinstance(encode, str):
        if encode not in CURVES:
            raise InputError(f"encode is {encode!r}; it must be 'srgb', 'linear' or a response")
        if encode == LINEAR and dtype == "float32":
            return CodeTable.of_light()

        def of_white(codes: np.ndarray) -> np.ndarray:
            return white * (srgb_light(codes) if encode == SRGB else codes)

        return CodeTable.of_curves([of_white] * channels, dtype)
    return CodeTable.of_curves(_curves_of_response(encode, channels), dtype)


def _curves_of_response(response: Any, channels: int) -> list[Curve]:
    """The light of codes of each channel, by a response of one curve or as many."""
    if not hasattr(response, "linear"):
        raise InputTypeError(
            f"encode is a {type(response).__name__}; it must be 'srgb', 'linear' or a response "
            "such as Setup.calibration.projector"
        )
    count = getattr(response, "channels", 1)
    if count not in (1, channels):
        raise InputError(f"encode is a response of {count} channels; T has {channels}")

    def curve_of(channel: int) -> Curve:
        def light(codes: np.ndarray) -> np.ndarray:
            if count == 1:
                return response.linear(codes)
            table = np.asarray(response.linear(np.repeat(codes[:, None], count, axis=1)))
            return table[..., channel] if table.ndim else table

        return light

    curves = [curve_of(channel) for channel in range(channels)]
    codes = np.linspace(0.0, 1.0, LISTED_CODES)
    for curve in curves:
        _check_rising(np.asarray(curve(codes)), codes)
    return curves


def _check_rising(light: np.ndarray, codes: np.ndarray) -> None:
    """Refuse a response whose light is not finite, falls, or never rises."""
    is_curve = light.shape == codes.shape and np.all(np.isfinite(light))
    if not is_curve or np.any(np.diff(light) < 0.0) or light[-1] <= light[0]:
        raise InputError(
            "encode is a response whose light is not finite, falls with the codes, or stays the "
            "same; it must give light of each code, and rise"
        )
