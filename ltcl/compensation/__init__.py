# SPDX-License-Identifier: BSD-3-Clause
"""Radiometric compensation: the projector pattern that makes the scene look as desired (section 8.2)."""

from __future__ import annotations

from ltcl.compensation.result import Compensation
from ltcl.compensation.task import compensate

__all__ = ["Compensation", "compensate"]
