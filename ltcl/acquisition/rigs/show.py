# SPDX-License-Identifier: BSD-3-Clause
"""`show`: the patterns of a folder, one after the other, full screen on a projector."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from ltcl import checks, images
from ltcl.acquisition.rig import require_members
from ltcl.acquisition.rigs.display import Display
from ltcl.acquisition.rigs.folder import ShootingList, Shot, find_photographs, inside, natural_order
from ltcl.errors import FileError, InputError
from ltcl.files import as_path

_POLL = 0.05  # seconds


def show(
    folder: str | os.PathLike[str],
    display: Any = 1,
    advance: str | float = "key",
    progress: Callable[[Shot, int, int], None] | None = None,
) -> int:
    """Show the patterns of a folder, one after the other, without smoothing.

    Of a `FolderRig` in the order of the shooting list, without photographs that are there already; else the
    pictures of the folder in the order of the numbers in their names.

    Parameters
    ----------
    folder : path
    display : int or object
        Number of the display, from 0; or what has `show(codes)` and `key_pressed()`, such as a `Display`.
    advance : "key", "arrival" or float
        When the next one is shown: after a key, when the photograph is in the folder, or after seconds.
    progress : function, optional
        Called with the `Shot` that is now on the display (number, pattern, seconds, save_as), how many were
        before it, and how many there are.

    Returns
    -------
    int
        How many were shown. InputError or FileError for no such display, an unusable `advance`, nothing to
        show; AcquisitionError where the display was closed, or pygame-ce is missing.

    Examples
    --------
    >>> import tempfile
    >>> from ltcl.acquisition import FolderRig
    >>> class Screen:
    ...     def show(self, codes): ...
    ...     def key_pressed(self):
    ...         return True
    >>> rig = FolderRig(tempfile.mkdtemp(), (2, 2), projector=(4, 8))
    >>> rig.prepare([(np.eye(2), 0.5), (np.ones((2, 2)), 0.5)])
    >>> show(rig.folder, Screen(), progress=lambda shot, done, total: print(shot.pattern, done, total))
    patterns/pattern_000001.png 0 2
    patterns/pattern_000002.png 1 2
    2
    """
    folder = as_path(folder)
    if isinstance(advance, str) and advance not in ("key", "arrival"):
        raise InputError(f"advance is {advance!r}; it must be 'key', 'arrival' or seconds")
    if not isinstance(advance, str):
        checks.number("advance", advance, above=0.0)
    if not isinstance(display, int):
        require_members("display", display, "show", "key_pressed")
    listed = ShootingList(folder).shots
    shots = [shot for shot in listed if shot.number not in find_photographs(folder, len(listed))[0]]
    if not listed and advance != "arrival":
        paths = sorted(folder.iterdir(), key=natural_order) if folder.is_dir() else []
        names = [path.name for path in paths if path.suffix.lower() in images.BITS]
        shots = [Shot(number, name, 0.0, "") for number, name in enumerate(names, 1)]
    if not listed and not shots:
        raise FileError(f"{folder}: has no shooting list, which 'ltcl acquire run' writes, and no pictures")
    screen = None if isinstance(display, int) else display
    try:
        for done, shot in enumerate(shots):
            codes = images.read_codes(inside(folder, shot.pattern))
            if codes.dtype.kind == "u":
                codes = codes / np.float32(np.iinfo(codes.dtype).max)
            if screen is None:
                screen = Display((codes.shape[0], codes.shape[1]), index=display)
            screen.show(codes)
            if progress is not None:
                progress(shot, done, len(shots))
            start = time.monotonic()
            while not (
                (screen.key_pressed() and advance == "key")
                or (advance == "arrival" and shot.number in find_photographs(folder, len(listed))[0])
                or (not isinstance(advance, str) and time.monotonic() - start >= advance)
            ):
                time.sleep(_POLL)
    finally:
        if screen is not None and screen is not display:
            screen.close()
    return len(shots)
