# SPDX-License-Identifier: BSD-3-Clause
"""Huge pages are asked for where they help, and never needed."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from ltcl.device import huge_pages

SWITCH = Path("/sys/kernel/mm/transparent_hugepage/enabled")


# In a process of its own: memory that others gave back may have huge pages already.
UPLOAD = """
import re, sys
from pathlib import Path
import numpy as np
import ltcl

def huge_kilobytes():
    maps = Path("/proc/self/smaps").read_text(encoding="utf-8")
    return sum(map(int, re.findall(r"AnonHugePages:\\s+(\\d+)", maps)))

values = np.ones(1 << 24, np.float32)
device = ltcl.open_device()
before = huge_kilobytes()
array = device.upload(values)
sys.exit(huge_kilobytes() <= before or not (array.get() == 1).all())
"""


@pytest.mark.slow
def test_large_buffers_get_huge_pages(device):
    is_given = SWITCH.is_file() and "[never]" not in SWITCH.read_text(encoding="utf-8")
    if not is_given or not device.is_cpu or "Portable Computing" not in device.driver:
        pytest.skip("this system gives no huge pages to buffers")
    assert subprocess.run([sys.executable, "-c", UPLOAD], check=False).returncode == 0


def test_buffers_do_without_huge_pages(device, monkeypatch):
    def refuse(*_):
        raise device.cl.LogicError("no map")

    monkeypatch.setattr(device.cl, "enqueue_map_buffer", refuse)
    huge_pages.ask(device, device.empty(1).buffer, huge_pages.MIN_BYTES)
    array = device.upload(np.ones(huge_pages.MIN_BYTES))
    np.testing.assert_array_equal(array.get(), 1)
