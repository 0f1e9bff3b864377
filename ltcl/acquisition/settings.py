# SPDX-License-Identifier: BSD-3-Clause
"""`ScanSettings`: the arguments of `ltcl.acquire` that decide on the photographs and on T.

`ltcl.acquire` takes its defaults from here, the table [acquire] of an acquisition.toml has these
fields as keys, and a store keeps them as JSON, so that a scan is resumed with the same settings.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from ltcl import checks
from ltcl.acquisition.geometry import Correspondence
from ltcl.acquisition.radiometry import Response
from ltcl.acquisition.rig import Shots, offered_exposure
from ltcl.errors import InputError, InputTypeError

STRATEGIES = ("sketch", "adaptive", "direct", "pixel", "block", "hadamard")
_GEOMETRIES = ("graycode", "aligned")


@dataclass(frozen=True, kw_only=True)
class ScanSettings:
    """Settings of a scan; `for_rig` checks them, as `ltcl.acquire` does.

    Attributes
    ----------
    geometry : "graycode", "aligned" or Correspondence
        How camera pixels are assigned to projector pixels: measured with Gray code, the same
        pixels, or as measured before.
    strategy : "auto", "sketch", "adaptive", "direct", "pixel", "block" or "hadamard"
        Order and grouping of the lit pixels; "auto" decides by the pixels and the noise of the
        camera.
    exposures : sequence of float, optional
        Seconds of the photographs of each pattern; None: chosen by the calibration.
    response : Response, optional
        Response of the camera; None: measured.
    frames : int
        Photographs of black and of white that are averaged.
    block : int
        Side of the blocks of the strategy "block", in projector pixels, at least 2.
    order : int
        Pixels of a batch of the strategy "hadamard", 2^k - 1.
    threshold : float
        Share of a camera pixel's light under white above which "adaptive" divides a cell.
    sigmas : float
        Standard deviations above which an entry, or a sum of entries, is kept; 0 keeps all.
    rtol : float, optional
        Relative error of pictures down to which a sketch goes on with more patterns, while that
        helps; None: the first patterns are all.
    photographs : int, optional
        Photographs that a sketch takes at most; with `rtol` None it goes on up to these.

    Examples
    --------
    >>> ScanSettings(strategy="pixel", frames=4).to_json()["frames"]
    4
    """

    geometry: str | Correspondence = "graycode"
    strategy: str = "auto"
    exposures: Sequence[float] | None = None
    response: Response | None = None
    frames: int = 16
    block: int = 2
    order: int = 63
    threshold: float = 0.004
    sigmas: float = 3.0
    rtol: float | None = None
    photographs: int | None = None

    def for_rig(self, shots: Shots) -> ScanSettings:
        """Check the settings for a rig; `exposures` become those that its camera offers.

        Raises
        ------
        InputError, InputTypeError
            A value that cannot be used, with its name; one exposure without a response.
        """
        _check_geometry(self.geometry)
        _check_response(self.response, shots)
        exposures = self.exposures
        if exposures is not None:
            exposures = _offered_exposures(exposures, shots)
        if checks.count("order", self.order) & (self.order + 1):
            raise InputError(f"order is {self.order}; it must be 2^k - 1: 1, 3, 7, 15, ...")
        checks.one_of("strategy", self.strategy, ("auto", *STRATEGIES))
        rtol = self.rtol
        if rtol is not None:
            rtol = checks.number("rtol", rtol, above=0.0, below=1.0)
        photographs = self.photographs
        if photographs is not None:
            photographs = checks.count("photographs", photographs)
        return replace(
            self,
            exposures=exposures,
            frames=checks.count("frames", self.frames),
            block=checks.count("block", self.block, least=2),
            order=int(self.order),
            threshold=checks.number("threshold", self.threshold, above=0.0, below=1.0),
            sigmas=checks.number("sigmas", self.sigmas, least=0.0),
            rtol=rtol,
            photographs=photographs,
        )

    def to_json(self) -> dict[str, Any]:
        """Plain JSON without the response; a Correspondence is recorded as "given"."""
        geometry = self.geometry if isinstance(self.geometry, str) else "given"
        exposures = None if self.exposures is None else list(self.exposures)
        return {
            "geometry": geometry,
            "strategy": self.strategy,
            "exposures": exposures,
            "frames": self.frames,
            "block": self.block,
            "order": self.order,
            "threshold": self.threshold,
            "sigmas": self.sigmas,
            "rtol": self.rtol,
            "photographs": self.photographs,
        }

    @classmethod
    def from_json(cls, content: dict[str, Any]) -> ScanSettings:
        """The settings that `to_json` recorded, without the response."""
        return cls(**content)


def _check_geometry(geometry: Any) -> None:
    is_map = isinstance(geometry, Correspondence)
    if not is_map and str(geometry) not in _GEOMETRIES:
        raise InputError(
            f"geometry is {checks.shown(geometry)}; "
            "it must be 'graycode', 'aligned' or a Correspondence"
        )


def _check_response(response: Any, shots: Shots) -> None:
    if not isinstance(response, Response | None):
        kind = type(response).__name__
        raise InputTypeError(f"response is a {kind}; it must be a Response, or None")
    has_one_exposure = shots.exposures is not None and len(shots.exposures) == 1
    if response is None and has_one_exposure:
        raise InputError(
            "rig.exposures has one exposure, which determines no response; give response="
        )


def _offered_exposures(exposures: Any, shots: Shots) -> tuple[float, ...]:
    """The exposures of the camera that equal the seconds asked for."""
    seconds = checks.real("exposures", exposures)
    checks.finite("exposures", seconds)
    if seconds.ndim != 1 or seconds.size == 0 or seconds.min() <= 0:
        raise InputError(f"exposures is {exposures!r}; it must be a sequence of positive seconds")
    offered = []
    for t in seconds.astype(float).tolist():
        offered.append(offered_exposure("exposures", t, shots.exposures))
    return tuple(offered)
