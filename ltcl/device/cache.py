# SPDX-License-Identifier: BSD-3-Clause
"""What ltcl remembers between runs: which drivers are safe, which kernel variant is fastest.

Small JSON files in a private folder (mode 0700) of the user's cache; never pickles. Everything here can be
lost at any time: an unreadable file or an unwritable folder means measuring again, not an error.
`LTCL_CACHE` names another folder.
"""

from __future__ import annotations

import contextlib
import json
import logging
import os
import tempfile
from pathlib import Path
from typing import Any

import platformdirs

log = logging.getLogger(__name__)


def folder() -> Path:
    """The private cache folder; it may not exist yet."""
    named = os.environ.get("LTCL_CACHE")
    return Path(named) if named else Path(platformdirs.user_cache_dir("ltcl", appauthor=False))


def make_folder(name: str = "") -> Path:
    """Create the cache folder, or the folder `name` in it, readable by its owner only."""
    path = folder()
    path.mkdir(mode=0o700, parents=True, exist_ok=True)  # an existing folder keeps its mode: it is the user's
    if name:
        path = path / name
        path.mkdir(mode=0o700, exist_ok=True)
    return path


def recall(file: str, key: str) -> Any:
    """What was remembered in `file` under `key`, or None."""
    return _read(file).get(key)


def remember(file: str, key: str, value: Any) -> None:
    """Remember `value` (plain JSON) in `file` under `key`; silently forget it where that is impossible."""
    try:
        path = make_folder() / file
        content = {**_read(file), key: value}
        handle, aside = tempfile.mkstemp(dir=path.parent, prefix=f".{file}.")
        try:
            with os.fdopen(handle, "w", encoding="utf-8") as stream:
                json.dump(content, stream, indent=1, sort_keys=True)
            os.replace(aside, path)
        except BaseException:
            with contextlib.suppress(OSError):
                os.unlink(aside)
            raise
    except OSError as error:
        log.debug("nothing remembered in %s: %s", file, error)


def _read(file: str) -> dict[str, Any]:
    try:
        content = json.loads((folder() / file).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return content if isinstance(content, dict) else {}
