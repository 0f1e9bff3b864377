# SPDX-License-Identifier: BSD-3-Clause
"""Work on more frames than memory holds, or on many scenes, here or on a cluster of Dask."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ltcl.batch.frames import CompensatedFrames, compensate_frames
    from ltcl.batch.manifest import FrameRecord
    from ltcl.batch.scenes import map

__all__ = ["CompensatedFrames", "FrameRecord", "compensate_frames", "map"]

# Loaded at the first use: tasks import `ltcl.batch.cluster`, and films need the tasks.
_MODULES = {
    "CompensatedFrames": "frames",
    "compensate_frames": "frames",
    "FrameRecord": "manifest",
    "map": "scenes",
}


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module 'ltcl.batch' has no attribute {name!r}")
    module = importlib.import_module(f"ltcl.batch.{_MODULES[name]}")
    return getattr(module, name)
