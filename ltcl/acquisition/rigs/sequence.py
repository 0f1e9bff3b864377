# SPDX-License-Identifier: BSD-3-Clause
"""Whether photographs belong together: one size and kind, exposed as asked, in the order of the list."""

from __future__ import annotations

from bisect import bisect_left
from datetime import datetime

import numpy as np

from ltcl.acquisition.rigs.exif import Taken
from ltcl.acquisition.rigs.photographs import Photograph
from ltcl.errors import AcquisitionError

_OFF = 0.05  # EXIF rounds to nominal values, 1/30 s for 1/32 s; no neighbouring third of a stop is as near


class Sequence:
    """Remembers the photographs that passed, and refuses one that does not fit them.

    Parameters
    ----------
    in_order : bool
        Whether times must rise with the numbers, as far as files tell them.
    """

    def __init__(self, *, in_order: bool) -> None:
        self._in_order = in_order
        self._first: tuple[str, tuple[int, ...], np.dtype] | None = None
        self._numbers: list[int] = []  # ascending; of the photographs whose times are known
        self._times: dict[int, datetime] = {}

    def check(self, name: str, number: int, seconds: float, photograph: Photograph) -> None:
        """Refuse a photograph of another size or kind, another exposure than `seconds`, or out of order.

        A number that passed is not checked again.

        Raises
        ------
        AcquisitionError
            It begins with `name`. What is refused is not remembered.
        """
        codes, taken = photograph
        first, shape, dtype = self._first or (name, codes.shape, codes.dtype)
        if (codes.shape, codes.dtype) != (shape, dtype):
            raise AcquisitionError(
                f"{name} is {codes.dtype} {codes.shape}; it must be {dtype} {shape}, as {first} is"
            )
        if taken.seconds is not None and abs(taken.seconds / seconds - 1.0) > _OFF:
            raise AcquisitionError(
                f"{name} was exposed for {taken.seconds:.4g} s by its EXIF; the list asks {seconds:.4g} s"
            )
        self._check_time(name, number, taken)
        self._first = first, shape, dtype

    def _check_time(self, name: str, number: int, taken: Taken) -> None:
        time = taken.time
        if time is None or not self._in_order:
            return
        place = bisect_left(self._numbers, number)
        for other in [*self._numbers[:place][-1:], *self._numbers[place : place + 1]]:
            if (time < self._times[other]) if other < number else (time > self._times[other]):
                raise AcquisitionError(
                    f"{name} was taken at {time}, photograph {other} at {self._times[other]}, against the "
                    "order of the list; put them right (in_order=False allows one that was taken again)"
                )
        self._numbers.insert(place, number)
        self._times[number] = time
