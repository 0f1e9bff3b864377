# SPDX-License-Identifier: BSD-3-Clause
"""Scanning T: which pixels are lit when, and T from the pictures.

pictures (with checks): a calibrated rig as a camera on the pixels of the scan, and the log of its pictures;
columns: batches of columns into a store; adaptive: cells lit together that do not conflict;
plan, forecast, report: what a scan takes, the error of its T, what came of it
"""

from __future__ import annotations

from ltcl.acquisition.scanning.columns import Hadamard, Pixels
from ltcl.acquisition.scanning.plan import Light, Plan, plans
from ltcl.acquisition.scanning.report import Report

__all__ = ["Hadamard", "Light", "Pixels", "Plan", "Report", "plans"]
