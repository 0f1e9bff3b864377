# SPDX-License-Identifier: BSD-3-Clause
"""`Freshness`: frames of a stage that show what was asked for, and nothing of what was there before.

    wait        as long as the slowest flash of the survey took, and a margin; what comes is thrown away
    steady?     two frames in a row must be the same but for noise: no half-changed (torn) one passes
    fresh?      where codes or exposure changed and the frame did not, or both changed, it may be an old one:
                a flash, white or black, is shown in between and must be seen to come and to go

A frame that fails is taken again, some times. An old frame passes only where the camera could not tell it
from the right one.
"""

from __future__ import annotations

import numpy as np

from ltcl.acquisition.rigs.stage import Frame, Stage, change
from ltcl.acquisition.rigs.survey import BRIGHT, Survey
from ltcl.errors import AcquisitionError

_TWINS = 3  # frames without any difference before a camera counts as free of noise
_PLAIN = 4.0  # times the tolerance: what must be seen


class Freshness:
    """Takes frames and checks them.

    Parameters
    ----------
    stage : Stage
    survey : Survey
        Of the stage.
    margin : float
        Seconds to wait beyond the slowest flash.
    retakes : int
        Further frames before one is refused.
    """

    def __init__(self, stage: Stage, survey: Survey, margin: float, retakes: int) -> None:
        self.survey = survey
        self._stage, self._margin, self._retakes = stage, margin, retakes
        self._shown: np.ndarray | None = None
        self._last: Frame | None = None

    def frame(self, codes: np.ndarray, seconds: float) -> Frame:
        """A frame of `codes`, exposed for `seconds`.

        Raises
        ------
        AcquisitionError
            Frames do not come to rest or stay old.
        """
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
        self._stage.settle(self._wait())
        first, twins, changed = self._stage.frame(), 0, 0.0
        tries = self._retakes + 1
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
            f"frames still change by {changed:.1%} of full scale after {self._retakes} more, noise explains "
            f"{self.survey.tolerance:.1%}: half-changed frames, flicker, or something moves"
        )

    def _wait(self) -> float:
        wait = self.survey.worst + self._margin
        if self._stage.camera.stream and self._stage.seconds is not None:
            # A frame comes at the end of its exposure, and the survey's was not that long.
            wait += max(0.0, self._stage.seconds - self.survey.seconds)
        return wait

    def _after_flash(self, codes: np.ndarray, frame: Frame) -> Frame:
        """A frame that is newer than a flash which was seen to come."""
        flash = self._flash(codes, frame)
        for _ in range(self._retakes + 1):
            self._stage.show(codes)
            fresh = self._steady()
            if flash is None or self._unlike(fresh, flash):
                return fresh
        raise AcquisitionError(
            f"the frame is stale: {self._retakes + 1} times the camera went on showing what was there before"
        )

    def _flash(self, codes: np.ndarray, frame: Frame) -> Frame | None:
        """The frame of a flash unlike `frame`; None where none can be told from it in this exposure."""
        most = 1.0 if float(codes.mean()) < 0.5 else 0.0
        plain = self._plain(frame)
        for code in (most, 1.0 - most):
            for _ in range(self._retakes + 1 if plain else 1):
                self._stage.show(np.full_like(codes, code))
                flash = self._steady()
                if self._came(flash, frame, code):
                    return flash
        if plain:
            raise AcquisitionError("the frame is stale: the camera sees no flash of the display any more")
        return None

    def _came(self, flash: Frame, frame: Frame, code: float) -> bool:
        """Whether the flash is what was shown last: white only adds light, black only takes it away.

        Unlike `frame` alone would not do: an earlier flash may come that late.
        """
        step = (flash.cells - frame.cells) * (2 * code - 1)
        return bool(step.max() > self.survey.tolerance and step.min() >= -self.survey.tolerance)

    def _plain(self, frame: Frame) -> bool:
        """Whether white and black must look different in this exposure."""
        share = min(1.0, (self._stage.seconds or 0.0) / self.survey.seconds)
        return self.survey.contrast * share > _PLAIN * self.survey.tolerance and bool(
            frame.cells.min() < BRIGHT
        )
