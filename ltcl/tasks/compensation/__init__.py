# SPDX-License-Identifier: BSD-3-Clause
"""Radiometric compensation: the pattern that makes the scene look as desired (section 8.2)."""

from __future__ import annotations

from ltcl.tasks.compensation.compensate import compensate
from ltcl.tasks.compensation.compensator import Compensator, FrameError, FrameStatistics
from ltcl.tasks.compensation.inputs import RTOL
from ltcl.tasks.compensation.result import Compensation

__all__ = [
    "RTOL",
    "Compensation",
    "Compensator",
    "FrameError",
    "FrameStatistics",
    "compensate",
]
