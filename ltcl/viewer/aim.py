# SPDX-License-Identifier: BSD-3-Clause
"""`AimScene`: the Scan view of the page while a rig is aimed."""

from __future__ import annotations

import threading
import time
from typing import Any

from ltcl import checks
from ltcl.acquisition.aiming import Reading
from ltcl.viewer.answers import Reply, ViewerScene
from ltcl.viewer.scan import Preview, histogram, thumbnail

# Readings that are kept.
MAX_READINGS = 24


class AimScene(ViewerScene):
    """Readings of a rig as they come; only `scan` and `pictures` may be asked."""

    def __init__(self, title: str) -> None:
        super().__init__(None, title, {}, None)
        self._lock = threading.Lock()
        self._previews: list[Preview] = []
        self._count = 0
        self._warnings: list[str] = []
        self._notes: list[str] = ["no photograph yet"]

    @property
    def questions(self) -> tuple[str, ...]:
        """Questions that may be asked."""
        return ("scan", "pictures")

    def add_reading(self, name: str, reading: Reading) -> None:
        """Show a reading from now on."""
        facts = {
            "name": name,
            "time": time.time(),
            "seconds": reading.seconds,
            "histogram": histogram(reading.picture),
        }
        with self._lock:
            self._count += 1
            preview = Preview(number=self._count, facts=facts, picture=thumbnail(reading.picture))
            self._previews = [*self._previews[1 - MAX_READINGS :], preview]
            self._warnings = reading.advice
            self._notes = reading.facts

    def add_warning(self, text: str) -> None:
        """Show what is wrong with the rig or the newest photograph."""
        with self._lock:
            self._warnings = [text]

    def scan(self, seen: Any) -> Reply:
        """Return the newest facts and warnings, and the previews after the first `seen` ones."""
        checks.count("seen", seen, least=0)
        with self._lock:
            new = [preview for preview in self._previews if preview.number > seen]
            facts = {
                "state": "aim",
                "done": self._count,
                "total": self._count,
                "what": "photographs",
                "left": None,
                "notes": self._notes,
                "warnings": self._warnings,
                "photographs": [preview.facts for preview in new],
                "seen": self._count,
                "finished": False,
            }
            return facts, {str(k): preview.picture for k, preview in enumerate(new)}
