# SPDX-License-Identifier: BSD-3-Clause
"""Work on more frames than memory holds, or on many scenes: here, or on the workers of a Dask cluster."""

from __future__ import annotations

from ltcl.batch.frames import CompensatedFrames, compensate_frames
from ltcl.batch.manifest import Record
from ltcl.batch.scenes import map

__all__ = ["CompensatedFrames", "Record", "compensate_frames", "map"]
