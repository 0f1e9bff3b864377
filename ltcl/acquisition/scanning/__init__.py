# SPDX-License-Identifier: BSD-3-Clause
"""Scanning T: which pixels are lit when (`columns`, `adaptive`), and T from their `pictures`.

plan, report: what a scan takes, what came of it
"""

from __future__ import annotations

from ltcl.acquisition.scanning.columns import Hadamard, Pixels
from ltcl.acquisition.scanning.plan import Light, Plan, plans
from ltcl.acquisition.scanning.report import Report

__all__ = ["Hadamard", "Light", "Pixels", "Plan", "Report", "plans"]
