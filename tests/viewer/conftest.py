# SPDX-License-Identifier: BSD-3-Clause
"""A Chromium that all tests share."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from typing import Any

import pytest

PROGRAMS = ("chromium", "chromium-browser", "google-chrome")
FLAGS = [
    "--no-sandbox",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--disable-gpu",
    "--enable-unsafe-swiftshader",
]


@pytest.fixture(scope="session")
def browser() -> Iterator[Any]:
    """A browser of Playwright."""
    playwright_api = pytest.importorskip(
        "playwright.sync_api", reason='playwright is not installed: pip install "ltcl[test]"'
    )
    browsers = [path for path in map(shutil.which, PROGRAMS) if path is not None]
    if not browsers:
        pytest.skip("Chromium is not installed (Debian: apt install chromium)")
    with playwright_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=browsers[0], args=FLAGS)
        yield browser
        browser.close()
