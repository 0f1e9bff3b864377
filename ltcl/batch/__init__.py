# SPDX-License-Identifier: BSD-3-Clause
"""Work on more frames than memory holds: read ahead, solved side by side, resumable after any end."""

from __future__ import annotations

from ltcl.batch.frames import CompensatedFrames, compensate_frames
from ltcl.batch.manifest import Record

__all__ = ["CompensatedFrames", "Record", "compensate_frames"]
