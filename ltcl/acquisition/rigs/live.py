# SPDX-License-Identifier: BSD-3-Clause
"""`LiveRig`: a camera on a cable photographs what a display shows.

Before the first photograph `survey` measures latency and noise, and refuses a camera that adapts. Later each
photograph must be as bright as an earlier one of the same codes and seconds, and each frame is checked:

    wait        as long as the slowest flash of the survey took, and a margin; what comes is dropped
    steady?     two frames in a row must be the same but for noise: no half-changed (torn) one passes
    fresh?      where codes or exposure changed and the frame did not, or both changed, it may be an old one:
                a flash, white or black, is shown in between and must be seen to come and to go

A frame that fails is taken again, some times, then refused by the photograph's number. An old frame passes
only where the camera could not distinguish it from the right one.

Most projectors show colours one after the other, or switch mirrors, within each picture. An exposure of n + f
periods, 0 < f < 1, catches a part of one period that depends on when it begins: up to f / (n + f) of white
light, three times that of a colour that is shown a third of the time. So exposures are offered only where the
nearest whole number of periods is within 2 % of them, as it is of all long ones.
"""

from __future__ import annotations

import contextlib
import logging
from dataclasses import asdict
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.acquisition.fingerprint import shot_key
from ltcl.acquisition.rig import (
    LONGEST,
    SHORTEST,
    as_codes,
    as_seconds,
    check_photograph,
    exact,
    require_members,
    to_unit,
)
from ltcl.acquisition.rigs.survey import (
    BRIGHT,
    Frame,
    Stage,
    Survey,
    cells,
    change,
    drift,
    is_saturated,
    survey,
)
from ltcl.errors import AcquisitionError, InputError

_log = logging.getLogger(__name__)
_USUAL = 1 / 15  # seconds: the survey begins no longer than that
_TRIALS = 6  # exposures for the survey, each half the one before
_DIM = 0.1  # of full scale: brightness is compared relative to that at least
_BROKEN = 0.02  # of an exposure, beside whole periods
_TWINS = 3  # frames without any difference before a camera counts as free of noise
_PLAIN = 4.0  # times the tolerance: what must be seen
_STEPS = (1, 2, 3, 4, 6, 8, 12, 16)  # periods, about half a stop apart, then doubled on and on


