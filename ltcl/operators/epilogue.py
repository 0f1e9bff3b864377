# SPDX-License-Identifier: BSD-3-Clause
"""The terms that a product adds in the same launch: out = a (A x) + b y + c x."""

from __future__ import annotations

from typing import NamedTuple

from ltcl.device import Array


class Epilogue(NamedTuple):
    """out = a (A x) + b y + c x in one launch; y, which may be `out`, is not read where b is 0."""

    a: float = 1.0
    b: float = 0.0
    y: Array | None = None
    c: float = 0.0

    def without_shift(self, x: Array) -> Epilogue:
        """The same epilogue of a product whose operand is not x, if y is free to stand for x.

        x takes the place of y where b is 0; else c remains, and the caller adds c x.
        """
        if self.b == 0.0:
            return Epilogue(a=self.a, b=self.c, y=x)
        return self

    def operand(self, unread: Array) -> Array:
        """y, or an array that stands for it: kernels take one also where b is 0."""
        return unread if self.y is None else self.y

    def added_to(self, out: Array) -> Epilogue:
        """The epilogue of a product that is added to what `out` already holds."""
        return Epilogue(a=self.a, b=1.0, y=out)


PLAIN = Epilogue()  # out = A x

# Right-hand sides that one launch of a product kernel takes.
WIDTHS = (8, 4, 3, 2, 1)


def widths(columns: int) -> list[tuple[int, int]]:
    """Launches for k right-hand sides, as pairs (offset, width): (0, 8) and (8, 3) for 11."""
    pieces = []
    offset = 0
    while offset < columns:
        width = widest_launch(columns - offset)
        pieces.append((offset, width))
        offset += width
    return pieces


def widest_launch(columns: int) -> int:
    """The most right-hand sides that one launch takes of `columns`, at least one."""
    return next(width for width in WIDTHS if width <= columns)
