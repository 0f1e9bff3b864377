# SPDX-License-Identifier: BSD-3-Clause
from __future__ import annotations

import os

import pytest


@pytest.fixture(autouse=True)
def disk_without_delay(monkeypatch: pytest.MonkeyPatch) -> None:
    """Flushing matters to a power cut, which no test can cause; `test_flushing.py` counts the calls."""
    monkeypatch.setattr(os, "fsync", lambda handle: None)