class LiveRig(contextlib.AbstractContextManager):
    """A camera and a display.

    Parameters
    ----------
    camera : object
        `OpenCVCamera`, `GPhoto2Camera`, or any with `channels`, 1 or 3; `stream`, whether frames come by
        themselves and may wait in a queue; `expose(seconds)`; and `frame()`, uint8, uint16 or float, (H, W)
        or (H, W, 3). Used where it has them: `exposures`, seconds, ascending (else any within `limits`, else
        1e-4 to 30); `bits` of uint16 (else 16); `describe()`, a dict of plain JSON; `close()`.
    display : object
        `Display`, or any with `grid`, `period` and `show(codes)`.
    period : "display", float or None
        Seconds of one picture of the projector: only multiples of it are offered as `exposures`. "display":
        as its driver says. None: the projector's light is steady (LCD, LCoS), and any exposure will do.
    margin : float
        Seconds to wait beyond the slowest flash.
    drift : float
        Largest relative difference of brightness between identical shots, in excess of noise.
    retakes : int
        Further frames before a photograph is refused.
    flashes : int
        For the latency, half of them to white.
    patience : float
        Seconds within which everything is at rest; no latency may be longer.

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
        require_members("camera", camera, "channels", "stream", "expose", "frame")
        require_members("display", display, "grid", "period", "show")
        self.projector_grid = checks.grid("display.grid", display.grid)
        self.channels = checks.one_of("camera.channels", camera.channels, (1, 3))
        self.bits = getattr(camera, "bits", None)
        if period == "display" and display.period is None:
            _log.warning("the display has no known period: exposures are not checked for whole periods")
        period = display.period if period == "display" else period
        self._period = None if period is None else checks.number("period", period, above=0.0, most=1.0)
        self.exposures = getattr(camera, "exposures", None)
        if self._period is not None:
            limits = getattr(camera, "limits", (SHORTEST, LONGEST))
            self.exposures = _whole_periods(self.exposures, self._period, limits)
        self._margin = checks.number("margin", margin, least=0.0, most=10.0)
        self._drift = checks.number("drift", drift, above=0.0, below=1.0)
        self._retakes = checks.count("retakes", retakes, least=0)
        self._flashes = checks.count("flashes", flashes, least=2)
        self._patience = checks.number("patience", patience, above=0.0, most=60.0)
        self._stage = Stage(camera, display)
        self._freshness: Freshness | None = None
        self._count = 0
        self._brightness: dict[str, np.ndarray] = {}

    def photograph(self, codes: Any, seconds: float) -> np.ndarray:
        """What the camera gives under `codes`, (h, w) or (h, w, 3) in [0, 1], checked: as `camera.frame()`.

        InputError for unusable codes or seconds; AcquisitionError where the camera is gone, adapts, drifts,
        or shows old or half-changed frames: the number of the photograph and the figure are named.
        """
        codes, seconds = self._validate(codes, seconds)
        try:
            if self._freshness is None:
                measured = survey(
                    self._stage,
                    self._survey_exposure(),
                    flashes=self._flashes,
                    patience=self._patience,
                    accepted=self._drift,
                )
                _log.info("%s", measured)
                self._freshness = Freshness(self._stage, measured, self._margin, self._retakes)
            frame = self._freshness.frame(codes, seconds)
            mean = frame.cells.mean(axis=(0, 1))
            before = self._brightness.setdefault(shot_key(codes, seconds), mean)
            relative, beyond = drift(mean, before, _DIM, self._freshness.survey.noise)
            if beyond > self._drift:
                raise AcquisitionError(
                    f"brightness deviates by {relative:.1%} from an earlier one of the same codes and "
                    f"seconds, drift={self._drift:g}: camera, projector or the light of the room drifts"
                )
        except AcquisitionError as error:
            raise AcquisitionError(f"photograph {self._count + 1}: {error}") from error
        self._count += 1
        return frame.codes

    def recall(self, codes: Any, seconds: float, image: np.ndarray) -> None:
        """Remember a photograph of an earlier session: one of the same shot must be as bright."""
        codes, seconds = self._validate(codes, seconds)
        check_photograph("image", image, self.channels)
        brightness = cells(to_unit("image", image, self._stage.camera)).mean(axis=(0, 1))
        self._brightness.setdefault(shot_key(codes, seconds), brightness)
        self._count += 1

    @property
    def survey(self) -> Survey | None:
        """What was measured; None before the first photograph."""
        return None if self._freshness is None else self._freshness.survey

    def describe(self) -> dict[str, Any]:
        """The rig as plain JSON."""
        parts = (self._stage.camera, self._stage.display)
        camera, display = (getattr(p, "describe", lambda p=p: {"kind": type(p).__name__})() for p in parts)
        return {
            "kind": "live",
            "projector_grid": list(self.projector_grid),
            "channels": self.channels,
            "camera": camera,
            "display": display,
            "period": self._period,
            "exposures": None if self.exposures is None else list(self.exposures),
            "survey": None if self.survey is None else asdict(self.survey),
        }

    def close(self) -> None:
        """Close camera and display, where they can be closed."""
        for part in (self._stage.camera, self._stage.display):
            getattr(part, "close", lambda: None)()

    def __exit__(self, *_: object) -> None:
        self.close()

    def _validate(self, codes: Any, seconds: Any) -> tuple[np.ndarray, float]:
        codes, seconds = as_codes(codes, self.projector_grid, self.channels), as_seconds(seconds)
        return codes, seconds if self.exposures is None else exact("seconds", seconds, self.exposures)

    def _survey_exposure(self) -> float:
        """An exposure in which white is not saturated."""
        offered = self.exposures or tuple(_USUAL / 2**k for k in reversed(range(_TRIALS)))
        seconds = max((s for s in offered if s <= _USUAL), default=offered[0])
        for _ in range(_TRIALS):
            if not is_saturated(self._stage, seconds, self._patience):
                return seconds
            shorter = [s for s in offered if s <= seconds / 2]
            if not shorter:
                break
            seconds = shorter[-1]
        raise AcquisitionError(
            f"white is saturated at {seconds:.4g} s; close the aperture, or lower the gain"
        )


class Freshness:
    """Takes frames and checks them: waits `margin` seconds beyond the slowest flash, retakes so many."""

    def __init__(self, stage: Stage, survey: Survey, margin: float, retakes: int) -> None:
        self.survey = survey
        self._stage, self._margin, self._retakes = stage, margin, retakes
        self._shown: np.ndarray | None = None
        self._last: Frame | None = None

    def frame(self, codes: np.ndarray, seconds: float) -> Frame:
        """A frame of `codes`, exposed for `seconds`; AcquisitionError where frames stay unsteady or old."""
        shown, last = self._shown, self._last
        self._shown = self._last = None  # after an error nothing is known of the frames to come
        moved = shown is None or not np.array_equal(shown, codes)
        timed = self._stage.seconds != seconds
        self._stage.expose(seconds)
        if moved:
            self._stage.show(codes)
        frame = self._steady()
        seen = last is not None and self._unlike(frame, last)
        if (moved and timed) or ((moved or timed) and not seen):
            frame = self._after_flash(codes, frame)
        self._shown, self._last = codes.copy(), frame
        return frame

    def _unlike(self, a: Frame, b: Frame) -> bool:
        return change(a, b) > self.survey.tolerance

    def _steady(self) -> Frame:
        """The second of two frames in a row that are the same but for noise."""
        wait = self.survey.worst + self._margin
        if self._stage.camera.stream and self._stage.seconds is not None:
            # A frame comes at the end of its exposure, and the survey's was not that long.
            wait += max(0.0, self._stage.seconds - self.survey.seconds)
        self._stage.settle(wait)
        first, twins, changed, tries = self._stage.frame(), 0, 0.0, self._retakes + 1
        while tries:
            second = self._stage.frame()
            if np.array_equal(first.codes, second.codes) and twins < _TWINS:
                twins += 1  # the same frame once more, perhaps
                continue
            changed = change(first, second)
            if changed <= self.survey.tolerance:
                return second
            first, twins, tries = second, 0, tries - 1
        raise AcquisitionError(
            f"frames still change by {changed:.1%} of full scale, {self.survey.tolerance:.1%} is noise: "
            "half-changed frames, flicker, or something moves"
        )

    def _after_flash(self, codes: np.ndarray, frame: Frame) -> Frame:
        """A frame that is newer than a flash which was seen to come."""
        flash = self._flash(codes, frame)
        for _ in range(self._retakes + 1):
            self._stage.show(codes)
            fresh = self._steady()
            if flash is None or self._unlike(fresh, flash):
                return fresh
        raise AcquisitionError(f"the frame is stale: {self._retakes + 1} frames showed the pattern before")

    def _flash(self, codes: np.ndarray, frame: Frame) -> Frame | None:
        """The frame of a flash unlike `frame`; None where none differs from it in this exposure.

        White only adds light, black only removes it: unlike `frame` alone could be an earlier flash, late.
        """
        first = 1.0 if float(codes.mean()) < 0.5 else 0.0
        tolerance = self.survey.tolerance
        part = min(1.0, (self._stage.seconds or 0.0) / self.survey.seconds)
        must_differ = self.survey.contrast * part > _PLAIN * tolerance and frame.cells.min() < BRIGHT
        for code in (first, 1.0 - first):
            for _ in range(self._retakes + 1 if must_differ else 1):
                self._stage.show(code)
                flash = self._steady()
                step = (flash.cells - frame.cells) * (2 * code - 1)
                if step.max() > tolerance and step.min() >= -tolerance:
                    return flash
        if must_differ:
            raise AcquisitionError("the frame is stale: the camera sees no flash of the display any more")
        return None


def _whole_periods(
    offered: tuple[float, ...] | None, period: float, limits: tuple[float, float]
) -> tuple[float, ...]:
    """The camera's exposures that see whole periods; multiples of the period where it has any in `limits`.

    >>> _whole_periods((1 / 125, 1 / 60, 1 / 50, 1 / 30), 1 / 60, (1e-4, 30))
    (0.016666666666666666, 0.03333333333333333)
    """
    if offered is None:
        most = int(limits[1] / period * (1 + 1e-9))
        counts = {step << k for step in _STEPS for k in range(most.bit_length()) if step << k <= most}
        whole = tuple(count * period for count in sorted(counts) if count * period >= limits[0])
    else:
        counts = {seconds: round(seconds / period) for seconds in offered}
        whole = tuple(t for t, n in counts.items() if n and abs(t - n * period) <= _BROKEN * t)
        limits = offered[0], offered[-1]
    if not whole:
        span = f"{limits[0]:.4g} to {limits[1]:.4g} s"
        raise InputError(f"period is {period:.4g} s; exposures of the camera, {span}, hold no multiple of it")
    return whole
