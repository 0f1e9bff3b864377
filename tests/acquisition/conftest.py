# SPDX-License-Identifier: BSD-3-Clause
from __future__ import annotations

import pytest


@pytest.fixture(autouse=True)
def without_delay(disk_without_delay: None) -> None:
    """All tests here write stores."""
