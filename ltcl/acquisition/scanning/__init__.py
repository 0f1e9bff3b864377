# SPDX-License-Identifier: BSD-3-Clause
"""Scanning T: the order in which pixels are lit, and T from the pictures.

columns, adaptive, sketch, direct
                     strategies: batches of columns; cells that are divided where needed; few
                     patterns, from which T is estimated; fine patterns, for direct light alone
pictures             pictures of patterns on the pixels of the scan; `picture_log` keeps them
plan, pace, report   photographs, time and errors before a scan; its result after it
"""

from __future__ import annotations

from ltcl.acquisition.scanning.columns import Hadamard, Pixels
from ltcl.acquisition.scanning.plan import Light, Plan, plans
from ltcl.acquisition.scanning.report import Report

__all__ = ["Hadamard", "Light", "Pixels", "Plan", "Report", "plans"]
