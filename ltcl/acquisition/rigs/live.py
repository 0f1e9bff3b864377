# SPDX-License-Identifier: BSD-3-Clause
"""`LiveRig`: a camera on a cable photographs what a display shows.

Before the first photograph `survey` measures latency and noise, and refuses a camera that adapts. Each frame
then passes `freshness`, which lets no old or half-changed one through. A photograph of the same codes and
seconds as an earlier one must be as bright as that. What fails is refused by the photograph's number.
"""

from __future__ import annotations

import hashlib
import logging
from dataclasses import asdict
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.acquisition.rig import LONGEST, SHORTEST, as_codes, as_seconds, check_photograph, to_unit
from ltcl.acquisition.rigs import periods
from ltcl.acquisition.rigs.freshness import Freshness
from ltcl.acquisition.rigs.stage import Frame, Stage, cells
from ltcl.acquisition.rigs.survey import Survey, drifted, saturated, survey
from ltcl.errors import AcquisitionError, InputError, InputTypeError

_log = logging.getLogger(__name__)
_USUAL = 1 / 15  # seconds: the survey begins no longer than that
_TRIALS = 6  # exposures for the survey, each half the one before
_DIM = 0.1  # of full scale: brightness is compared relative to that at least


class LiveRig:
    """A camera and a display.

    Parameters
    ----------
    camera : Camera
        `OpenCVCamera`, `GPhoto2Camera`, or any object with channels, stream, expose(seconds), frame().
    display : Display
        Or any object with grid, period and show(codes).
    period : "display", float or None
        Seconds of one picture of the projector: only multiples of it are offered as `exposures`. "display":
        as its driver says. None: the projector's light is steady (LCD, LCoS), and any exposure will do.
    margin : float
        Seconds to wait beyond the slowest flash.
    drift : float
        Largest relative difference of brightness between identical shots, beside what noise explains.
    retakes : int
        Further frames before a photograph is refused.
    flashes : int
        For the latency, half of them to white.
    patience : float
        Seconds within which everything is at rest; no latency may be longer.

    Attributes
    ----------
    projector_grid, channels
        As of the display and the camera.
    exposures : tuple of float, or None
        The seconds that can be asked for; None: any.
    bits : int or None
        In use in a uint16 image; None: all.

    Raises
    ------
    InputError, InputTypeError
        A camera or a display that lacks something, numbers out of range, no exposure that is a multiple of
        the period.

    Examples
    --------
    A camera that sees the display as it is, without latency or noise:

    >>> class Screen:
    ...     grid, period = (2, 2), None
    ...
    ...     def show(self, codes):
    ...         self.codes = codes
    >>> class Eye:
    ...     channels, stream, exposures = 1, False, (0.01,)
    ...
    ...     def expose(self, seconds): ...
    ...     def frame(self):
    ...         return np.rint(screen.codes * 200).astype(np.uint8)
    >>> screen = Screen()
    >>> rig = LiveRig(Eye(), screen, patience=0.01)
    >>> rig.photograph(np.eye(2), 0.01)
    array([[200,   0],
           [  0, 200]], dtype=uint8)
    >>> round(rig.survey.contrast, 3)
    0.784
    """

    def __init__(
        self,
        camera: Any,
        display: Any,
        *,
        period: str | float | None = "display",
        margin: float = 0.02,
        drift: float = 0.02,
        retakes: int = 5,
        flashes: int = 8,
        patience: float = 1.0,
    ) -> None:
        _refuse_lacking("camera", camera, ("channels", "stream", "expose", "frame"))
        _refuse_lacking("display", display, ("grid", "period", "show"))
        self.projector_grid = checks.grid("display.grid", display.grid)
        self.channels = checks.one_of("camera.channels", camera.channels, (1, 3))
        self.bits = getattr(camera, "bits", None)
        self._period = _period(period, display)
        limits = getattr(camera, "limits", (SHORTEST, LONGEST))
        self.exposures = periods.exposures(getattr(camera, "exposures", None), self._period, limits)
        self._margin = checks.number("margin", margin, least=0.0, most=10.0)
        self._drift = checks.number("drift", drift, above=0.0, below=1.0)
        self._retakes = checks.count("retakes", retakes, least=0)
        self._flashes = checks.count("flashes", flashes, least=2)
        self._patience = checks.number("patience", patience, above=0.0, most=60.0)
        self._stage = Stage(camera, display)
        self._freshness: Freshness | None = None
        self._count = 0
        self._brightness: dict[tuple[bytes, float], np.ndarray] = {}

    def photograph(self, codes: Any, seconds: float) -> np.ndarray:
        """What the camera gives under `codes`, checked: as `Camera.frame`.

        Parameters
        ----------
        codes : (h, w), or (h, w, 3) of a rig with three channels
            In [0, 1]; (h, w) feeds all channels alike.
        seconds : float
            Of exposure, one of `exposures` where the rig has them.

        Raises
        ------
        InputError, InputTypeError
            Codes or seconds that cannot be used.
        AcquisitionError
            The camera is gone, adapts, drifts, or shows old or half-changed frames; the number of the
            photograph and the figure are named.
        """
        codes = as_codes(codes, self.projector_grid, self.channels)
        seconds = self._offered(as_seconds(seconds))
        try:
            frame = self._ready().frame(codes, seconds)
            self._refuse_drift(codes, seconds, frame, self._ready().survey.noise)
        except AcquisitionError as error:
            raise AcquisitionError(f"photograph {self._count + 1}: {error}") from error
        self._count += 1
        return frame.codes

    def recall(self, codes: Any, seconds: float, image: np.ndarray) -> None:
        """Remember a photograph of an earlier session: one of the same codes and seconds must be as bright.

        Raises
        ------
        InputError, InputTypeError
            As in `photograph`.
        AcquisitionError
            The image is none of this camera.
        """
        codes = as_codes(codes, self.projector_grid, self.channels)
        check_photograph("image", image, self.channels)
        seen = cells(to_unit("image", image, self._stage.camera)).mean(axis=(0, 1))
        self._brightness.setdefault(_shot(codes, self._offered(as_seconds(seconds))), seen)
        self._count += 1

    @property
    def survey(self) -> Survey | None:
        """What was measured; None before the first photograph."""
        return None if self._freshness is None else self._freshness.survey

    def calibrate(self) -> Survey:
        """Measure latency and noise, once; the first photograph does it where nobody did.

        Raises
        ------
        AcquisitionError
            The camera does not see the display, flickers or adapts.
        """
        return self._ready().survey

    def describe(self) -> dict[str, Any]:
        """The rig as plain JSON."""
        parts = {"camera": self._stage.camera, "display": self._stage.display}
        told = {name: part.describe() if hasattr(part, "describe") else {} for name, part in parts.items()}
        return {
            "kind": "live",
            "projector_grid": list(self.projector_grid),
            "channels": self.channels,
            **{name: told[name] or {"kind": type(part).__name__} for name, part in parts.items()},
            "period": self._period,
            "exposures": None if self.exposures is None else list(self.exposures),
            "survey": None if self.survey is None else asdict(self.survey),
        }

    def close(self) -> None:
        """Close camera and display, where they can be closed."""
        for part in (self._stage.camera, self._stage.display):
            end = getattr(part, "close", None)
            if end is not None:
                end()

    def __enter__(self) -> LiveRig:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _ready(self) -> Freshness:
        if self._freshness is None:
            seconds = self._probe()
            found = survey(
                self._stage, seconds, flashes=self._flashes, patience=self._patience, drift=self._drift
            )
            _log.info("%s", found)
            self._freshness = Freshness(self._stage, found, self._margin, self._retakes)
        return self._freshness

    def _offered(self, seconds: float) -> float:
        if self.exposures is None:
            return seconds
        nearest = min(self.exposures, key=lambda offered: abs(offered - seconds))
        if abs(nearest - seconds) > 1e-3 * seconds:
            raise InputError(
                f"seconds is {seconds:g}; it must be an exposure of the rig, the nearest is {nearest:g}"
            )
        return nearest

    def _probe(self) -> float:
        """An exposure in which white is not full, for the survey."""
        offered = self.exposures or tuple(_USUAL / 2**k for k in reversed(range(_TRIALS)))
        seconds = max((s for s in offered if s <= _USUAL), default=offered[0])
        for _ in range(_TRIALS):
            if not saturated(self._stage, seconds, self._patience):
                return seconds
            shorter = [s for s in offered if s <= seconds / 2]
            if not shorter:
                break
            seconds = shorter[-1]
        raise AcquisitionError(
            f"white is full in the shortest exposure that was tried, {seconds:.4g} s; close the aperture, or "
            "lower the camera's gain"
        )

    def _refuse_drift(self, codes: np.ndarray, seconds: float, frame: Frame, noise: float) -> None:
        mean = frame.cells.mean(axis=(0, 1))
        before = self._brightness.setdefault(_shot(codes, seconds), mean)
        off, beyond = drifted(mean, before, _DIM, noise)
        if beyond > self._drift:
            raise AcquisitionError(
                f"it is {off:.1%} brighter or darker than an earlier one of the same codes and seconds, "
                f"drift={self._drift:g} accepts {self._drift:.1%}: the camera, the projector or the light of "
                "the room drifts"
            )


def _shot(codes: np.ndarray, seconds: float) -> tuple[bytes, float]:
    told = repr(codes.shape).encode() + codes.tobytes()
    return hashlib.blake2b(told, digest_size=16).digest(), seconds


def _refuse_lacking(name: str, given: Any, wanted: tuple[str, ...]) -> None:
    lacking = [part for part in wanted if not hasattr(given, part)]
    if lacking:
        raise InputTypeError(
            f"{name} is a {type(given).__name__} without {', '.join(lacking)}; it must have them"
        )


def _period(given: str | float | None, display: Any) -> float | None:
    if given != "display":
        return None if given is None else checks.number("period", given, above=0.0, most=1.0)
    if display.period is None:
        _log.warning("the display does not tell its period: exposures are not checked for whole periods")
        return None
    return checks.number("display.period", display.period, above=0.0, most=1.0)
