# SPDX-License-Identifier: BSD-3-Clause
"""Compression in these tests chooses by bytes: times would make them depend on the machine's load."""

from __future__ import annotations

import pytest


@pytest.fixture(autouse=True)
def untimed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("LTCL_TUNE", "0")
