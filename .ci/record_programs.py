# SPDX-License-Identifier: BSD-3-Clause
"""Pytest plugin: write down every program of `kernels/` that tests build, with its defines.

`LTCL_PROGRAMS` names the file, in JSON, which `bench/gpu_static.py --programs` reads. Tests run in
one process, as with ``-n 0``. Programs that do not compile, and those of a test's own folder, are
left out.
"""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

from ltcl.device import Device, sources

KERNELS = sources.folder()

_build = sources.build
_programs: dict[str, dict[str, Any]] = {}


def _recorded(device: Device, file: str, defines: dict[str, Any]) -> Any:
    """Build a program, and write it down if it compiles."""
    program = _build(device, file, defines)
    if sources.folder() == KERNELS:
        entry = {
            "file": file,
            "defines": {name: str(value) for name, value in sorted(defines.items())},
            "shape": device.kind,
        }
        _programs[json.dumps(entry)] = entry
        # At once: whoever ends the run keeps what there is.
        path = Path(os.environ["LTCL_PROGRAMS"])
        path.write_text(json.dumps(list(_programs.values()), indent=1), encoding="utf-8")
    return program


sources.build = _recorded
