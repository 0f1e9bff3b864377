# SPDX-License-Identifier: BSD-3-Clause
"""Changed files are read or refused in one line: seconds by default, minutes by a variable.

LTCL_FUZZ_SECONDS=300 python -m pytest -m '' tests/fuzz
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

# They are not imported here, as atheris changes what it imports.
TARGETS = ("pictures", "films", "stores")
SECONDS = float(os.environ.get("LTCL_FUZZ_SECONDS", "6"))


@pytest.mark.rare
@pytest.mark.parametrize("target", TARGETS)
def test_changed_files_are_read_or_refused(tmp_path, target):
    arguments = ["--seconds", str(SECONDS / len(TARGETS)), "--folder", str(tmp_path)]
    command = [sys.executable, "-m", "tests.fuzz.fuzz", target, *arguments]
    root = Path(__file__).parents[2]
    run = subprocess.run(command, cwd=root, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr[-3000:]
    # FFmpeg and libpng say nothing.
    assert "@ 0x" not in run.stderr
    assert "libpng" not in run.stderr
